"""`MergeRollback`: a false merge is taken back over some steps, so that no step has to take in all that was read since.

The groups that there were are taken up again as they were and catch up, a few steps of readings at a time, while their
robots still go by the joint filter. When they have caught up they take over, as if the merge had never been.
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

LEAST_REPLAYED = 2  # per tick and side: one is read in every tick


@dataclass(slots=True, eq=False)
class MergeRollback:
    """Where the taking back of a merge, and of those on top of it, has got to.

    Attributes:
        number: Of the map that the false merge made.
        sides: The joint filters of the groups that there will be, each on its way to the present.
        replayed: What each has taken in so far.
    """

    number: int
    sides: list[Branch]
    replayed: list[list[ReplayedStep]]

    @classmethod
    def of(cls, trunk: Branch, number: int) -> "MergeRollback":
        """Begin to take back the merge that made map `number`, which a joint filter watches.

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
        """Return the merges of a joint filter that go, the last one first; none if it does not watch the false one."""
        if all(watch.number != self.number for watch in trunk.monitors):
            return []
        return list(_down_to(trunk.monitors[-1], self.number))

    def catch_up(self, trunk: Branch, log: InputBuffer) -> bool:
        """Take in some steps of what the joint filter knows, and tell whether that was all."""
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
        """Return all that decides how it goes on."""
        return {
            "number": self.number,
            "sides": tuple(side.get_state() for side in self.sides),
            "replayed": tuple(tuple(done) for done in self.replayed),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any]) -> "MergeRollback":
        """Go on with what `get_state` returned."""
        sides = [Branch.from_state(side) for side in state["sides"]]
        return cls(state["number"], sides, [list(with_constants(done)) for done in state["replayed"]])


def _down_to(watch: MergeMonitor, number: int) -> Iterator[MergeMonitor]:
    """Yield a merge and those under it, down to the one that made map `number`."""
    yield watch
    for side in watch.sides:
        if any(older.number == number for older in side.watches):
            yield from _down_to(side.watches[-1], number)


def _sides(watch: MergeMonitor, number: int) -> Iterator[PreMergeSnapshot]:
    """Yield the groups that are left when a merge and those under it, down to map `number`, are taken back."""
    for side in watch.sides:
        if any(older.number == number for older in side.watches):
            yield from _sides(side.watches[-1], number)
        else:
            yield side
