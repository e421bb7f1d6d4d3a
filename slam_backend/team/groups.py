"""Groups of robots that share a map frame, and the assignment of robots to groups and filters."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.team.branches import Branch, StepRouting, fork, landmark_counts, missing, replay, split_by_component
from slam_backend.team.merge_monitor import MergeMonitor
from slam_backend.team.merge_rollback import MergeRollback
from slam_backend.team.shared_records import SharedRecords


class Group:
    """Group of robots in ascending order; the map frame is the start frame of the lowest.

    Args:
        trunk: Branch of the joint filter.
        forks: Branches of robots that are out of contact with it.

    Attributes:
        branches: The trunk, then the forks. Each robot uses exactly one of them.
        undoing: Rollback of a merge in progress, or None.
    """

    def __init__(self, trunk: Branch, forks: Sequence[Branch] = ()) -> None:
        self.branches = [trunk, *forks]
        self.undoing: MergeRollback | None = None

    @property
    def trunk(self) -> Branch:
        """The branch of the joint filter."""
        return self.branches[0]

    @property
    def robots(self) -> tuple[int, ...]:
        """All robots of the group."""
        return self.branches[0].robots

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

    # ------------------------------------------------------------------ snapshots

    def steps_unknown(self) -> list[int]:
        """Return the first steps that filters may have to replay; empty if all are up to date."""
        held = [
            1 + last
            for branch in self.branches
            for robot, last in branch.last_steps.items()
            if robot not in branch.active_robots
        ]
        return held + [side.oldest for branch in self.branches for monitor in branch.monitors for side in monitor.sides]

    def numbers(self) -> set[int]:
        """Return the numbers of all maps that the group uses or may restore."""
        monitors = [monitor for branch in self.branches for monitor in branch.monitors]
        return {branch.number for branch in self.branches}.union(*map(_numbers, monitors))

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the group."""
        return {
            "branches": tuple(branch.get_state() for branch in self.branches),
            "undoing": None if self.undoing is None else self.undoing.get_state(),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], at_hand: Mapping[tuple[int, ...], FastSlam] | None = None) -> "Group":
        """Build a group from `get_state`; a given filter with the trunk's robots is reused."""
        at_hand = {} if at_hand is None else at_hand
        trunk, *forks = state["branches"]
        group = cls(
            Branch.from_state(trunk, at_hand.get(trunk["robots"])), [Branch.from_state(branch) for branch in forks]
        )
        group.undoing = None if state["undoing"] is None else MergeRollback.from_state(state["undoing"])
        return group


def _numbers(monitor: MergeMonitor) -> set[int]:
    """Return the numbers of the maps that an undo of a merge would restore."""
    older = [_numbers(one) for side in monitor.sides for one in side.monitors]
    return {side.trunk["number"] for side in monitor.sides}.union(*older)


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
        has_monitors: Whether a merge can still be undone, or is being undone.
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
    has_monitors: bool

    @classmethod
    def of(cls, groups: Sequence[Group]) -> Self:
        """Return the topology of some groups."""
        owned = [(group, branch) for group in groups for branch in group.branches]
        by_robot = {r: (group, branch, branch.robots.index(r)) for group, branch in owned for r in branch.active_robots}
        places = tuple(by_robot[robot] for robot in sorted(by_robot))
        oldest = [step for group in groups for step in group.steps_unknown()]
        return cls(
            groups=tuple(group.robots for group in groups),
            branches=tuple(branch for _, branch in owned),
            routings=tuple(StepRouting.of(branch, branch.active_robots) for _, branch in owned),
            places=places,
            known_robots=tuple(branch.robots for _, branch, _ in places),
            same_filter=tuple(branch.active_robots for _, branch, _ in places),
            maps=tuple(branch.number for _, branch, _ in places),
            numbers=frozenset[int]().union(*(group.numbers() for group in groups)),
            oldest=min(oldest, default=None),
            is_split=len(owned) > len(groups),
            has_monitors=any(branch.monitors or group.undoing is not None for group, branch in owned),
        )
