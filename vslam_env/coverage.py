"""How much of the reachable floor the robots have seen, by their own grids."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import jit
from slam_backend.errors import FloatArray
from slam_backend.geometry import inverse, transform_points
from vslam_env.navigation import FREE, GRID_SIZE, cell_of


@jit
def _count_seen(cells: Any, places: Any, seen: Any) -> int:
    """Mark the places (n,) (flat indices, -1 = outside) whose cell is free; return how many are marked."""
    count = 0
    for i in range(len(places)):
        if not seen[i] and places[i] >= 0:
            seen[i] = cells[places[i]] == FREE
        count += seen[i]
    return count


class CoverageMeter:
    """Share of the free floor inside the union of the robots' grids, each laid at its true start pose.

    Args:
        free_area_cells: (n, 2) float64 [m], world frame. Centres of the cells of the free floor.
        true_starts: (K, 3) float64 [m, m, rad], world frame.
    """

    def __init__(self, free_area_cells: FloatArray, true_starts: FloatArray) -> None:
        self._places = [
            _flat_cells(transform_points(inverse(start), free_area_cells)) for start in np.asarray(true_starts)
        ]
        self._count = len(free_area_cells)

    def share(self, grids: Sequence[NDArray[np.uint8]]) -> float:
        """Return the coverage in [0, 1] from the cells (300, 300) of each robot's grid."""
        seen = np.zeros(self._count, np.bool_)
        count = 0
        for cells, places in zip(grids, self._places, strict=True):
            count = _count_seen(cells.ravel(), places, seen)
        return count / max(self._count, 1)


def _flat_cells(points: FloatArray) -> NDArray[np.int32]:
    """Return indices (n,) into a flat grid of the cells in which points (n, 2), start frame, lie; -1 outside."""
    rows, cols = cell_of(points).T
    inside = (rows >= 0) & (rows < GRID_SIZE) & (cols >= 0) & (cols < GRID_SIZE)
    return np.where(inside, rows * GRID_SIZE + cols, -1).astype(np.int32)
