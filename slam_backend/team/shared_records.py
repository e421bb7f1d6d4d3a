"""`SharedRecords`: what the groups of a team write down in common: readings, bytes, and what becomes of their maps."""

import copy
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend.core.read_only import as_read_only, with_constants
from slam_backend.fastslam.reports import LandmarksCreated, MapChange, MapForked, StepReport
from slam_backend.fastslam.step_input import InputBuffer
from slam_backend.team.branches import ReplayedStep
from slam_backend.team.communication import TrafficCounter


class SharedRecords:
    """The common records of a team.

    Args:
        num_robots: K; the first K maps are those of the robots alone.
        seed: Of the streams from which forks draw.

    Attributes:
        log: What was read and may have to be taken in again.
        exchange: Counts bytes.
        rng: From which forks get their own streams.
        entries: What happened to maps since the last report.
    """

    def __init__(self, num_robots: int, seed: np.random.SeedSequence) -> None:
        self.log = InputBuffer()
        self.exchange = TrafficCounter(num_robots)
        self.rng = np.random.default_rng(seed)
        self.entries: list[MapChange] = []
        self._next_number = num_robots

    def new_number(self) -> int:
        """Return a number that no map has had."""
        self._next_number += 1
        return self._next_number - 1

    def copied(self, source: int, copy: int) -> None:
        """Write down that a filter forked."""
        self.entries.append(MapForked(source, copy))

    def note_created(self, number: int, step: int, report: StepReport) -> None:
        """Write down which landmarks a step of the filter of a map created."""
        for robot in report.rows:
            if robot >= 0 and report.all_associations.created_ids(robot):
                created = as_read_only(report.all_associations.created(robot))
                self.entries.append(LandmarksCreated(number, robot, step, created))

    def note_replay(self, number: int, replayed: Sequence[ReplayedStep]) -> None:
        """Write down which landmarks a replay created in a map."""
        for done in replayed:
            self.note_created(number, done.step, done.report)

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the records go on."""
        return {
            "log": self.log.get_state(),
            "exchange": self.exchange.get_state(),
            "rng": copy.deepcopy(self.rng.bit_generator.state),
            "entries": tuple(self.entries),
            "next_number": self._next_number,
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with what `get_state` returned."""
        self.log.set_state(state["log"])
        self.exchange.set_state(state["exchange"])
        self.rng.bit_generator.state = copy.deepcopy(state["rng"])
        self.entries = list(with_constants(state["entries"]))
        self._next_number = state["next_number"]
