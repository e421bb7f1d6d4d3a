"""Where the seen floor ends: frontiers."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import BoolArray, FloatArray, check_array
from vslam_env.navigation._arguments import check_cells
from vslam_env.navigation._painting_kernels import GRID_SIZE, known_bounds
from vslam_env.navigation._search_kernels import HEADING, LENGTH, SIZE, XY, frontiers_over
from vslam_env.navigation.planning import checked_start


@dataclass(frozen=True, slots=True, kw_only=True)
class Frontiers:
    """Places to explore, by increasing path length.

    Attributes:
        goals: (n, 2) float64 [m], start frame. Open floor next to the middle of each frontier.
        headings: (n,) float64 [rad], start frame. Where the unknown lies, seen from the goal.
        sizes: (n,) float64 [m]. Length of each frontier.
        lengths: (n,) float64 [m]. Of the path from the robot to the goal.
    """

    goals: FloatArray
    headings: FloatArray
    sizes: FloatArray
    lengths: FloatArray


def find_frontiers(
    cells: NDArray[np.uint8], start_xy: ArrayLike, radius: float = 0.2, ignored: BoolArray | None = None
) -> Frontiers:
    """Find where floor that a robot can reach borders on what has not been seen.

    A frontier is a connected set of unknown cells beside free ones, of at least 0.6 m, and with an open cell within
    1 m of it to which a way is known. Those above 4 m are cut into pieces of equal size.

    Args:
        cells: (300, 300) uint8. `SeenGrid.cells`.
        start_xy: (2,) float64 [m], start frame. Where the robot is.
        radius: Of the robot [m].
        ignored: (300, 300) bool. Unknown cells that do not count; None to count all.

    Returns:
        The frontiers, nearest first; none if nothing is left to explore.

    Raises:
        ValueError: If an array has the wrong shape, or a number is not finite.
    """
    if ignored is None:
        ignored = np.zeros((GRID_SIZE, GRID_SIZE), np.bool_)
    mask = check_array("ignored", ignored, (GRID_SIZE, GRID_SIZE), "Mark cells of the grid.", dtype=np.bool_)
    check_cells(cells)
    rows = frontiers_over(cells, known_bounds(cells), *checked_start(start_xy, radius), mask)
    return Frontiers(
        goals=rows[:, XY].copy(),
        headings=rows[:, HEADING].copy(),
        sizes=rows[:, SIZE].copy(),
        lengths=rows[:, LENGTH].copy(),
    )
