"""Records shared by the groups of a team: inputs, traffic, and changes of maps."""

from collections.abc import Sequence

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import StepReport
from slam_backend.fastslam.step_input import InputBuffer
from slam_backend.state import MAX_LANDMARKS, Child, Each, Generator, Int, State
from slam_backend.team.branches import ReplayedStep
from slam_backend.team.communication import TrafficCounter
from slam_backend.team.reports import MAP_CHANGE, LandmarksCreated, MapChange, MapForked


class SharedRecords:
    """Shared records of a team.

    Args:
        num_robots: K; the first K maps are those of the single robots.
        seed: Seed of the forks' random streams.

    Attributes:
        log: Inputs that may have to be replayed.
        exchange: Traffic counter.
        rng: Generator that seeds the forks' random streams.
        entries: Changes of maps since the last report.
        spare: Filter of the last fork that ended, or None. The next fork takes its memory, for new memory can take ten
            times as long as the copy. Not part of a state.
    """

    STATE = State(
        log=Child(InputBuffer), exchange=Child(TrafficCounter), rng=Generator(), entries=Each(MAP_CHANGE, kind=list),
        next_number=Int(0, MAX_LANDMARKS),
    )  # fmt: skip

    def __init__(self, num_robots: int, seed: np.random.SeedSequence) -> None:
        self.log = InputBuffer()
        self.exchange = TrafficCounter(num_robots)
        self.rng = np.random.default_rng(seed)
        self.entries: list[MapChange] = []
        self.spare: FastSlam | None = None
        self._next_number = num_robots

    def new_number(self) -> int:
        """Return a map number that was never used."""
        self._next_number += 1
        return self._next_number - 1

    def take_spare(self) -> FastSlam | None:
        """Return the filter of the last fork that ended, once."""
        spare, self.spare = self.spare, None
        return spare

    def copied(self, source: int, copy: int) -> None:
        """Record the fork of a filter."""
        self.entries.append(MapForked(source, copy))

    def note_created(self, number: int, step: int, report: StepReport) -> None:
        """Record the landmarks that a step of a map's filter created."""
        for robot in report.rows:
            if robot >= 0 and report.all_associations.created_ids(robot):
                created = as_read_only(report.all_associations.created(robot))
                self.entries.append(LandmarksCreated(number, robot, step, created))

    def note_replay(self, number: int, replayed: Sequence[ReplayedStep]) -> None:
        """Record the landmarks that a replay created in a map."""
        for done in replayed:
            self.note_created(number, done.step, done.report)
