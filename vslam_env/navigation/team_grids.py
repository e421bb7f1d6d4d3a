"""Occupancy grids of a team, updated together with the readings of a tick."""

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.state import Child, Each, State
from vslam_env.navigation._grid_kernels import NUM_PAINT_ROWS, update_grids
from vslam_env.navigation.grid_storage import GridStorage
from vslam_env.navigation.occupancy_grid import OccupancyGrid
from vslam_env.navigation.validation import check_ranges, pose_floats


class TeamGrids(GridStorage):
    """Occupancy grid of each robot, stored in common arrays; see `GridStorage` for these.

    Args:
        num_robots: Number of robots K.

    Attributes:
        grids: Grid of each robot.
    """

    STATE = State(grids=Each(Child(OccupancyGrid), "K", list))

    def __init__(self, num_robots: int) -> None:
        super().__init__(num_robots)
        self.grids = [OccupancyGrid.over(self, robot) for robot in range(num_robots)]
        self._room = np.empty((0, 0))

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
            scans: (K, R) float64 [m]. Scans of the robots, see `OccupancyGrid.update_from_scan`.
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
        tick = shared, poses, scans, bumps, directions, max_range, radius, self._room
        owner, robot, needed = update_grids(self.arrays, *tick)
        if 2 * needed > self.size:
            self.reserve(needed)
            update_grids(self.arrays, *tick)
        if owner >= 0:
            pose_floats(poses[owner, robot])
            check_ranges(scans[robot])
