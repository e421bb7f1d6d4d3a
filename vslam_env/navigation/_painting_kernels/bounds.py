"""The bounds of what is known of a grid: first row and column, and one past the last ones; zeros if nothing is."""

from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit


@device
@in_place
def widen(bounds: Any, row: int, col: int) -> None:
    """Move bounds (4,) int32 so that a cell is within."""
    if bounds[2] == 0:
        bounds[0], bounds[1], bounds[2], bounds[3] = row, col, row + 1, col + 1
    bounds[0], bounds[1] = min(bounds[0], row), min(bounds[1], col)
    bounds[2], bounds[3] = max(bounds[2], row + 1), max(bounds[3], col + 1)


@jit
def known_bounds(cells: Any) -> Any:
    """Return the bounds (4,) int32 of what is known of a grid's cells (300, 300) uint8."""
    height, width = cells.shape
    bounds, in_columns = np.zeros(4, np.int32), np.zeros(width, np.uint8)
    for row in range(height):
        line, known = cells[row], 0
        for col in range(width):  # two loops: each becomes vector instructions
            known |= line[col]
        if known:
            for col in range(width):
                in_columns[col] |= line[col]
            if bounds[2] == 0:
                bounds[0] = row
            bounds[2] = row + 1
    columns = np.flatnonzero(in_columns)
    if len(columns) > 0:
        bounds[1], bounds[3] = columns[0], columns[-1] + 1
    return bounds
