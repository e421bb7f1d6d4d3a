"""Coverage of the free floor by the robots' occupancy grids, and each robot's share in its discovery."""

import numpy as np

from slam_backend.core.read_only import as_constant
from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.geometry import inverse, transform_points
from slam_backend.state import BOOL, INT64, Array, Float, State
from vslam_env.navigation import FREE, TeamGrids, cell_of
from vslam_env.navigation._grid_kernels import GRID_SIZE
from vslam_env.navigation.grid_storage import margin


class CoverageCells:
    """Cells of the free floor in each robot's grid, given its true start pose; read-only.

    Args:
        free_area_cells: (n, 2) float64 [m], world frame. Centres of the cells of the free floor.
        true_starts: (K, 3) float64 [m, m, rad], world frame. Start poses.

    Attributes:
        cells: (n, 2) float64 [m], world frame. Centres of the cells of the free floor.
        rows, columns: (K, n) int32. Place of each in the robots' grids, counted in a grid of the first size, so that
            it may be negative.
    """

    def __init__(self, free_area_cells: FloatArray, true_starts: FloatArray) -> None:
        places = [cell_of(transform_points(inverse(start), free_area_cells), GRID_SIZE) for start in true_starts]
        self.cells = as_constant(np.ascontiguousarray(free_area_cells))
        self.rows, self.columns = map(as_constant, np.moveaxis(np.array(places, np.int32), 2, 0))

    def seen(self, grids: TeamGrids) -> BoolArray:
        """Return which cells each robot has seen (K, n), given the occupancy grids of the robots."""
        size = grids.cells.shape[1]
        rows, columns = self.rows + margin(size), self.columns + margin(size)
        outside = (rows.view(np.uint32) >= size) | (columns.view(np.uint32) >= size)  # negative ones are large
        flat = rows * size + columns
        flat[outside] = 0
        verdicts = [cells.ravel().take(at) for cells, at in zip(grids.cells, flat, strict=True)]
        return np.asarray((np.array(verdicts) == FREE) & ~outside)


class CoverageTracker:
    """Share of the free floor seen in the robots' grids, and each robot's share in its discovery.

    Args:
        cells: Floor cells in the robots' grids.

    Attributes:
        share: Share of the floor that the robots saw at the last update, in [0, 1].
    """

    STATE = State(ever=Array(BOOL, "CELLS"), found=Array(INT64, "K"), share=Float(0.0, 1.0))

    def __init__(self, cells: CoverageCells) -> None:
        self._cells = cells
        self._ever = np.zeros(len(cells.cells), np.bool_)
        self._found = np.zeros(len(cells.rows), np.int64)
        self.share = 0.0

    def update(self, grids: TeamGrids, positions: FloatArray) -> FloatArray:
        """Compute the share, and credit floor that is seen for the first time to the nearest robot.

        A cell is discovered once, so the shares of discovery never decrease. Their sum is the coverage unless seen
        floor is lost again.

        Args:
            grids: Occupancy grids of the robots.
            positions: (K, 2 or 3) float64 [m], world frame. True positions of the robots.

        Returns:
            (K,) float64. Share of the free floor that each robot was nearest to when it was first seen.
        """
        seen = np.asarray(self._cells.seen(grids).any(axis=0))
        fresh = self._cells.cells[seen & ~self._ever]
        gaps = np.square(fresh[:, None] - positions[:, :2]).sum(axis=2)
        self._found += np.bincount(gaps.argmin(axis=1), minlength=len(positions))
        self._ever |= seen
        self.share = float(np.count_nonzero(seen) / max(len(seen), 1))
        return np.asarray(self._found / max(len(seen), 1))

    def overlap(self, grids: TeamGrids) -> float:
        """Return the share of the floor seen by any robot that at least two see in their own grids, 0 if none is."""
        seers = np.count_nonzero(self._cells.seen(grids), axis=0)
        return int(np.count_nonzero(seers > 1)) / max(int(np.count_nonzero(seers)), 1)

    def share_now(self, grids: TeamGrids) -> float:
        """Return the share of the floor that the robots see now, without an update."""
        return float(np.count_nonzero(self._cells.seen(grids).any(axis=0)) / max(len(self._ever), 1))
