"""Occupancy grid of one robot in its own start frame."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.short_repr import described
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_float
from slam_backend.state import Record, State
from vslam_env.navigation import _grid_kernels as _painting
from vslam_env.navigation._grid_kernels import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    LARGEST_HALF_WIDTH,
    MOST_FREE,
    MOST_OCCUPIED,
    OCCUPIED,
    UNKNOWN,
    Grid,
)
from vslam_env.navigation.grid_storage import GridPart, GridStorage, known_bounds, margin
from vslam_env.navigation.validation import check_ranges, pose_floats, ray_directions

# State of a cell by its evidence, as an unsigned byte.
_CELL_STATES = np.where(np.arange(256) == 0, UNKNOWN, np.where(np.arange(256) < 128, OCCUPIED, FREE)).astype(np.uint8)

__all__ = ["CELL", "FREE", "GRID_SIZE", "OCCUPIED", "UNKNOWN", "OccupancyGrid", "cell_of", "centre_of"]


def cell_of(points: ArrayLike, size: int = GRID_SIZE) -> IntArray:
    """Return the cells that contain points.

    Args:
        points: (..., 2) float64 [m], start frame, rows (x, y).
        size: Cells along a side of the grid, `len(grid.cells)`; a new grid's by default.

    Returns:
        (..., 2) int64 rows (row, column), to index `OccupancyGrid.cells`. Below 0 or at least `size` for points outside
        the grid.

    >>> cell_of([0.1, -29.9]).tolist()
    [0, 150]
    >>> cell_of([0.1, -29.9], size=600).tolist()
    [150, 300]
    """
    points = np.asarray(points, dtype=np.float64)
    return np.asarray(np.floor((points[..., ::-1] + HALF_WIDTH) / CELL), dtype=np.int64) + margin(size)


def centre_of(cells: ArrayLike, size: int = GRID_SIZE) -> FloatArray:
    """Return the centres of cells.

    Args:
        cells: (..., 2) int64 rows (row, column).
        size: Cells along a side of the grid, see `cell_of`.

    Returns:
        (..., 2) float64 [m], start frame, rows (x, y).

    >>> centre_of([0, 150]).round(6).tolist()
    [0.1, -29.9]
    """
    indices = np.asarray(cells)[..., ::-1] - margin(size)
    return np.asarray((indices + 0.5) * CELL - HALF_WIDTH, dtype=np.float64)


class OccupancyGrid:
    """Occupancy grid around a robot's start pose that grows with what was seen, up to 400 m in each direction.

    Each cell counts evidence (hits minus passes) within bounds, so that a single wrong reading neither closes a door
    nor opens a wall; `cells` holds the resulting states. A new grid covers 60 x 60 m; it doubles when something is seen
    beyond. Readings farther than 400 m from the start are ignored.
    """

    STATE = State(known=Record(GridPart))

    __slots__ = ("_read_only", "_row", "_storage")

    def __init__(self) -> None:
        self._storage, self._row, self._read_only = GridStorage(1), 0, False

    @classmethod
    def over(cls, storage: GridStorage, row: int, *, read_only: bool = False) -> "OccupancyGrid":
        """Return the grid in a row of a storage."""
        grid = cls.__new__(cls)
        grid._storage, grid._row, grid._read_only = storage, row, read_only
        return grid

    def __repr__(self) -> str:
        return described(self, ("cells", "bounds"))

    @property
    def _grid(self) -> Grid:
        return self._storage.views[self._row]

    @property
    def cells(self) -> NDArray[np.uint8]:
        """(S, S) uint8. `UNKNOWN`, `FREE` or `OCCUPIED`, indexed [row, column] with row = y upwards and column = x.

        Read-only; it shares memory with the grid until the grid grows. The start pose is in the middle; see `cell_of`.
        """
        return self._storage.read_only_cells[self._row]

    @property
    def bounds(self) -> NDArray[np.int32]:
        """(4,) int32. First row and column of the known part, and one past the last ones; zeros if nothing is known."""
        return self._grid.bounds.copy()

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
        directions, max_range = ray_directions(angles), float(max_range)
        self._reserve(max(abs(x), abs(y)) + min(float(ranges.max()), max_range))
        _painting.update_from_scan(self._grid, x, y, theta, ranges, directions, max_range)

    def clear_disc(self, pose: ArrayLike, radius: float = 0.2) -> None:
        """Mark the cells under a robot's body as free.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Pose of the robot.
            radius: Radius of the robot [m]. Occupied cells at the rim stay: they may be a wall that the robot touches.
        """
        self._refuse_if_read_only()
        x, y, _ = pose_floats(pose)
        radius = check_float("radius", radius, "Give the robot's radius in metres.", above=0.0)
        self._reserve(max(abs(x), abs(y)) + radius)
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
        self._reserve(max(abs(x), abs(y)) + radius + CELL)
        _painting.mark_bump(self._grid, x, y, theta, radius)

    def merge(self, other: "OccupancyGrid", self_from_other: ArrayLike) -> None:
        """Add the evidence of another robot's grid.

        Each cell takes the other's value at its centre, or the firmest wall among four points around it: without these,
        a wall one cell thick would come out of a rotation with holes.

        Args:
            other: Grid to add; unchanged.
            self_from_other: (3,) float64 [m, m, rad]. The other's start pose in this robot's start frame.
        """
        self._refuse_if_read_only()
        x, y, theta = pose_floats(self_from_other, "self_from_other")
        part = other.known
        height, width = part.values.shape
        if not height:
            return
        c, s, (top, left) = math.cos(theta), math.sin(theta), part.corner
        u = np.array([left, left, left + width, left + width]) * CELL - HALF_WIDTH
        v = np.array([top, top + height, top, top + height]) * CELL - HALF_WIDTH
        far = 2.0 * LARGEST_HALF_WIDTH  # as good as anywhere outside
        corners = np.clip(np.column_stack([x + c * u - s * v, y + s * u + c * v]), -far, far)
        self._reserve(float(np.abs(corners).max()))
        grid, size = self._grid, self._storage.size
        first, last = np.clip([cell_of(corners.min(axis=0), size), cell_of(corners.max(axis=0), size) + 1], 0, size)
        here = slice(first[0], last[0]), slice(first[1], last[1])
        u, v = np.moveaxis(centre_of(np.moveaxis(np.mgrid[here], 0, -1), size) - (x, y), -1, 0)
        columns, rows = (c * u + s * v + HALF_WIDTH) / CELL - left, (-s * u + c * v + HALF_WIDTH) / CELL - top
        around = np.pad(part.values, 1).astype(np.int64)  # nothing is known of what lies outside

        def evidence_at(ahead: float, aside: float) -> IntArray:
            row, col = np.floor(rows + ahead).astype(np.int64) + 1, np.floor(columns + aside).astype(np.int64) + 1
            return np.asarray(around[row.clip(0, height + 1), col.clip(0, width + 1)])

        evidence = evidence_at(0.0, 0.0)
        wall = np.maximum.reduce([evidence_at(ahead, aside) for ahead in (-0.25, 0.25) for aside in (-0.25, 0.25)])
        evidence = np.where(wall > np.maximum(evidence, 0), wall, evidence)
        total = np.clip(grid.evidence[here] + evidence, MOST_FREE, MOST_OCCUPIED)
        total[(total == 0) & (evidence != 0)] = -1  # 0 is kept for cells that were never touched
        grid.evidence[here] = total
        grid.cells[here] = _CELL_STATES[grid.evidence[here].view(np.uint8)]
        grid.bounds[:] = known_bounds(grid.cells)

    def enter(self, free: ArrayLike, occupied: ArrayLike) -> None:
        """Enter places as if scans had shown them as often as counts.

        Args:
            free: (n, 2) float64 [m], start frame.
            occupied: (m, 2) float64 [m], start frame. Cells that contain both are occupied.
        """
        self._refuse_if_read_only()
        places = [np.asarray(points, np.float64).reshape(-1, 2) for points in (free, occupied)]
        self._reserve(max(float(np.abs(points).max(initial=0.0)) for points in places))
        grid, size = self._grid, self._storage.size
        for points, evidence in zip(places, (MOST_FREE, MOST_OCCUPIED), strict=True):
            cells = cell_of(points, size)
            there = tuple(cells[((cells >= 0) & (cells < size)).all(axis=1)].T)
            grid.evidence[there] = evidence
            grid.cells[there] = _CELL_STATES[np.int8(evidence).view(np.uint8)]
        grid.bounds[:] = known_bounds(grid.cells)

    def copy(self) -> "OccupancyGrid":
        """Return an independent, writable grid with the same content."""
        grid = OccupancyGrid()
        grid.known = self.known
        return grid

    def read_only_view(self) -> "OccupancyGrid":
        """Return a read-only view of this grid, which follows its changes."""
        return OccupancyGrid.over(self._storage, self._row, read_only=True)

    @property
    def known(self) -> GridPart:
        """Copy of the evidence in the known part; may be assigned to another grid, whose views remain valid."""
        return GridPart.of(self._grid.evidence, self._grid.bounds)

    @known.setter
    def known(self, part: GridPart) -> None:
        self._refuse_if_read_only()
        self._storage.reserve(part.reach)
        grid = self._grid
        top, left, bottom, right = grid.bounds.tolist()
        grid.evidence[top:bottom, left:right] = grid.cells[top:bottom, left:right] = 0
        there, grid.bounds[:] = part.place(self._storage.size)
        grid.evidence[there] = part.values
        grid.cells[there] = _CELL_STATES[part.values.view(np.uint8)]

    def _reserve(self, distance: float) -> None:
        """Grow the grid so that it holds what is at most so far from the start [m] along x and y."""
        self._storage.reserve(_painting.cells_to_middle(distance))

    def _refuse_if_read_only(self) -> None:
        if self._read_only:
            raise RuntimeError("OccupancyGrid: this is a read-only view. Make a copy() to write to.")
