"""Paths over the floor that a robot has seen, and the commands that drive it along one.

Only cells known to be free are travelled: unknown ones may hide walls, and frontiers, the goals of exploration, are
reached over free cells anyway. Walls are widened by the robot's radius and half a cell, and cells within 0.4 m of
that cost more, so that a path keeps away from walls where there is room but still goes through a door.

The search is one of our own (`_planning_kernels`), because candidates for a robot have to cost less than 0.4 ms: over
the 7,000 cells of a 20 x 14 m office, on one core, scipy.sparse.csgraph needs 1.5 ms to build the graph and 0.9 ms
for `dijkstra` (0.3 ms for `breadth_first_order`, which ignores costs). Here weights and wavefront take
0.1 ms, and an update of the candidates 0.1 to 0.2 ms in all. scipy's `dijkstra` is the oracle of the tests.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.jit import in_place
from slam_backend.core.validation import BoolArray, FloatArray, argument_error, check_array, check_float
from vslam_env.navigation._grid_kernels import CELL, GRID_SIZE, HALF_WIDTH
from vslam_env.navigation._planning_kernels import (
    UNREACHED,
    FrontierColumns,
    compute_frontiers,
    dijkstra,
    nearest_open,
    shorten_path,
)
from vslam_env.navigation.occupancy_grid import centre_of, known_bounds
from vslam_env.navigation.validation import check_cells, point_floats, pose_floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Frontiers:
    """Places to explore, by increasing path length.

    Attributes:
        goals: (n, 2) float64 [m], start frame. Open floor next to the middle of each frontier.
        headings: (n,) float64 [rad], start frame. Where the unknown lies, seen from the goal.
        sizes: (n,) float64 [m]. Length of each frontier.
        lengths: (n,) float64 [m]. Of the path from the robot to the goal.
    """

    goals: FloatArray
    headings: FloatArray
    sizes: FloatArray
    lengths: FloatArray


def find_frontiers(
    cells: NDArray[np.uint8], start_xy: ArrayLike, radius: float = 0.2, ignored: BoolArray | None = None
) -> Frontiers:
    """Find where floor that a robot can reach borders on what has not been seen.

    A frontier is a connected set of unknown cells beside free ones, of at least 0.6 m, and with an open cell within
    1 m of it to which a way is known. Those above 4 m are cut into pieces of equal size.

    Args:
        cells: (300, 300) uint8. `SeenGrid.cells`.
        start_xy: (2,) float64 [m], start frame. Place of the robot.
        radius: Radius of the robot [m].
        ignored: (300, 300) bool. Unknown cells that do not count; None to count all.

    Returns:
        The frontiers, nearest first; none if nothing is left to explore.

    Raises:
        ValueError: If an array has the wrong shape, or a number is not finite.
    """
    if ignored is None:
        ignored = np.zeros((GRID_SIZE, GRID_SIZE), np.bool_)
    mask = check_array("ignored", ignored, (GRID_SIZE, GRID_SIZE), "Mark cells of the grid.", dtype=np.bool_)
    check_cells(cells)
    rows = compute_frontiers(cells, known_bounds(cells), *_checked_start(start_xy, radius), mask)
    found = FrontierColumns.of(rows)
    return Frontiers(
        goals=found.goals, headings=found.heading.copy(), sizes=found.size.copy(), lengths=found.length.copy()
    )


GOAL_CELLS = 2  # a goal in a wall's margin is served by open floor this near

MIN_RADIUS = 0.11  # [m] for a smaller one walls would not be widened enough to keep diagonal steps from crossing them

LOOKAHEAD = 0.4  # [m]
TURN_GAIN = 3.0  # [1/s]; times the tick of 0.1 s it is well below 1, so the heading settles without swinging
TURN_ONLY = 0.7  # [rad] with a larger heading error the robot turns in place
ARRIVED = 0.1  # [m]
SLOW_DOWN = 1.5  # [1/s] speed allowed per metre that is left
FACED = 0.05  # [rad]


@dataclass(frozen=True, slots=True, kw_only=True)
class DistanceMap:
    """The cheapest ways from one place to all known floor.

    Arrays cover the known part of the grid and a margin.

    Attributes:
        corner: The grid's row and column of the arrays' first cell.
        box: (h, w) uint8. The grid's cells; 3 outside the grid.
        weights: (h, w) uint8. Cost per length; 0 where the robot may not be.
        cost: (h, w) int32. Of the cheapest way; 2^31 - 1 where there is none.
        parent: (h, w) int32. Flat index of the cell before on that way; -1 at the first cell and where there is none.
    """

    corner: tuple[int, int]
    box: NDArray[np.uint8]
    weights: NDArray[np.uint8]
    cost: NDArray[np.int32]
    parent: NDArray[np.int32]

    def cell_of(self, xy: ArrayLike) -> tuple[int, int]:
        """Return the arrays' (row, column) in which a point (2,) [m] lies; it may be outside the arrays."""
        far = 2.0 * HALF_WIDTH  # as good as anywhere outside
        x, y = (min(max(coordinate, -far), far) for coordinate in point_floats(xy, "xy"))
        row, col = math.floor((y + HALF_WIDTH) / CELL), math.floor((x + HALF_WIDTH) / CELL)
        return row - self.corner[0], col - self.corner[1]


