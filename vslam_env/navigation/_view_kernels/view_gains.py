"""What a camera gains from a pose: unknown area, walls that lack looks, and landmarks measured too rarely."""

import math
from typing import Any

from slam_backend.core.jit import device, in_place
from vslam_env.navigation._grid_kernels import CELL, LARGEST_HALF_WIDTH, LARGEST_SIZE, OCCUPIED, UNKNOWN, is_occupied
from vslam_env.navigation._view_kernels.looks import FACING, is_border, lack_of_looks, nearest_look

MARCH = 0.75 * CELL  # [m] step along a line of sight
RAY_ANGLE = 0.05  # [rad] between rays of a view
AT_WALL = 0.3  # [m] a line of sight to a landmark ends so far before it
UNKNOWN_AREA, UNSEEN_WALL, WEAK_LANDMARKS, UNCERTAIN_LENGTH, NUM_GAINS = 0, 1, 2, 3, 4


@device
@in_place
def is_clear(cells: Any, x: float, y: float, to_x: float, to_y: float, slack: float) -> bool:
    """Return whether no occupied cell lies on the line from a point to another one [m], up to a slack before it [m]."""
    distance = math.hypot(to_x - x, to_y - y)
    steps = int(max(distance - slack, 0.0) / MARCH)
    for k in range(1, steps + 1):
        share = k * MARCH / distance
        if is_occupied(cells, x + share * (to_x - x), y + share * (to_y - y)):
            return False
    return True


@device
@in_place
def wall_length(cells: Any, row: int, col: int, along_x: float, along_y: float) -> float:
    """Return the length of wall beside a border cell that a ray of unit width covers; 0 if the ray grazes it."""
    normal_x, normal_y = 0, 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            if cells[row + i, col + j] == OCCUPIED:
                normal_x, normal_y = normal_x + j, normal_y + i
    length = math.sqrt(normal_x * normal_x + normal_y * normal_y)
    across = normal_x * along_x + normal_y * along_y
    return length / across if across >= max(FACING * length, 1e-9) else 0.0


@device
@in_place
def view_gains(cells: Any, looks: Any, weak: Any, view: Any, camera: Any, gains: Any) -> None:
    """Find out what there is to gain from a pose; areas and lengths are sums over a fan of rays.

    Args:
        cells: (S, S) uint8. Cells of a grid.
        looks: (S, S) uint8. Looks of the grid.
        weak: (n, 2) [m]. Landmarks measured too rarely.
        view: (3 or more,) [m, m, rad]. Pose of the camera.
        camera: (3,). Half the field of view [rad], range [m], radius of the robot [m].
        gains: (3 or more,). Output: unknown area [m^2] in view, through what is unknown; length [m] of walls in view
            that were looked at too little, by the share of looks that they lack; number of weak landmarks in view.
    """
    size, half_fov, reach = len(cells), camera[0], camera[1]
    x, y = view[0], view[1]
    gains[UNKNOWN_AREA] = gains[UNSEEN_WALL] = gains[WEAK_LANDMARKS] = 0.0
    rays, steps = int(2.0 * half_fov / RAY_ANGLE) + 1, int(reach / CELL)
    width = 2.0 * half_fov / rays
    inset = (LARGEST_SIZE - size) // 2  # in the largest grid coordinates are positive, so that `int` rounds them down
    start_col, start_row = (x + LARGEST_HALF_WIDTH) / CELL, (y + LARGEST_HALF_WIDTH) / CELL
    area, wall, nearest = 0.0, 0.0, nearest_look(reach)
    for k in range(rays):
        angle = view[2] - half_fov + (k + 0.5) * width
        c, s = math.cos(angle), math.sin(angle)
        last_row, last_col = int(start_row) - inset, int(start_col) - inset
        for i in range(steps + 1):
            row, col = int(start_row + i * s) - inset, int(start_col + i * c) - inset
            inside = 1 <= row < size - 1 and 1 <= col < size - 1
            state = cells[row, col] if inside else UNKNOWN
            if state == OCCUPIED:
                if i * CELL >= nearest and is_border(cells, last_row, last_col):
                    lack = lack_of_looks(looks, last_row, last_col)
                    if lack > 0.0:
                        wall += wall_length(cells, last_row, last_col, c, s) * i * lack
                break
            area += i if state == UNKNOWN else 0
            last_row, last_col = row, col
    gains[UNKNOWN_AREA], gains[UNSEEN_WALL] = area * width * CELL * CELL, wall * width * CELL
    least = math.cos(half_fov)
    view_x, view_y = math.cos(view[2]), math.sin(view[2])
    for k in range(len(weak)):
        u, v = weak[k, 0] - x, weak[k, 1] - y
        distance = math.sqrt(u * u + v * v)
        if distance < reach and u * view_x + v * view_y > least * distance:
            gains[WEAK_LANDMARKS] += is_clear(cells, x, y, weak[k, 0], weak[k, 1], AT_WALL)
