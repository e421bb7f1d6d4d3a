"""Poses as seen from where robots started: in all particles at once, and what these say together."""

import math

import numpy as np

from slam_backend._jit import inlined, jit
from slam_backend._kernels.weights import mixture
from slam_backend.errors import FloatArray

AT_ORIGIN, KNOWN, SPREAD = 0, 1, 2  # what starts of particles can be


@jit
def start_kind(starts: FloatArray, count: int) -> int:
    """Tell whether the starts (3, P) of `count` particles are all the origin, all the same, or differ."""
    at_origin = same = True
    for axis in range(3):
        for m in range(count):
            at_origin &= starts[axis, m] == 0.0
            same &= starts[axis, m] == starts[axis, 0]
    return AT_ORIGIN if at_origin else KNOWN if same else SPREAD


@inlined
def _see(start: FloatArray, pose: FloatArray, spread: FloatArray, seen: FloatArray, seen_spread: FloatArray) -> None:
    """Write a pose (3,) and its covariance (6,), xx, xy, xt, yy, yt, tt, as they are seen from a start (3,)."""
    c, s = math.cos(start[2]), math.sin(start[2])
    dx, dy = pose[0] - start[0], pose[1] - start[1]
    seen[0], seen[1] = c * dx + s * dy, c * dy - s * dx
    seen[2] = (pose[2] - start[2] + math.pi) % (2.0 * math.pi) - math.pi
    xx, xy, yy = spread[0], spread[1], spread[3]
    seen_spread[0] = c * c * xx + 2.0 * c * s * xy + s * s * yy
    seen_spread[1] = c * s * (yy - xx) + (c * c - s * s) * xy
    seen_spread[3] = s * s * xx - 2.0 * c * s * xy + c * c * yy
    seen_spread[2] = c * spread[2] + s * spread[4]
    seen_spread[4] = c * spread[4] - s * spread[2]
    seen_spread[5] = spread[5]


@jit
def see_from_starts(
    starts: FloatArray, means: FloatArray, covariances: FloatArray, count: int, seen: FloatArray, spread: FloatArray
) -> None:
    """Write each particle's pose estimate as seen from its own start pose.

    Args:
        starts: (3, P) float64 [m, m, rad], map frame. Where the robot started in each particle.
        means: (3, P) float64 [m, m, rad], map frame.
        covariances: (6, P) float64: xx, xy, xt, yy, yt, tt of each, map frame.
        count: Particles; the lanes beyond mean nothing.
        seen, spread: (3, P), (6, P), written up to `count`: the same in the start frames.
    """
    for m in range(count):
        _see(starts[:, m], means[:, m], covariances[:, m], seen[:, m], spread[:, m])


@jit
def own_frames(
    starts: FloatArray, means: FloatArray, covariances: FloatArray, weights: FloatArray, best: int,
    poses: FloatArray, spreads: FloatArray, frames: FloatArray,
) -> None:  # fmt: skip
    """Move the estimates of robots' poses from the map frame to their own start frames.

    Each particle's pose is seen from where the robot started in that particle, so that what is not known of the start
    does not blur it.

    Args:
        starts, means, covariances: (K, 3, P), (K, 3, P), (K, 6, P) of all robots and particles, map frame.
        weights: (M,) summing to 1.
        best: The most probable particle.
        poses, spreads: (K, 3), (K, 3, 3) [m, m, rad] the estimates, replaced.
        frames: (K, 3) [m, m, rad], written: the motion from the map frame to each start frame in particle `best`.
    """
    count, padded = len(weights), starts.shape[2]
    packed, seen_packed, pose = np.empty(6), np.empty(6), np.empty(3)
    for robot in range(len(starts)):
        x, y, theta = starts[robot, 0, best], starts[robot, 1, best], starts[robot, 2, best]
        c, s = math.cos(theta), math.sin(theta)
        frames[robot, 0], frames[robot, 1] = -c * x - s * y, s * x - c * y
        frames[robot, 2] = (math.pi - theta) % (2.0 * math.pi) - math.pi
        kind = start_kind(starts[robot], count)
        if kind == SPREAD:
            seen, spread = np.zeros((3, padded)), np.zeros((6, padded))
            see_from_starts(starts[robot], means[robot], covariances[robot], count, seen, spread)
            mixture(seen, spread, weights, poses[robot], spreads[robot])
        elif kind == KNOWN:
            entry = 0
            for j in range(3):
                for k in range(j, 3):
                    packed[entry] = spreads[robot, j, k]
                    entry += 1
            pose[:] = poses[robot]
            _see(starts[robot, :, best], pose, packed, poses[robot], seen_packed)
            entry = 0
            for j in range(3):
                for k in range(j, 3):
                    spreads[robot, j, k] = spreads[robot, k, j] = seen_packed[entry]
                    entry += 1
