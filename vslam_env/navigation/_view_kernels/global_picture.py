"""Picture of all that a robot has seen, at the finest resolution at which it fits."""

from typing import Any

import numpy as np

from slam_backend.core.jit import jit
from vslam_env.navigation._grid_kernels import CELL, FREE, OCCUPIED, to_coordinate
from vslam_env.navigation._view_kernels.looks import mark_borders, mark_unseen

COARSE = 48  # cells along a side of the global grid, as of the local one, so that one network can look at both
NUM_COARSE = 3  # channels: free, occupied, walls looked at


@jit
def write_global_grid(cells: Any, looks: Any, bounds: Any, picture: Any, frame: Any) -> None:
    """Write the known part of a grid at the finest resolution at which it fits, by whole multiples of a cell.

    Args:
        cells: (S, S) uint8. Cells of a grid.
        looks: (S, S) uint8. Looks of the grid.
        bounds: (4,) int32. Bounds of its known part.
        picture: (3, 48, 48) uint8. Output, rows with y and columns with x: shares of free and of occupied cells, and
            the share of border cells that were looked at, times 255.
        frame: (3,) float32. Output: x and y of the picture's middle in the start frame, and size of its cells [m].
    """
    size = len(cells)
    height, width = bounds[2] - bounds[0], bounds[3] - bounds[1]
    scale = max((max(height, width) + COARSE - 1) // COARSE, 1)
    top, left = bounds[0] - (COARSE * scale - height) // 2, bounds[1] - (COARSE * scale - width) // 2
    first, last = max(bounds[1], 1), min(bounds[3], size - 1)
    first_row, last_row = max(bounds[0], 1), min(bounds[2], size - 1)
    num = max(last - first, 0)
    places, shades = np.empty(num, np.int32), np.empty(scale * scale + 1, np.uint8)
    for i in range(num):
        places[i] = (first + i - left) // scale
    for k in range(len(shades)):  # instead of a division per cell
        shades[k] = k * 255 // (scale * scale)
    borders, unseen, columns = np.empty(num, np.uint8), np.empty(num, np.uint8), np.empty(num + 2, np.uint16)
    counts, sums = np.empty((4, num), np.uint16), np.empty((4, COARSE), np.int32)
    free, occupied, at_wall, looked = counts[0], counts[1], counts[2], counts[3]
    picture[:] = 0
    for r in range(COARSE):
        begin, end = max(top + r * scale, first_row), min(top + (r + 1) * scale, last_row)
        if begin >= end or num == 0:
            continue
        for i in range(num):
            free[i] = occupied[i] = at_wall[i] = looked[i] = 0
        for row in range(begin, end):
            mark_borders(cells, row, first, last, borders)
            mark_unseen(borders, looks, row, first, columns, unseen)
            here = cells[row, first:last]
            for i in range(num):  # without branches: this becomes vector code
                free[i] += here[i] == FREE
                occupied[i] += here[i] == OCCUPIED
                at_wall[i] += borders[i]
                looked[i] += borders[i] - unseen[i]
        sums[:] = 0
        for k in range(4):
            for i in range(num):
                sums[k, places[i]] += counts[k, i]
        for block in range(COARSE):
            picture[0, r, block], picture[1, r, block] = shades[sums[0, block]], shades[sums[1, block]]
            if sums[2, block] > 0:
                picture[2, r, block] = sums[3, block] * 255 // sums[2, block]
    frame[0] = to_coordinate(left, size) + 0.5 * (COARSE * scale - 1) * CELL
    frame[1] = to_coordinate(top, size) + 0.5 * (COARSE * scale - 1) * CELL
    frame[2] = scale * CELL


@jit
def write_global_grids(cells: Any, looks: Any, bounds: Any, pictures: Any, frames: Any) -> None:
    """Write the pictures of K grids; arguments as those of `write_global_grid`, with an axis of K before."""
    for robot in range(len(cells)):
        write_global_grid(cells[robot], looks[robot], bounds[robot], pictures[robot], frames[robot])
