"""Pose estimates over all particles, and relative to where robots started."""

import math

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit, simd, simd_inline, stack_array
from slam_backend.core.simd_math import sine_cosine, wrapped
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import COV_XI_SIZE, LANES
from slam_backend.fastslam.relative_poses import COVARIANCE, OWN, SIGMAS, START


@simd_inline
def _add_up(lanes_of: FloatArray, sums: FloatArray) -> None:
    """Write the sums (n,) of rows of lanes (n LANES,): each in order, one beside the other."""
    sums[:] = 0.0
    for i in range(LANES):
        for c in range(len(sums)):
            sums[c] += lanes_of[c * LANES + i]


@simd
def mixture(
    means: FloatArray, covariances: FloatArray, weights: FloatArray, mean: FloatArray, covariance: FloatArray
) -> None:
    """Write mean (3,) and covariance (3, 3) of a weighted mixture of Gaussian poses.

    Args:
        means: (3, P), P >= M whole blocks of lanes; headings averaged on the circle.
        covariances: (6, P), upper triangles.
        weights: (M,), summing to 1.
    """
    w, sums, share = stack_array(LANES), stack_array(6), stack_array(COV_XI_SIZE)
    share[:] = 0.0
    for first in range(0, len(weights), LANES):
        for i in range(LANES):  # zeros for surplus lanes
            w[i] = weights[first + i] if first + i < len(weights) else 0.0
        for i in range(LANES):
            sine, cosine = sine_cosine(means[2, first + i])
            share[i] += w[i] * means[0, first + i]
            share[LANES + i] += w[i] * means[1, first + i]
            share[2 * LANES + i] += w[i] * sine
            share[3 * LANES + i] += w[i] * cosine
    _add_up(share, sums)
    mean_x, mean_y, mean_theta = sums[0], sums[1], wrapped(math.atan2(sums[2], sums[3]))
    mean[0], mean[1], mean[2] = mean_x, mean_y, mean_theta
    share[:] = 0.0
    for first in range(0, len(weights), LANES):
        for i in range(LANES):
            w[i] = weights[first + i] if first + i < len(weights) else 0.0
        for i in range(LANES):
            x, y = means[0, first + i] - mean_x, means[1, first + i] - mean_y
            t = wrapped(means[2, first + i] - mean_theta)
            share[i] += w[i] * (x * x + covariances[0, first + i])
            share[LANES + i] += w[i] * (x * y + covariances[1, first + i])
            share[2 * LANES + i] += w[i] * (x * t + covariances[2, first + i])
            share[3 * LANES + i] += w[i] * (y * y + covariances[3, first + i])
            share[4 * LANES + i] += w[i] * (y * t + covariances[4, first + i])
            share[5 * LANES + i] += w[i] * (t * t + covariances[5, first + i])
    _add_up(share, sums)
    covariance[0, 0], covariance[1, 1], covariance[2, 2] = sums[0], sums[3], sums[5]
    covariance[0, 1] = covariance[1, 0] = sums[1]
    covariance[0, 2] = covariance[2, 0] = sums[2]
    covariance[1, 2] = covariance[2, 1] = sums[4]


@in_place
def add_gauge_covariance(scatter: FloatArray, poses: FloatArray, covariances: FloatArray) -> None:
    """Add to the covariances of poses, in place, what a scattered motion of the whole map adds, to first order.

    Args:
        scatter: (3, 3) covariance of the motion [m, m, rad] about the origin.
        poses: (n, 3) [m, m, rad], map frame.
        covariances: (n, 3, 3), changed: J C J^T with J = [[1, 0, -y], [0, 1, x], [0, 0, 1]] is added to each.
    """
    for n in range(len(poses)):
        x, y, c = poses[n, 0], poses[n, 1], covariances[n]
        across, along = scatter[0, 2] - y * scatter[2, 2], scatter[1, 2] + x * scatter[2, 2]
        c[0, 0] += scatter[0, 0] - y * scatter[0, 2] - y * across
        c[1, 1] += scatter[1, 1] + x * scatter[1, 2] + x * along
        both = scatter[0, 1] + x * scatter[0, 2] - y * along
        c[0, 1] += both
        c[1, 0] += both
        c[0, 2] += across
        c[2, 0] += across
        c[1, 2] += along
        c[2, 1] += along
        c[2, 2] += scatter[2, 2]


AT_ORIGIN, KNOWN, SPREAD = 0, 1, 2  # what starts of particles can be


@device
@in_place
def start_kind(starts: FloatArray, count: int) -> int:
    """Tell whether the starts (3, P) of `count` particles are all the origin, all the same, or differ."""
    at_origin = same = True
    for axis in range(3):
        for m in range(count):
            at_origin &= starts[axis, m] == 0.0
            same &= starts[axis, m] == starts[axis, 0]
    return AT_ORIGIN if at_origin else KNOWN if same else SPREAD


@inline
def _relative_pose(
    start: FloatArray, pose: FloatArray, spread: FloatArray, seen: FloatArray, seen_spread: FloatArray
) -> None:
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


