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

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import between, cosine_sine, inverse, wrap_angle
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


def compute_gauge_fix(
    tiles: FloatArray, seen: IntArray, landmarks: FloatArray, poses: FloatArray, means: FloatArray,
    weights: FloatArray, lever: float,
) -> tuple[float, GaugeFix]:  # fmt: skip
    """Return the decrease of the poses' scatter by fixing the gauge, and the result.

    Args:
        tiles, seen, landmarks, poses, means, weights: See `fix_gauge`.
        lever: Lever arm of headings [m].
    """
    targets = landmarks[seen, :2]
    values = tiles[seen][:, :, [0, 1, XX, YY]].transpose(0, 2, 1, 3).reshape(len(seen), 4, -1)[:, :, : len(weights)]
    points, spreads = values[:, :2], ((values[:, :2] - targets[:, :, None]) ** 2 + values[:, 2:]).sum(axis=1)
    shares = 1.0 / np.maximum((weights * spreads).sum(axis=1), 1e-300)
    motions = fit_rigid_2d(points, targets, shares / shares.sum())
    moved = move(poses, motions)

    def scatter_of(each: FloatArray) -> FloatArray:
        off = each - means[:, :, None]
        off[:, 2] = lever * wrap_angle(each[:, 2] - means[:, 2, None])
        return np.asarray((off * off).sum(axis=(0, 1)))

    gained = float((weights * (scatter_of(poses) - scatter_of(moved))).sum())
    back = inverse(motions).T
    scatter = (weights * back[:, None] * back).sum(axis=2)  # (9)
    return gained, GaugeFix(moved, motions, scatter)


def fit_rigid_2d(points: FloatArray, targets: FloatArray, shares: FloatArray) -> FloatArray:
    """Return the rigid motions (M, 3) that best align points (n, 2, M) with targets (n, 2), weighted by (n,)."""
    centre, target = (shares[:, None, None] * points).sum(axis=0), (shares[:, None] * targets).sum(axis=0)
    (x, y), (u, v) = (points - centre).transpose(1, 0, 2), (shares[:, None] * (targets - target)).T[:, :, None]
    across, along = (v * x - u * y).sum(axis=0).tolist(), (u * x + v * y).sum(axis=0).tolist()
    motions = np.zeros((points.shape[2], 3))
    motions[:, 2] = list(map(math.atan2, across, along))
    c, s = cosine_sine(motions[:, 2])
    motions[:, 0], motions[:, 1] = (
        target[0] - (c * centre[0] - s * centre[1]),
        target[1] - (s * centre[0] + c * centre[1]),
    )
    return motions


def move(poses: FloatArray, motions: FloatArray) -> FloatArray:
    """Return poses (K, 3, M) moved by each particle's motion (M, 3)."""
    (c, s), moved = cosine_sine(motions[:, 2]), np.empty(poses.shape)
    moved[:, 0] = motions[:, 0] + c * poses[:, 0] - s * poses[:, 1]
    moved[:, 1] = motions[:, 1] + s * poses[:, 0] + c * poses[:, 1]
    moved[:, 2] = wrap_angle(motions[:, 2] + poses[:, 2])
    return moved
