"""Evidence of a grid's cells: counted within bounds, turned into states, and merged from another robot's grid."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place, inline

GRID_SIZE = 300
CELL = 0.2
UNKNOWN, FREE, OCCUPIED = 0, 1, 2

HALF_WIDTH = 0.5 * GRID_SIZE * CELL  # [m]; the start pose is the middle of the grid

# Evidence per cell: 0 never touched, negative free, positive occupied. A hit outweighs three passes, so that a wall of
# no thickness survives rays that graze its cell; the bounds let a few seconds of new readings overrule any old ones.
HIT = 3
MOST_FREE, MOST_OCCUPIED = -8, 12

MOST_CHANGES = 4096  # a grid keeps so many; a scan makes a hundred at most


class Grid(NamedTuple):
    """The arrays of a seen grid; those of a team's grids have one dimension more.

    Rows go with y and columns with x. The start pose is the middle.

    Attributes:
        evidence: (300, 300) int8. Hits against passes.
        cells: (300, 300) uint8. Verdict on each cell.
        changes: (1 + n,) int32. Number of changed verdicts, -1 if it is not known; then the places of these cells in
            the flat grid.
        bounds: (4,) int32. First row and column of what is known, and one past the last ones; zeros if nothing is.
    """

    evidence: NDArray[np.int8]
    cells: NDArray[np.uint8]
    changes: NDArray[np.int32]
    bounds: NDArray[np.int32]


@inline
def clamp_evidence(evidence: int) -> int:
    """Keep the evidence of a cell within its bounds; 0 is kept for cells that were never touched."""
    evidence = min(max(evidence, MOST_FREE), MOST_OCCUPIED)
    return evidence if evidence != 0 else -1


@device
@in_place
def set_state(grid: Grid, row: int, col: int, verdict: int) -> None:
    """Set the verdict on a cell; if it is a new one, note the change and widen the bounds."""
    cells, changes, bounds = grid.cells, grid.changes, grid.bounds
    if cells[row, col] != verdict:
        if cells[row, col] == UNKNOWN:
            if bounds[2] == 0:
                bounds[0], bounds[1], bounds[2], bounds[3] = row, col, row + 1, col + 1
            bounds[0], bounds[1] = min(bounds[0], row), min(bounds[1], col)
            bounds[2], bounds[3] = max(bounds[2], row + 1), max(bounds[3], col + 1)
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


@in_place
def merge_grid(grid: Grid, other: Any, known: Any, x: float, y: float, theta: float) -> None:
    """Add another grid's evidence, seen from pose (x, y, theta) of its frame in this one.

    Each cell takes the other's value at its centre, or the firmest wall among four points around it: without these,
    a wall one cell thick would come out of a rotation with holes.

    Args:
        grid: Changed.
        other: (300, 300) int8. Evidence of the other grid.
        known: (4,) int32. Bounds of the other grid.
        x: Place of the other's start pose [m].
        y: See `x`.
        theta: Heading of the other's start pose [rad].
    """
    if known[2] == 0:
        return
    c, s = math.cos(theta), math.sin(theta)
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    for row in (known[0], known[2]):
        for col in (known[1], known[3]):
            u, v = col * CELL - HALF_WIDTH, row * CELL - HALF_WIDTH
            low_x, high_x = min(low_x, x + c * u - s * v), max(high_x, x + c * u - s * v)
            low_y, high_y = min(low_y, y + s * u + c * v), max(high_y, y + s * u + c * v)
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
                grid.evidence[row, col] = clamp_evidence(grid.evidence[row, col] + found)
                set_state(grid, row, col, OCCUPIED if grid.evidence[row, col] > 0 else FREE)
