"""Which scans can be painted, and where the rows of a grid are crossed by rays."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inlined
from slam_backend.core.validation import FloatArray
from vslam_env.navigation._painting_kernels.evidence import CELL
from vslam_env.navigation._painting_kernels.surveys import ALONG_X, ALONG_Y, TELLING

# Rays as they are seen in the frame of a grid: after the rows of a survey that turn, how far to the left a ray gets
# from row to row [cells], left as seen by the robot that looks to these rows; how far off the rows are of which it can
# tell [m], less than 0 if it leads away; before which cell it crosses a row.
SLOPE, TOP, CROSSING, NUM_SEEN_ROWS = 4, 5, 6, 7
ASIDE = 1e12  # [cells] per row: how far off a ray crosses rows that it leads away from


@in_place
def good_ranges(ranges: FloatArray) -> bool:
    """Tell whether ranges (n,) [m] are at least 0."""
    good = True
    for i in range(len(ranges)):
        good &= ranges[i] >= 0.0  # no NaN is
    return good


@in_place
def good_angles(angles: FloatArray) -> bool:
    """Tell whether the angles (n,) [rad] of rays ascend and span less than pi."""
    for i in range(len(angles)):
        if not abs(angles[i]) <= 2.0 * math.pi or (i > 0 and not angles[i] > angles[i - 1]):
            return False
    return bool(angles[-1] - angles[0] < math.pi)


@device
@in_place
def look_to_side(told: Any, side: float, seen: Any) -> None:
    """Write how rays lead to the rows above the robot, or to those below.

    Args:
        told: (15, n + 1) float64, of `survey`.
        side: 1 for the rows above, -1 for those below.
        seen: (7, n + 1) float64, of `turn`, and as described above.
    """
    aside = -ASIDE  # all cells lie to the left of what comes before the rays that lead there, none of what comes after
    for i in range(told.shape[1] - 1):
        up = seen[ALONG_Y, i]
        leads_there = side * up > 0.0
        seen[SLOPE, i] = -seen[ALONG_X, i] / (up if leads_there else 1.0) if leads_there else aside
        seen[TOP, i] = side * told[TELLING, i] * up + 0.5 * CELL if leads_there else -1.0
        aside = ASIDE if leads_there else aside


@inlined
def cross_row(seen: Any, begin: int, end: int, steps: float, beside: float, passed: Any) -> tuple[int, int]:
    """Tell which rays the cells of a row lie to the left of.

    Args:
        seen: (7, n + 1) float64, of `look_to_side`. The crossings are written to it.
        begin: The first ray that is asked about.
        end: One past the last.
        steps: How far the row is from the robot [cells].
        beside: Where the robot is, counted from the rightmost cell [cells].
        passed: (width + 1,) uint32, cells from right to left. Written to: one past the last ray that is crossed just
            before a cell; 0 if none is.

    Returns:
        The first cell to the left of the first of these rays, and the first to the left of the last one.
    """
    most = float(len(passed) - 1)
    slopes, crossings = seen[SLOPE, begin:end], seen[CROSSING, begin:end]
    for i in range(len(slopes)):  # by itself, it becomes vector instructions
        crossings[i] = np.ceil(min(max(beside + steps * slopes[i], 0.0), most))
    passed[:] = 0
    first, crossing = len(passed) - 1, 0
    for i in range(len(crossings)):
        crossing = int(crossings[i])
        passed[np.uint32(crossing)] = begin + i + 1
        first = min(first, crossing)
    return first, crossing
