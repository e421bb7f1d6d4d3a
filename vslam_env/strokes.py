"""`Strokes`: what the readings of a tick wrote into a team's grids, and what grids miss of it when robots return."""

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import compose


class Strokes(NamedTuple):
    """What the readings of one tick wrote into the grids, as `TeamGrids.paint_readings` takes it.

    Attributes:
        tick: Of the readings.
        shared: (K, K) int64. 1 where i's grid took what robot j read, then or when they came together again.
        poses: (K, K, 3) [m, m, rad]. Where robot j was believed to be in i's start frame.
        scans: (K, R) [m].
        bumps: (K,) bool. Who bumped into something.
    """

    tick: int
    shared: IntArray
    poses: FloatArray
    scans: FloatArray
    bumps: BoolArray


class Telling(NamedTuple):
    """That one robot's grid takes what another's has.

    Attributes:
        giver, taker: These robots.
        motion: (3,) [m, m, rad]. The giver's start pose in the taker's start frame.
        since: The taker may miss what was read from this tick on.
        is_whole: Whether the taker absorbs the whole of it, strokes that are forgotten included.
    """

    giver: int
    taker: int
    motion: FloatArray
    since: int
    is_whole: bool


def caught_up(history: Sequence[Strokes], tellings: Iterable[Telling]) -> tuple[list[Strokes], list[Strokes]]:
    """Return a history in which robots have told each other what they had before, and what is to be painted for that.

    Args:
        history: Of some ticks.
        tellings: Who tells whom, all at once: nobody hands on what is told now.

    Returns:
        The history, and for each tick of which grids miss something the strokes that they miss.
    """
    if not history:
        return [], []
    before = np.array([strokes.shared for strokes in history])
    shared, missed, poses = before.copy(), np.zeros_like(before), np.array([strokes.poses for strokes in history])
    for giver, taker, motion, _, is_whole in tellings:
        ticks, readers = np.nonzero(before[:, giver] > shared[:, taker])
        shared[ticks, taker, readers] = 1
        missed[ticks, taker, readers] = not is_whole
        poses[ticks, taker, readers] = compose(motion, poses[ticks, giver, readers])
    rows = (shared != before).any(axis=(1, 2))
    after = [
        strokes._replace(shared=shared[row].copy(), poses=poses[row].copy()) if rows[row] else strokes
        for row, strokes in enumerate(history)
    ]
    late = np.flatnonzero(missed.any(axis=(1, 2)))
    return after, [after[row]._replace(shared=missed[row]) for row in late.tolist()]


def separated(
    history: Iterable[Strokes], before: Iterable[Strokes], sides: Sequence[Sequence[int]]
) -> tuple[list[Strokes], list[Strokes]]:
    """Return a history in which two sides were never together, and what is to be painted into their grids of before.

    Args:
        history: With all that either side took from the other.
        before: The history when they came together; what stands there is in the grids.
        sides: The robots of either; others keep what they have.
    """
    robots, then = [robot for side in sides for robot in side], {strokes.tick: strokes.shared for strokes in before}
    after, again = [], []
    for strokes in history:
        own = np.zeros_like(strokes.shared)
        for side in sides:
            own[np.ix_(side, side)] = strokes.shared[np.ix_(side, side)]
        held = then.get(strokes.tick, np.zeros_like(own))
        shared = strokes.shared.copy()
        shared[robots] = held[robots] | own[robots]
        after.append(strokes._replace(shared=shared))
        if (missing := own & ~held).any():
            again.append(strokes._replace(shared=missing))
    return after, again
