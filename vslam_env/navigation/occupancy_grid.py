"""Occupancy grid of one robot in its own start frame."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_float
from vslam_env.navigation import _grid_kernels as _painting
from vslam_env.navigation._grid_kernels import CELL, FREE, GRID_SIZE, HALF_WIDTH, OCCUPIED, UNKNOWN, Grid
from vslam_env.navigation.validation import check_ranges, pose_floats, ray_directions

# State of a cell by its evidence, as an unsigned byte.
_CELL_STATES = np.where(np.arange(256) == 0, UNKNOWN, np.where(np.arange(256) < 128, OCCUPIED, FREE)).astype(np.uint8)

__all__ = ["CELL", "FREE", "GRID_SIZE", "OCCUPIED", "UNKNOWN", "SeenGrid", "cell_of", "centre_of"]


def cell_of(points: ArrayLike) -> IntArray:
    """Return the cells that contain points.

    Args:
        points: (..., 2) float64 [m], start frame, rows (x, y).

    Returns:
        (..., 2) int64 rows (row, column), to index `SeenGrid.cells`. Below 0 or at least `GRID_SIZE` for points
        outside the grid.

    >>> cell_of([0.1, -29.9]).tolist()
    [0, 150]
    """
    points = np.asarray(points, dtype=np.float64)
    return np.asarray(np.floor((points[..., ::-1] + HALF_WIDTH) / CELL), dtype=np.int64)


def centre_of(cells: ArrayLike) -> FloatArray:
    """Return the centres of cells.

    Args:
        cells: (..., 2) int64 rows (row, column).

    Returns:
        (..., 2) float64 [m], start frame, rows (x, y).

    >>> centre_of([0, 150]).round(6).tolist()
    [0.1, -29.9]
    """
    return np.asarray((np.asarray(cells)[..., ::-1] + 0.5) * CELL - HALF_WIDTH, dtype=np.float64)


def known_bounds(cells: NDArray[np.uint8]) -> NDArray[np.int32]:
    """Return the bounds (4,) of the known part of cells (300, 300), see `TeamGrids`."""
    rows, cols = np.flatnonzero(cells.any(axis=1)), np.flatnonzero(cells.any(axis=0))
    return np.array([rows[0], cols[0], rows[-1] + 1, cols[-1] + 1] if len(rows) else [0, 0, 0, 0], np.int32)


class SeenGrid:
    """Occupancy grid of 60 x 60 m around a robot's start pose; its size is independent of the world.

    Each cell counts evidence (hits minus passes) within bounds, so that a single wrong reading neither closes a door
    nor opens a wall; `cells` holds the resulting states. Readings outside the grid are ignored.

    Attributes:
        cells: (300, 300) uint8, read-only, indexed [row, column] with row = y upwards and column = x: `UNKNOWN`,
            `FREE` or `OCCUPIED`. It shares memory with the grid.
    """

    __slots__ = ("_grid", "_read_only", "cells")

    def __init__(self) -> None:
        shape = (GRID_SIZE, GRID_SIZE)
        bounds = np.zeros(4, np.int32)
        self._adopt(Grid(np.zeros(shape, np.int8), np.full(shape, UNKNOWN, np.uint8), _no_changes(), bounds))

    def _adopt(self, grid: Grid, *, read_only: bool = False) -> "SeenGrid":
        """Use given arrays as the memory of this grid."""
        self._grid, self._read_only = grid, read_only
        self.cells = as_read_only(grid.cells)
        return self

    @classmethod
    def over(cls, *arrays: NDArray[Any], read_only: bool = False) -> "SeenGrid":
        """Return a grid that uses the arrays of a `Grid`."""
        return cls.__new__(cls)._adopt(Grid(*arrays), read_only=read_only)

    def update_from_scan(self, pose: ArrayLike, ranges: ArrayLike, angles: ArrayLike, max_range: float = 8.0) -> None:
        """Paint a range scan: cells before the first hit are free, cells at the hit are occupied.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Pose of the robot.
            ranges: (n,) float64 [m]. A range of `max_range` or more is no hit.
            angles: (n,) float64 [rad], robot frame. Ascending, n >= 2, spanning less than pi.
            max_range: Range of the range finder [m].

        Raises:
            ValueError: If the pose is not finite, or ranges or angles are invalid.
            RuntimeError: If the grid is a read-only view.
        """
        self._refuse_if_read_only()
        x, y, theta = pose_floats(pose)
        ranges = np.ascontiguousarray(ranges, dtype=np.float64)
        angles = np.ascontiguousarray(angles, dtype=np.float64)
        if ranges.ndim != 1 or ranges.shape != angles.shape or len(ranges) < 2:
            raise argument_error(
                "ranges",
                "an array of shape (n,), n >= 2, like angles",
                f"shape {ranges.shape} with angles {angles.shape}",
                "Give one range per ray.",
            )
        check_ranges(ranges)
        directions = ray_directions(angles)
        _painting.update_from_scan(self._grid, x, y, theta, ranges, directions, float(max_range))

    def clear_disc(self, pose: ArrayLike, radius: float = 0.2) -> None:
        """Mark the cells under a robot's body as free.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Pose of the robot.
            radius: Radius of the robot [m]. Occupied cells at the rim stay: they may be a wall that the robot touches.
        """
        self._refuse_if_read_only()
        x, y, _ = pose_floats(pose)
        radius = check_float("radius", radius, "Give the robot's radius in metres.", above=0.0)
        _painting.clear_disc(self._grid, x, y, radius)

    def bump(self, pose: ArrayLike, radius: float = 0.2) -> None:
        """Mark the cell just ahead of a robot's rim as occupied after a bump.

        The direction of a bump is unknown, so it weighs no more than two hits, and later readings can clear the cell.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Pose of the robot.
            radius: Radius of the robot [m].
        """
        self._refuse_if_read_only()
        x, y, theta = pose_floats(pose)
        _painting.mark_bump(self._grid, x, y, theta, radius)

    def merge(self, other: "SeenGrid", self_from_other: ArrayLike) -> None:
        """Add the evidence of another robot's grid.

        Args:
            other: Grid to add; unchanged.
            self_from_other: (3,) float64 [m, m, rad]. The other's start pose in this robot's start frame.
        """
        self._refuse_if_read_only()
        x, y, theta = pose_floats(self_from_other, "self_from_other")
        _painting.merge_grid(self._grid, other._grid.evidence.copy(), other._grid.bounds.copy(), x, y, theta)

    def copy(self) -> "SeenGrid":
        """Return an independent, writable grid with the same content."""
        evidence, cells, _, bounds = self._grid
        return SeenGrid.over(evidence.copy(), cells.copy(), _no_changes(), bounds.copy())

    def read_only_view(self) -> "SeenGrid":
        """Return a read-only view that shares memory with this grid."""
        return SeenGrid.over(*self._grid, read_only=True)

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the complete state."""
        return {"evidence": self._grid.evidence.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore a state of `get_state` in place; views of the grid remain valid."""
        self._refuse_if_read_only()
        shape = (GRID_SIZE, GRID_SIZE)
        evidence = state["evidence"]
        if not (isinstance(evidence, np.ndarray) and evidence.dtype == np.int8 and evidence.shape == shape):
            evidence = check_array("evidence", evidence, shape, "Pass what get_state returned.", dtype=np.int8)
        self._grid.evidence[:] = evidence
        np.take(_CELL_STATES, evidence.view(np.uint8), out=self._grid.cells, mode="wrap")
        self._grid.changes[0] = -1
        self._grid.bounds[:] = known_bounds(self.cells)

    def _refuse_if_read_only(self) -> None:
        if self._read_only:
            raise RuntimeError("SeenGrid: this is a read-only view. Make a copy() to write to.")


def _no_changes() -> NDArray[np.int32]:
    """Return the record of a grid whose changes are unknown."""
    return np.full(1 + _painting.MOST_CHANGES, -1, np.int32)