def distance_map(cells: NDArray[np.uint8], start_xy: ArrayLike, radius: float = 0.2) -> DistanceMap:
    """Find the cheapest ways from a place to all floor that is known to be free.

    Args:
        cells: (300, 300) uint8. `SeenGrid.cells`.
        start_xy: (2,) float64 [m], start frame. If a robot may not be there, the nearest open cell within 1 m that no
            wall separates stands in.
        radius: Radius of the robot [m], at least 0.11.

    Returns:
        The map; all of it is unreached if there is no open cell near the start.

    Raises:
        ValueError: If the cells are not a grid's, or a number is not finite.
    """
    check_cells(cells)
    start = _checked_start(start_xy, radius)
    box, weights, cost, parent, row, col = dijkstra(cells, known_bounds(cells), *start)
    return DistanceMap(corner=(row, col), box=box, weights=weights, cost=cost, parent=parent)


def _checked_start(start_xy: ArrayLike, radius: float) -> tuple[float, float, float]:
    """Return a place (2,) [m] and the radius [m] of a robot as three floats, or raise."""
    x, y = point_floats(start_xy, "start_xy")
    radius = check_float("radius", radius, "Give the robot's radius in metres.", at_least=MIN_RADIUS, at_most=1.0)
    return x, y, radius


def plan_path(
    cells: NDArray[np.uint8], start_xy: ArrayLike, goal_xy: ArrayLike, radius: float = 0.2
) -> FloatArray | None:
    """Plan a short path over known floor that keeps away from walls where there is room.

    Args:
        cells: (300, 300) uint8. `SeenGrid.cells`.
        start_xy: (2,) float64 [m], start frame. May lie in a wall's margin: the path then begins with the way out.
        goal_xy: (2,) float64 [m], start frame. If it lies in a wall's margin, the path ends up to 0.4 m away from it.
        radius: Radius of the robot [m].

    Returns:
        (n, 2) float64 [m], start frame: the corners, n >= 2, from `start_xy` to the goal; or None if no way is known.

    Raises:
        ValueError: If the cells are not a grid's, or a number is not finite.
    """
    start, goal = point_floats(start_xy, "start_xy"), point_floats(goal_xy, "goal_xy")
    ways = distance_map(cells, start, radius)
    goal_cell = ways.cell_of(goal)
    end_cell = nearest_open(ways.box, ways.weights, *goal_cell, GOAL_CELLS)
    if end_cell[0] < 0 or ways.cost[end_cell] == UNREACHED:
        return None
    corners = shorten_path(ways.weights, ways.cost, ways.parent, *end_cell)
    centres = centre_of(corners + np.array(ways.corner))
    between = centres[1:-1] if tuple(corners[0]) == ways.cell_of(start) else centres[:-1]
    return np.vstack([start, between, goal if end_cell == goal_cell else centres[-1]])


@in_place
def _pursue(x: float, y: float, path: FloatArray) -> tuple[float, float, float]:
    """Return the point `LOOKAHEAD` beyond a path's nearest point to (x, y), and the length that is left [m]."""
    best, segment, along = math.inf, 0, 0.0
    left = 0.0
    for i in range(len(path) - 1):
        step_x, step_y = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
        length = math.hypot(step_x, step_y)
        share = 0.0
        if length > 0.0:
            share = ((x - path[i, 0]) * step_x + (y - path[i, 1]) * step_y) / length**2
            share = min(max(share, 0.0), 1.0)
        distance = math.hypot(path[i, 0] + share * step_x - x, path[i, 1] + share * step_y - y)
        left += length
        if distance < best:
            best, segment, along = distance, i, share * length
            left = length - along
    ahead = LOOKAHEAD + along
    for i in range(segment, len(path) - 1):
        step_x, step_y = path[i + 1, 0] - path[i, 0], path[i + 1, 1] - path[i, 1]
        length = math.hypot(step_x, step_y)
        if ahead < length:
            return path[i, 0] + ahead / length * step_x, path[i, 1] + ahead / length * step_y, left
        ahead -= length
    return path[-1, 0], path[-1, 1], left


def follow_path(
    pose: ArrayLike,
    path: ArrayLike,
    max_speed: float = 1.0,
    max_turn: float = 1.5,
    final_heading: float | None = None,
) -> tuple[float, float]:
    """Drive along a path by pure pursuit: turn towards a point a little ahead, the slower the more there is to turn.

    Args:
        pose: (3,) float64 [m, m, rad], start frame.
        path: (n, 2) float64 [m], start frame, n >= 1, as `plan_path` returns it.
        max_speed: Largest speed [m/s].
        max_turn: Largest rate of turn [rad/s].
        final_heading: Where to look once at the end [rad], start frame; None to stay as the robot comes.

    Returns:
        (v, omega): 0 <= v <= max_speed [m/s] and |omega| <= max_turn [rad/s]; (0, 0) at the end.

    Raises:
        ValueError: If the pose or the path has the wrong shape.
    """
    x, y, theta = pose_floats(pose)
    path_array = np.ascontiguousarray(path, dtype=np.float64)
    if path_array.ndim != 2 or path_array.shape[1] != 2 or len(path_array) == 0:
        raise argument_error(
            "path", "an array of shape (n, 2), n >= 1", f"shape {path_array.shape}", "Give what plan_path returned."
        )
    target_x, target_y, left = _pursue(x, y, path_array)
    left = max(left, math.hypot(path_array[-1, 0] - x, path_array[-1, 1] - y))
    if left < ARRIVED:
        if final_heading is None:
            return 0.0, 0.0
        error = math.remainder(final_heading - theta, 2.0 * math.pi)
        return 0.0, 0.0 if abs(error) < FACED else min(max(TURN_GAIN * error, -max_turn), max_turn)
    error = math.remainder(math.atan2(target_y - y, target_x - x) - theta, 2.0 * math.pi)
    omega = min(max(TURN_GAIN * error, -max_turn), max_turn)
    return min(max_speed * max(0.0, 1.0 - abs(error) / TURN_ONLY), SLOW_DOWN * left), omega
