"""Evidence of a grid's cells: counted within bounds, turned into states, and merged from another robot's grid."""

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


@device
@in_place
def bounds_seen_from(known: Any, margin: int, x: float, y: float, theta: float) -> tuple[float, float, float, float]:
    """Return the least and greatest x, and the least and greatest y, of the known part of another grid [m].

    Args:
        known: (4,) int32. Bounds of the other grid.
        margin: Margin of the other grid, see `margin_of`.
        x: Place of the other's start pose [m].
        y: See `x`.
        theta: Heading of the other's start pose [rad].
    """
    c, s = math.cos(theta), math.sin(theta)
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    for row in (known[0] - margin, known[2] - margin):
        for col in (known[1] - margin, known[3] - margin):
            u, v = col * CELL - HALF_WIDTH, row * CELL - HALF_WIDTH
            low_x, high_x = min(low_x, x + c * u - s * v), max(high_x, x + c * u - s * v)
            low_y, high_y = min(low_y, y + s * u + c * v), max(high_y, y + s * u + c * v)
    return low_x, high_x, low_y, high_y


@in_place
def reach_of_merge(known: Any, size: int, x: float, y: float, theta: float) -> int:
    """Return how many cells a grid needs on each side of its middle to hold another one; arguments as in `merge_grid`.

    Args:
        known: (4,) int32. Bounds of the other grid.
        size: Size of the other grid.
        x: Place of the other's start pose [m].
        y: See `x`.
        theta: Heading of the other's start pose [rad].
    """
    if known[2] == 0:
        return 0
    low_x, high_x, low_y, high_y = bounds_seen_from(known, margin_of(size), x, y, theta)
    return cells_to_middle(max(max(-low_x, high_x), max(-low_y, high_y)))


@inline
def evidence_at(evidence: Any, row: int, col: int) -> int:
    """Return the evidence of a cell, 0 outside the grid."""
    return evidence[row, col] if 0 <= row < len(evidence) and 0 <= col < len(evidence) else 0


@in_place
def merge_grid(grid: Grid, other: Any, known: Any, x: float, y: float, theta: float) -> None:
    """Add another grid's evidence, seen from pose (x, y, theta) of its frame in this one.

    Each cell takes the other's value at its centre, or the firmest wall among four points around it: without these,
    a wall one cell thick would come out of a rotation with holes.

    Args:
        grid: Changed.
        other: (S', S') int8. Evidence of the other grid.
        known: (4,) int32. Bounds of the other grid.
        x: Place of the other's start pose [m].
        y: See `x`.
        theta: Heading of the other's start pose [rad].
    """
    if known[2] == 0:
        return
    c, s = math.cos(theta), math.sin(theta)
    margin, others = margin_of(len(grid.cells)), margin_of(len(other))
    low_x, high_x, low_y, high_y = bounds_seen_from(known, others, x, y, theta)
    first_row, last_row = cell_range(low_y, high_y, len(grid.cells))
    first_col, last_col = cell_range(low_x, high_x, len(grid.cells))
    for row in range(first_row, last_row):
        for col in range(first_col, last_col):
            u = (col - margin + 0.5) * CELL - HALF_WIDTH - x
            v = (row - margin + 0.5) * CELL - HALF_WIDTH - y
            other_x, other_y = (c * u + s * v + HALF_WIDTH) / CELL, (-s * u + c * v + HALF_WIDTH) / CELL
            top, bottom = math.floor(other_y - 0.25) + others, math.floor(other_y + 0.25) + others
            left, right = math.floor(other_x - 0.25) + others, math.floor(other_x + 0.25) + others
            evidence = evidence_at(other, math.floor(other_y) + others, math.floor(other_x) + others)
            wall = max(
                max(evidence_at(other, top, left), evidence_at(other, top, right)),
                max(evidence_at(other, bottom, left), evidence_at(other, bottom, right)),
            )
            evidence = wall if wall > max(evidence, 0) else evidence
            if evidence != 0:
                grid.evidence[row, col] = clamp_evidence(grid.evidence[row, col] + evidence)
                set_state(grid, row, col, OCCUPIED if grid.evidence[row, col] > 0 else FREE)
