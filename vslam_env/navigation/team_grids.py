"""Occupancy grids of a team, updated together with the readings of a tick."""

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from vslam_env.navigation._grid_kernels import MOST_CHANGES, NUM_PAINT_ROWS, update_grids
from vslam_env.navigation.occupancy_grid import GRID_SIZE, UNKNOWN, SeenGrid
from vslam_env.navigation.validation import check_ranges, pose_floats


class TeamGrids:
    """Occupancy grid of each robot, stored in common arrays.

    Args:
        num_robots: Number of robots K.

    Attributes:
        grids: Grid of each robot.
        cells: (K, 300, 300) uint8. Cells of all grids; read-only.
        changes: (K, 1 + n) int32. Number of cells of each grid that changed state since the reader last set this number
            to 0, followed by their flat indices, possibly with duplicates. -1 if any cell may have changed, as
            initially.
        bounds: (K, 4) int32. First row and column of the known part of each grid, and one past the last ones; zeros if
            nothing is known; read-only.
    """

    def __init__(self, num_robots: int) -> None:
        shape = (num_robots, GRID_SIZE, GRID_SIZE)
        evidence, self.cells = np.zeros(shape, np.int8), np.full(shape, UNKNOWN, np.uint8)
        self.changes = np.full((num_robots, 1 + MOST_CHANGES), -1, np.int32)
        self.bounds = np.zeros((num_robots, 4), np.int32)
        self._room = np.empty((0, 0))
        self._together = evidence, self.cells, self.changes, self.bounds
        self.grids = list(map(SeenGrid.over, *self._together))

    def update(
        self,
        shared: IntArray,
        poses: FloatArray,
        scans: FloatArray,
        bumps: BoolArray,
        directions: FloatArray,
        max_range: float,
        radius: float,
    ) -> None:
        """Paint the readings of a tick by `update_from_scan`, `clear_disc` and, after a bump, `bump`.

        Args:
            shared: (K, K) int64. 1 where the readings of robot j are painted into the grid of robot i.
            poses: (K, K, 3) float64 [m, m, rad]. Pose of robot j in the start frame of robot i.
            scans: (K, R) float64 [m]. Scans of the robots, see `SeenGrid.update_from_scan`.
            bumps: (K,) bool. True for robots that bumped into an obstacle.
            directions: (2, R) float64. Unit vectors of the rays from `ray_directions`.
            max_range: Range of the range finder [m].
            radius: Radius of the robots [m].

        Raises:
            ValueError: If a pose of a shared reading is not finite, or a range is negative; nothing is painted then.
        """
        num_rays = scans.shape[1]
        if self._room.shape[1] != num_rays + 1:
            self._room = np.empty((NUM_PAINT_ROWS, num_rays + 1))
        owner, robot = update_grids(
            self._together, shared, poses, scans, bumps, directions, max_range, radius, self._room
        )
        if owner >= 0:
            pose_floats(poses[owner, robot])
            check_ranges(scans[robot])
