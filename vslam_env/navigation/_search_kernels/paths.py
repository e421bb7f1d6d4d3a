"""A way through cells is pulled straight."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from vslam_env.navigation._search_kernels.ways import STRAIGHT


@device
@in_place
def _line_cost(weights: Any, row: float, col: float, to_row: float, to_col: float) -> float:
    """Return the cost of a straight line between two cells, infinite if it leaves the open ones."""
    distance = math.hypot(to_row - row, to_col - col)
    samples = int(4.0 * distance) + 1
    total = 0.0
    for i in range(samples + 1):
        share = i / samples
        weight = weights[int(row + share * (to_row - row) + 0.5), int(col + share * (to_col - col) + 0.5)]
        if weight == 0:
            return np.inf
        total += weight
    return 2.0 * STRAIGHT * distance * total / (samples + 1)


@jit
def straight_path(weights: Any, cost: Any, parent: Any, row: int, col: int) -> Any:
    """Follow the parents from a goal back to the start, and pull the way straight where that costs no more.

    Args:
        weights: (h, w) uint8.
        cost: (h, w) int32, of `wavefront`.
        parent: (h, w) int32, of `parents_of`.
        row: The goal, a reached cell.
        col: See `row`.

    Returns:
        (n, 2) int64 rows (row, column) of the corners, from the start to the goal.
    """
    width = weights.shape[1]
    costs, before = cost.ravel(), parent.ravel()
    goal = row * width + col
    count = 1
    cell = goal
    while before[cell] >= 0:
        cell = before[cell]
        count += 1
    way = np.empty(count, np.int64)
    cell = goal
    for i in range(count - 1, -1, -1):
        way[i] = cell
        cell = before[cell]

    corners = np.empty((count, 2), np.int64)
    corners[0, 0], corners[0, 1] = way[0] // width, way[0] % width
    num = 1
    anchor = 0
    while anchor < count - 1:
        reached = anchor + 1
        while reached + 1 < count:
            ahead = way[reached + 1]
            line = _line_cost(weights, way[anchor] // width, way[anchor] % width, ahead // width, ahead % width)
            if line > 1.02 * (costs[ahead] - costs[way[anchor]]):  # 2 % for the short diagonal and the sampling
                break
            reached += 1
        corners[num, 0], corners[num, 1] = way[reached] // width, way[reached] % width
        num += 1
        anchor = reached
    return corners[:num]
