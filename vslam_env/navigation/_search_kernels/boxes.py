"""The known part of a grid is cut out of it."""

from typing import Any

import numpy as np

from slam_backend._jit import jit
from vslam_env.navigation._painting_kernels import GRID_SIZE, UNKNOWN

PAD = 2  # cells around the known box, so that loops over frontiers and neighbours need no bounds
OUTSIDE = 3  # beyond the 60 x 60 m: neither known nor worth exploring


@jit
def known_bounds(cells: Any) -> tuple[int, int, int, int]:
    """Return first row, first column, height and width of the cells (300, 300) that are known; zeros if none is."""
    first_row, last_row = 0, GRID_SIZE - 1
    while first_row <= last_row and not any_above_zero(cells[first_row]):
        first_row += 1
    if first_row > last_row:
        return 0, 0, 0, 0
    while not any_above_zero(cells[last_row]):
        last_row -= 1
    columns = np.zeros(GRID_SIZE, np.uint8)
    for row in range(first_row, last_row + 1):
        for col in range(GRID_SIZE):
            columns[col] |= cells[row, col]
    first_col, last_col = 0, GRID_SIZE - 1
    while columns[first_col] == UNKNOWN:
        first_col += 1
    while columns[last_col] == UNKNOWN:
        last_col -= 1
    return first_row, first_col, last_row - first_row + 1, last_col - first_col + 1


@jit
def any_above_zero(numbers: Any) -> bool:
    """Tell whether any of some small numbers (n,), >= 0, is above 0; for cells, whether any is known."""
    seen = np.uint8(0)
    for i in range(len(numbers)):
        seen = np.uint8(seen | numbers[i])
    return bool(seen > 0)


@jit
def known_box(cells: Any, row: int, col: int, height: int, width: int) -> Any:
    """Cut the known box out of a grid, and pad it with the cells around.

    Args:
        cells: (300, 300) uint8. The grid.
        row: First row of the box.
        col: First column of the box.
        height: Of the box in cells.
        width: Of the box in cells.

    Returns:
        (height + 2 PAD, width + 2 PAD) uint8, its first cell being (row - PAD, col - PAD) of the grid.
    """
    box = np.full((height + 2 * PAD, width + 2 * PAD), OUTSIDE, np.uint8)
    first, last = max(col - PAD, 0), min(col + width + PAD, GRID_SIZE)
    for grid_row in range(max(row - PAD, 0), min(row + height + PAD, GRID_SIZE)):
        here, there = box[grid_row - row + PAD, first - col + PAD :], cells[grid_row, first:last]
        for i in range(len(there)):  # an assignment of slices would take ten times as long
            here[i] = there[i]
    return box
