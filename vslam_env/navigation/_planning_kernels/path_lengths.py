"""Lengths of the cheapest paths between places, and the lines of sight between them."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place, jit
from vslam_env.navigation._grid_kernels import CELL, OCCUPIED
from vslam_env.navigation._planning_kernels.dijkstra import NO_GOAL, UNREACHED, wavefront


@jit
def path_lengths(weights: Any, starts: Any, goals: Any) -> Any:
    """Return the lengths (k, n) float64 [m] of the cheapest paths from starts to goals; infinite if there is none.

    Args:
        weights: (h, w) uint8, of `inflate_costs`.
        starts: (k, 2) int64. Rows and columns of open cells; -1: no such cell.
        goals: (n, 2) int64, like the starts.
    """
    width = weights.shape[1]
    lengths = np.full((len(starts), len(goals)), np.inf)
    for i in range(len(starts)):
        if starts[i, 0] < 0:
            continue
        cost, parents = wavefront(weights, starts[i, 0], starts[i, 1], NO_GOAL)
        before = parents.ravel()
        for j in range(len(goals)):
            row, col = goals[j]
            if row < 0 or cost[row, col] == UNREACHED:
                continue
            cell, length = row * width + col, 0.0
            while before[cell] >= 0:
                step = abs(cell - before[cell])
                length += CELL if step == 1 or step == width else math.sqrt(2.0) * CELL
                cell = before[cell]
            lengths[i, j] = length
    return lengths


@in_place
def lines_of_sight(box: Any, viewpoints: Any, targets: Any, reach: float, visible: Any) -> None:
    """Write which targets are seen from which viewpoints: (n, m) bool, True without a wall between them.

    Args:
        box: (h, w) uint8. Cells; only occupied ones block the view.
        viewpoints: (n, 2) int64. Rows and columns of cells in the box.
        targets: (m, 2) int64. Rows and columns of cells in the box, which do not hide themselves.
        reach: Range of view [cells].
        visible: (n, m) bool. Pairs that are tried; those not visible become False.
    """
    for i in range(len(viewpoints)):
        row, col = viewpoints[i]
        for j in range(len(targets)):
            if not visible[i, j]:
                continue
            rows, cols = targets[j, 0] - row, targets[j, 1] - col
            distance = math.hypot(rows, cols)
            is_seen = distance <= reach
            samples = 2 * math.ceil(distance)
            k = 1
            while is_seen and k < samples:
                r, c = row + math.floor(k / samples * rows + 0.5), col + math.floor(k / samples * cols + 0.5)
                is_target = r == targets[j, 0] and c == targets[j, 1]
                is_seen = is_target or box[r, c] != OCCUPIED
                k += 1
            visible[i, j] = is_seen
