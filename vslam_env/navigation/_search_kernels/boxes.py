"""The known part of a grid is cut out of it."""

from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from vslam_env.navigation._painting_kernels import GRID_SIZE

PAD = 2  # cells around the known box, so that loops over frontiers and neighbours need no bounds
OUTSIDE = 3  # beyond the 60 x 60 m: neither known nor worth exploring


@device
@in_place
def any_above_zero(numbers: Any) -> bool:
    """Tell whether any of some small numbers (n,), >= 0, is above 0."""
    seen = np.uint8(0)
    for i in range(len(numbers)):
        seen = np.uint8(seen | numbers[i])
    return bool(seen > 0)


@device
@jit
def known_box(cells: Any, bounds: Any) -> Any:
    """Cut the known box out of a grid, and pad it with the cells around.

    Args:
        cells: (300, 300) uint8. The grid.
        bounds: (4,) int32, of `known_bounds`.

    Returns:
        (h + 2 PAD, w + 2 PAD) uint8, `PAD` cells before its bounds and after them.
    """
    row, col, height, width = bounds[0], bounds[1], bounds[2] - bounds[0], bounds[3] - bounds[1]
    box = np.full((height + 2 * PAD, width + 2 * PAD), OUTSIDE, np.uint8)
    first, last = max(col - PAD, 0), min(col + width + PAD, GRID_SIZE)
    for grid_row in range(max(row - PAD, 0), min(row + height + PAD, GRID_SIZE)):
        here, there = box[grid_row - row + PAD, first - col + PAD :], cells[grid_row, first:last]
        for i in range(len(there)):  # an assignment of slices would take ten times as long
            here[i] = there[i]
    return box
