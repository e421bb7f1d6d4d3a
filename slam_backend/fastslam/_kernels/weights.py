"""Weights of particles, and what they say together: mixtures and reports (Eqs. 3, 11, 12)."""

import math

import numpy as np

from slam_backend.core.jit import device, in_place, lanes, lanes_inlined, room
from slam_backend.core.simd_math import sine_cosine, wrapped
from slam_backend.core.validation import FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.layout import (
    ASSOCIATED,
    BEGIN,
    COUNT,
    CREATED,
    END,
    LANES,
    LOG_LIKELIHOOD,
    LOG_WEIGHTS,
    PATH_LOG_WEIGHTS,
    REJECTED,
    SPREAD_SIZE,
    WEIGHTS,
)


@device
@in_place
def weigh(
    log_likelihood: FloatArray, log_weights: FloatArray, path_log_weights: FloatArray, weights: FloatArray
) -> float:
    """Add a step's log-likelihood to the log-weights (M,) and normalise (Eqs. 3, 11, 12; Algorithm 1, l. 9).

    Args:
        log_likelihood: (M,).
        log_weights, path_log_weights: (M,), updated.
        weights: (M,), written: they sum to 1.

    Returns:
        The effective sample size.
    """
    m = len(log_weights)
    largest = -np.inf
    for i in range(m):
        path_log_weights[i] += log_likelihood[i]  # Eq. 12
        log_weights[i] += log_likelihood[i]  # Eqs. 3, 11
        largest = max(largest, log_weights[i])
    total = 0.0
    for i in range(m):
        weights[i] = math.exp(log_weights[i] - largest)
        total += weights[i]
    log_total = math.log(total)
    squares = 0.0
    for i in range(m):
        log_weights[i] = log_weights[i] - largest - log_total  # one after the other: the largest may be huge
        weights[i] /= total
        squares += weights[i] * weights[i]
    return 1.0 / squares


@lanes_inlined
def _load_weights(weights: FloatArray, first: int, block: FloatArray) -> None:
    """Write the weights (M,) of a block (LANES,) from `first` on, zeros for surplus lanes."""
    for i in range(LANES):
        block[i] = weights[first + i] if first + i < len(weights) else 0.0


@lanes_inlined
def _add_up(lanes_of: FloatArray, sums: FloatArray) -> None:
    """Write the sums (n,) of rows of lanes (n LANES,): each in order, one beside the other."""
    sums[:] = 0.0
    for i in range(LANES):
        for c in range(len(sums)):
            sums[c] += lanes_of[c * LANES + i]


@lanes
def mixture(
    means: FloatArray, covariances: FloatArray, weights: FloatArray, mean: FloatArray, covariance: FloatArray
) -> None:
    """Write mean (3,) and covariance (3, 3) of a weighted mixture of Gaussian poses.

    Args:
        means: (3, P), P >= M whole blocks of lanes; headings averaged on the circle.
        covariances: (6, P), upper triangles.
        weights: (M,), summing to 1.
    """
    w, sums, share = room(LANES), room(6), room(SPREAD_SIZE)
    share[:] = 0.0
    for first in range(0, len(weights), LANES):
        _load_weights(weights, first, w)
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
        _load_weights(weights, first, w)
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
def add_share(scatter: FloatArray, poses: FloatArray, covariances: FloatArray) -> None:
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


