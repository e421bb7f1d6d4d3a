"""Another robot's grid is added to one, turned and shifted into its frame."""

import math
from typing import Any

from slam_backend.core.jit import device, in_place
from vslam_env.navigation._painting_kernels.evidence import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    OCCUPIED,
    bounded,
    cell_range,
    judge,
)


@device
@in_place
def _bounds_in_frame(other: Any, x: float, y: float, c: float, s: float) -> tuple[float, float, float, float]:
    """Return low x, high x, low y and high y [m] of what a grid knows, seen from pose (x, y) turned by (c, s)."""
    low_row, high_row, low_col, high_col = GRID_SIZE, -1, GRID_SIZE, -1
    for row in range(GRID_SIZE):
        for col in range(GRID_SIZE):
            if other[row, col] != 0:
                low_row, high_row = min(low_row, row), row
                low_col, high_col = min(low_col, col), max(high_col, col)
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    if high_row >= 0:
        for row in (low_row, high_row + 1):
            for col in (low_col, high_col + 1):
                u, v = col * CELL - HALF_WIDTH, row * CELL - HALF_WIDTH
                low_x, high_x = min(low_x, x + c * u - s * v), max(high_x, x + c * u - s * v)
                low_y, high_y = min(low_y, y + s * u + c * v), max(high_y, y + s * u + c * v)
    return low_x, high_x, low_y, high_y


@in_place
def paint_grid(
    evidence: Any, cells: Any, changes: Any, bounds: Any, other: Any, x: float, y: float, theta: float
) -> None:
    """Add another grid's evidence, seen from pose (x, y, theta) of its frame in this one.

    Each cell takes the other's value at its centre, or the firmest wall among four points around it: without these,
    a wall one cell thick would come out of a rotation with holes.
    """
    c, s = math.cos(theta), math.sin(theta)
    low_x, high_x, low_y, high_y = _bounds_in_frame(other, x, y, c, s)
    first_row, last_row = cell_range(low_y, high_y)
    first_col, last_col = cell_range(low_x, high_x)
    for row in range(first_row, last_row):
        for col in range(first_col, last_col):
            u = (col + 0.5) * CELL - HALF_WIDTH - x
            v = (row + 0.5) * CELL - HALF_WIDTH - y
            other_x, other_y = (c * u + s * v + HALF_WIDTH) / CELL, (-s * u + c * v + HALF_WIDTH) / CELL
            found = 0
            for point in range(5):
                shift = 0.0 if point == 0 else 0.25
                px = other_x + (shift if point % 2 else -shift)
                py = other_y + (shift if point > 2 else -shift)
                if 0.0 <= px < GRID_SIZE and 0.0 <= py < GRID_SIZE:
                    value = other[int(py), int(px)]
                    if point == 0 or value > max(found, 0):
                        found = value
            if found != 0:
                evidence[row, col] = bounded(evidence[row, col] + found)
                judge(cells, changes, bounds, row, col, OCCUPIED if evidence[row, col] > 0 else FREE)