@device
@in_place
def relative_poses_from_starts(
    starts: FloatArray, means: FloatArray, covariances: FloatArray, count: int, seen: FloatArray, spread: FloatArray
) -> None:
    """Write each particle's pose estimate as seen from its own start pose.

    Args:
        starts: (3, P) float64 [m, m, rad], map frame. Start of the robot in each particle.
        means: (3, P) float64 [m, m, rad], map frame.
        covariances: (6, P) float64: xx, xy, xt, yy, yt, tt of each, map frame.
        count: Particles; the lanes beyond mean nothing.
        seen, spread: (3, P), (6, P), written up to `count`: the same in the start frames.
    """
    for m in range(count):
        _relative_pose(starts[:, m], means[:, m], covariances[:, m], seen[:, m], spread[:, m])


@device
@jit
def _relative_pose_of_self(
    starts: FloatArray, means: FloatArray, covariances: FloatArray, weights: FloatArray, best: int, kind: int,
    pose: FloatArray, spread: FloatArray,
) -> None:  # fmt: skip
    """Move a robot's estimate (3,), (3, 3), in place, from the map frame to its start frame; see `write_team_poses`."""
    if kind == SPREAD:
        padded = starts.shape[1]
        seen, seen_spread = np.zeros((3, padded)), np.zeros((6, padded))
        relative_poses_from_starts(starts, means, covariances, len(weights), seen, seen_spread)
        mixture(seen, seen_spread, weights, pose, spread)
    elif kind == KNOWN:
        packed, seen_packed, from_map = np.empty(6), np.empty(6), pose.copy()
        entry = 0
        for j in range(3):
            for k in range(j, 3):
                packed[entry] = spread[j, k]
                entry += 1
        _relative_pose(starts[:, best], from_map, packed, pose, seen_packed)
        entry = 0
        for j in range(3):
            for k in range(j, 3):
                spread[j, k] = spread[k, j] = seen_packed[entry]
                entry += 1


@in_place
def write_team_poses(
    robots: FloatArray, scatters: FloatArray, weights: FloatArray, best: int, estimates: FloatArray,
    spreads: FloatArray, members: IntArray, poses: FloatArray, beliefs: FloatArray,
) -> None:  # fmt: skip
    """Write where the robots of a filter stand, and where they see each other, in their own start frames.

    Each particle's pose is seen from where the robot started in that particle, so that what is not known of the start
    does not blur it. What particles do not show of a start that is held widens the pose that is seen from there.

    Args:
        robots: (5, n, 3, P) what its robots have in all particles, see `layout`, map frame.
        scatters: (n, 3, 3) covariances of their starts that particles do not show [m, m, rad], start frames; 0 where
            they show all.
        weights: (M,) summing to 1; (0,) where all robots started at the origin in all particles.
        best: The most probable particle.
        estimates, spreads: (n, 3), (n, 3, 3) [m, m, rad] the robots' poses over all particles, map frame.
        members: (2, n) int64. Robots of the team, and 1 below each that uses this filter; only these are written.
        poses, beliefs: Arrays of the `TeamPoses` of all robots of the team; written, without the sample sizes.
    """
    count = members.shape[1]
    starts, means = robots[L.STARTS], robots[L.MEANS]
    covariances = robots[L.COVARIANCES :].reshape((count, 6, robots.shape[3]))
    for i in range(count):
        if not members[1, i]:
            continue
        own = members[0, i]
        seen, belief = poses[own], beliefs[own]
        x, y, theta = starts[i, 0, best], starts[i, 1, best], starts[i, 2, best]
        c, s = math.cos(theta), math.sin(theta)
        to_x, to_y, turn = -c * x - s * y, s * x - c * y, (math.pi - theta) % (2.0 * math.pi) - math.pi
        belief[START], belief[START + 1], belief[START + 2] = to_x, to_y, turn
        for j in range(3):
            belief[OWN + j] = estimates[i, j]
            for k in range(3):
                belief[COVARIANCE + 3 * j + k] = spreads[i, j, k]
        if len(weights) > 0:
            is_held = scatters[i, 2, 2] > 0.0  # then the estimate's share of the frame is not its own
            kind = SPREAD if is_held else start_kind(starts[i], len(weights))
            pose, spread = belief[OWN : OWN + 3], belief[COVARIANCE:SIGMAS].reshape((3, 3))
            _relative_pose_of_self(starts[i], means[i], covariances[i], weights, best, kind, pose, spread)
            if is_held:
                add_gauge_covariance(scatters[i], pose.reshape((1, 3)), spread.reshape((1, 3, 3)))
        for mate in range(len(seen)):
            for j in range(3):
                seen[mate, j] = belief[OWN + j] if mate == own else np.nan
            belief[SIGMAS + mate] = np.nan
        belief[SIGMAS + own] = math.sqrt(0.5 * (belief[COVARIANCE] + belief[COVARIANCE + 4]))
        c, s = math.cos(turn), math.sin(turn)
        for j in range(count):
            if j != i:
                mate = members[0, j]
                seen[mate, 0] = to_x + c * estimates[j, 0] - s * estimates[j, 1]
                seen[mate, 1] = to_y + s * estimates[j, 0] + c * estimates[j, 1]
                seen[mate, 2] = (turn + estimates[j, 2] + math.pi) % (2.0 * math.pi) - math.pi
                belief[SIGMAS + mate] = math.sqrt(0.5 * (spreads[j, 0, 0] + spreads[j, 1, 1]))
