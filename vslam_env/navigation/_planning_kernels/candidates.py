"""Which of the frontiers found now are candidates that there were already, and in which slots they all stand."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from vslam_env.navigation._grid_kernels import CELL, GRID_SIZE, HALF_WIDTH
from vslam_env.navigation._planning_kernels.frontiers import HEADING, NUM_COLUMNS, compute_frontiers

SAME_GOAL = 1.0  # [m] between updates the goal of a living candidate moves less than this
AT_GOAL = 0.5  # [m]
LOOKING = 0.6  # [rad] a robot whose heading is this near to a candidate's looks at the unknown
LOOK_COUNTS = 4  # times as much as a visit without a look, for a teammate's direction is not told
PATIENCE = 16  # visits, after which what is still unseen there never will be seen
GIVEN_UP = 0.8  # [m] radius of what is then left out


@device
@in_place
def _visit(rows: Any, poses: Any, robot: int, visits: Any, given_up: Any) -> None:
    """Add to the visits (m,) of candidates what a robot and its teammates count; where patience runs out, give up.

    Args:
        rows: (m, 5) of the slots, as of `compute_frontiers`; NaN in empty ones.
        poses: (n, 3) [m, m, rad] of the robot and of teammates; NaN: it does not know.
        robot: Its row of them.
        visits: (m,) counted so far; begun anew where it gives up.
        given_up: (300, 300) bool, cells of the grid that do not count any more; added to.
    """
    x, y, theta = poses[robot]
    for i in range(len(rows)):
        at_goal = np.hypot(rows[i, 0] - x, rows[i, 1] - y) <= AT_GOAL
        looked = at_goal and math.cos(rows[i, HEADING] - theta) > math.cos(LOOKING)
        for k in range(len(poses)):  # those that are unknown are nowhere near
            at_goal |= np.hypot(rows[i, 0] - poses[k, 0], rows[i, 1] - poses[k, 1]) <= AT_GOAL
        visits[i] += (1 if at_goal else 0) + (LOOK_COUNTS - 1 if looked else 0)
        if visits[i] >= PATIENCE:
            _give_up(rows[i, 0], rows[i, 1], given_up)
            visits[i] = 0


@device
@in_place
def _give_up(goal_x: float, goal_y: float, given_up: Any) -> None:
    """Mark the cells of a grid around a goal that nobody can see."""
    for r in range(GRID_SIZE):
        for c in range(GRID_SIZE):
            x, y = (c + 0.5) * CELL - HALF_WIDTH, (r + 0.5) * CELL - HALF_WIDTH
            given_up[r, c] |= (x - goal_x) ** 2 + (y - goal_y) ** 2 <= GIVEN_UP**2


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
def fill_slots(costs: Any, found: Any, rows: Any, visits: Any) -> None:
    """Write the next rows (m, 5) and visits (m,) of slots: old candidates stay where they were, new ones fill the gaps.

    Costs (m, n) are below `SAME_GOAL` for what is the same, at most once per row and column; `found` (n, 5).
    """
    chosen = np.full(len(rows), -1, np.int64)
    is_new = np.ones(len(found), np.bool_)
    for slot in range(len(rows)):
        for source in range(len(found)):
            if costs[slot, source] < SAME_GOAL:
                chosen[slot], is_new[source] = source, False

    rows[:] = np.nan
    new = 0
    for slot in range(len(rows)):
        source = chosen[slot]
        if source < 0:
            visits[slot] = 0
            while new < len(found) and not is_new[new]:
                new += 1
            if new == len(found):
                continue
            source = new
            new += 1
        for column in range(NUM_COLUMNS):
            rows[slot, column] = found[source, column]


@jit
def update_slots(
    cells: Any, bounds: Any, row: int, col: int, reach: float, escape: int, poses: Any, robot: int,
    rows: Any, visits: Any, given_up: Any,
) -> tuple[Any, Any, bool]:  # fmt: skip
    """Bring a robot's candidates up to date, if it is clear which of them are found again.

    Args:
        cells, bounds, row, col, reach, escape: As of `compute_frontiers`.
        poses, robot, rows, visits, given_up: As of `_visit`; the last three are written.

    Returns:
        The frontiers (n, 5); the distances (m, n), of `pair_distances`; and whether the slots are filled: if not, the
        pairs are to be chosen, and `fill_slots` called.
    """
    _visit(rows, poses, robot, visits, given_up)
    found = compute_frontiers(cells, bounds, row, col, reach, escape, given_up)
    costs = np.empty((len(rows), len(found)))
    is_clear = pair_distances(rows, found, costs)
    if is_clear:
        fill_slots(costs, found, rows, visits)
    return found, costs, is_clear