@device
@in_place
def summarise(
    rows: IntArray, turns: IntArray, found: Int32Array, distances: FloatArray, told: IntArray, best: int, ids: IntArray,
    last_seen: IntArray, now: int, long: float,
) -> tuple[int, int, int, int, int, float]:  # fmt: skip
    """Tell what became of the robots' measurements.

    Args:
        rows, turns: Which of all n measurements they are, as in `take_turns`; those of others are passed over.
        found: (n, P) slots to which the particles gave the measurements, -1 = rejected.
        distances: (n, P) squared distances of matches.
        told: (2, n), written: the id to which the most probable particle gave each measurement, -1 = rejected; and the
            id of the landmark that it created in any particle, -1 = none. There the slots of these landmarks stand.
        best: The most probable particle.
        ids: (slots,) stable names.
        last_seen: (slots,) number of the step in which the most probable particle last matched a landmark, 0 = it never
            did. Changed.
        now: That of this step.
        long: Steps after which a landmark was not seen for long.

    Returns:
        How many landmarks not seen for long the most probable particle matched; how many measurements started a
        landmark in any particle; how many the most probable particle started, matched, and made nothing of, unused ones
        included; and the mean of its squared distances, without what it predicted behind the camera, NaN if there is
        none.
    """
    associated, created = told[ASSOCIATED], told[CREATED]
    num_given, num_created, num_new, num_matched, num_long_unseen, squares, judged = 0, 0, 0, 0, 0, 0.0, 0
    for row in rows:
        if row < 0:
            continue
        num_given += max(turns[row, COUNT], 0)
        for b in range(turns[row, BEGIN], turns[row, END]):
            slot, new = found[b, best], created[b]
            associated[b] = ids[slot] if slot >= 0 else REJECTED
            created[b] = ids[new] if new >= 0 else REJECTED
            if new >= 0:
                num_created += 1
                last_seen[new] = 0
            if slot < 0:
                continue
            num_long_unseen += 0 < last_seen[slot] < now - long
            last_seen[slot] = now
            if slot == new:
                num_new += 1
            else:
                num_matched += 1
                if distances[b, best] < np.inf:
                    squares += distances[b, best]
                    judged += 1
    num_rejected = num_given - num_new - num_matched
    return num_long_unseen, num_created, num_new, num_matched, num_rejected, squares / judged if judged > 0 else np.nan


@device
@in_place
def conclude(
    weights: FloatArray, count: int, means: FloatArray, covariances: FloatArray, frame: FloatArray,
    mean: FloatArray, covariance: FloatArray, rows: IntArray, turns: IntArray, found: Int32Array, distances: FloatArray,
    told: IntArray, ids: IntArray, last_seen: IntArray, now: int, long: float, threshold: float,
) -> tuple[int, int, int, int, int, int, float, float, bool]:  # fmt: skip
    """Do what `weigh`, `mixture` and `add_share` for each of K robots and, for their measurements, `summarise` do.

    Args:
        weights: (4, P) log-weights, those along paths, weights, and a step's log-likelihood; the first three change.
        count: M.
        means, covariances: (K, 3, P), (K, 6, P) N(x^, P^) before sampling.
        frame: (3, 3) covariance of a motion of the whole map that particles do not show, or zeros.
        mean, covariance: (K, 3), (K, 3, 3), written: of each robot's pose over all particles.
        rows, ..., long: As in `summarise`.
        threshold: Share of M below which the effective sample size asks for resampling.

    Returns:
        The most probable particle; the first five that `summarise` returns of it; the effective sample size; the last
        one; and whether the particles are to be resampled, now that something was measured.
    """
    path_log_weights, own = weights[PATH_LOG_WEIGHTS][:count], weights[WEIGHTS][:count]
    ess = weigh(weights[LOG_LIKELIHOOD][:count], weights[LOG_WEIGHTS][:count], path_log_weights, own)
    for robot in range(len(means)):
        mixture(means[robot], covariances[robot], own, mean[robot], covariance[robot])
    if frame[0, 0] != 0.0 or frame[2, 2] != 0.0:
        add_share(frame, mean, covariance)
    best = int(path_log_weights.argmax())
    long_unseen, created, new, matched, rejected, nis = summarise(
        rows, turns, found, distances, told, best, ids, last_seen, now, long
    )  # fmt: skip
    used = 0
    for row in rows:
        if row >= 0:
            used += turns[row, END] - turns[row, BEGIN]
    is_depleted = used > 0 and ess <= threshold * count * (1.0 + 1e-9)  # rounding must not decide
    return best, long_unseen, created, new, matched, rejected, ess, nis, is_depleted
