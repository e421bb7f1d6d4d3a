"""Rollback of a false merge over several steps, which bounds the replayed input per step.

The groups from before the merge are rebuilt from snapshots and catch up, a few steps of input at a time, while their
robots still use the joint filter. When they have caught up they replace it, as if the merge had never happened.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from slam_backend.core.read_only import with_constants
from slam_backend.core.state_checks import refuse_malformed
from slam_backend.fastslam.state_checks import check_filter
from slam_backend.fastslam.step_input import InputBuffer
from slam_backend.team.branches import MAX_REPLAYED, Branch, ReplayedStep, replay
from slam_backend.team.merge_monitor import MergeMonitor, PreMergeSnapshot

LEAST_REPLAYED = 2  # input steps replayed per side and step of the team, which itself adds one


@dataclass(slots=True, eq=False)
class MergeRollback:
    """Progress of the rollback of a merge, and of those on top of it.

    Attributes:
        number: Number of the map that the false merge made.
        sides: Joint filters of the restored groups, on their way to the present.
        replayed: Steps replayed by each side so far.
    """

    number: int
    sides: list[Branch]
    replayed: list[list[ReplayedStep]]

    @classmethod
    def of(cls, trunk: Branch, number: int) -> "MergeRollback":
        """Start the rollback of the merge that made map `number`, monitored by a joint filter.

        Raises:
            ValueError: If a filter from before it is damaged: states share the dicts that hold it with the team.
        """
        before = [side.trunk for side in _sides(trunk.monitors[-1], number)]
        for side in before:
            with refuse_malformed("state"):
                check_filter("state['filter']", side["filter"], (trunk.filter.options,))
        sides = [Branch.from_state(side) for side in before]
        return cls(number, sides, [[] for _ in sides])

    def merges(self, trunk: Branch) -> list[MergeMonitor]:
        """Return the merges to undo, the last one first; none if the joint filter does not monitor the false one."""
        if all(monitor.number != self.number for monitor in trunk.monitors):
            return []
        return list(_down_to(trunk.monitors[-1], self.number))

    def catch_up(self, trunk: Branch, log: InputBuffer) -> bool:
        """Replay some steps that the joint filter has processed, and return whether all sides are up to date."""
        share = max(LEAST_REPLAYED, MAX_REPLAYED // len(self.sides))
        caught_up = True
        for side, done in zip(self.sides, self.replayed, strict=True):
            wanted = {
                robot: trunk.last_steps[robot]
                for robot in side.robots
                if trunk.last_steps[robot] > side.last_steps[robot]
            }
            done += replay(side, log, wanted, share)
            caught_up &= all(side.last_steps[robot] >= last for robot, last in wanted.items())
        return caught_up

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the rollback."""
        return {
            "number": self.number,
            "sides": tuple(side.get_state() for side in self.sides),
            "replayed": tuple(tuple(done) for done in self.replayed),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "MergeRollback":
        """Build a rollback from `get_state`."""
        sides = [Branch.from_state(side) for side in state["sides"]]
        return cls(state["number"], sides, [list(with_constants(done)) for done in state["replayed"]])


def _down_to(monitor: MergeMonitor, number: int) -> Iterator[MergeMonitor]:
    """Yield a merge and those below it, down to the one that made map `number`."""
    yield monitor
    for side in monitor.sides:
        if any(older.number == number for older in side.monitors):
            yield from _down_to(side.monitors[-1], number)


def _sides(monitor: MergeMonitor, number: int) -> Iterator[PreMergeSnapshot]:
    """Yield the groups that remain when a merge and those below it, down to map `number`, are undone."""
    for side in monitor.sides:
        if any(older.number == number for older in side.monitors):
            yield from _sides(side.monitors[-1], number)
        else:
            yield side
