"""Memory of occupancy grids that grow with what was seen."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.state import INT8, UINT8, Array, Int, Row, Sizes, with_state
from vslam_env.navigation._grid_kernels import CELL, GRID_SIZE, LARGEST_SIZE, Grid

GRID_SIZES = (GRID_SIZE, 600, 1200, 2400, LARGEST_SIZE)  # by doubling, up to 400 m on each side of the start


class GridStorage:
    """Arrays of the occupancy grids of K robots, in the middle of which lie the start poses.

    All grids have the same size S, one of `GRID_SIZES`, which grows when a robot sees beyond it. The size says nothing
    about the world except how far any robot of the team has seen, and no result depends on it.

    Args:
        num_grids: Number of grids K.

    Attributes:
        evidence: (K, S, S) int8. Hits minus passes of each cell.
        cells: (K, S, S) uint8. State of each cell.
        bounds: (K, 4) int32. First row and column of the known part of each grid, and one past the last ones; zeros if
            nothing is known.
        views: Arrays of each grid.
        read_only_cells: Read-only views (S, S) of the cells of each grid.
    """

    def __init__(self, num_grids: int) -> None:
        self.bounds = np.zeros((num_grids, 4), np.int32)
        self._adopt(*_empty(num_grids, GRID_SIZE))

    def _adopt(self, evidence: NDArray[np.int8], cells: NDArray[np.uint8]) -> None:
        """Use given arrays for evidence and cells."""
        self.evidence, self.cells = evidence, cells
        self.views = list(map(Grid, evidence, cells, self.bounds))
        self.read_only_cells = [as_read_only(view.cells) for view in self.views]

    @property
    def size(self) -> int:
        """Number of cells S along a side of each grid."""
        return int(self.cells.shape[1])

    @property
    def arrays(self) -> Grid:
        """The arrays of all grids."""
        return Grid(self.evidence, self.cells, self.bounds)

    def reserve(self, needed: int) -> None:
        """Grow until the grids reach a number of cells from their middle in each direction, or are the largest ones.

        Views of the cells that were taken before keep their content but are no longer updated.
        """
        size = size_for(needed)
        if size <= self.size:
            return
        before, old = self.evidence, self.cells
        evidence, cells = _empty(len(before), size)
        shift = (size - self.size) // 2
        for k, (top, left, bottom, right) in enumerate(self.bounds.tolist()):
            there = (k, slice(top + shift, bottom + shift), slice(left + shift, right + shift))
            here = (k, slice(top, bottom), slice(left, right))
            evidence[there], cells[there] = before[here], old[here]
            if bottom:
                self.bounds[k] += shift
        self._adopt(evidence, cells)


def _empty(num_grids: int, size: int) -> tuple[NDArray[np.int8], NDArray[np.uint8]]:
    """Return evidence and cells of empty grids; the system provides the memory of what is written to only."""
    shape = (num_grids, size, size)
    try:
        return np.zeros(shape, np.int8), np.zeros(shape, np.uint8)  # 0 is `UNKNOWN`
    except MemoryError as error:
        side, needed = size * CELL, 2 * num_grids * size**2 / 2**20
        raise MemoryError(
            f"occupancy grids: {num_grids} grids of {side:g} x {side:g} m need {needed:.0f} MiB, which the system "
            "refused. Use fewer robots or environments."
        ) from error


def known_bounds(cells: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the bounds (4,) of the known part of cells (S, S), see `GridStorage`."""
    rows = np.flatnonzero(cells.max(axis=1, initial=0))  # unlike `any`, `max` uses vector instructions
    cols = np.flatnonzero(cells[rows[0] : rows[-1] + 1].max(axis=0)) if len(rows) else rows
    return np.array([rows[0], cols[0], rows[-1] + 1, cols[-1] + 1] if len(rows) else [0, 0, 0, 0], np.int32)


def margin(size: int) -> int:
    """Return how many rows a grid of a size has before the first row of a new grid."""
    return (size - GRID_SIZE) // 2


def size_for(needed: int) -> int:
    """Return the size of grids that reach a number of cells from their middle in each direction, if any grid does."""
    return next((size for size in GRID_SIZES if size >= 2 * needed), LARGEST_SIZE)


FIRST = Int(-margin(LARGEST_SIZE), LARGEST_SIZE)


@with_state(corner=Row(FIRST, FIRST), values=Array(INT8, "h w", -128, 127, constant=True))
class GridPart(NamedTuple):
    """Evidence in the known part of a grid.

    Attributes:
        corner: First row and column, counted in a grid of the first size, so that they may be negative.
        values: (h, w) int8, read-only. Evidence of the cells.
    """

    corner: tuple[int, int]
    values: NDArray[Any]

    @classmethod
    def of(cls, values: NDArray[Any], bounds: NDArray[np.int32]) -> Self:
        """Return a copy of the part of values (S, S) within bounds (4,), see `GridStorage`."""
        top, left, bottom, right = bounds.tolist()
        shift = margin(len(values)) if bottom else 0
        return cls((top - shift, left - shift), as_constant(values[top:bottom, left:right]))

    @property
    def reach(self) -> int:
        """How many cells a grid needs on each side of its middle to hold this part."""
        (row, col), (height, width) = self.corner, self.values.shape
        return int(max(GRID_SIZE // 2 - min(row, col), max(row + height, col + width) - GRID_SIZE // 2))

    def place(self, size: int) -> tuple[tuple[slice, slice], NDArray[np.int32]]:
        """Return where this part lies in a grid of a size, and the bounds (4,) of its cells that are not 0."""
        (row, col), (height, width) = self.corner, self.values.shape
        top, left = row + margin(size), col + margin(size)
        known = known_bounds(self.values.view(np.uint8))
        if known[2]:
            known += np.array([top, left, top, left], np.int32)
        return (slice(top, top + height), slice(left, left + width)), known

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise for a part that reaches beyond the largest grid."""
        for first, count in zip(parts["corner"], parts["values"].shape, strict=True):
            if first + count > LARGEST_SIZE - margin(LARGEST_SIZE):
                raise ValueError(f"{count} cells from {first} on, beyond the largest grid")


@with_state(corner=Row(FIRST, FIRST), values=Array(UINT8, "h w", constant=True))
class LooksPart(GridPart):
    """Looks in the part of a grid with any; `values` are uint8."""

    __slots__ = ()
