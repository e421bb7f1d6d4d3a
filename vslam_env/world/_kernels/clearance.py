"""Compiled distances to walls: of points, and of the cells of a raster."""

import numpy as np

from slam_backend.core.jit import inline, jit
from slam_backend.core.validation import FloatArray


@inline
def _distance(px: float, py: float, ex: float, ey: float, square: float) -> float:
    """Return how far (px, py) is from the line from the origin to (ex, ey), whose squared length is `square`."""
    u = min(1.0, max(0.0, (px * ex + py * ey) / square))
    return float(np.sqrt((px - u * ex) ** 2 + (py - u * ey) ** 2))


@jit
def distances_to_walls(points: FloatArray, walls: FloatArray) -> FloatArray:
    """Return the distance (P,) float64 [m] from each point to the nearest wall.

    Args:
        points: (P, 2) float64 [m], world frame.
        walls: (S, 4) float64 [m], world frame.
    """
    nearest = np.full(len(points), np.inf)
    for i in range(len(walls)):
        ex, ey = walls[i, 2] - walls[i, 0], walls[i, 3] - walls[i, 1]
        square = ex * ex + ey * ey
        for p in range(len(points)):
            px, py = points[p, 0] - walls[i, 0], points[p, 1] - walls[i, 1]
            nearest[p] = min(nearest[p], _distance(px, py, ex, ey, square))
    return nearest


@jit
def clearance_raster(
    walls: FloatArray, origin: FloatArray, cell: float, rows: int, columns: int, limit: float
) -> FloatArray:
    """Return the exact distance (rows, columns) [m] of cell centres to the nearest wall, cut off at `limit` [m].

    Args:
        walls: (S, 4) float64 [m], world frame.
        origin: (2,) float64 [m], world frame. Lower left corner of cell (0, 0).
        cell: Side of a cell [m].
        rows: Cells along y.
        columns: Cells along x.
        limit: Distances beyond are not told apart [m].
    """
    clearance = np.full((rows, columns), limit)
    for i in range(len(walls)):
        x1, y1 = walls[i, 0] - origin[0], walls[i, 1] - origin[1]
        ex, ey = walls[i, 2] - walls[i, 0], walls[i, 3] - walls[i, 1]
        square = ex * ex + ey * ey
        first_row = max(0, int((min(y1, y1 + ey) - limit) / cell))
        last_row = min(rows, int((max(y1, y1 + ey) + limit) / cell) + 1)
        first_column = max(0, int((min(x1, x1 + ex) - limit) / cell))
        last_column = min(columns, int((max(x1, x1 + ex) + limit) / cell) + 1)
        for row in range(first_row, last_row):
            py = (row + 0.5) * cell - y1
            for column in range(first_column, last_column):
                px = (column + 0.5) * cell - x1
                clearance[row, column] = min(clearance[row, column], _distance(px, py, ex, ey, square))
    return clearance
