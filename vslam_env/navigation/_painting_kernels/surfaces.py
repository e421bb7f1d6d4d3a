"""What neighbouring rays of a scan see between them: one surface, a jump in range, or nothing."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import inlined, jit

SAME_SURFACE_GAP = 0.4  # [m] no robot fits between two hits this near: they are joined unseen
STRAIGHT_GAP = 0.8  # [m] joined if a third hit lies on their line; doors are 1.1 m and wider
STRAIGHT_TOLERANCE = 0.1  # [m]
NOTHING, JUMP, SPARSE, SOLID = 0, 1, 2, 3  # what two neighbouring rays see


@jit
def _on_one_line(hits: Any, is_hit: Any, i: int) -> bool:
    """Tell whether rays i - 1, i and i + 1 all hit, and the middle hit lies on the line through the others."""
    if not (0 < i < len(hits) - 1 and is_hit[i - 1] and is_hit[i] and is_hit[i + 1]):
        return False
    along_x, along_y = hits[i + 1, 0] - hits[i - 1, 0], hits[i + 1, 1] - hits[i - 1, 1]
    cross = along_x * (hits[i, 1] - hits[i - 1, 1]) - along_y * (hits[i, 0] - hits[i - 1, 0])
    return bool(abs(cross) <= STRAIGHT_TOLERANCE * math.hypot(along_x, along_y))


@inlined
def surface_between(hits: Any, is_hit: Any, i: int) -> tuple[int, float, float, float]:
    """Find out what two neighbouring rays see.

    Args:
        hits: (n, 2) float64 [m]. Where the rays end, seen from the robot.
        is_hit: (n,) bool. Whether they met something there.
        i: The first of the two rays.

    Returns:
        `SOLID`, one surface without a gap to drive through; `SPARSE`, hits that line up with a third one but leave room
        for a gap; `JUMP`, a jump in range; `NOTHING`, no hit. And of the line through the two hits the unit normal
        towards the robot, x and y, and the robot's distance [m]; an infinitely distant line if they see no surface.
    """
    if not (is_hit[i] and is_hit[i + 1]):
        return JUMP if is_hit[i] or is_hit[i + 1] else NOTHING, 0.0, 0.0, np.inf
    along_x, along_y = hits[i + 1, 0] - hits[i, 0], hits[i + 1, 1] - hits[i, 1]
    gap = max(math.hypot(along_x, along_y), 1e-9)
    if gap <= SAME_SURFACE_GAP:
        kind = SOLID
    elif _on_one_line(hits, is_hit, i) or _on_one_line(hits, is_hit, i + 1):
        kind = SOLID if gap <= STRAIGHT_GAP else SPARSE
    else:
        return JUMP, 0.0, 0.0, np.inf
    return kind, -along_y / gap, along_x / gap, (along_y * hits[i, 0] - along_x * hits[i, 1]) / gap
