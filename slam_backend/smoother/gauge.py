"""Gauge of new particles: the rigid motion of the whole map is fixed and kept as a covariance, not sampled.

A path drawn from the posterior is rotated and shifted about its start by an amount that its first steps leave
uncertain. No later measurement determines this motion. Resampling would nevertheless select a few of its samples and
finally one: the mean over the particles would drift within this uncertainty and jump back at the next rejuvenation.
Therefore each new particle is moved rigidly so that the landmarks now in view match the MAP path. The covariance of the
motions is stored once and added to any estimate in the map frame (Rao-Blackwellization: the motion is integrated out
given all other variables).
"""

import math
from typing import NamedTuple

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import between, wrap_angle
from slam_backend.smoother.graph import LEVER

XX, YY = 3, 6  # rows of a tile: variances of a landmark in the plane
MIN_SHARED = 2  # landmarks that determine the rotation of a particle


class GaugeFix(NamedTuple):
    """Rigid motions of particles into a common gauge.

    Attributes:
        poses: (K, 3, M) float64 [m, m, rad], map frame. Newest poses of the particles, moved.
        motions: (M, 3) float64 [m, m, rad], map frame. Rigid motion of each particle.
        scatter: (3, 3) float64 [m, m, rad]. Covariance of the inverse motions, removed from the particles.
    """

    poses: FloatArray
    motions: FloatArray
    scatter: FloatArray


def fix_gauge(
    tiles: FloatArray, seen: IntArray, landmarks: FloatArray, poses: FloatArray, means: FloatArray, weights: FloatArray
) -> GaugeFix | None:
    """Return the rigid motions that align each particle's landmarks with those of the MAP path.

    Each fit is weighted least squares; a landmark's weight is the inverse of its scatter.

    Args:
        tiles: (l, P / LANES, 9, LANES) float64. Means and covariances of landmarks, by lanes.
        seen: (n,) int64. Rows of the landmarks now in view.
        landmarks: (l, 3) float64 [m]. All landmarks of the MAP path.
        poses: (K, 3, M) float64 [m, m, rad], map frame. Newest poses of the particles.
        means: (K, 3) Newest poses of the MAP path.
        weights: (M,) Normalised weights.

    Returns:
        The motions; None if there are too few landmarks, or the scatter of the newest poses would increase.
    """
    if len(seen) < MIN_SHARED:
        return None
    gained, held = compute_gauge_fix(tiles, seen, landmarks, poses, means, weights, LEVER)
    return held if gained > 0.0 else None


def fix_start(
    starts: FloatArray, poses: FloatArray, start: FloatArray, mean: FloatArray, weights: FloatArray
) -> FloatArray:
    """Set all particles' starts to that of the MAP path, if this reduces the scatter of the newest poses seen from it.

    In a map with fixed gauge an unknown start is determined by old measurements only; resampling would merely select
    one of the sampled starts.

    Args:
        starts: (3, M) float64 [m, m, rad], map frame. The robot's start in each particle; written.
        poses: (3, M) float64 [m, m, rad], map frame. The robot's newest pose in each particle.
        start, mean: (3,) Start and newest pose of the robot in the MAP path.
        weights: (M,) Normalised weights.

    Returns:
        (3, 3) Covariance [m, m, rad], start frame, of the start, removed from the particles; 0 if they are unchanged.
    """
    motion, apart = between(start, mean), between(starts.T, start)
    off = [between(origins, poses.T) - motion for origins in (starts.T, start)]
    squares = [
        weights @ (each * each) for each in (np.column_stack([d[:, :2], LEVER * wrap_angle(d[:, 2])]) for d in off)
    ]
    if squares[1].sum() >= squares[0].sum():
        return np.zeros((3, 3))
    starts[:] = start[:, None]
    return np.asarray((weights * apart.T) @ apart)  # (9)


