"""Relations between places on known floor: lengths of paths, lines of sight, common rooms, and frontier cells.

All functions take a `DistanceMap`, whose arrays hold the known part of the grid; places are in the start frame.
"""

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from vslam_env.navigation._grid_kernels import CELL, FREE, OCCUPIED, UNKNOWN
from vslam_env.navigation._planning_kernels import lines_of_sight, nearest_open, path_lengths
from vslam_env.navigation.planning import DistanceMap

OPEN_CELLS = 5  # [cells] an open cell is looked for this far from a place in an inflated wall
ROOM_CORE = 0.75  # [m] distance from walls of the cells at the core of a room; doors are narrower than twice this


def lengths_between(ways: DistanceMap, starts: ArrayLike, goals: ArrayLike) -> FloatArray:
    """Return the lengths of the cheapest paths between places.

    Args:
        ways: Distance map of the grid, from any start.
        starts: (k, 2) float64 [m], start frame. Places where the paths begin; one search each.
        goals: (n, 2) float64 [m], start frame. Places where they end.

    Returns:
        (k, n) float64 [m]. Infinite where no path is known.

    Raises:
        ValueError: If an array has the wrong shape or is not finite.
    """
    return np.asarray(path_lengths(ways.weights, _open_cells(ways, starts), _open_cells(ways, goals)))


def sees(
    ways: DistanceMap, viewpoints: ArrayLike, targets: IntArray, reach: float, among: BoolArray | None = None
) -> BoolArray:
    """Return which cells are visible from which places: no occupied cell lies between them.

    Args:
        ways: Distance map of the grid.
        viewpoints: (n, 2) float64 [m], start frame. Places to look from; any heading.
        targets: (m, 2) int64 rows (row, column) in the arrays of `ways`, as from `frontier_cells` or `cells_of`.
        reach: Range of view [m].
        among: (n, m) bool. Pairs of a place and a cell that are tried; the result is False for others. None: all.

    Returns:
        (n, m) bool.
    """
    places = cells_of(ways, viewpoints)
    visible = np.ones((len(places), len(targets)), np.bool_) if among is None else among.copy()
    lines_of_sight(ways.box, places, np.ascontiguousarray(targets), reach / CELL, visible)
    return visible


def cells_of(ways: DistanceMap, places: ArrayLike) -> IntArray:
    """Return the cells (n, 2) int64 rows (row, column) of places (n, 2) [m]; those outside are moved to the edge."""
    return np.clip(ways.cells_of(places), 0, np.array(ways.box.shape) - 1)


def frontier_cells(ways: DistanceMap) -> IntArray:
    """Return the unknown cells (m, 2) int64 rows (row, column) that border on free ones, in the arrays of `ways`."""
    free = np.pad(ways.box == FREE, 1)
    beside = free[:-2, 1:-1] | free[2:, 1:-1] | free[1:-1, :-2] | free[1:-1, 2:]
    return np.argwhere(beside & (ways.box == UNKNOWN))


def rooms_of(ways: DistanceMap, places: ArrayLike, core: float = ROOM_CORE) -> IntArray:
    """Return the room of each place, a number > 0; places with the same number share a room.

    Rooms are the connected parts of the free cells at least `core` away from walls, and the cells nearest to them
    (morphological segmentation, Fabrizi and Saffiotti 2000; compared by Bormann et al. 2016).

    Args:
        ways: Distance map of the grid.
        places: (n, 2) float64 [m], start frame.
        core: Distance from walls of the core of a room [m]; passages narrower than twice this separate rooms.

    Returns:
        (n,) int64. 1 everywhere if no place is that far from walls.
    """
    from scipy import ndimage  # slow import, not always needed

    cells = cells_of(ways, places)
    clearance = ndimage.distance_transform_edt(ways.box != OCCUPIED)
    labels, count = ndimage.label((clearance * CELL >= core) & (ways.box == FREE), np.ones((3, 3)))
    if count == 0:
        return np.ones(len(cells), np.int64)
    rows, cols = ndimage.distance_transform_edt(labels == 0, return_distances=False, return_indices=True)
    nearest = labels[rows, cols]
    return np.asarray(nearest[cells[:, 0], cells[:, 1]], dtype=np.int64)


def _open_cells(ways: DistanceMap, places: ArrayLike) -> NDArray[np.int64]:
    """Return the open cells (n, 2) nearest to places (n, 2) [m]; -1 where there is none nearby."""
    cells = [
        nearest_open(ways.box, ways.weights, row, col, OPEN_CELLS, 1) for row, col in ways.cells_of(places).tolist()
    ]
    return np.array(cells, np.int64).reshape(-1, 2)
