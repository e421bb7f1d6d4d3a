"""The pictures of their surroundings that robots observe: 48 x 48 cells around each, turned so that ahead is up."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, room_of
from slam_backend.fastslam.relative_poses import OWN, START
from vslam_env.navigation import CELL, FREE, GRID_SIZE, OCCUPIED, UNKNOWN

SIZE = 48
CHANNELS = ("free", "occupied", "landmarks")
MARK = 255
REACH = 0.75 * SIZE  # [cells] more than from the robot to a corner of its picture


@device
@in_place
def paint(cells: Any, belief: Any, places: Any, local: Any) -> None:
    """Sample the seen grid at the centres of the local cells, and mark the cells that hold landmarks.

    Rows go from 4.8 m ahead to 4.8 m behind, columns from 4.8 m to the left to 4.8 m to the right. Each row is written
    in short loops without branches, which become vector instructions but for the look-up itself.

    Args:
        cells: (300, 300) uint8. Of the seen grid.
        belief: (16 or more,). Of the robot, see `Standpoints`: where it is, and what moves landmarks to its frame.
        places: (n, 4). Of the landmarks, see `OutlineRows`.
        local: (3, 48, 48) uint8. Channels free, occupied, landmarks, of cells of 0.2 m, 0 or 255. Written to.
    """
    x, y = belief[OWN], belief[OWN + 1]
    c, s = math.cos(belief[OWN + 2]), math.sin(belief[OWN + 2])
    middle = 0.5 * SIZE
    flat = cells.reshape(cells.size)
    low, high = REACH - 0.5 * GRID_SIZE, 0.5 * GRID_SIZE - REACH
    surely_inside = low < x / CELL < high and low < y / CELL < high
    place, seen = room_of(SIZE, np.int32), room_of(SIZE, np.uint8)
    for row in range(SIZE):
        ahead = middle - 0.5 - row  # [cells], as what follows
        first_i, first_j = y / CELL + s * ahead + 0.5 * GRID_SIZE, x / CELL + c * ahead + 0.5 * GRID_SIZE
        if surely_inside:
            for col in range(SIZE):
                left = middle - 0.5 - col
                place[col] = np.int32(first_i + c * left) * GRID_SIZE + np.int32(first_j - s * left)
            for col in range(SIZE):
                seen[col] = flat[np.uint32(place[col])]
        else:
            for col in range(SIZE):
                left = middle - 0.5 - col
                i, j = first_i + c * left, first_j - s * left
                inside = 0.0 <= i < GRID_SIZE and 0.0 <= j < GRID_SIZE
                seen[col] = cells[int(i), int(j)] if inside else UNKNOWN
        free, occupied, landmarks = local[0, row], local[1, row], local[2, row]
        for col in range(SIZE):
            free[col] = MARK if seen[col] == FREE else 0
            occupied[col] = MARK if seen[col] == OCCUPIED else 0
            landmarks[col] = 0
    start_x, start_y = belief[START], belief[START + 1]
    start_c, start_s = math.cos(belief[START + 2]), math.sin(belief[START + 2])
    for k in range(len(places)):
        dx = start_x + start_c * places[k, 0] - start_s * places[k, 1] - x
        dy = start_y + start_s * places[k, 0] + start_c * places[k, 1] - y
        row = math.floor(middle - (c * dx + s * dy) / CELL)
        col = math.floor(middle - (c * dy - s * dx) / CELL)
        if 0 <= row < SIZE and 0 <= col < SIZE:
            local[2, row, col] = MARK
