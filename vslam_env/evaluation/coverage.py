"""How much of the reachable floor the robots have seen, by their own grids, and which of them found it."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place
from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import FloatArray
from slam_backend.geometry import inverse, transform_points
from vslam_env.navigation import FREE, GRID_SIZE, TeamGrids, cell_of

PLACE, CELL = 0, 1  # rows of what is laid
OBSERVER_COUNT, EVER_SEEN = 0, 1  # rows of the floor


@device
@in_place
def _recount(changes: Any, cells: Any, places: Any, laid: Any, seen: Any, floor: Any, fresh: Any) -> int:
    """Bring up to date what one robot sees of the floor.

    Args:
        changes: (1 + n,) int32. Of its grid, see `TeamGrids`.
        cells: (300, 300) uint8. Of its grid.
        places: (m,) int32, ascending. Places of floor cells in the flat grid.
        laid: (m,) int32. These floor cells.
        seen: (m,) int8. Whether the robot saw them; changed.
        floor: (2, N) int64. How many robots see each floor cell, and whether it is known to have been found; the first
            is changed.
        fresh: (1 + N,) int32. How many others have come to be seen, then which; -1: any of them. Added to.

    Returns:
        How many more floor cells are seen by some robot than before.
    """
    seers, ever = floor[OBSERVER_COUNT], floor[EVER_SEEN]
    more, flat, all_may_have = 0, cells.reshape(cells.size), changes[0] < 0
    for k in range(1 if all_may_have else changes[0]):
        for i in range(0 if all_may_have else np.searchsorted(places, changes[1 + k]), len(places)):
            if not all_may_have and places[i] != changes[1 + k]:
                break
            now, cell = flat[places[i]] == FREE, laid[i]
            if now != seen[i]:
                seen[i] = now
                seers[cell] += 1 if now else -1
                if now and seers[cell] == 1:
                    more += 1
                    if not ever[cell] and fresh[0] >= 0:
                        fresh[0] = fresh[0] + 1 if fresh[0] < len(ever) else -1
                        if fresh[0] > 0:
                            fresh[fresh[0]] = cell
                elif not now:
                    more -= seers[cell] == 0
    return more


@device
@in_place
def _find(fresh: Any, floor: Any, area: Any, positions: Any, found: Any) -> None:
    """Count floor cells that are seen for the first time for the robot nearest to them.

    Args:
        fresh: (1 + N,) int32. Which may be, as `_recount` leaves them; none afterwards.
        floor: (2, N) int64. As in `_recount`; whether each cell has been found is changed.
        area: (N, 2) float64 [m], world frame. The floor cells.
        positions: (K, 2 or 3) float64 [m], world frame.
        found: (K,) int64. How many each robot has found; changed.
    """
    seers, ever = floor[OBSERVER_COUNT], floor[EVER_SEEN]
    for k in range(len(ever) if fresh[0] < 0 else fresh[0]):
        i = k if fresh[0] < 0 else fresh[1 + k]
        if seers[i] > 0 and not ever[i]:
            ever[i] = 1
            nearest, least = 0, np.inf
            for robot in range(len(positions)):
                gap = (area[i, 0] - positions[robot, 0]) ** 2 + (area[i, 1] - positions[robot, 1]) ** 2
                if gap < least:
                    nearest, least = robot, gap
            found[nearest] += 1
    fresh[0] = 0


@in_place
def _update(
    changes: Any, cells: Any, laid: Any, bounds: Any, seen: Any, floor: Any, fresh: Any, area: Any, positions: Any,
    found: Any, shares: Any,
) -> int:  # fmt: skip
    """Take in what has changed in all grids; return how many more floor cells are seen by some robot than before.

    Args:
        changes: (K, 1 + n) int32. Of the grids, see `TeamGrids`; none afterwards.
        cells: (K, 300, 300) uint8. Of the grids.
        laid, bounds: Of the floor, see `CoverageCells`.
        seen: As in `_recount`, of all robots.
        floor, fresh: As in `_recount`.
        area, positions, found: As in `_find`.
        shares: (K,) float64. Written to: what each has found as a share of the floor.
    """
    more = 0
    for robot in range(len(cells)):
        own = slice(bounds[robot], bounds[robot + 1])
        more += _recount(changes[robot], cells[robot], laid[PLACE, own], laid[CELL, own], seen[own], floor, fresh)
        changes[robot, 0] = 0
    _find(fresh, floor, area, positions, found)
    for robot in range(len(found)):
        shares[robot] = found[robot] / max(len(area), 1)
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

    It goes by what has changed in the grids since it was asked last, so it is asked about the same ones throughout.

    Args:
        meter: Of the world and the robots' starts.
    """

    def __init__(self, meter: CoverageCells) -> None:
        self._meter = meter
        count = len(meter.cells)
        self._seen = np.zeros(meter.laid.shape[1], np.int8)
        self._floor = np.zeros((2, count), np.int64)
        self._covered = 0
        self._began = False
        self._fresh = np.zeros(1 + count, np.int32)
        self._found = np.zeros(len(meter.bounds) - 1, np.int64)

    def update(self, grids: TeamGrids, positions: FloatArray, found: FloatArray) -> float:
        """Look at what the robots have seen by now, and take their grids' changes.

        A cell is found once, so that what has been found never falls, and sums up to the coverage unless floor has been
        lost again.

        Args:
            grids: Of the robots.
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
            grids.changes, grids.cells, meter.laid, meter.bounds, self._seen, self._floor, self._fresh, meter.cells,
            positions, self._found, found,
        )  # fmt: skip
        return self._covered / max(len(meter.cells), 1)

    def get_state(self) -> dict[str, Any]:
        """Return a copy of what cannot be counted again from the grids."""
        return {"ever": self._floor[EVER_SEEN] > 0, "found": self._found.copy()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with what `get_state` returned; the grids are asked for their changes as ever."""
        self._floor[EVER_SEEN], self._found = state["ever"], state["found"].copy()
        self._fresh[0] = -1


def _flat_cells(points: FloatArray) -> NDArray[np.int32]:
    """Return the places of a flat grid in which points (n, 2), start frame, lie, ascending, and below their indices."""
    rows, cols = cell_of(points).T
    inside = np.flatnonzero((rows >= 0) & (rows < GRID_SIZE) & (cols >= 0) & (cols < GRID_SIZE))
    places = (rows * GRID_SIZE + cols)[inside]
    order = np.argsort(places, kind="stable")
    return np.array([places[order], inside[order]], np.int32)
