"""The frame of new particles is held: what no measurement to come can tell apart is not left to chance.

A path drawn from the posterior turns and shifts the whole map about its start by as much as its first steps leave open.
Whatever a robot measures from now on says nothing of that. Resampling none the less leaves a few of these motions and
in the end one: the mean over the particles wanders through all that was open, and is thrown back at the next draw. So
each new particle is moved as a rigid whole to where the landmarks that the robots now see are in the most probable
path, and what the motions scattered is kept as one covariance, of which any estimate in the map frame has its share
(Rao and Blackwell: the motion, given all else, is integrated out and not sampled).
"""

import math
from typing import NamedTuple

import numpy as np

from slam_backend.core.jit import device, in_place, jit, simd, stack_array
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import between, wrap_angle
from slam_backend.smoother._kernels import LANES
from slam_backend.smoother.graph import LEVER_ARM

XX, YY = 3, 6  # rows of a tile: variances of a landmark in the plane
MIN_SHARED = 2  # landmarks that say how a particle is turned


class GaugeFix(NamedTuple):
    """How particles are moved.

    Attributes:
        poses: (K, 3, M) float64 [m, m, rad], map frame. Newest poses of the particles, moved.
        motions: (M, 3) float64 [m, m, rad], map frame. What moves each particle.
        scatter: (3, 3) float64 [m, m, rad]. Covariance of their inverses, which the particles no longer show.
    """

    poses: FloatArray
    motions: FloatArray
    scatter: FloatArray


def fix_gauge(
    tiles: FloatArray, seen: IntArray, landmarks: FloatArray, poses: FloatArray, means: FloatArray, weights: FloatArray
) -> GaugeFix | None:
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
    if len(seen) < MIN_SHARED:
        return None
    moved, motions, scatter = np.empty_like(poses), np.empty((len(weights), 3)), np.zeros((3, 3))
    if not compute_gauge_fix(tiles, seen, landmarks, poses, means, LEVER_ARM, weights, moved, motions, scatter):
        return None
    return GaugeFix(moved, motions, scatter)


def fix_start(
    starts: FloatArray, poses: FloatArray, start: FloatArray, mean: FloatArray, weights: FloatArray
) -> FloatArray:
    """Let all particles have the start of the most probable path, where their poses then agree better from there.

    A start in a map that is held is open as the map is in the frame of the first robot: what was measured long ago
    decides it, and resampling would only choose one of the starts drawn.

    Args:
        starts: (3, M) float64 [m, m, rad], map frame. Where the robot started in each particle; written.
        poses: (3, M) float64 [m, m, rad], map frame. Its newest poses.
        start, mean: (3,) Its start and its newest pose in the most probable path.
        weights: (M,) summing to 1.

    Returns:
        (3, 3) Covariance [m, m, rad], in the start frame, of the start as particles no longer show it; 0 where they
        keep theirs.
    """
    own, apart = between(start, mean), between(starts.T, start)
    off = [between(origins, poses.T) - own for origins in (starts.T, start)]
    squares = [
        weights @ (each * each) for each in (np.column_stack([d[:, :2], LEVER_ARM * wrap_angle(d[:, 2])]) for d in off)
    ]
    if squares[1].sum() >= squares[0].sum():
        return np.zeros((3, 3))
    starts[:] = start[:, None]
    return np.asarray((weights * apart.T) @ apart)  # (9)


@jit
def compute_gauge_fix(
    tiles: FloatArray, seen: IntArray, landmarks: FloatArray, poses: FloatArray, means: FloatArray, lever: float,
    weights: FloatArray, moved: FloatArray, motions: FloatArray, scatter: FloatArray,
) -> bool:  # fmt: skip
    """Write what `GaugeFix` holds, `scatter` from zeros on; return whether that helps.

    Args:
        tiles, seen, landmarks, poses, means, weights: As of `fix_gauge`.
        lever: [m] At which headings are felt.
        moved, motions, scatter: As of `GaugeFix`, results.
    """
    n, m = len(seen), len(weights)
    targets, points, squares = landmarks[seen], np.empty((n, 2, m)), np.empty((n, m))
    gather_landmarks(tiles, seen, targets, points, squares)
    shares = np.empty(n)
    landmark_weights(squares, weights, shares)
    fit_rigid_2d(points, targets, shares, motions)
    if not apply_if_closer(poses, motions, means, lever, weights, moved):
        return False
    add_covariance(motions, weights, scatter)
    return True


@device
@in_place
def landmark_weights(squares: FloatArray, weights: FloatArray, shares: FloatArray) -> None:
    """Write weights of landmarks (n,) that sum to 1, by the inverse of the mean of squares (n, M), weighed by (M,)."""
    total = 0.0
    for n in range(len(squares)):
        mean = 0.0
        for i in range(len(weights)):
            mean += squares[n, i] * weights[i]
        shares[n] = 1.0 / max(mean, 1e-300)
        total += shares[n]
    for n in range(len(shares)):
        shares[n] /= total


@device
@in_place
def fit_rigid_2d(points: FloatArray, targets: FloatArray, shares: FloatArray, motions: FloatArray) -> None:
    """Write the rigid motions (M, 3) that bring points (n, 2, M) to targets (n, 2 or 3) best, weighed by (n,)."""
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


