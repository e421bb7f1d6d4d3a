"""What a range scan tells of the floor, in the robot's own frame, and as it is seen in the frame of a grid."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from slam_backend.core.validation import FloatArray

SAME_SURFACE_GAP = 0.4  # [m] no robot fits between two hits this near: they are joined unseen
STRAIGHT_GAP = 0.8  # [m] joined if a third hit lies on their line; doors are 1.1 m and wider
STRAIGHT_TOLERANCE = 0.1  # [m]
WALL_HALF_THICKNESS = 0.12  # [m] half a cell and a little, so that a wall marks at least one cell wherever it lies
LEAST = 1e-9  # of what is divided by

# A survey has a row for each of these, and columns for the n rays of a scan, the last one for none: which way they go,
# how far [m], where they end [m], whether they met something, whether the hit lies on a line through those beside it,
# how far along them anything may be told of cells beside them [m]. What follows is of rays k - 1 and k, while the first
# and the last column stand for no rays: the surface that both see lies where NORMAL_X x + NORMAL_Y y + OFFSET is 0,
# infinitely far off if they see none; where this is above WALL_ABOVE, it is a wall, and before it all is free nearer
# than the root of FREE_BELOW; whether there is a jump in range; how far along both something may be told where they see
# no surface [m].
ALONG_X, ALONG_Y, NORMAL_X, NORMAL_Y = range(4)  # these turn with the robot
REACH, END_X, END_Y, IS_HIT, IN_LINE, TELLING, OFFSET, WALL_ABOVE, FREE_BELOW, IS_JUMP, TELLING_FREE = range(4, 15)
NUM_ROWS = 15


@jit
def directions_of(angles: FloatArray) -> Any:
    """Return unit vectors (2, n) at angles (n,) [rad]."""
    directions = np.empty((2, len(angles)))
    for i in range(len(angles)):
        directions[0, i], directions[1, i] = math.cos(angles[i]), math.sin(angles[i])
    return directions


@device
@in_place
def _survey_rays(ranges: FloatArray, directions: FloatArray, max_range: float, told: Any) -> None:
    """Write what each ray tells by itself, and whether three hits lie on one line."""
    count = len(ranges)
    for i in range(count):
        reach = min(ranges[i], max_range)
        told[ALONG_X, i], told[ALONG_Y, i] = directions[0, i], directions[1, i]
        told[REACH, i], told[IS_HIT, i] = reach, ranges[i] < max_range
        told[END_X, i], told[END_Y, i] = reach * directions[0, i], reach * directions[1, i]
        told[IN_LINE, i] = 0.0
    for row in (ALONG_X, ALONG_Y, REACH, IS_HIT, TELLING):
        told[row, count] = 0.0
    for i in range(1, count - 1):
        along_x, along_y = told[END_X, i + 1] - told[END_X, i - 1], told[END_Y, i + 1] - told[END_Y, i - 1]
        cross = along_x * (told[END_Y, i] - told[END_Y, i - 1]) - along_y * (told[END_X, i] - told[END_X, i - 1])
        on_line = abs(cross) <= STRAIGHT_TOLERANCE * math.sqrt(along_x * along_x + along_y * along_y)
        told[IN_LINE, i] = told[IS_HIT, i - 1] * told[IS_HIT, i] * told[IS_HIT, i + 1] * on_line


@device
@in_place
def _survey_pairs(told: Any) -> None:
    """Write what neighbouring rays see between them: one surface, a jump in range, or nothing.

    It is one surface if there is no gap between the hits to drive through, or if they line up with a third one; where
    that leaves room for a gap, nothing is a wall between them.
    """
    count = told.shape[1] - 1
    for k in (0, count):
        told[NORMAL_X, k], told[NORMAL_Y, k], told[OFFSET, k], told[WALL_ABOVE, k] = 0.0, 0.0, np.inf, np.inf
        told[FREE_BELOW, k], told[IS_JUMP, k], told[TELLING_FREE, k] = np.inf, 0.0, 0.0
    for k in range(1, count):  # hardly any branches, for none could be foreseen
        x, y, reach = told[END_X, k - 1], told[END_Y, k - 1], min(told[REACH, k - 1], told[REACH, k])
        along_x, along_y = told[END_X, k] - x, told[END_Y, k] - y
        gap = max(math.sqrt(along_x * along_x + along_y * along_y), LEAST)
        hits, in_line = told[IS_HIT, k - 1] + told[IS_HIT, k], told[IN_LINE, k - 1] + told[IN_LINE, k] > 0.0
        is_surface = (hits > 1.0) & ((gap <= SAME_SURFACE_GAP) | in_line)
        is_jump = (hits > 0.0) & (not is_surface)
        told[NORMAL_X, k] = -along_y / gap if is_surface else 0.0
        told[NORMAL_Y, k] = along_x / gap if is_surface else 0.0
        told[OFFSET, k] = (along_y * x - along_x * y) / gap if is_surface else np.inf
        wall_above = -WALL_HALF_THICKNESS if gap <= STRAIGHT_GAP else WALL_HALF_THICKNESS
        told[WALL_ABOVE, k] = wall_above if is_surface else np.inf
        free_below = max(reach - (WALL_HALF_THICKNESS if is_jump else 0.0), 0.0) ** 2
        told[FREE_BELOW, k], told[IS_JUMP, k] = np.inf if is_surface else free_below, is_jump
        cosine = told[ALONG_X, k - 1] * told[ALONG_X, k] + told[ALONG_Y, k - 1] * told[ALONG_Y, k]
        end_of_tangent = reach / max(math.sqrt(0.5 * max(1.0 + cosine, 0.0)), LEAST)  # of the arc up to the reach
        told[TELLING_FREE, k] = 0.0 if is_surface else end_of_tangent


@device
@in_place
def survey(ranges: FloatArray, directions: FloatArray, max_range: float, told: Any) -> None:
    """Find out what a scan of `good_ranges` tells.

    Args:
        ranges: (n,) float64 [m].
        directions: (2, n) float64. Of the rays, ascending, robot frame.
        max_range: A reading as far as this saw nothing [m].
        told: (15, n + 1) float64, robot frame. Written to, as described above.
    """
    _survey_rays(ranges, directions, max_range, told)
    _survey_pairs(told)
    for i in range(len(ranges)):
        telling = told[REACH, i]
        for k in (i, i + 1):
            across = -(told[NORMAL_X, k] * told[ALONG_X, i] + told[NORMAL_Y, k] * told[ALONG_Y, i])
            through_wall = told[REACH, i] + WALL_HALF_THICKNESS / max(across, LEAST)
            telling = max(telling, through_wall if told[WALL_ABOVE, k] < np.inf else told[TELLING_FREE, k])
        told[TELLING, i] = telling


@device
@in_place
def turn(told: Any, theta: float, seen: Any) -> None:
    """Write the rows (4, n + 1) of a survey that turn as they are seen at a heading theta [rad]."""
    c, s = math.cos(theta), math.sin(theta)
    for x, y in ((ALONG_X, ALONG_Y), (NORMAL_X, NORMAL_Y)):
        for i in range(told.shape[1]):
            seen[x, i] = c * told[x, i] - s * told[y, i]
            seen[y, i] = s * told[x, i] + c * told[y, i]
