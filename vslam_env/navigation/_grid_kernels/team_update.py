"""What robots read in a tick is written into grids: their scans, the floor that they cover, and their bumps."""

import math
from typing import Any

from slam_backend.core.jit import in_place
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from vslam_env.navigation._grid_kernels.occupancy import (
    CELL,
    FREE,
    HALF_WIDTH,
    HIT,
    OCCUPIED,
    Grid,
    cell_index,
    cell_range,
    cells_to_middle,
    margin_of,
    set_state,
)
from vslam_env.navigation._grid_kernels.scan_update import NUM_ROWS, scan_geometry, update_from_geometry


@in_place
def clear_disc(grid: Grid, x: float, y: float, radius: float) -> None:
    """Free what a robot covers: unknown cells centred in its disc, and occupied ones that lie wholly inside."""
    evidence, size = grid.evidence, len(grid.cells)
    margin = margin_of(size)
    first_row, last_row = cell_range(y - radius, y + radius, size)
    first_col, last_col = cell_range(x - radius, x + radius, size)
    for row in range(first_row, last_row):
        for col in range(first_col, last_col):
            if evidence[row, col] < 0:
                continue
            v = (row - margin + 0.5) * CELL - HALF_WIDTH - y
            u = (col - margin + 0.5) * CELL - HALF_WIDTH - x
            distance = math.hypot(u, v)
            inside = distance <= max(radius - 0.5 * CELL, 0.0)
            if inside or (evidence[row, col] == 0 and distance <= radius):
                evidence[row, col] = min(evidence[row, col], -1)
                set_state(grid, row, col, FREE)


@in_place
def mark_bump(grid: Grid, x: float, y: float, theta: float, radius: float) -> None:
    """Mark the cell just ahead of a robot's rim as occupied, no firmer than two hits."""
    ahead, size = radius + 0.5 * CELL, len(grid.cells)
    row = cell_index(y + ahead * math.sin(theta), margin_of(size))
    col = cell_index(x + ahead * math.cos(theta), margin_of(size))
    if 0 <= row < size and 0 <= col < size:
        grid.evidence[row, col] = max(grid.evidence[row, col], 2 * HIT)
        set_state(grid, row, col, OCCUPIED)


@in_place
def update_grids(
    grids: tuple[Any, Any, Any],
    shared: IntArray,
    poses: FloatArray,
    scans: FloatArray,
    bumps: BoolArray,
    directions: FloatArray,
    max_range: float,
    radius: float,
    buffer: FloatArray,
) -> tuple[int, int, int]:
    """Write what robots read in a tick: their scans, the floor that they cover, and their bumps.

    Args:
        grids: Grids of K robots, as the arrays of a `Grid`; changed.
        shared: (K, K) int64. See `TeamGrids.update`, as for poses, scans, bumps and directions.
        poses: (K, K, 3) float64 [m, m, rad].
        scans: (K, R) float64 [m].
        bumps: (K,) bool.
        directions: (2, R) float64.
        max_range: Range of the scans [m].
        radius: Radius of the robots [m].
        buffer: See `update_from_geometry`.

    Returns:
        Owner and robot of a pose or a scan that is invalid, -1 if all are valid; and the number of cells that a grid
        needs on each side of its middle. If something is invalid or the grids are smaller, nothing is written.
    """
    evidence, cells, bounds = grids
    farthest = 0.0
    for robot in range(len(scans)):
        good, longest = True, 0.0
        for i in range(scans.shape[1]):
            good &= scans[robot, i] >= 0.0  # no NaN is
            longest = max(longest, scans[robot, i])
        if not good:
            return robot, robot, 0
        for owner in range(len(shared)):
            x, y, theta = poses[owner, robot]
            if shared[owner, robot]:
                if not math.isfinite(x + y + theta):
                    return owner, robot, 0
                farthest = max(farthest, max(abs(x), abs(y)) + min(longest, max_range))
    needed = cells_to_middle(farthest + radius)
    if needed > cells.shape[1] // 2:
        return -1, -1, needed
    for robot in range(len(scans)):
        scan_geometry(scans[robot], directions, max_range, buffer[:NUM_ROWS])
        for owner in range(len(shared)):
            if shared[owner, robot]:
                grid = Grid(evidence[owner], cells[owner], bounds[owner])
                x, y, theta = poses[owner, robot]
                update_from_geometry(grid, x, y, theta, buffer)
                clear_disc(grid, x, y, radius)
                if bumps[robot]:
                    mark_bump(grid, x, y, theta, radius)
    return -1, -1, needed
