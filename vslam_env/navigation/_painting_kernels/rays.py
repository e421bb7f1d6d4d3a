"""Between which two rays of a scan the cells of a grid lie."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray
from vslam_env.navigation._painting_kernels.evidence import CELL, HALF_WIDTH

READINGS_FINE, BAD_RANGES, BAD_ANGLES = 0, 1, 2
FLAT = 1e-9  # a ray that rises less than this runs along the rows


@jit
def fault_of_scan(ranges: FloatArray, angles: FloatArray) -> int:
    """Return what is wrong with the ranges (n,) [m] or the angles (n,) [rad] of a scan, or `READINGS_FINE`."""
    count = len(ranges)
    for i in range(count):
        if not ranges[i] >= 0.0:  # also catches NaN
            return BAD_RANGES
        if not abs(angles[i]) <= 2.0 * math.pi or (i > 0 and not angles[i] > angles[i - 1]):
            return BAD_ANGLES
    return READINGS_FINE if angles[count - 1] - angles[0] < math.pi else BAD_ANGLES


@jit
def pairs_of_cells(rays: Any, x: float, y: float, first_row: int, first_col: int, height: int, width: int) -> Any:
    """Tell for each cell of a box between which two rays from (x, y) its centre lies.

    A search for each cell would cost more than all else that a scan takes. Here the cells of a row are visited in the
    order in which the rays, ascending, pass them; where each ray crosses the row tells how many have passed, and the
    definition is then asked to make sure of it.

    Args:
        rays: (n, 2) float64. Directions of the rays, ascending, spanning less than pi.
        x: Where they begin [m].
        y: Likewise.
        first_row: Of the box.
        first_col: Likewise.
        height: Of the box [cells].
        width: Likewise.

    Returns:
        (height, width) int16: k for a cell on ray k or to the left of it, and to the right of ray k + 1; -1 where there
        are no two such rays.
    """
    count = len(rays)
    slopes = np.empty((2, count))  # steps along x per step along y, of the rows below the robot and of those above
    for i in range(count):
        slopes[0, i], slopes[1, i] = rays[i, 0] / min(rays[i, 1], -FLAT), rays[i, 0] / max(rays[i, 1], FLAT)
    pairs = np.empty((height, width), np.int16)
    passed, crossings = np.empty(width + 1, np.int64), np.empty(count, np.int32)
    for r in range(height):
        v = (first_row + r + 0.5) * CELL - HALF_WIDTH - y
        above = 1 if v > 0.0 else 0
        start, sense = (width - 1, -1) if above else (0, 1)
        beside = sense * ((x + HALF_WIDTH) / CELL - 0.5 - first_col - start)  # where the robot is on the way
        for i in range(count):  # apart from what follows, so that this becomes vector instructions
            crossing = beside - abs(v) / CELL * slopes[above, i]
            crossings[i] = np.int32(np.ceil(min(max(crossing, 0.0), float(width))))
        passed[:] = 0
        for i in range(count):
            passed[crossings[i]] = i + 1
        guess = 0
        for j in range(width):
            guess = max(guess, passed[j])
            c = start + sense * j
            u = (first_col + c + 0.5) * CELL - HALF_WIDTH - x
            number = guess
            while number > 0 and rays[number - 1, 0] * v < rays[number - 1, 1] * u:
                number -= 1
            while number < count and rays[number, 0] * v >= rays[number, 1] * u:
                number += 1
            pairs[r, c] = number - 1 if number < count else -1
    return pairs
