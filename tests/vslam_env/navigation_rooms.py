"""A small building, a ray caster and an ideal robot, to try navigation without a simulator."""

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between, compose

ANGLES = np.deg2rad(np.linspace(-26.5, 26.5, 32))
MAX_RANGE = 8.0


def doored_wall(x1: float, x2: float, y: float, doors: list[float], width: float = 1.2) -> list[list[float]]:
    """Return the segments of a wall along x with doors centred at given places."""
    stops = [x1, *(edge for door in doors for edge in (door - width / 2, door + width / 2)), x2]
    return [[stops[i], y, stops[i + 1], y] for i in range(0, len(stops), 2)]


def building() -> FloatArray:
    """Return the walls (n, 4) of six rooms of different sizes along a corridor, 17 x 11 m."""
    outer = [[0, 0, 17, 0], [17, 0, 17, 11], [17, 11, 0, 11], [0, 11, 0, 0]]
    corridor = doored_wall(0, 17, 4.5, [2.0, 7.3, 13.1]) + doored_wall(0, 17, 6.5, [3.1, 9.0, 15.2])
    rooms = [[5, 0, 5, 4.5], [10, 0, 10, 4.5], [6, 6.5, 6, 11], [12, 6.5, 12, 11]]
    return np.array(outer + corridor + rooms, dtype=np.float64)


def cast(walls: FloatArray, pose: FloatArray) -> FloatArray:
    """Return the true ranges (32,) from a pose to walls (n, 4)."""
    headings = pose[2] + ANGLES
    dx, dy = np.cos(headings)[:, None], np.sin(headings)[:, None]
    ax, ay = walls[:, 0] - pose[0], walls[:, 1] - pose[1]
    ex, ey = walls[:, 2] - walls[:, 0], walls[:, 3] - walls[:, 1]
    across = dx * ey - dy * ex
    across = np.where(np.abs(across) < 1e-12, np.nan, across)
    along, share = (ax * ey - ay * ex) / across, (ax * dy - ay * dx) / across
    hits = np.where((along > 0) & (share >= 0) & (share <= 1), along, MAX_RANGE)
    return np.minimum(hits.min(axis=1), MAX_RANGE)


def scan(walls: FloatArray, pose: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Return ranges (32,) with noise of 1 %; a ray without a hit reads the greatest range."""
    ranges = cast(walls, pose)
    return np.where(ranges < MAX_RANGE, ranges * (1.0 + 0.01 * rng.standard_normal(len(ranges))), MAX_RANGE)


def clearance(walls: FloatArray, points: FloatArray) -> FloatArray:
    """Return the distance (n,) from points (n, 2) to the nearest of walls (m, 4)."""
    start, along = walls[:, :2], walls[:, 2:] - walls[:, :2]
    share = ((points[:, None] - start) * along).sum(axis=-1) / (along**2).sum(axis=-1)
    nearest = start + np.clip(share, 0.0, 1.0)[..., None] * along
    return np.linalg.norm(points[:, None] - nearest, axis=-1).min(axis=1)


def drive(pose: FloatArray, speed: float, turn: float, seconds: float = 0.1) -> FloatArray:
    """Return the pose after driving with constant velocities, turning first."""
    turned = compose(pose, [0.0, 0.0, turn * seconds])
    return compose(turned, [speed * seconds, 0.0, 0.0])


def in_start_frame(start: FloatArray, pose: FloatArray) -> FloatArray:
    """Return a pose of the world as seen from the start pose."""
    return between(start, pose)
