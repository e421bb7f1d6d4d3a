"""The frame of new particles is held: what no measurement to come can tell apart is not left to chance.

A path drawn from the posterior turns and shifts the whole map about its start by as much as its first steps leave open.
Whatever a robot measures from now on says nothing of that. Resampling none the less leaves a few of these motions and
in the end one: the mean over the particles wanders through all that was open, and is thrown back at the next draw. So
each new particle is moved as a rigid whole to where the landmarks that the robots now see are in the most probable
path, and what the motions scattered is kept as one covariance, of which any estimate in the map frame has its share
(Rao and Blackwell: the motion, given all else, is integrated out and not sampled).
"""

from dataclasses import dataclass

import numpy as np

from slam_backend._jit import lanes
from slam_backend.errors import FloatArray, IntArray
from slam_backend.geometry import compose, inverse, wrap_angle
from slam_backend.smoothing._kernels import LANES
from slam_backend.smoothing.graph import LEVER

PLANE = [0, 1, 3, 6]  # rows of a tile: where a landmark is in the plane, and its variances there
LEAST_SHARED = 2  # landmarks that say how a particle is turned


@dataclass(frozen=True, slots=True, eq=False)
class Held:
    """How particles are moved.

    Attributes:
        motions: (M, 3) float64 [m, m, rad], map frame. What moves each particle.
        scatter: (3, 3) float64 [m, m, rad]. Covariance of their inverses, which the particles no longer show.
    """

    motions: FloatArray
    scatter: FloatArray


def holding(
    tiles: FloatArray, seen: IntArray, landmarks: FloatArray, poses: FloatArray, means: FloatArray, weights: FloatArray
) -> Held | None:
    """Return the motions that bring each particle's landmarks to those of the most probable path.

    The fit of each particle is one of least squares, landmarks weighed by the inverse of how much they scatter.

    Args:
        tiles: (l, P / LANES, 9, LANES) float64. Means and covariances of landmarks, by lanes.
        seen: (n,) int64. Which of them are now seen.
        landmarks: (l, 3) float64 [m]. All of them in the most probable path.
        poses: (K, 3, M) float64 [m, m, rad], map frame. Newest poses of the particles.
        means: (K, 3) Of the most probable path.
        weights: (M,) summing to 1.

    Returns:
        None where it does not help: too few landmarks, or the newest poses would scatter more than they do.
    """
    if len(seen) < LEAST_SHARED:
        return None
    m = poses.shape[2]
    rows = tiles[seen[:, None], :, PLANE].reshape(len(seen), len(PLANE), -1)[:, :, :m]
    targets = landmarks[seen, :2]
    off = rows[:, :2] - targets[:, :, None]
    squares = off * off
    spread = (squares[:, 0] + squares[:, 1] + rows[:, 2] + rows[:, 3]) @ weights
    motions = _fitted(rows[:, :2], targets, 1.0 / np.maximum(spread, 1e-300))
    moved = compose(motions, poses.transpose(0, 2, 1)).transpose(0, 2, 1)
    if not _scatter(moved, means, weights) < _scatter(poses, means, weights):
        return None
    back = inverse(motions)
    return Held(motions, np.asarray(np.einsum("m,mi,mj->ij", weights, back, back)))  # (9)


def _fitted(points: FloatArray, targets: FloatArray, weights: FloatArray) -> FloatArray:
    """Return the rigid motions (M, 3) that bring points (n, 2, M) to targets (n, 2) best, weighed by (n,)."""
    shares = weights / weights.sum()
    centres, target = np.einsum("n,nim->im", shares, points), shares @ targets
    from_centre, aim = points - centres, shares[:, None] * (targets - target)
    x, y = from_centre[:, 0], from_centre[:, 1]
    turns = np.arctan2(aim[:, 1] @ x - aim[:, 0] @ y, aim[:, 0] @ x + aim[:, 1] @ y)
    c, s = np.cos(turns), np.sin(turns)
    ahead = target[0] - (c * centres[0] - s * centres[1])
    return np.stack([ahead, target[1] - (s * centres[0] + c * centres[1]), turns], axis=1)


def _scatter(poses: FloatArray, means: FloatArray, weights: FloatArray) -> float:
    """Return the mean square [m^2] of how far poses (K, 3, M) are from means (K, 3), headings felt at `LEVER`."""
    off = poses - means[:, :, None]
    off[:, 2] = LEVER * wrap_angle(off[:, 2])
    return float(((off * off).sum(axis=(0, 1)) * weights).sum())


def move_poses(poses: FloatArray, motions: FloatArray, chosen: IntArray) -> None:
    """Move the chosen robots' poses (K, 3, M) of each particle, in place, by its motion (M, 3)."""
    poses[chosen] = compose(motions, poses[chosen].transpose(0, 2, 1)).transpose(0, 2, 1)


def move_tiles(tiles: FloatArray, motions: FloatArray) -> None:
    """Move landmarks (l, P / LANES, 9, LANES) of each particle, in place, by its motion (M, 3); surplus lanes stay."""
    blocks = tiles.shape[1]
    rows = np.zeros((4, blocks * LANES))
    rows[0], rows[1, : len(motions)] = 1.0, np.sin(motions[:, 2])
    rows[0, : len(motions)] = np.cos(motions[:, 2])
    rows[2:, : len(motions)] = motions[:, :2].T
    moved_tiles(tiles.reshape(-1), len(tiles), blocks, np.ascontiguousarray(rows.reshape(4, blocks, LANES)))


@lanes
def moved_tiles(tiles: FloatArray, num_landmarks: int, num_blocks: int, motions: FloatArray) -> None:
    """Move means and covariances of landmarks, in place.

    Args:
        tiles: (num_landmarks * num_blocks * 9 * LANES,) x, y, z, xx, xy, xz, yy, yz, zz of each, by lanes.
        num_landmarks, num_blocks: How many there are.
        motions: (4, num_blocks, LANES) cosine and sine of each turn, and the shift [m].
    """
    for landmark in range(num_landmarks):
        for block in range(num_blocks):
            base = (landmark * num_blocks + block) * 9 * LANES
            tile = tiles[base : base + 9 * LANES]
            cosine, sine = motions[0, block], motions[1, block]
            ahead, left = motions[2, block], motions[3, block]
            for i in range(LANES):
                c, s = cosine[i], sine[i]
                x, y = tile[i], tile[LANES + i]
                tile[i] = c * x - s * y + ahead[i]
                tile[LANES + i] = s * x + c * y + left[i]
                xx, xy, yy = tile[3 * LANES + i], tile[4 * LANES + i], tile[6 * LANES + i]
                xz, yz = tile[5 * LANES + i], tile[7 * LANES + i]
                tile[3 * LANES + i] = c * c * xx - 2.0 * c * s * xy + s * s * yy
                tile[4 * LANES + i] = c * s * (xx - yy) + (c * c - s * s) * xy
                tile[6 * LANES + i] = s * s * xx + 2.0 * c * s * xy + c * c * yy
                tile[5 * LANES + i] = c * xz - s * yz
                tile[7 * LANES + i] = s * xz + c * yz