@jit
def compute_gauge_fix(
    tiles: FloatArray, seen: IntArray, landmarks: FloatArray, poses: FloatArray, means: FloatArray,
    weights: FloatArray, lever: float,
) -> tuple[float, GaugeFix]:  # fmt: skip
    """Return the decrease of the poses' scatter by fixing the gauge, and the result.

    Args:
        tiles, seen, landmarks, poses, means, weights: See `fix_gauge`.
        lever: Lever arm of headings [m].
    """
    n, m, num_lanes = len(seen), len(weights), tiles.shape[3]
    points, shares = np.empty((n, 2, m)), np.empty(n)
    total = 0.0
    for k in range(n):
        mean, target = 0.0, landmarks[seen[k]]
        for block in range(tiles.shape[1]):
            tile, first = tiles[seen[k], block], block * num_lanes
            for lane in range(min(num_lanes, m - first)):
                x, y = tile[0, lane], tile[1, lane]
                points[k, 0, first + lane], points[k, 1, first + lane] = x, y
                dx, dy = x - target[0], y - target[1]
                mean += (dx * dx + dy * dy + tile[XX, lane] + tile[YY, lane]) * weights[first + lane]
        shares[k] = 1.0 / max(mean, 1e-300)
        total += shares[k]
    for k in range(n):
        shares[k] /= total
    motions, moved, scatter = np.empty((m, 3)), np.empty(poses.shape), np.zeros((3, 3))
    fit_rigid_2d(points, landmarks[seen], shares, motions)
    move(poses, motions, moved)
    gained = 0.0
    for i in range(m):
        before, after = 0.0, 0.0
        for robot in range(len(poses)):
            x, y, heading = means[robot, 0], means[robot, 1], means[robot, 2]
            dx, dy = poses[robot, 0, i] - x, poses[robot, 1, i] - y
            turn = lever * ((poses[robot, 2, i] - heading + math.pi) % (2.0 * math.pi) - math.pi)
            before = before + dx * dx + dy * dy + turn * turn
            dx, dy = moved[robot, 0, i] - x, moved[robot, 1, i] - y
            turn = lever * ((moved[robot, 2, i] - heading + math.pi) % (2.0 * math.pi) - math.pi)
            after = after + dx * dx + dy * dy + turn * turn
        gained += weights[i] * (before - after)
        x, y, turn = motions[i, 0], motions[i, 1], motions[i, 2]
        c, s = math.cos(turn), math.sin(turn)
        back = (-(c * x + s * y), s * x - c * y, -turn)
        for row in range(3):
            for column in range(3):
                scatter[row, column] += weights[i] * back[row] * back[column]  # (9)
    return gained, GaugeFix(moved, motions, scatter)


@device
@in_place
def fit_rigid_2d(points: FloatArray, targets: FloatArray, shares: FloatArray, motions: FloatArray) -> None:
    """Write the rigid motions (M, 3) that best align points (n, 2, M) with targets (n, 2 or 3), weighted by (n,)."""
    target_x, target_y = 0.0, 0.0
    for n in range(len(shares)):
        target_x += shares[n] * targets[n, 0]
        target_y += shares[n] * targets[n, 1]
    for i in range(len(motions)):
        centre_x, centre_y = 0.0, 0.0
        for n in range(len(shares)):
            centre_x += shares[n] * points[n, 0, i]
            centre_y += shares[n] * points[n, 1, i]
        along, across = 0.0, 0.0
        for n in range(len(shares)):
            x, y = points[n, 0, i] - centre_x, points[n, 1, i] - centre_y
            aim_x, aim_y = shares[n] * (targets[n, 0] - target_x), shares[n] * (targets[n, 1] - target_y)
            along += aim_x * x + aim_y * y
            across += aim_y * x - aim_x * y
        turn = math.atan2(across, along)
        c, s = math.cos(turn), math.sin(turn)
        motions[i, 0] = target_x - (c * centre_x - s * centre_y)
        motions[i, 1] = target_y - (s * centre_x + c * centre_y)
        motions[i, 2] = turn


@in_place
def move(poses: FloatArray, motions: FloatArray, moved: FloatArray) -> None:
    """Write poses (K, 3, M) moved by each particle's motion (M, 3); `moved` may be `poses`."""
    for i in range(len(motions)):
        c, s = math.cos(motions[i, 2]), math.sin(motions[i, 2])
        for robot in range(len(poses)):
            x, y, heading = poses[robot, 0, i], poses[robot, 1, i], poses[robot, 2, i]
            moved[robot, 0, i] = motions[i, 0] + c * x - s * y
            moved[robot, 1, i] = motions[i, 1] + s * x + c * y
            turned = motions[i, 2] + heading + math.pi
            if not 0.0 <= turned < 2.0 * math.pi:  # where it lies there, `%` would not change it
                turned %= 2.0 * math.pi
            moved[robot, 2, i] = turned - math.pi
