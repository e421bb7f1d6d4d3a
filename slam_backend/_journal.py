"""What the last steps of a filter came to, as it waits to be written into the robots' logs, many steps at a time."""

from collections.abc import Sequence
from itertools import groupby

import numpy as np

from slam_backend._kernels.layout import ASSOCIATED
from slam_backend._log_kernels import write_guesses
from slam_backend._rejuvenation_step import RejuvenationStep
from slam_backend.errors import FloatArray
from slam_backend.input_log import StepInput
from slam_backend.reports import StepReport
from slam_backend.run_log import RobotLog

LONGEST = 32  # steps that wait


# Of one step: its number, what was read, what the filter made of it, and where its robots were thought to be (K, 3).
Entry = tuple[int, StepInput, StepReport, FloatArray]


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
    _, inputs, report, _ = entry
    return len(inputs.turns), report.rows


def _write_together(entries: Sequence[Entry], logs: Sequence[RobotLog], smoother: RejuvenationStep | None) -> None:
    """Do what `write_down` does for steps that are alike."""
    numbers, inputs, reports, means_then = zip(*entries, strict=True)
    steps = np.array(numbers)
    table = np.concatenate([read.table for read in inputs])
    moves = np.concatenate([read.moves for read in inputs])
    sightings = np.concatenate([read.sightings for read in inputs])
    told, means = np.concatenate([report.findings.told for report in reports], axis=1), np.concatenate(means_then)
    for robot, (row, log) in enumerate(zip(reports[0].rows, logs, strict=True)):
        if row >= 0:
            log.extend(row, steps, table, moves, sightings, told[ASSOCIATED])
            if smoother is not None:
                heard, poses = np.empty_like(steps), np.empty((len(steps), 3))
                count, is_placed = write_guesses(row, robot, steps, table, means, heard, poses)
                smoother.note(robot, heard[:count], poses[:count], is_placed)
                _tell_refused(smoother, robot, row, entries)


def _tell_refused(smoother: RejuvenationStep, robot: int, row: int, entries: Sequence[Entry]) -> None:
    """Tell the smoother what of a robot's measurements was neither matched nor new."""
    for step, inputs, report, _ in entries:
        if report.num_rejected:
            _, begin, end, _, named, _ = inputs.turns[row]
            if not named:
                found = report.findings.told[ASSOCIATED, begin:end]
                smoother.note_refused(robot, step, found, inputs.descriptors[begin:end])
