"""Fast argument checks for functions that run several times a tick."""

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import FloatArray, argument_error
from vslam_env.navigation.grid_storage import GRID_SIZES


def pose_floats(pose: ArrayLike, name: str = "pose") -> tuple[float, float, float]:
    """Return a pose (3,) as three finite floats, or raise."""
    values = np.asarray(pose, dtype=np.float64)
    if values.shape != (3,):
        raise argument_error(name, "an array of shape (3,)", f"shape {values.shape}", "Give (x, y, theta).")
    x, y, theta = values.tolist()
    if not math.isfinite(x + y + theta):
        raise argument_error(name, "finite numbers", values, "Give (x, y, theta) in metres and radians.")
    return x, y, theta


def point_floats(point: ArrayLike, name: str) -> tuple[float, float]:
    """Return a point (2,) as two finite floats, or raise."""
    values = np.asarray(point, dtype=np.float64)
    if values.shape != (2,):
        raise argument_error(name, "an array of shape (2,)", f"shape {values.shape}", "Give (x, y).")
    x, y = values.tolist()
    if not math.isfinite(x + y):
        raise argument_error(name, "finite numbers", values, "Give (x, y) in metres.")
    return x, y


def positions_array(positions: ArrayLike, name: str) -> FloatArray:
    """Return positions as an array (k, 2), k >= 0, or raise."""
    values = np.ascontiguousarray(positions, dtype=np.float64)
    if values.size == 0:
        return np.empty((0, 2))
    if values.ndim != 2 or values.shape[1] != 2 or not np.isfinite(values).all():
        got = "NaN or infinity" if values.ndim == 2 and values.shape[1] == 2 else f"shape {values.shape}"
        raise argument_error(name, "finite numbers in an array of shape (k, 2)", got, "Give rows (x, y).")
    return values


def check_ranges(ranges: FloatArray) -> None:
    """Raise unless ranges (n,) [m] are at least 0."""
    if not (ranges >= 0.0).all():  # False for NaN
        raise argument_error("ranges", "distances >= 0 [m]", ranges, "Use max_range for a ray without a hit.")


def ray_directions(angles: FloatArray) -> FloatArray:
    """Return the unit vectors (2, n) of rays at angles (n,) [rad], n >= 1, ascending over less than pi, or raise."""
    are_good = len(angles) and (np.abs(angles) <= 2.0 * math.pi).all() and (np.diff(angles) > 0.0).all()
    if not (are_good and angles[-1] - angles[0] < math.pi):
        expected = "ascending angles spanning less than pi [rad]"
        raise argument_error("angles", expected, angles, "Order the rays from right to left.")
    return np.array([[math.cos(angle) for angle in angles], [math.sin(angle) for angle in angles]])


def check_cells(cells: NDArray[np.uint8]) -> None:
    """Raise unless an array has shape and dtype of `OccupancyGrid.cells`."""
    is_grid = isinstance(cells, np.ndarray) and cells.dtype == np.uint8 and cells.ndim == 2
    if not (is_grid and cells.shape[0] == cells.shape[1] and len(cells) in GRID_SIZES):
        got = f"shape {cells.shape} of {cells.dtype}" if isinstance(cells, np.ndarray) else cells
        raise argument_error("cells", "the grid, or its cells (S, S) of uint8", got, "Pass belief.grid.")
