"""Evidence of a grid's cells: counted within bounds, and turned into states."""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place, inline

CELL = 0.2
UNKNOWN, FREE, OCCUPIED = 0, 1, 2

# Cells along a side of a new grid and of the largest one. The start pose is the middle of both. Indices of cells are
# floored in the new grid and then moved by a whole number of cells (`margin_of`), so that the size of a grid changes no
# rounding.
GRID_SIZE, LARGEST_SIZE = 300, 4000
HALF_WIDTH = 0.5 * GRID_SIZE * CELL  # [m]
LARGEST_HALF_WIDTH = 0.5 * LARGEST_SIZE * CELL  # [m]

# Evidence per cell: 0 never touched, negative free, positive occupied. A hit outweighs three passes, so that a wall of
# no thickness survives rays that graze its cell; the bounds let a few seconds of new readings overrule any old ones.
HIT = 3
MOST_FREE, MOST_OCCUPIED = -8, 12


class Grid(NamedTuple):
    """The arrays of an occupancy grid; those of a team's grids have one dimension more.

    Rows go with y and columns with x. The start pose is the middle.

    Attributes:
        evidence: (S, S) int8. Hits against passes.
        cells: (S, S) uint8. Verdict on each cell.
        bounds: (4,) int32. First row and column of what is known, and one past the last ones; zeros if nothing is.
    """

    evidence: NDArray[np.int8]
    cells: NDArray[np.uint8]
    bounds: NDArray[np.int32]


@inline
def margin_of(size: int) -> int:
    """Return how many rows a grid of a size has before the first row of a new grid."""
    return (size - GRID_SIZE) // 2


@inline
def clamp_evidence(evidence: int) -> int:
    """Keep the evidence of a cell within its bounds; 0 is kept for cells that were never touched."""
    evidence = min(max(evidence, MOST_FREE), MOST_OCCUPIED)
    return evidence if evidence != 0 else -1


@device
@in_place
def widen_bounds(bounds: Any, row: int, col: int) -> None:
    """Widen bounds (4,) of cells, zeros if there are none yet, by one."""
    if bounds[2] == 0:
        bounds[0], bounds[1], bounds[2], bounds[3] = row, col, row + 1, col + 1
    bounds[0], bounds[1] = min(bounds[0], row), min(bounds[1], col)
    bounds[2], bounds[3] = max(bounds[2], row + 1), max(bounds[3], col + 1)


@device
@in_place
def set_state(grid: Grid, row: int, col: int, verdict: int) -> None:
    """Set the verdict on a cell, and widen the bounds if it was unknown."""
    cells = grid.cells
    if cells[row, col] == UNKNOWN:
        widen_bounds(grid.bounds, row, col)
    cells[row, col] = verdict


@inline
def cell_index(coordinate: float, margin: int) -> int:
    """Return the row or column of a coordinate [m] in a grid with a margin."""
    return math.floor((coordinate + HALF_WIDTH) / CELL) + margin


@inline
def to_index(coordinate: float, size: int) -> int:
    """Return the row or column of a coordinate [m] in a grid of some size, whose middle is the start."""
    return cell_index(coordinate, margin_of(size))


@inline
def to_coordinate(index: int, size: int) -> float:
    """Return the coordinate [m] of the centre of a row or column."""
    return (index - margin_of(size) + 0.5) * CELL - HALF_WIDTH


@inline
def is_occupied(cells: Any, x: float, y: float) -> bool:
    """Return whether a point [m] lies in an occupied cell of a grid."""
    size = len(cells)
    row, col = to_index(y, size), to_index(x, size)
    return bool(0 <= row < size and 0 <= col < size and cells[row, col] == OCCUPIED)


EDGE = 4  # cells around what is known that a grid keeps unknown, so that its size changes no frontier


@in_place
def cells_to_middle(distance: float) -> int:
    """Return how many cells a grid needs on each side of its middle to hold what is at most so far away [m]."""
    return min(math.ceil(min(distance, LARGEST_HALF_WIDTH) / CELL) + EDGE, LARGEST_SIZE // 2)


@inline
def cell_range(low: float, high: float, size: int) -> tuple[int, int]:
    """Return the first and the one-past-last index of the cells between two coordinates [m], inside a grid."""
    margin = margin_of(size)
    least, most = float(-margin), float(GRID_SIZE + margin)
    first = min(max((low + HALF_WIDTH) / CELL, least), most)
    last = min(max((high + HALF_WIDTH) / CELL + 1.0, least), most)
    return math.floor(first) + margin, math.floor(last) + margin