@device
@in_place
def add_covariance(motions: FloatArray, weights: FloatArray, scatter: FloatArray) -> None:
    """Add the mean square (3, 3) of the inverses of motions (M, 3), weighed by (M,)."""
    for i in range(len(motions)):
        x, y, turn = motions[i, 0], motions[i, 1], motions[i, 2]
        c, s = math.cos(turn), math.sin(turn)
        back = (-(c * x + s * y), s * x - c * y, -turn)
        for row in range(3):
            for column in range(3):
                scatter[row, column] += weights[i] * back[row] * back[column]  # (9)


@device
@in_place
def gather_landmarks(
    tiles: FloatArray, seen: IntArray, targets: FloatArray, points: FloatArray, squares: FloatArray
) -> None:  # fmt: skip
    """Write where particles hold some landmarks to be in the plane, and how far off that may be.

    Args:
        tiles, seen: As of `fix_gauge`.
        targets: (n, 2 or 3) [m] where they are in the most probable path.
        points: (n, 2, M) [m], result.
        squares: (n, M) [m^2], result: squared distances from there, and the variances of the landmarks.
    """
    num_lanes = tiles.shape[3]
    for n in range(len(seen)):
        for block in range(tiles.shape[1]):
            tile, first = tiles[seen[n], block], block * num_lanes
            for lane in range(min(num_lanes, squares.shape[1] - first)):
                x, y = tile[0, lane], tile[1, lane]
                points[n, 0, first + lane], points[n, 1, first + lane] = x, y
                dx, dy = x - targets[n, 0], y - targets[n, 1]
                squares[n, first + lane] = dx * dx + dy * dy + tile[XX, lane] + tile[YY, lane]


@in_place
def move(poses: FloatArray, motions: FloatArray, moved: FloatArray) -> None:
    """Write poses (K, 3, M) of each particle moved by its motion (M, 3); `moved` may be `poses`."""
    for robot in range(len(poses)):
        for i in range(len(motions)):
            x, y, heading = poses[robot, 0, i], poses[robot, 1, i], poses[robot, 2, i]
            c, s = math.cos(motions[i, 2]), math.sin(motions[i, 2])
            moved[robot, 0, i] = motions[i, 0] + c * x - s * y
            moved[robot, 1, i] = motions[i, 1] + s * x + c * y
            moved[robot, 2, i] = (motions[i, 2] + heading + math.pi) % (2.0 * math.pi) - math.pi


@in_place
def wrap(poses: FloatArray) -> None:
    """Bring the headings of poses (K, 3, M) [m, m, rad] to [-pi, pi), in place."""
    for robot in range(len(poses)):
        for i in range(poses.shape[2]):
            poses[robot, 2, i] = (poses[robot, 2, i] + math.pi) % (2.0 * math.pi) - math.pi


@device
@in_place
def squared_error(poses: FloatArray, means: FloatArray, lever: float, squares: FloatArray) -> None:
    """Write how far off particles are.

    Args:
        poses: (K, 3, M) [m, m, rad].
        means: (K, 3) likewise.
        lever: [m] At which headings are felt.
        squares: (M,) [m^2], result: sum over the robots of squared distances.
    """
    squares[:] = 0.0
    for robot in range(len(poses)):
        for i in range(len(squares)):
            dx, dy = poses[robot, 0, i] - means[robot, 0], poses[robot, 1, i] - means[robot, 1]
            turn = lever * ((poses[robot, 2, i] - means[robot, 2] + math.pi) % (2.0 * math.pi) - math.pi)
            squares[i] = squares[i] + dx * dx + dy * dy + turn * turn


@device
@jit
def apply_if_closer(
    poses: FloatArray, motions: FloatArray, means: FloatArray, lever: float, weights: FloatArray, moved: FloatArray
) -> bool:
    """Move particles as `move` does; return whether this lowers their mean `squared_error`, weighted by (M,)."""
    before, after = np.empty(len(weights)), np.empty(len(weights))
    move(poses, motions, moved)
    squared_error(poses, means, lever, before)
    squared_error(moved, means, lever, after)
    gained = 0.0
    for i in range(len(weights)):
        gained += weights[i] * (before[i] - after[i])
    return gained > 0.0


def transform_tiles(tiles: FloatArray, motions: FloatArray) -> None:
    """Move landmarks (l, P / LANES, 9, LANES) of each particle, in place, by its motion (M, 3); surplus lanes stay."""
    transformed_tiles(tiles.reshape(-1), len(tiles), tiles.shape[1], motions)


@simd
def transformed_tiles(tiles: FloatArray, num_landmarks: int, num_blocks: int, motions: FloatArray) -> None:
    """Move means and covariances of landmarks, in place.

    Args:
        tiles: (num_landmarks * num_blocks * 9 * LANES,) x, y, z, xx, xy, xz, yy, yz, zz of each, by lanes.
        num_landmarks, num_blocks: How many there are.
        motions: (M, 3) [m, m, rad] of the particles.
    """
    cosine, sine, ahead, left = stack_array(LANES), stack_array(LANES), stack_array(LANES), stack_array(LANES)
    for block in range(num_blocks):
        first = block * LANES
        for i in range(LANES):
            cosine[i], sine[i], ahead[i], left[i] = 1.0, 0.0, 0.0, 0.0
        for i in range(min(LANES, len(motions) - first)):
            motion = motions[first + i]
            cosine[i], sine[i], ahead[i], left[i] = math.cos(motion[2]), math.sin(motion[2]), motion[0], motion[1]
        for landmark in range(num_landmarks):
            base = (landmark * num_blocks + block) * 9 * LANES
            tile = tiles[base : base + 9 * LANES]
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
