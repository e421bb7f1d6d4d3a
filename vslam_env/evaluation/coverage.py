"""Coverage of the free floor by the robots' occupancy grids, and each robot's share in its discovery."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place
from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import inverse, transform_points
from slam_backend.state import INT64, Array, State
from vslam_env.navigation import FREE, TeamGrids, cell_of
from vslam_env.navigation._grid_kernels import LARGEST_SIZE


class Tally(NamedTuple):
    """Observation counts of N floor cells, with m entries in the grids of K robots.

    Attributes:
        seen: (m,) int8. 1 for entries whose floor cell the robot has seen.
        seers: (N,) int64. Number of robots that see each cell.
        ever: (N,) int64. 1 for cells that have been discovered.
        fresh: (1 + N,) int32. Number and indices of cells that may be newly discovered; -1: any cells.
        found: (K,) int64. Number of cells discovered by each robot.
    """

    seen: NDArray[np.int8]
    seers: IntArray
    ever: IntArray
    fresh: NDArray[np.int32]
    found: IntArray


@device
@in_place
def _recount(changes: Any, cells: Any, laid: Any, first: int, last: int, tally: Tally) -> int:
    """Update the floor cells seen by one robot.

    Args:
        changes: (1 + n,) int32. Changes of the robot's grid, see `GridStorage`.
        cells: (S, S) uint8. Cells of the robot's grid.
        laid: (2, m) int32. Floor cells in the grids, see `CoverageCells`.
        first: First entry of the robot in `laid`.
        last: One past its last entry.
        tally: Counts; changed.

    Returns:
        Increase in the number of floor cells seen by any robot.
    """
    seen, seers, fresh = tally.seen, tally.seers, tally.fresh
    places, more, all_may_have = laid[0, :last], 0, changes[0] < 0
    size, inset = len(cells), (LARGEST_SIZE - len(cells)) // 2
    for k in range(1 if all_may_have else changes[0]):
        begin = first if all_may_have else first + np.searchsorted(places[first:], changes[1 + k])
        for i in range(begin, last):
            if not all_may_have and places[i] != changes[1 + k]:
                break
            row, col = places[i] // LARGEST_SIZE - inset, places[i] % LARGEST_SIZE - inset
            is_inside = 0 <= row < size and 0 <= col < size
            now, cell = is_inside and cells[row, col] == FREE, laid[1, i]
            if now != seen[i]:
                seen[i] = now
                seers[cell] += 1 if now else -1
                if now and seers[cell] == 1:
                    more += 1
                    if not tally.ever[cell] and fresh[0] >= 0:
                        fresh[0] = fresh[0] + 1 if fresh[0] < len(seers) else -1
                        if fresh[0] > 0:
                            fresh[fresh[0]] = cell
                elif not now:
                    more -= seers[cell] == 0
    return more


@in_place
def _update(
    changes: Any, cells: Any, laid: Any, bounds: Any, area: Any, positions: Any, arrays: tuple[Any, ...], shares: Any
) -> int:
    """Process the changes of all grids, and credit floor cells seen for the first time to the nearest robot.

    Args:
        changes: (K, 1 + n) int32. Changes of the grids, see `TeamGrids`; cleared.
        cells: (K, S, S) uint8. Cells of the grids.
        laid, bounds: Floor cells in the grids, see `CoverageCells`.
        area: (N, 2) float64 [m], world frame. Centres of the floor cells.
        positions: (K, 2 or 3) float64 [m], world frame. Positions of the robots.
        arrays: Arrays of a `Tally`; changed.
        shares: (K,) float64. Output: cells discovered by each robot as a share of the floor.

    Returns:
        Increase in the number of floor cells seen by any robot.
    """
    tally, more = Tally(*arrays), 0
    for robot in range(len(cells)):
        more += _recount(changes[robot], cells[robot], laid, bounds[robot], bounds[robot + 1], tally)
        changes[robot, 0] = 0
    fresh = tally.fresh
    for k in range(len(area) if fresh[0] < 0 else fresh[0]):
        i = k if fresh[0] < 0 else fresh[1 + k]
        if tally.seers[i] > 0 and not tally.ever[i]:
            tally.ever[i] = 1
            nearest, least = 0, np.inf
            for robot in range(len(positions)):
                gap = (area[i, 0] - positions[robot, 0]) ** 2 + (area[i, 1] - positions[robot, 1]) ** 2
                if gap < least:
                    nearest, least = robot, gap
            tally.found[nearest] += 1
    fresh[0] = 0
    for robot in range(len(tally.found)):
        shares[robot] = tally.found[robot] / max(len(area), 1)
    return more


class CoverageCells:
    """Cells of the free floor in each robot's grid, given its true start pose; read-only.

    Args:
        free_area_cells: (n, 2) float64 [m], world frame. Centres of the cells of the free floor.
        true_starts: (K, 3) float64 [m, m, rad], world frame. Start poses.

    Attributes:
        cells: (n, 2) float64 [m], world frame. Centres of the cells of the free floor.
        laid: (2, m) int32. Flat indices of the floor cells in a grid of the largest size, ascending for each robot,
            and the indices of these floor cells.
        bounds: (K + 1,) int64. Start of each robot's columns in `laid`, and the end of the last.
    """

    def __init__(self, free_area_cells: FloatArray, true_starts: FloatArray) -> None:
        parts = [_flat_cells(transform_points(inverse(start), free_area_cells)) for start in np.asarray(true_starts)]
        self.cells = as_constant(np.ascontiguousarray(free_area_cells))
        self.laid = as_read_only(np.concatenate(parts, axis=1))
        self.bounds = as_read_only(np.cumsum([0, *(part.shape[1] for part in parts)]))


class CoverageTracker:
    """Share of the free floor seen in the robots' grids, and each robot's share in its discovery.

    Updates are incremental, so all calls must concern the same grids.

    Args:
        cells: Floor cells in the robots' grids.
    """

    STATE = State(ever=Array(INT64, "CELLS", 0, 1), found=Array(INT64, "K"))

    def __init__(self, cells: CoverageCells) -> None:
        self._meter = cells
        count = len(cells.cells)
        self._tally = Tally(
            seen=np.zeros(cells.laid.shape[1], np.int8),
            seers=np.zeros(count, np.int64),
            ever=np.zeros(count, np.int64),
            fresh=np.zeros(1 + count, np.int32),
            found=np.zeros(len(cells.bounds) - 1, np.int64),
        )
        self._ever, self._found = self._tally.ever, self._tally.found
        self._covered = 0
        self._began = False

    def update(self, grids: TeamGrids, positions: FloatArray, found: FloatArray) -> float:
        """Update the coverage from the grids and clear their record of changes.

        A cell is discovered once, so the shares of discovery never decrease. Their sum is the coverage unless seen
        floor is lost again.

        Args:
            grids: Occupancy grids of the robots.
            positions: (K, 2 or 3) float64 [m], world frame. True positions of the robots.
            found: (K,) float64. Output: share of the free floor that each robot was nearest to when it was first seen.

        Returns:
            Coverage in [0, 1].
        """
        if not self._began:
            grids.changes[:, 0] = -1
            self._began = True
        area = self._meter
        self._covered += _update(
            grids.changes, grids.cells, area.laid, area.bounds, area.cells, positions, tuple(self._tally), found
        )
        return self._covered / max(len(area.cells), 1)

    @property
    def overlap(self) -> float:
        """Share of the floor seen by any robot that at least two robots see in their own grids; 0 if none is seen."""
        return int(np.count_nonzero(self._tally.seers > 1)) / max(self._covered, 1)

    def rebuild(self) -> None:
        """Look at all floor cells again; all else follows from the grids' changes."""
        self._tally.fresh[0] = -1


def _flat_cells(points: FloatArray) -> NDArray[np.int32]:
    """Return the flat indices of points (n, 2), start frame, in the largest grid, ascending, and which points they are.

    Points outside that grid are left out.
    """
    rows, cols = cell_of(points, LARGEST_SIZE).T
    inside = np.flatnonzero((rows >= 0) & (rows < LARGEST_SIZE) & (cols >= 0) & (cols < LARGEST_SIZE))
    places = (rows * LARGEST_SIZE + cols)[inside]
    order = np.argsort(places, kind="stable")
    return np.array([places[order], inside[order]], np.int32)
