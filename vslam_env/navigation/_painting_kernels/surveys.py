"""What a range scan tells of the floor, in the robot's own frame, and as it is seen in the frame of a grid."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray
from vslam_env.navigation._painting_kernels.surfaces import JUMP, SOLID, SPARSE, surface_between

WALL_HALF_THICKNESS = 0.12  # [m] half a cell and a little, so that a wall marks at least one cell wherever it lies
LEAST = 1e-9  # of what is divided by

# A survey has a row for each of these, and columns for the n rays of a scan, the last one for none: which way they go,
# how far [m], how far along them anything may be told of cells beside them [m], whether they met something. What
# follows is of rays k - 1 and k, while the first and the last column stand for no rays: the surface that both see lies
# where NORMAL_X x + NORMAL_Y y + OFFSET is 0, infinitely far off if they see none; where this is above WALL_ABOVE, it
# is a wall, and before it all is free nearer than the root of FREE_BELOW; whether there is a jump in range.
ALONG_X, ALONG_Y, REACH, TELLING, IS_HIT, NORMAL_X, NORMAL_Y, OFFSET, WALL_ABOVE, FREE_BELOW, IS_JUMP = range(11)
NUM_ROWS = 11


@jit
def directions_of(angles: FloatArray) -> Any:
    """Return unit vectors (2, n) at angles (n,) [rad]."""
    directions = np.empty((2, len(angles)))
    for i in range(len(angles)):
        directions[0, i], directions[1, i] = math.cos(angles[i]), math.sin(angles[i])
    return directions


@jit
def survey(ranges: FloatArray, directions: FloatArray, max_range: float, told: Any) -> None:
    """Find out what a scan of `good_ranges` tells.

    Args:
        ranges: (n,) float64 [m].
        directions: (2, n) float64. Of the rays, ascending, robot frame.
        max_range: A reading as far as this saw nothing [m].
        told: (11, n + 1) float64, robot frame. Written to, as described above.
    """
    count = len(ranges)
    hits, is_hit = np.empty((count, 2)), np.empty(count, np.bool_)
    for i in range(count):
        reach, is_hit[i] = min(ranges[i], max_range), ranges[i] < max_range
        told[ALONG_X, i], told[ALONG_Y, i] = directions[0, i], directions[1, i]
        told[REACH, i], told[TELLING, i], told[IS_HIT, i] = reach, reach, is_hit[i]
        hits[i, 0], hits[i, 1] = reach * directions[0, i], reach * directions[1, i]
    for row in (ALONG_X, ALONG_Y, REACH, TELLING, IS_HIT):
        told[row, count] = 0.0
    for k in (0, count):
        told[NORMAL_X, k], told[NORMAL_Y, k], told[OFFSET, k] = 0.0, 0.0, np.inf
        told[WALL_ABOVE, k], told[FREE_BELOW, k], told[IS_JUMP, k] = np.inf, np.inf, 0.0
    for k in range(1, count):
        kind, normal_x, normal_y, offset = surface_between(hits, is_hit, k - 1)
        reach, wall_above, free_below = min(told[REACH, k - 1], told[REACH, k]), np.inf, np.inf
        if kind < SPARSE:
            free_below = max(reach - (WALL_HALF_THICKNESS if kind == JUMP else 0.0), 0.0) ** 2
        else:
            wall_above = -WALL_HALF_THICKNESS if kind == SOLID else WALL_HALF_THICKNESS
        told[NORMAL_X, k], told[NORMAL_Y, k], told[OFFSET, k] = normal_x, normal_y, offset
        told[WALL_ABOVE, k], told[FREE_BELOW, k], told[IS_JUMP, k] = wall_above, free_below, kind == JUMP
        cosine = directions[0, k - 1] * directions[0, k] + directions[1, k - 1] * directions[1, k]
        for i in range(k - 1, k + 1):
            if kind < SPARSE:  # to the end of a tangent of the arc
                telling = reach / max(math.sqrt(0.5 * max(1.0 + cosine, 0.0)), LEAST)
            else:  # through the wall
                across = -(normal_x * directions[0, i] + normal_y * directions[1, i])
                telling = told[REACH, i] + WALL_HALF_THICKNESS / max(across, LEAST)
            told[TELLING, i] = max(told[TELLING, i], telling)


@jit
def turn(told: Any, theta: float, seen: Any) -> None:
    """Write down what a scan tells, (11, n + 1), as it is seen from where it was taken with heading theta [rad]."""
    c, s = math.cos(theta), math.sin(theta)
    seen[:] = told
    for x, y in ((ALONG_X, ALONG_Y), (NORMAL_X, NORMAL_Y)):
        for i in range(told.shape[1]):
            seen[x, i] = c * told[x, i] - s * told[y, i]
            seen[y, i] = s * told[x, i] + c * told[y, i]
