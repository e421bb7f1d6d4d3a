"""Groups of robots that share a map frame, and the assignment of robots to groups and filters."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.state import Child, Each, Sizes, State
from slam_backend.team.branches import Branch, StepRouting, fork, landmark_counts, missing, replay, split_by_component
from slam_backend.team.shared_records import SharedRecords


class Group:
    """Group of robots in ascending order; the map frame is the start frame of the lowest.

    Args:
        trunk: Branch of the joint filter.
        forks: Branches of robots that are out of contact with it.

    Attributes:
        branches: The trunk, then the forks. Each robot uses exactly one of them.
    """

    STATE = State(branches=Each(Child(Branch), kind=list))

    def __init__(self, trunk: Branch, forks: Sequence[Branch] = ()) -> None:
        self.branches = [trunk, *forks]

    @property
    def trunk(self) -> Branch:
        """The branch of the joint filter."""
        return self.branches[0]

    @property
    def robots(self) -> tuple[int, ...]:
        """All robots of the group."""
        return self.branches[0].robots

    @property
    def merge_numbers(self) -> list[int]:
        """Numbers of the merges that the joint filter monitors, oldest first."""
        return self.branches[0].merge_numbers

    # ------------------------------------------------------------------ loss and return of contact

    def update_connectivity(self, networks: IntArray, records: SharedRecords) -> None:
        """Fork filters whose robots have lost contact, and replay the inputs of returning robots.

        Args:
            networks: (K,) robots with the same number are in contact.
            records: Records of the team.
        """
        if len(self.robots) == 1:
            return
        for branch in list(self.branches):
            for part in split_by_component(branch.active_robots, networks)[1:]:
                copied = fork(branch, part, records.new_number(), records.rng, records.take_spare())
                records.copied(branch.number, copied.number)
                branch.active_robots = tuple(robot for robot in branch.active_robots if robot not in part)
                self.branches.append(copied)
        if len(self.branches) > 1:
            self._choose_trunk(networks)
            for network in np.unique(networks[list(self.robots)]):
                here = [branch for branch in self.branches if networks[branch.active_robots[0]] == network]
                if len(here) > 1:
                    self._rejoin(here, records)

    def _choose_trunk(self, networks: IntArray) -> None:
        """Pass the joint filter to robots that meet other groups, if its own robots meet none, so that they can merge.

        A fork can replace the trunk unless the trunk has had a merge or an undo since the fork.
        """
        outside = set(np.delete(networks, self.robots).tolist())
        meeting = [branch for branch in self.branches if networks[branch.active_robots[0]] in outside]
        meeting = [branch for branch in meeting if branch.epoch == self.trunk.epoch]
        if meeting and self.trunk not in meeting:
            old, new = self.trunk, meeting[0]
            old.split_from, old.split_counts = new.number, dict(new.split_counts)
            self.branches = [new, *(branch for branch in self.branches if branch is not new)]

    def _rejoin(self, here: list[Branch], records: SharedRecords) -> None:
        """Replay in the best informed of some branches in contact what the others know, and end those it covers."""
        main = max(here, key=self._rank)
        others = [branch for branch in here if branch is not main and set(branch.active_robots) <= set(main.robots)]
        wanted: dict[int, int] = {}
        for other in others:
            for robot, last in missing(main, other).items():
                wanted[robot] = max(last, wanted.get(robot, -1))
        done = replay(main, records.log, wanted)
        records.note_replay(main.number, done)
        records.exchange.record_replay(done)
        for other in others:
            known = other.known_landmarks(main, done)
            if all(main.last_steps[robot] == other.last_steps[robot] for robot in other.active_robots):
                counts, size = landmark_counts(main.filter), main.filter.descriptor_size
                records.exchange.record_return(main.active_robots[0], known, counts, size)
                main.active_robots = tuple(sorted(main.active_robots + other.active_robots))
                self.branches = [branch for branch in self.branches if branch is not other]
                records.spare = other.filter

    def _rank(self, branch: Branch) -> tuple[bool, int, int, int]:
        """Return the sort key of branches in contact: the trunk first, then the one with the most merges."""
        return branch is self.trunk, branch.epoch, len(branch.active_robots), -branch.active_robots[0]

    def drop_monitors(self, watch_steps: int) -> bool:
        """End the monitoring of merges after so many steps, oldest first; return whether any ended."""
        ended = False
        for branch in self.branches:
            while branch.monitors and branch.monitors[0].steps >= watch_steps:
                branch.monitors.pop(0)
                ended = True
        return ended

    # ------------------------------------------------------------------ snapshots

    def steps_unknown(self) -> list[int]:
        """Return the first steps that filters may have to replay for robots that return; empty if none."""
        return [
            1 + last
            for branch in self.branches
            for robot, last in branch.last_steps.items()
            if robot not in branch.active_robots
        ]

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless each robot of the group is active in one branch, which is up to date with it."""
        active = [robot for branch in parts["branches"] for robot in branch["active_robots"]]
        if not parts["branches"] or tuple(sorted(active)) != parts["branches"][0]["robots"]:
            raise ValueError("a robot that is not active in exactly one branch")
        for branch in parts["branches"]:
            last = {branch["last_steps"][robot] for robot in branch["active_robots"]}
            if last != {sizes["STEPS"] - 1}:
                raise ValueError("a branch without active robots, or with one whose last step is not that of the team")


