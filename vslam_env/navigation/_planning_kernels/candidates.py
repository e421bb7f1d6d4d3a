"""Which of the frontiers found now are candidates that there were already, and in which slots they all stand."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit
from vslam_env.navigation._grid_kernels import cell_index, margin_of
from vslam_env.navigation._planning_kernels.costmap import PAD
from vslam_env.navigation._planning_kernels.dijkstra import UNREACHED, dijkstra
from vslam_env.navigation._planning_kernels.frontiers import HEADING, NUM_COLUMNS, frontiers_reached

SAME_GOAL = 1.0  # [m] between updates the goal of a living candidate moves less than this
AT_GOAL = 0.5  # [m]
LOOKING = 0.6  # [rad] a robot whose heading is this near to a candidate's looks at the unknown
LOOK_COUNTS = 4  # times as much as a visit without a look, for a teammate's direction is not told
PATIENCE = 16  # visits, after which what is still unseen there never will be seen
CUT_MARGIN = 25  # [cells] from where a search was cut off: what is to be seen from there may lie beyond


@inline
def is_settled(weights: Any, cost: Any, corner: Any, bounds: Any, row: int, col: int) -> bool:
    """Return whether a search over all known floor, or over a part, tells what there is at a cell of the grid.

    It does unless the cell is open and not reached, or within `CUT_MARGIN` of an edge where the search was cut off.

    Args:
        weights: (h, w) uint8. Weights of a box, 0 = closed.
        cost: (h, w) int32. Costs of `wavefront` over it.
        corner: Row and column of the box in the grid.
        bounds: (4,) int32. Bounds of the known part of the grid.
        row: Row of the cell in the grid.
        col: Column of the cell in the grid.
    """
    height, width = cost.shape
    r, c = row - corner[0], col - corner[1]
    if not (0 <= r < height and 0 <= c < width) or (weights[r, c] > 0 and cost[r, c] == UNREACHED):
        return False
    top, left, bottom, right = corner[0] + PAD, corner[1] + PAD, corner[0] + height - PAD, corner[1] + width - PAD
    inside_rows = (top <= bounds[0] or row >= top + CUT_MARGIN) and (bottom >= bounds[2] or row < bottom - CUT_MARGIN)
    inside_cols = (left <= bounds[1] or col >= left + CUT_MARGIN) and (right >= bounds[3] or col < right - CUT_MARGIN)
    return bool(inside_rows and inside_cols)


@device
@jit
def with_distant(frontiers: Any, rows: Any, ways: tuple[Any, Any, Any, Any, int, int], bounds: Any, size: int) -> Any:
    """Return the frontiers (n, 5) that a search over a part found, and the candidates of which it tells nothing.

    Args:
        frontiers: (m, 5). Frontiers; those of which the search does not tell all are left out.
        rows: (k, 5). Candidates; NaN: none.
        ways: Paths of the search, of `dijkstra`.
        bounds: (4,) int32. Bounds of the known part of the grid.
        size: Number of cells along a side of the grid.
    """
    _, weights, cost, _, row, col = ways
    corner = row, col
    both, num, margin = np.empty((len(frontiers) + len(rows), NUM_COLUMNS)), 0, margin_of(size)
    for i in range(len(frontiers)):
        if is_settled(
            weights, cost, corner, bounds, cell_index(frontiers[i, 1], margin), cell_index(frontiers[i, 0], margin)
        ):
            both[num] = frontiers[i]
            num += 1
    num_frontiers = num
    for i in range(len(rows)):
        if np.isnan(rows[i, 0]):
            continue
        if is_settled(weights, cost, corner, bounds, cell_index(rows[i, 1], margin), cell_index(rows[i, 0], margin)):
            continue
        is_new = True
        for j in range(num_frontiers):
            is_new &= np.hypot(both[j, 0] - rows[i, 0], both[j, 1] - rows[i, 1]) >= SAME_GOAL
        if is_new:
            both[num] = rows[i]
            num += 1
    return both[:num]


@device
@in_place
def pair_distances(goals: Any, places: Any, costs: Any) -> bool:
    """Write the distances (m, n), at most `SAME_GOAL`, between goals (m, 2 or more) and places (n, 2 or more).

    They are `SAME_GOAL` for goals that are NaN, of empty slots.

    Returns:
        Whether none is nearer than that to several: then such pairs are those of the least total distance.
    """
    is_clear, paired = True, 0
    for j in range(len(places)):
        near = 0  # bits of goals
        for i in range(len(goals)):
            distance = np.hypot(goals[i, 0] - places[j, 0], goals[i, 1] - places[j, 1])
            is_near = distance < SAME_GOAL
            costs[i, j] = distance if is_near else SAME_GOAL
            near |= is_near << i
        is_clear &= near & (near - 1 | paired) == 0
        paired |= near
    return is_clear


@jit
def fill_slots(costs: Any, frontiers: Any, rows: Any, visits: Any) -> None:
    """Write the next rows (m, 5) and visits (m,) of slots: old candidates stay where they were, new ones fill the gaps.

    Costs (m, n) are below `SAME_GOAL` for what is the same, at most once per row and column; `frontiers` (n, 5).
    """
    chosen = np.full(len(rows), -1, np.int64)
    is_new = np.ones(len(frontiers), np.bool_)
    for slot in range(len(rows)):
        for source in range(len(frontiers)):
            if costs[slot, source] < SAME_GOAL:
                chosen[slot], is_new[source] = source, False

    rows[:] = np.nan
    new = 0
    for slot in range(len(rows)):
        source = chosen[slot]
        if source < 0:
            visits[slot] = 0
            while new < len(frontiers) and not is_new[new]:
                new += 1
            if new == len(frontiers):
                continue
            source = new
            new += 1
        for column in range(NUM_COLUMNS):
            rows[slot, column] = frontiers[source, column]


@jit
def update_slots(
    cells: Any, bounds: Any, radius: float, poses: Any, robot: int, rows: Any, visits: Any, given_up: Any, reach: float
) -> tuple[Any, Any, bool, Any, tuple[Any, Any, Any, Any, int, int]]:
    """Bring a robot's candidates up to date, if it is clear which of them are found again.

    The robot and its teammates visit candidates; where patience runs out, a candidate is given up.

    Args:
        cells: (S, S) uint8. The grid.
        bounds: (4,) int32, of `known_bounds`.
        radius: Radius of the robot [m].
        poses: (n, 3) [m, m, rad]. Poses of the robot and its teammates; NaN: unknown to the robot.
        robot: Row of the robot in the poses.
        rows: (m, 5). Slots, see `FrontierColumns`; NaN in empty ones. Changed.
        visits: (m,) int64. Visits of each candidate so far; changed.
        given_up: (g, 2) [m]. Goals that no longer count.
        reach: Distance [m] from the robot along x and y beyond which candidates stay as they are; infinity: all known
            floor is searched.

    Returns:
        The frontiers (n, 5), candidates that stay included; the distances (m, n), of `pair_distances`; whether the
        slots are filled: if not, the pairs are to be chosen, and `fill_slots` called; the goals that no longer count
        now; and the paths from the robot, of `dijkstra`.
    """
    x, y, theta = poses[robot]
    for i in range(len(rows)):
        goal_x, goal_y = rows[i, 0], rows[i, 1]
        at_goal = np.hypot(goal_x - x, goal_y - y) <= AT_GOAL
        looked = at_goal and math.cos(rows[i, HEADING] - theta) > math.cos(LOOKING)
        for k in range(len(poses)):  # those that are unknown are nowhere near
            at_goal |= np.hypot(goal_x - poses[k, 0], goal_y - poses[k, 1]) <= AT_GOAL
        visits[i] += (1 if at_goal else 0) + (LOOK_COUNTS - 1 if looked else 0)
        if visits[i] >= PATIENCE:
            visits[i] = 0
            before, given_up = given_up, np.empty((len(given_up) + 1, 2))
            given_up[: len(before)] = before
            given_up[-1, 0], given_up[-1, 1] = goal_x, goal_y

    ways = dijkstra(cells, bounds, x, y, radius, np.nan, np.nan, reach)
    frontiers = frontiers_reached(ways, len(cells), given_up)
    if reach < np.inf:
        frontiers = with_distant(frontiers, rows, ways, bounds, len(cells))
    costs = np.empty((len(rows), len(frontiers)))
    is_clear = pair_distances(rows, frontiers, costs)
    if is_clear:
        fill_slots(costs, frontiers, rows, visits)
    return frontiers, costs, is_clear, given_up, ways
