"""Distances of points and raster cells to walls."""

import numpy as np

from slam_backend.core.validation import FloatArray


def distances_to_walls(points: FloatArray, walls: FloatArray) -> FloatArray:
    """Return the distance (P,) float64 [m] from each point to the nearest wall.

    Args:
        points: (P, 2) float64 [m], world frame. Points.
        walls: (S, 4) float64 [m], world frame. Wall segments.
    """
    nearest = np.full(len(points), np.inf)
    for x1, y1, x2, y2 in walls:
        np.minimum(nearest, _distance(points[:, 0] - x1, points[:, 1] - y1, x2 - x1, y2 - y1), out=nearest)
    return nearest


def clearance_raster(
    walls: FloatArray, origin: FloatArray, cell: float, rows: int, columns: int, limit: float
) -> FloatArray:
    """Return the exact distance (rows, columns) [m] of cell centres to the nearest wall, cut off at `limit` [m].

    Args:
        walls: (S, 4) float64 [m], world frame. Wall segments.
        origin: (2,) float64 [m], world frame. Lower left corner of cell (0, 0).
        cell: Side of a cell [m].
        rows: Number of cells along y.
        columns: Number of cells along x.
        limit: Cutoff of the distances [m].
    """
    clearance = np.full((rows, columns), limit)
    ys, xs = (np.arange(rows)[:, None] + 0.5) * cell, (np.arange(columns) + 0.5) * cell
    for wall in walls:
        (x1, y1), (ex, ey) = wall[:2] - origin, wall[2:] - wall[:2]
        near = _span(y1, ey, cell, rows, limit), _span(x1, ex, cell, columns, limit)
        distances = _distance(xs[near[1]] - x1, ys[near[0]] - y1, ex, ey)
        clearance[near] = np.minimum(clearance[near], distances)
    return clearance


def _span(start: float, extent: float, cell: float, count: int, limit: float) -> slice:
    """Return the cells of an axis that may lie within `limit` [m] of a wall from `start` to `start + extent` [m]."""
    first = max(0, int((min(start, start + extent) - limit) / cell))
    return slice(first, max(first, min(count, int((max(start, start + extent) + limit) / cell) + 1)))


def _distance(px: FloatArray, py: FloatArray, ex: float, ey: float) -> FloatArray:
    """Return the distances of points (px, py) from the segment from the origin to (ex, ey) [m]."""
    u = np.minimum(1.0, np.maximum(0.0, (px * ex + py * ey) / (ex * ex + ey * ey)))
    return np.asarray(np.sqrt((px - u * ex) ** 2 + (py - u * ey) ** 2))
