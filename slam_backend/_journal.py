"""What the last steps of a filter came to, as it waits to be written into the robots' logs, many steps at a time."""

from collections.abc import Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from slam_backend._kernels.layout import ASSOCIATED
from slam_backend._log_kernels import write_guesses
from slam_backend._rejuvenation_step import RejuvenationStep
from slam_backend.errors import FloatArray, IntArray
from slam_backend.input_log import StepInput
from slam_backend.reports import StepReport
from slam_backend.run_log import RobotLog

LONGEST = 32  # steps that wait


class Entry(NamedTuple):
    """One step.

    Attributes:
        step: Its number.
        inputs: What was read.
        report: What the filter made of it.
        means: (K, 3) [m, m, rad] where its robots were thought to be.
    """

    step: int
    inputs: StepInput
    report: StepReport
    means: FloatArray

    @property
    def found(self) -> IntArray:
        """(n,) landmark that each measurement was taken for, -1 = none; only those of the robots mean anything."""
        return np.asarray(self.report.findings.told[ASSOCIATED])


def write_down(entries: Sequence[Entry], logs: Sequence[RobotLog], smoother: RejuvenationStep | None) -> None:
    """Enter into the logs of K robots, and tell the smoother, what some steps came to.

    Args:
        entries: The steps in order.
        logs: Of the robots; a step in which one did nothing and was given no measurement gets no row.
        smoother: Of the filter, if it has one.
    """
    for _, alike in groupby(entries, _robots_of):
        _write_together(list(alike), logs, smoother)


def _robots_of(entry: Entry) -> tuple[int, tuple[int, ...]]:
    """Return how many robots there are readings of, and whose were taken in: these make steps alike."""
    return len(entry.inputs.turns), entry.report.rows


def _write_together(entries: Sequence[Entry], logs: Sequence[RobotLog], smoother: RejuvenationStep | None) -> None:
    """Do what `write_down` does for steps that are alike."""
    numbers, inputs, reports, means_then = zip(*entries, strict=True)
    steps = np.array(numbers)
    table = np.concatenate([read.table for read in inputs])
    moves = np.concatenate([read.moves for read in inputs])
    sightings = np.concatenate([read.sightings for read in inputs])
    found, means = np.concatenate([entry.found for entry in entries]), np.concatenate(means_then)
    for robot, (row, log) in enumerate(zip(reports[0].rows, logs, strict=True)):
        if row >= 0:
            log.extend(row, steps, table, moves, sightings, found)
            if smoother is not None:
                heard, poses = np.empty_like(steps), np.empty((len(steps), 3))
                count, is_placed = write_guesses(row, robot, steps, table, means, heard, poses)
                smoother.note(robot, heard[:count], poses[:count], is_placed)
                _tell_refused(smoother, robot, row, entries)


def _tell_refused(smoother: RejuvenationStep, robot: int, row: int, entries: Sequence[Entry]) -> None:
    """Tell the smoother what of a robot's measurements was neither matched nor new."""
    for entry in entries:
        if entry.report.num_rejected:
            _, begin, end, _, named, _ = entry.inputs.turns[row]
            if not named:
                smoother.note_refused(robot, entry.step, entry.found[begin:end], entry.inputs.descriptors[begin:end])
