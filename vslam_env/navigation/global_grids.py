"""Pictures of all that robots have seen, at the finest resolution at which it fits."""

from typing import Self

import numpy as np
from numpy.typing import NDArray

from vslam_env.navigation._view_kernels import COARSE, NUM_COARSE, write_global_grid, write_global_grids
from vslam_env.navigation.looks import TeamLooks
from vslam_env.navigation.occupancy_grid import OccupancyGrid
from vslam_env.navigation.team_grids import TeamGrids


class GlobalGrids:
    """Picture of each robot's grid. They follow from the grids and looks, and are no part of a state.

    Args:
        num_robots: Number of robots K.

    Attributes:
        pictures: (K, 3, 48, 48) uint8. Shares of free, occupied and looked-at cells, see `write_global_grid`.
        frames: (K, 3) float32 [m]. Middle of each picture in the start frame of the robot, and size of its cells.
    """

    def __init__(self, num_robots: int) -> None:
        self.pictures: NDArray[np.uint8] = np.zeros((num_robots, NUM_COARSE, COARSE, COARSE), np.uint8)
        self.frames: NDArray[np.float32] = np.zeros((num_robots, 3), np.float32)

    @classmethod
    def of(cls, grid: OccupancyGrid, looks: NDArray[np.uint8]) -> Self:
        """Return the picture of one grid and its looks (S, S) uint8."""
        self = cls(1)
        write_global_grid(grid.cells, looks, grid.bounds, self.pictures[0], self.frames[0])
        return self

    def update(self, grids: TeamGrids, looks: TeamLooks) -> None:
        """Draw the grids of the robots with their looks, which have the same size."""
        write_global_grids(grids.cells, looks.counts, grids.bounds, self.pictures, self.frames)
