"""Records shared by the groups of a team: inputs, traffic, and changes of maps."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend.core.read_only import as_read_only, with_constants
from slam_backend.core.state import accepted, restore, take
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import StepReport
from slam_backend.fastslam.step_input import InputBuffer
from slam_backend.team.branches import ReplayedStep
from slam_backend.team.communication import TrafficCounter
from slam_backend.team.reports import LandmarksCreated, MapChange, MapForked


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

    def __getstate__(self) -> dict[str, Any]:
        """Return the attributes for copies and pickles, which need no spare memory."""
        return vars(self) | {"spare": None}

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the records."""
        return {
            "log": take(self.log),
            "exchange": self.exchange.get_state(),
            "rng": copy.deepcopy(self.rng.bit_generator.state),
            "entries": tuple(self.entries),
            "next_number": self._next_number,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore the records from `get_state`."""
        restore(self.log, accepted(InputBuffer, "state['log']", state["log"]))
        self.exchange.set_state(state["exchange"])
        self.rng.bit_generator.state = copy.deepcopy(state["rng"])
        self.entries = list(with_constants(state["entries"]))
        self._next_number = state["next_number"]
