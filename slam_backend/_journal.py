"""What the last steps of a filter came to, as it waits to be written into the robots' logs, many steps at a time."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from slam_backend._kernels import IDLE, PLACED
from slam_backend._rejuvenation_step import RejuvenationStep
from slam_backend.errors import FloatArray, IntArray
from slam_backend.input_log import StepInput
from slam_backend.run_log import RobotLog

LONGEST = 32  # steps that wait


class Entry(NamedTuple):
    """One step.

    Attributes:
        step: Its number.
        inputs: What was read.
        rows: Of each robot there; -1: none.
        found: (n,) landmark that each measurement was taken for, -1 = none; only those of the robots mean anything.
        means: (K, 3) [m, m, rad] where the robots were thought to be.
        num_rejected: How many of their measurements were neither matched nor new.
    """

    step: int
    inputs: StepInput
    rows: tuple[int, ...]
    found: IntArray
    means: FloatArray
    num_rejected: int


def may_follow(last: Entry, entry: Entry) -> bool:
    """Tell whether two steps can be written down together."""
    return last.rows == entry.rows and len(last.inputs.turns) == len(entry.inputs.turns)


def write_down(entries: Sequence[Entry], logs: Sequence[RobotLog], smoother: RejuvenationStep | None) -> None:
    """Enter into the logs of K robots, and tell the smoother, what some steps came to.

    Args:
        entries: The steps in order, each of which `may_follow` the one before; at least one.
        logs: Of the robots; a step in which one did nothing and was given no measurement gets no row.
        smoother: Of the filter, if it has one.
    """
    steps = np.array([entry.step for entry in entries])
    table = np.concatenate([entry.inputs.table for entry in entries])
    moves = np.concatenate([entry.inputs.moves for entry in entries])
    sightings = np.concatenate([entry.inputs.sightings for entry in entries])
    found = np.concatenate([entry.found for entry in entries])
    for robot, (row, log) in enumerate(zip(entries[0].rows, logs, strict=True)):
        if row >= 0:
            log.extend(row, steps, table, moves, sightings, found)
            if smoother is not None:
                _tell(smoother, robot, row, entries)


def _tell(smoother: RejuvenationStep, robot: int, row: int, entries: Sequence[Entry]) -> None:
    """Tell the smoother where a robot that read something was thought to be, and what of it was refused."""
    poses: dict[int, FloatArray] = {}
    is_placed = False
    for step, inputs, _, found, means, num_rejected in entries:
        act, begin, end, _, named, count = inputs.turns[row]
        if act != IDLE or count > 0:
            poses[step] = means[robot]
            is_placed |= act == PLACED
            if num_rejected and not named:
                smoother.note_refused(robot, step, found[begin:end], inputs.descriptors[begin:end])
    smoother.note(robot, poses, is_placed)
