"""Looks at walls: how often each free cell just before a wall was looked at.

A wall stretch is looked at from one side only, so that looks are counted on the free cells just before walls. A border
cell is a free cell beside an occupied one.
"""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline
from vslam_env.navigation._grid_kernels import FREE, OCCUPIED, to_index, widen_bounds

MOST_LOOKS = 255
LOOKED = 45  # looks at a border cell and its eight neighbours after which hardly a landmark there is missed
FACING = 0.5  # cosine of the largest incidence at which landmarks are measured
NEAREST = 1.4  # [m] from which landmarks 0.5 m above or below the camera are in its view
BEFORE = 0.2  # [m] from a hit to the cell that counts the look
JUMP = 0.5  # [m] neighbouring hits farther apart lie on different surfaces


@device
@in_place
def is_border(cells: Any, row: int, col: int) -> bool:
    """Return whether a cell, not at the edge of the grid, is free and beside an occupied one."""
    beside = (
        (cells[row - 1, col] == OCCUPIED)
        | (cells[row + 1, col] == OCCUPIED)
        | (cells[row, col - 1] == OCCUPIED)
        | (cells[row, col + 1] == OCCUPIED)
    )
    return bool(cells[row, col] == FREE and beside)


@device
@in_place
def mark_borders(cells: Any, row: int, first: int, last: int, flags: Any) -> None:
    """Write 1 for the border cells of a part of a row, else 0, without branches: this becomes vector code."""
    here, above, below = cells[row, first:last], cells[row + 1, first:last], cells[row - 1, first:last]
    left, right = cells[row, first - 1 : last - 1], cells[row, first + 1 : last + 1]
    for i in range(len(here)):
        beside = (above[i] == OCCUPIED) | (below[i] == OCCUPIED) | (left[i] == OCCUPIED) | (right[i] == OCCUPIED)
        flags[i] = (here[i] == FREE) & beside


@inline
def nearest_look(reach: float) -> float:
    """Return the range [m] from which a wall is seen at all heights of landmarks, for cameras with a range [m]."""
    return min(NEAREST, 0.5 * reach)


@device
@in_place
def count_looks(looks: Any, row: int, col: int) -> int:
    """Return the looks at a cell, not at the edge of the grid, and its eight neighbours."""
    total = 0
    for r in range(row - 1, row + 2):
        for c in range(col - 1, col + 2):
            total += looks[r, c]
    return total


@device
@in_place
def lack_of_looks(looks: Any, row: int, col: int) -> float:
    """Return the share, 0 to 1, of the looks that the wall beside a cell, not at the edge of the grid, still lacks."""
    return max(1.0 - count_looks(looks, row, col) / LOOKED, 0.0)


@device
@in_place
def mark_unseen(flags: Any, looks: Any, row: int, first: int, columns: Any, unseen: Any) -> None:
    """Write 1 for the border cells of a part of a row that were looked at too little, else 0; this becomes vector code.

    Args:
        flags: (n,) uint8. Result of `mark_borders` for the part.
        looks: (S, S) uint8. Looks of the grid.
        row: Row of the part, not at the edge of the grid.
        first: First column of the part; neither it nor its last one is at the edge.
        columns: (n + 2,) uint16. Workspace.
        unseen: (n,) uint8. Output.
    """
    end = first + len(flags) + 1
    above, here, below = looks[row - 1, first - 1 : end], looks[row, first - 1 : end], looks[row + 1, first - 1 : end]
    for i in range(len(columns)):
        columns[i] = above[i] + here[i] + below[i]
    for i in range(len(flags)):
        around = np.uint16(columns[i] + columns[i + 1] + columns[i + 2])
        unseen[i] = flags[i] & (around < LOOKED)


@device
@in_place
def looks_of(scan: Any, directions: Any, reach: float, points: Any) -> int:
    """Find the looks of one scan at the walls that it meets at a usable range and incidence.

    Args:
        scan: (R,) [m]. Ranges.
        directions: (2, R). Unit vectors of the rays; zeros for rays outside the field of view.
        reach: Range below which landmarks are measured [m].
        points: (R, 2) [m], robot frame. Output: points just before the walls.

    Returns:
        Number of points.
    """
    count, num, nearest = len(scan), 0, nearest_look(reach)
    for k in range(count):
        if not nearest < scan[k] < reach:
            continue
        first = k - 1 if k > 0 and abs(scan[k - 1] - scan[k]) < JUMP else k
        last = k + 1 if k + 1 < count and abs(scan[k + 1] - scan[k]) < JUMP else k
        along_x = scan[last] * directions[0, last] - scan[first] * directions[0, first]
        along_y = scan[last] * directions[1, last] - scan[first] * directions[1, first]
        across = directions[0, k] * along_y - directions[1, k] * along_x
        if across * across > FACING * FACING * (along_x * along_x + along_y * along_y):
            before = max(scan[k] - BEFORE, 0.0)
            points[num, 0], points[num, 1] = before * directions[0, k], before * directions[1, k]
            num += 1
    return num


@device
@in_place
def count_looks_at(looks: Any, bounds: Any, row: int, col: int, more: int) -> None:
    """Add to the looks at a cell, and widen the bounds (4,) of the cells with looks."""
    looks[row, col] = min(looks[row, col] + more, MOST_LOOKS)
    widen_bounds(bounds, row, col)


@in_place
def paint_looks(
    looks: Any, bounds: Any, shared: Any, poses: Any, scans: Any, directions: Any, reach: float,
    points: Any,
) -> None:  # fmt: skip
    """Count the looks of a tick, once a scan and cell.

    Args:
        looks: (K, S, S) uint8. Looks of the grids of K robots; changed.
        bounds: (K, 4) int32. Bounds of those that are not zero, as in `GridStorage`; changed.
        shared: (K, K) int64. See `TeamGrids.update`.
        poses: (K, K, 3) [m, m, rad]. See there.
        scans: (K, R) [m]. See there.
        directions: (2, R). See `looks_of`.
        reach: Range below which landmarks are measured [m].
        points: (R, 2). Workspace.
    """
    size = looks.shape[1]
    for robot in range(len(scans)):
        num = looks_of(scans[robot], directions, reach, points)
        for owner in range(len(shared)):
            if not shared[owner, robot]:
                continue
            x, y, theta = poses[owner, robot]
            c, s = math.cos(theta), math.sin(theta)
            last_row = last_col = -1
            for k in range(num):
                row = to_index(y + s * points[k, 0] + c * points[k, 1], size)
                col = to_index(x + c * points[k, 0] - s * points[k, 1], size)
                if 0 <= row < size and 0 <= col < size and (row != last_row or col != last_col):
                    count_looks_at(looks[owner], bounds[owner], row, col, 1)
                    last_row, last_col = row, col
