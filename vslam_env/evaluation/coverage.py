"""How much of the reachable floor the robots have seen, by their own grids, and which of them found it."""

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place
from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import inverse, transform_points
from vslam_env.navigation import FREE, GRID_SIZE, TeamGrids, cell_of


class Tally(NamedTuple):
    """What is counted of N floor cells, of which m entries lie in the grids of K robots.

    Attributes:
        seen: (m,) int8. Whether a robot sees the cell of each entry.
        seers: (N,) int64. Number of robots that see each cell.
        ever: (N,) int64. 1 for cells that have been found.
        fresh: (1 + N,) int32. Number of cells that may have been found since, then which; -1: any may have been.
        found: (K,) int64. Number of cells that each robot has found.
    """

    seen: NDArray[np.int8]
    seers: IntArray
    ever: IntArray
    fresh: NDArray[np.int32]
    found: IntArray


@device
@in_place
def _recount(changes: Any, cells: Any, laid: Any, first: int, last: int, tally: Tally) -> int:
    """Bring up to date which entries, from the first to before the last, one robot sees.

    Args:
        changes: (1 + n,) int32. Changes of its grid, see `TeamGrids`.
        cells: (300, 300) uint8. Cells of its grid.
        laid: (2, m) int32. See `CoverageCells`.
        first: First entry of the robot.
        last: One past its last entry.
        tally: Changed.

    Returns:
        How many more floor cells are seen by some robot than before.
    """
    seen, seers, fresh = tally.seen, tally.seers, tally.fresh
    places, more, flat, all_may_have = laid[0, :last], 0, cells.reshape(cells.size), changes[0] < 0
    for k in range(1 if all_may_have else changes[0]):
        begin = first if all_may_have else first + np.searchsorted(places[first:], changes[1 + k])
        for i in range(begin, last):
            if not all_may_have and places[i] != changes[1 + k]:
                break
            now, cell = flat[places[i]] == FREE, laid[1, i]
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
    """Take in what has changed in all grids; count floor cells seen for the first time for the robot nearest to them.

    Args:
        changes: (K, 1 + n) int32. Changes of the grids, see `TeamGrids`; none afterwards.
        cells: (K, 300, 300) uint8. Cells of the grids.
        laid, bounds: See `CoverageCells`.
        area: (N, 2) float64 [m], world frame. Floor cells.
        positions: (K, 2 or 3) float64 [m], world frame.
        arrays: Those of a `Tally`, changed.
        shares: (K,) float64. Written to: what each robot has found as a share of the floor.

    Returns:
        How many more floor cells are seen by some robot than before.
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
    """Where the cells of the free floor lie in each robot's grid, laid at its true start pose; read-only.

    Args:
        free_area_cells: (n, 2) float64 [m], world frame. Centres of the cells of the free floor.
        true_starts: (K, 3) float64 [m, m, rad], world frame.

    Attributes:
        cells: The same centres.
        laid: (2, m) int32. Robot by robot the places in its flat grid in which floor cells lie, ascending, and below
            them these floor cells.
        bounds: (K + 1,) int64. Where each robot's part of that begins, and the last ends.
    """

    def __init__(self, free_area_cells: FloatArray, true_starts: FloatArray) -> None:
        own = [_flat_cells(transform_points(inverse(start), free_area_cells)) for start in np.asarray(true_starts)]
        self.cells = as_constant(np.ascontiguousarray(free_area_cells))
        self.laid = as_read_only(np.concatenate(own, axis=1))
        self.bounds = as_read_only(np.cumsum([0, *(part.shape[1] for part in own)]))


class CoverageTracker:
    """Share of the free floor inside the union of the robots' grids, and each robot's part in it.

    It counts what has changed in the grids since the last update, so every update takes the same grids.

    Args:
        meter: Meter of the world and the robots' starts.
    """

    def __init__(self, meter: CoverageCells) -> None:
        self._meter = meter
        count = len(meter.cells)
        self._tally = Tally(
            seen=np.zeros(meter.laid.shape[1], np.int8),
            seers=np.zeros(count, np.int64),
            ever=np.zeros(count, np.int64),
            fresh=np.zeros(1 + count, np.int32),
            found=np.zeros(len(meter.bounds) - 1, np.int64),
        )
        self._covered = 0
        self._began = False

    def update(self, grids: TeamGrids, positions: FloatArray, found: FloatArray) -> float:
        """Look at what the robots have seen by now, and take their grids' changes.

        A cell is found once, so that what has been found never falls, and sums up to the coverage unless floor has been
        lost again.

        Args:
            grids: Grids of the robots.
            positions: (K, 2 or 3) float64 [m], world frame. True positions of the robots.
            found: (K,) float64. Written to: the share of the free floor that each robot was nearest to when it was
                first seen.

        Returns:
            The coverage in [0, 1].
        """
        if not self._began:
            grids.changes[:, 0] = -1
            self._began = True
        meter = self._meter
        self._covered += _update(
            grids.changes, grids.cells, meter.laid, meter.bounds, meter.cells, positions, tuple(self._tally), found
        )
        return self._covered / max(len(meter.cells), 1)

    def get_state(self) -> dict[str, Any]:
        """Return a copy of what cannot be counted again from the grids."""
        return {"ever": self._tally.ever > 0, "found": self._tally.found.copy()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with what `get_state` returned; the changes of the grids count as before."""
        self._tally.ever[:], self._tally.found[:] = state["ever"], state["found"]
        self._tally.fresh[0] = -1


def _flat_cells(points: FloatArray) -> NDArray[np.int32]:
    """Return the places of a flat grid in which points (n, 2), start frame, lie, ascending, and below their indices."""
    rows, cols = cell_of(points).T
    inside = np.flatnonzero((rows >= 0) & (rows < GRID_SIZE) & (cols >= 0) & (cols < GRID_SIZE))
    places = (rows * GRID_SIZE + cols)[inside]
    order = np.argsort(places, kind="stable")
    return np.array([places[order], inside[order]], np.int32)
