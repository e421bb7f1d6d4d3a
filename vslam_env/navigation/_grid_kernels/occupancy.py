"""Evidence of a grid's cells: counted within bounds, turned into states, and merged from another robot's grid."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit

GRID_SIZE = 300
CELL = 0.2
UNKNOWN, FREE, OCCUPIED = 0, 1, 2

HALF_WIDTH = 0.5 * GRID_SIZE * CELL  # [m]; the start pose is the middle of the grid

# Evidence per cell: 0 never touched, negative free, positive occupied. A hit outweighs three passes, so that a wall of
# no thickness survives rays that graze its cell; the bounds let a few seconds of new readings overrule any old ones.
HIT = 3
MOST_FREE, MOST_OCCUPIED = -8, 12

MOST_CHANGES = 4096  # that a grid keeps for whoever counts its free cells; a scan makes a hundred at most


@inline
def clamp_evidence(evidence: int) -> int:
    """Keep the evidence of a cell within its bounds; 0 is kept for cells that were never touched."""
    evidence = min(max(evidence, MOST_FREE), MOST_OCCUPIED)
    return evidence if evidence != 0 else -1


@device
@in_place
def set_state(cells: Any, changes: Any, bounds: Any, row: int, col: int, verdict: int) -> None:
    """Set a cell's verdict, and note it if it changed or was not known before.

    Args:
        cells: (300, 300) uint8.
        changes: (1 + n,) int32. How many changed, -1 if that is not known any more; then which, as places in the flat
            grid.
        bounds: (4,) int32. Of what is known.
        row: Of the cell.
        col: Of the cell.
        verdict: The new one.
    """
    if cells[row, col] != verdict:
        if cells[row, col] == UNKNOWN:
            extend_bounds(bounds, row, col)
        cells[row, col] = verdict
        if 0 <= changes[0] < len(changes) - 1:
            changes[0] += 1
            changes[changes[0]] = row * GRID_SIZE + col
        else:
            changes[0] = -1


@inline
def cell_range(low: float, high: float) -> tuple[int, int]:
    """Return the first and the one-past-last index of the cells between two coordinates [m], inside the grid."""
    first = min(max((low + HALF_WIDTH) / CELL, 0.0), float(GRID_SIZE))
    last = min(max((high + HALF_WIDTH) / CELL + 1.0, 0.0), float(GRID_SIZE))
    return int(first), int(last)


@device
@in_place
def extend_bounds(bounds: Any, row: int, col: int) -> None:
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
def merge_grid(
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
                evidence[row, col] = clamp_evidence(evidence[row, col] + found)
                set_state(cells, changes, bounds, row, col, OCCUPIED if evidence[row, col] > 0 else FREE)
