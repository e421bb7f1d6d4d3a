"""What robots read in a tick is written into grids: their scans, the floor that they cover, and their bumps."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import BoolArray, FloatArray, IntArray
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
from vslam_env.navigation._painting_kernels.scans import paint_survey
from vslam_env.navigation._painting_kernels.surveys import NUM_ROWS, directions_of, survey

BAD_POSE = 3  # beside what `fault_of_scan` finds


@jit
def paint_disc(evidence: Any, cells: Any, changes: Any, x: float, y: float, radius: float) -> None:
    """Free what a robot covers: unknown cells centred in its disc, and occupied ones that lie wholly inside."""
    first_row, last_row = cell_range(y - radius, y + radius)
    first_col, last_col = cell_range(x - radius, x + radius)
    for row in range(first_row, last_row):
        for col in range(first_col, last_col):
            if evidence[row, col] < 0:
                continue
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
def paint_readings(
    evidence: Any,
    cells: Any,
    changes: Any,
    owners: IntArray,
    robots: IntArray,
    poses: FloatArray,
    scans: FloatArray,
    bumps: BoolArray,
    angles: FloatArray,
    max_range: float,
    radius: float,
) -> tuple[int, int]:
    """Write what robots read in a tick: their scans, the floor that they cover, and their bumps.

    Args:
        evidence: (K, 300, 300) int8, as what follows: the grids, one after the other.
        cells: (K, 300, 300) uint8.
        changes: (K, 1 + n) int32.
        owners: See `TeamGrids.paint_readings`, also for the rest.
        robots: (n,) int64.
        poses: (K, K, 3) float64 [m, m, rad].
        scans: (K, R) float64 [m].
        bumps: (K,) bool.
        angles: (R,) float64 [rad].
        max_range: [m].
        radius: [m].

    Returns:
        `READINGS_FINE`, or what is wrong, and with which of the n; nothing was written then.
    """
    surveys, surveyed = np.empty((len(scans), NUM_ROWS, len(angles) + 1)), np.zeros(len(scans), np.bool_)
    directions = directions_of(angles)
    for i in range(len(owners)):
        robot = robots[i]
        x, y, theta = poses[owners[i], robot]
        if not math.isfinite(x + y + theta):
            return BAD_POSE, i
        if not surveyed[robot]:
            fault = fault_of_scan(scans[robot], angles)
            if fault != READINGS_FINE:
                return fault, i
            survey(scans[robot], directions, max_range, surveys[robot])
            surveyed[robot] = True
    for i in range(len(owners)):
        owner, robot = owners[i], robots[i]
        x, y, theta = poses[owner, robot]
        paint_survey(evidence[owner], cells[owner], changes[owner], x, y, theta, surveys[robot])
        paint_disc(evidence[owner], cells[owner], changes[owner], x, y, radius)
        if bumps[robot]:
            paint_bump(evidence[owner], cells[owner], changes[owner], x, y, theta, radius)
    return READINGS_FINE, -1
