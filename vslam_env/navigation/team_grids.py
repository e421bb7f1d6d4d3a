"""`TeamGrids`: the seen grids of a team, into all of which a tick's readings are painted at once."""

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from vslam_env.navigation._grid_kernels import MOST_CHANGES, NUM_PAINT_ROWS, update_grids
from vslam_env.navigation.occupancy_grid import GRID_SIZE, UNKNOWN, SeenGrid
from vslam_env.navigation.validation import check_ranges, pose_floats


class TeamGrids:
    """A seen grid for each robot; they lie in arrays of one piece.

    Args:
        num_robots: K.

    Attributes:
        grids: Grids of the robots.
        cells: (K, 300, 300) uint8. Their cells, one after the other. To be looked at.
        changes: (K, 1 + n) int32. Per grid the number of verdicts that have changed since a reader of the cells set it
            to 0, then the places of that many cells in the flat grid, some perhaps twice. -1 if all may have changed,
            as in the beginning.
        bounds: (K, 4) int32. First row and column of what is known of each grid, and one past the last ones; zeros if
            nothing is. To be looked at.
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
        """Paint what robots read in a tick: by `update_from_scan`, `clear_disc` and, after a bump, `bump`.

        Args:
            shared: (K, K) int64. 1 where what robot j reads is painted into i's grid; of the robots in ascending order.
            poses: (K, K, 3) float64 [m, m, rad]. Where robot j was, in the start frame of i's grid.
            scans: (K, R) float64 [m]. As `SeenGrid.update_from_scan` expects each.
            bumps: (K,) bool. Which robots bumped into something.
            directions: (2, R) float64. Of the rays, as `ray_directions` returns them.
            max_range: Range of the scans [m].
            radius: Radius of the robots [m].

        Raises:
            ValueError: If one of these poses is not finite, or ranges are less than 0; then nothing is painted.
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
