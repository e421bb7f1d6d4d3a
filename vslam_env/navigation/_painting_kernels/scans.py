"""A range scan is written into a grid: free before the first surface, occupied on it, untold behind."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray
from vslam_env.navigation._painting_kernels.evidence import (
    CELL,
    FREE,
    HALF_WIDTH,
    HIT,
    OCCUPIED,
    bounded,
    cell_range,
    judge,
)
from vslam_env.navigation._painting_kernels.rays import pairs_of_cells
from vslam_env.navigation._painting_kernels.surfaces import JUMP, SOLID, SPARSE, find_surfaces

WALL_HALF_THICKNESS = 0.12  # [m] half a cell and a little, so that a wall marks at least one cell wherever it lies


@jit
def paint_scan(
    evidence: Any,
    cells: Any,
    changes: Any,
    x: float,
    y: float,
    theta: float,
    ranges: FloatArray,
    angles: FloatArray,
    max_range: float,
) -> None:
    """Write one scan in which `fault_of_scan` finds nothing, visiting each cell between its rays once.

    Two neighbouring rays that see one surface span a triangle: a cell of it is free before the surface, occupied on
    it, untold behind. Where hits are sparse, as on a wall seen at a grazing angle, what lies between them stays
    untold. Where the range jumps, the cells nearer than both readings are free, if they are not on a surface that may
    go on there, and each hit marks its own cell.
    """
    count = len(ranges)
    rays, hits = np.empty((count, 2)), np.empty((count, 2))
    reach, is_hit = np.empty(count), np.empty(count, np.bool_)
    low_x = high_x = low_y = high_y = 0.0
    for i in range(count):
        rays[i, 0], rays[i, 1] = math.cos(theta + angles[i]), math.sin(theta + angles[i])
        reach[i], is_hit[i] = min(ranges[i], max_range), ranges[i] < max_range
        hits[i, 0], hits[i, 1] = reach[i] * rays[i, 0], reach[i] * rays[i, 1]
        low_x, high_x = min(low_x, hits[i, 0]), max(high_x, hits[i, 0])
        low_y, high_y = min(low_y, hits[i, 1]), max(high_y, hits[i, 1])
    kinds, lines = find_surfaces(hits, is_hit)
    free_below = np.empty(count - 1)
    for k in range(count - 1):
        margin = WALL_HALF_THICKNESS if kinds[k] == JUMP else 0.0
        free_below[k] = max(min(reach[k], reach[k + 1]) - margin, 0.0)

    first_row, last_row = cell_range(y + low_y - CELL, y + high_y + CELL)
    first_col, last_col = cell_range(x + low_x - CELL, x + high_x + CELL)
    pairs = pairs_of_cells(rays, x, y, first_row, first_col, last_row - first_row, last_col - first_col)
    _add(evidence, cells, changes, pairs, x, y, first_row, first_col, kinds, lines, free_below, hits, is_hit)


@jit
def _add(
    evidence: Any,
    cells: Any,
    changes: Any,
    pairs: Any,
    x: float,
    y: float,
    first_row: int,
    first_col: int,
    kinds: Any,
    lines: Any,
    free_below: Any,
    hits: Any,
    is_hit: Any,
) -> None:
    """Add what a scan says of each cell to the evidence.

    What is asked of a cell stands here as it is, for calls that hand on arrays would take three times as long.

    Args:
        evidence: (300, 300) int8.
        cells: (300, 300) uint8.
        changes: See `judge`.
        pairs: (h, w) int16, of `pairs_of_cells`.
        x: Of the robot [m].
        y: Likewise.
        first_row: Where `pairs` begins.
        first_col: Likewise.
        kinds: (n - 1,) int8, of `find_surfaces`.
        lines: (n - 1, 3) float64, of `find_surfaces`.
        free_below: (n - 1,) float64 [m]. Where two rays see no surface, the floor is free up to this distance.
        hits: (n, 2) float64 [m]. Where the rays end, seen from the robot.
        is_hit: (n,) bool. Whether they met something there.
    """
    for r in range(pairs.shape[0]):
        row = first_row + r
        v = (row + 0.5) * CELL - HALF_WIDTH - y
        for c in range(pairs.shape[1]):
            k = pairs[r, c]
            if k < 0:
                continue
            col = first_col + c
            u = (col + 0.5) * CELL - HALF_WIDTH - x
            change = 0
            if kinds[k] >= SPARSE:
                before = lines[k, 0] * u + lines[k, 1] * v + lines[k, 2]
                if before > WALL_HALF_THICKNESS:
                    change = -1
                elif before > -WALL_HALF_THICKNESS and kinds[k] == SOLID:
                    change = HIT
            elif u * u + v * v < free_below[k] ** 2:
                change = -1
                if kinds[k] == JUMP:
                    for other in range(max(k - 1, 0), min(k + 2, len(kinds))):
                        before = lines[other, 0] * u + lines[other, 1] * v + lines[other, 2]
                        if abs(before) < WALL_HALF_THICKNESS:
                            change = 0
            elif kinds[k] == JUMP:
                for ray in range(k, k + 2):
                    off_x, off_y = abs(u - hits[ray, 0]), abs(v - hits[ray, 1])
                    if is_hit[ray] and max(off_x, off_y) <= 0.5 * CELL:
                        change = HIT
            if change != 0:
                old = evidence[row, col]
                new = bounded(old + change)
                evidence[row, col] = new
                if old == 0 or (new > 0) != (old > 0):
                    judge(cells, changes, row, col, OCCUPIED if new > 0 else FREE)
