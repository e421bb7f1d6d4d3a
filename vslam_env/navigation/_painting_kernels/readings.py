"""What a robot reads in a tick is written into a grid: its scan, the floor that it covers, and a bump."""

import math
from typing import Any

from slam_backend._jit import jit
from slam_backend.errors import FloatArray
from vslam_env.navigation._painting_kernels.evidence import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    HIT,
    OCCUPIED,
    cell_range,
    judge,
)
from vslam_env.navigation._painting_kernels.rays import READINGS_FINE, fault_of_scan
from vslam_env.navigation._painting_kernels.scans import paint_scan

BAD_POSE = 3  # beside the faults of `paint_scan`


@jit
def paint_disc(evidence: Any, cells: Any, changes: Any, x: float, y: float, radius: float) -> None:
    """Free what a robot covers: unknown cells centred in its disc, and occupied ones that lie wholly inside."""
    first_row, last_row = cell_range(y - radius, y + radius)
    first_col, last_col = cell_range(x - radius, x + radius)
    for row in range(first_row, last_row):
        for col in range(first_col, last_col):
            v = (row + 0.5) * CELL - HALF_WIDTH - y
            u = (col + 0.5) * CELL - HALF_WIDTH - x
            distance = math.hypot(u, v)
            inside = distance <= max(radius - 0.5 * CELL, 0.0)
            if inside or (evidence[row, col] == 0 and distance <= radius):
                evidence[row, col] = min(evidence[row, col], -1)
                judge(cells, changes, row, col, FREE)


@jit
def paint_bump(evidence: Any, cells: Any, changes: Any, x: float, y: float, theta: float, radius: float) -> None:
    """Mark the cell just ahead of a robot's rim as occupied, no firmer than two hits."""
    ahead = radius + 0.5 * CELL
    row = math.floor((y + ahead * math.sin(theta) + HALF_WIDTH) / CELL)
    col = math.floor((x + ahead * math.cos(theta) + HALF_WIDTH) / CELL)
    if 0 <= row < GRID_SIZE and 0 <= col < GRID_SIZE:
        evidence[row, col] = max(evidence[row, col], 2 * HIT)
        judge(cells, changes, row, col, OCCUPIED)


@jit
def paint_reading(
    evidence: Any,
    cells: Any,
    changes: Any,
    pose: FloatArray,
    ranges: FloatArray,
    angles: FloatArray,
    max_range: float,
    radius: float,
    bump: bool,
) -> int:
    """Write what a robot at `pose` (3,) reads in a tick: its scan, the floor that it covers, and a bump."""
    x, y, theta = pose[0], pose[1], pose[2]
    if not math.isfinite(x + y + theta):
        return BAD_POSE
    fault = fault_of_scan(ranges, angles)
    if fault == READINGS_FINE:
        paint_scan(evidence, cells, changes, x, y, theta, ranges, angles, max_range)
        paint_disc(evidence, cells, changes, x, y, radius)
        if bump:
            paint_bump(evidence, cells, changes, x, y, theta, radius)
    return fault
