"""A range scan is written into a grid: free before the first surface, occupied on it, untold behind."""

from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inlined, jit, room_of
from slam_backend.core.validation import FloatArray
from vslam_env.navigation._painting_kernels.evidence import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    HIT,
    OCCUPIED,
    bounded,
    cell_range,
    judge,
)
from vslam_env.navigation._painting_kernels.rays import NUM_SEEN_ROWS, TOP, cross_row, look_to_side
from vslam_env.navigation._painting_kernels.surveys import (
    ALONG_X,
    ALONG_Y,
    FREE_BELOW,
    IS_HIT,
    IS_JUMP,
    NORMAL_X,
    NORMAL_Y,
    NUM_ROWS,
    OFFSET,
    REACH,
    WALL_ABOVE,
    WALL_HALF_THICKNESS,
    survey,
    turn,
)

NONE_PASSED: Any = np.uint32(0)  # unsigned, as are other places of arrays below, so that none counts from the end
MOST_PLACES = GRID_SIZE + 1  # before the cells of a row, and after the last one
LEAST_HEIGHT = 1e-9  # [m] that a row is taken to be from the robot, so that no ray crosses it nowhere


@inlined
def _before(told: Any, seen: Any, k: Any, u: float, v: float) -> float:
    """Return how far before the surface of a pair of rays a point lies [m]."""
    before: float = seen[NORMAL_X, k] * u + seen[NORMAL_Y, k] * v + told[OFFSET, k]
    return before


@device
@in_place
def _told_at_jump(told: Any, seen: Any, k: Any, u: float, v: float, change: int) -> int:
    """Return the evidence for a cell between two rays at whose ends the range jumps; seen from the robot at (u, v) [m].

    What is free by its distance may be on a surface that goes on from beside; what is not may hold one of the hits.
    """
    right = np.int64(k) - 1
    if change < 0:
        beside = min(abs(_before(told, seen, right, u, v)), abs(_before(told, seen, k + 1, u, v)))
        return 0 if beside < WALL_HALF_THICKNESS else change
    for i in range(right, right + 2):
        off_x = u - told[REACH, i] * seen[ALONG_X, i]
        off_y = v - told[REACH, i] * seen[ALONG_Y, i]
        if told[IS_HIT, i] > 0.0 and max(abs(off_x), abs(off_y)) <= 0.5 * CELL:
            return HIT
    return 0


@jit
def room_to_paint(num_rays: int) -> FloatArray:
    """Return room (22, n + 1) for a survey of n rays, and below it for what `paint_survey` makes of it."""
    return np.empty((NUM_ROWS + NUM_SEEN_ROWS, num_rays + 1))


@device
@in_place
def paint_survey(
    evidence: Any, cells: Any, changes: Any, bounds: Any, x: float, y: float, theta: float, room: FloatArray
) -> None:
    """Write what a scan tells into a grid, visiting each cell between rays that reach its row once.

    Two neighbouring rays that see one surface span a triangle: a cell of it is free before the surface, occupied on
    it, untold behind. Where hits are sparse, as on a wall seen at a grazing angle, what lies between them stays
    untold. Where the range jumps, the cells nearer than both readings are free, if they are not on a surface that may
    go on there, and each hit marks its own cell.

    Which two rays a cell lies between is told by where they cross its row. Rays that can tell nothing of a row are
    passed over at both ends of the fan; from row to row away from the robot there are more of them.

    Args:
        evidence: (300, 300) int8.
        cells: (300, 300) uint8.
        changes: See `judge`, also for the bounds.
        bounds: (4,) int32.
        x: Where the robot was [m].
        y: Likewise.
        theta: Its heading [rad].
        room: Of `room_to_paint`, holding a survey.
    """
    told, seen, count = room[:NUM_ROWS], room[NUM_ROWS:], room.shape[1] - 1
    all_passed = room_of(MOST_PLACES, np.uint32)
    turn(told, theta, seen)
    low_x = high_x = low_y = high_y = 0.0
    for i in range(count):
        end_x, end_y = told[REACH, i] * seen[ALONG_X, i], told[REACH, i] * seen[ALONG_Y, i]
        low_x, high_x = min(low_x, end_x), max(high_x, end_x)
        low_y, high_y = min(low_y, end_y), max(high_y, end_y)
    first_row, last_row = cell_range(y + low_y - CELL, y + high_y + CELL)
    first_col, last_col = cell_range(x + low_x - CELL, x + high_x + CELL)
    width = last_col - first_col
    own_row = int(min(max((y + HALF_WIDTH) / CELL + 0.5, float(first_row)), float(last_row)))
    passed, tops = all_passed[: width + 1], seen[TOP]
    for side in (-1, 1):
        look_to_side(told, float(side), seen)
        right = first_col if side < 0 else last_col - 1  # seen by the robot that looks to these rows
        beside = side * (right + 0.5 - (x + HALF_WIDTH) / CELL)
        first, last = 0, count - 1
        for row in range(own_row, last_row) if side > 0 else range(own_row - 1, first_row - 1, -1):
            v = (row + 0.5) * CELL - HALF_WIDTH - y
            while first <= last and tops[first] < side * v:
                first += 1
            while first <= last and tops[last] < side * v:
                last -= 1
            if first > last:
                break
            begin, end = max(first - 1, 0), min(last + 2, count)
            start, stop = cross_row(seen, begin, end, max(side * v, LEAST_HEIGHT) / CELL, beside, passed)
            evidence_row, k = evidence[row], NONE_PASSED
            for j in range(start, stop):
                k = max(k, passed[np.uint32(j)])
                col: Any = np.uint32(right - side * j)
                u = (col + 0.5) * CELL - HALF_WIDTH - x
                before, change = _before(told, seen, k, u, v), 0
                if (before > WALL_HALF_THICKNESS) & (u * u + v * v < told[FREE_BELOW, k]):
                    change = -1
                elif before > told[WALL_ABOVE, k]:
                    change = HIT
                if told[IS_JUMP, k] > 0.0:
                    change = _told_at_jump(told, seen, k, u, v, change)
                old = evidence_row[col]
                new = bounded(old + change) if change != 0 else old
                if new != old:
                    evidence_row[col] = new
                    if old == 0 or (new > 0) != (old > 0):
                        judge(cells, changes, bounds, row, col, OCCUPIED if new > 0 else FREE)


@jit
def paint_scan(
    evidence: Any,
    cells: Any,
    changes: Any,
    bounds: Any,
    x: float,
    y: float,
    theta: float,
    ranges: FloatArray,
    directions: FloatArray,
    max_range: float,
) -> None:
    """Write one scan of `good_ranges` into a grid: `survey` and `paint_survey`."""
    room = room_to_paint(len(ranges))
    survey(ranges, directions, max_range, room[:NUM_ROWS])
    paint_survey(evidence, cells, changes, bounds, x, y, theta, room)
