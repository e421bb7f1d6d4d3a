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
def _mark_seen(cells: Any, places: Any, floor: Any, seen: Any) -> int:
    """Mark floor cells `floor` (n,) whose place (n,) in a flat grid is free; return how many were not marked before.

    Places ascend, so that a grid is read from its beginning to its end.
    """
    count = 0
    for i in range(len(places)):
        if cells[places[i]] == FREE and not seen[floor[i]]:
            seen[floor[i]] = True
            count += 1
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
            count += _mark_seen(cells.ravel(), *places, seen)
        return count / max(self._count, 1)


def _flat_cells(points: FloatArray) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return the cells of a flat grid in which points (n, 2), start frame, lie, ascending, and the points' indices."""
    rows, cols = cell_of(points).T
    inside = np.flatnonzero((rows >= 0) & (rows < GRID_SIZE) & (cols >= 0) & (cols < GRID_SIZE))
    places = (rows * GRID_SIZE + cols)[inside]
    order = np.argsort(places, kind="stable")
    return places[order].astype(np.int32), inside[order].astype(np.int32)