class TeamTopology(NamedTuple):
    """Assignment of robots to groups and filters, valid until a group, branch or monitor starts or ends.

    Attributes:
        groups: The robots of each group, by ascending first robot.
        branches: Branches of all groups.
        routings: Step routing of each branch.
        places: Group, branch, and index in the branch of each robot.
        known_robots: Robots in the filter of each robot, itself included, ascending.
        same_filter: Robots that use the same filter as each robot, itself included, ascending.
        maps: Number of each robot's map.
        numbers: Numbers of all maps that are in use or may be restored.
        oldest: First step that a filter may have to replay; None: none.
        is_split: Whether some robots are out of contact with their group's joint filter.
    """

    groups: tuple[tuple[int, ...], ...]
    branches: tuple[Branch, ...]
    routings: tuple[StepRouting, ...]
    places: tuple[tuple[Group, Branch, int], ...]
    known_robots: tuple[tuple[int, ...], ...]
    same_filter: tuple[tuple[int, ...], ...]
    maps: tuple[int, ...]
    numbers: frozenset[int]
    oldest: int | None
    is_split: bool

    @classmethod
    def of(cls, groups: Sequence[Group], restorable: Sequence[tuple[int, set[int]]]) -> Self:
        """Return the topology of some groups.

        Args:
            groups: The groups.
            restorable: First step to replay and the numbers of the restored maps, if a merge is undone, of each merge.
        """
        owned = [(group, branch) for group in groups for branch in group.branches]
        by_robot = {r: (group, branch, branch.robots.index(r)) for group, branch in owned for r in branch.active_robots}
        places = tuple(by_robot[robot] for robot in sorted(by_robot))
        oldest = [step for group in groups for step in group.steps_unknown()] + [step for step, _ in restorable]
        return cls(
            groups=tuple(group.robots for group in groups),
            branches=tuple(branch for _, branch in owned),
            routings=tuple(StepRouting.of(branch, branch.active_robots) for _, branch in owned),
            places=places,
            known_robots=tuple(branch.robots for _, branch, _ in places),
            same_filter=tuple(branch.active_robots for _, branch, _ in places),
            maps=tuple(branch.number for _, branch, _ in places),
            numbers=frozenset(branch.number for _, branch in owned).union(*(numbers for _, numbers in restorable)),
            oldest=min(oldest, default=None),
            is_split=len(owned) > len(groups),
        )
