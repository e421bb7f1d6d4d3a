"""The picture of its surroundings that a robot observes: 48 x 48 cells around it, turned so that ahead is up."""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import jit
from slam_backend.errors import FloatArray
from slam_backend.geometry import compose, inverse
from vslam_env.belief import Belief
from vslam_env.navigation import CELL, FREE, GRID_SIZE, OCCUPIED

SIZE = 48
CHANNELS = ("free", "occupied", "landmarks")
MARK = 255


@jit
def _paint(cells: Any, x: float, y: float, theta: float, robot_from_map: FloatArray, means: FloatArray) -> Any:
    """Sample the seen grid at the centres of the local cells, and mark the cells that hold landmarks."""
    local = np.zeros((3, SIZE, SIZE), np.uint8)
    c, s = math.cos(theta), math.sin(theta)
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
    c, s = math.cos(robot_from_map[2]), math.sin(robot_from_map[2])
    for k in range(len(means)):
        ahead = robot_from_map[0] + c * means[k, 0] - s * means[k, 1]
        left = robot_from_map[1] + s * means[k, 0] + c * means[k, 1]
        row, col = math.floor(middle - ahead / CELL), math.floor(middle - left / CELL)
        if 0 <= row < SIZE and 0 <= col < SIZE:
            local[2, row, col] = MARK
    return local


def local_grid(belief: Belief) -> NDArray[np.uint8]:
    """Return the robot's surroundings as it believes them to be.

    Returns:
        (3, 48, 48) uint8, robot frame, cells of 0.2 m that are 0 or 255. Channels free, occupied, landmarks. Rows go
        from 4.8 m ahead to 4.8 m behind, columns from 4.8 m to the left to 4.8 m to the right. A fresh array.
    """
    x, y, theta = belief.pose.tolist()
    robot_from_map = compose(inverse(belief.pose), belief.start_from_group)
    grid: NDArray[np.uint8] = _paint(belief.grid.cells, x, y, theta, robot_from_map, belief.group_map.means)
    return grid
