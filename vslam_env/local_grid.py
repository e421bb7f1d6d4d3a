"""The picture of its surroundings that a robot observes: 48 x 48 cells around it, turned so that ahead is up."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import jit
from vslam_env.navigation import CELL, FREE, GRID_SIZE, OCCUPIED
from vslam_env.robot_belief import Glimpse

SIZE = 48
CHANNELS = ("free", "occupied", "landmarks")
MARK = 255


@jit
def _paint(cells: Any, pose: Any, start_from_group: Any, means: Any) -> Any:
    """Sample the seen grid at the centres of the local cells, and mark the cells that hold landmarks."""
    local = np.zeros((3, SIZE, SIZE), np.uint8)
    x, y = pose[0], pose[1]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    middle = 0.5 * SIZE
    for row in range(SIZE):
        ahead = (middle - 0.5 - row) * CELL
        for col in range(SIZE):
            left = (middle - 0.5 - col) * CELL
            i = math.floor((y + s * ahead + c * left) / CELL + 0.5 * GRID_SIZE)
            j = math.floor((x + c * ahead - s * left) / CELL + 0.5 * GRID_SIZE)
            if 0 <= i < GRID_SIZE and 0 <= j < GRID_SIZE:
                if cells[i, j] == FREE:
                    local[0, row, col] = MARK
                elif cells[i, j] == OCCUPIED:
                    local[1, row, col] = MARK
    start_c, start_s = math.cos(start_from_group[2]), math.sin(start_from_group[2])
    for k in range(len(means)):
        dx = start_from_group[0] + start_c * means[k, 0] - start_s * means[k, 1] - x
        dy = start_from_group[1] + start_s * means[k, 0] + start_c * means[k, 1] - y
        row = math.floor(middle - (c * dx + s * dy) / CELL)
        col = math.floor(middle - (c * dy - s * dx) / CELL)
        if 0 <= row < SIZE and 0 <= col < SIZE:
            local[2, row, col] = MARK
    return local


def local_grid(glimpse: Glimpse) -> NDArray[np.uint8]:
    """Return the robot's surroundings as it believes them to be.

    Returns:
        (3, 48, 48) uint8, robot frame, cells of 0.2 m that are 0 or 255. Channels free, occupied, landmarks. Rows go
        from 4.8 m ahead to 4.8 m behind, columns from 4.8 m to the left to 4.8 m to the right. A fresh array.
    """
    grid: NDArray[np.uint8] = _paint(glimpse.cells, glimpse.pose, glimpse.start_from_group, glimpse.outline.means)
    return grid
