"""Weights of particles, and what they say together: mixtures and reports (Eqs. 3, 11, 12)."""

import math

import numpy as np

from slam_backend._jit import jit, lanes
from slam_backend._kernels.lane_math import sine_cosine, wrapped
from slam_backend._kernels.layout import LANES, REJECTED
from slam_backend.errors import FloatArray, Int32Array, IntArray


@jit
def weigh(
    log_likelihood: FloatArray, log_weights: FloatArray, path_log_weights: FloatArray, weights: FloatArray
) -> float:
    """Add a step's log-likelihood to the log-weights (M,) and normalise (Eqs. 3, 11, 12; Algorithm 1, l. 9).

    Args:
        log_likelihood: (P,), read up to M.
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
    m = len(weights)
    sums = np.zeros((4, LANES))
    w = np.empty(LANES)
    for first in range(0, m, LANES):
        real = min(LANES, m - first)
        for i in range(LANES):
            w[i] = weights[first + i] if i < real else 0.0
        for i in range(LANES):
            sine, cosine = sine_cosine(means[2, first + i])
            sums[0, i] += w[i] * means[0, first + i]
            sums[1, i] += w[i] * means[1, first + i]
            sums[2, i] += w[i] * sine
            sums[3, i] += w[i] * cosine
    mean[0], mean[1] = sums[0].sum(), sums[1].sum()
    mean[2] = wrapped(math.atan2(sums[2].sum(), sums[3].sum()))
    spread = np.zeros((6, LANES))
    for first in range(0, m, LANES):
        real = min(LANES, m - first)
        for i in range(LANES):
            w[i] = weights[first + i] if i < real else 0.0
        for i in range(LANES):
            x, y = means[0, first + i] - mean[0], means[1, first + i] - mean[1]
            t = wrapped(means[2, first + i] - mean[2])
            spread[0, i] += w[i] * (x * x + covariances[0, first + i])
            spread[1, i] += w[i] * (x * y + covariances[1, first + i])
            spread[2, i] += w[i] * (x * t + covariances[2, first + i])
            spread[3, i] += w[i] * (y * y + covariances[3, first + i])
            spread[4, i] += w[i] * (y * t + covariances[4, first + i])
            spread[5, i] += w[i] * (t * t + covariances[5, first + i])
    covariance[0, 0] = spread[0].sum()
    covariance[0, 1] = covariance[1, 0] = spread[1].sum()
    covariance[0, 2] = covariance[2, 0] = spread[2].sum()
    covariance[1, 1] = spread[3].sum()
    covariance[1, 2] = covariance[2, 1] = spread[4].sum()
    covariance[2, 2] = spread[5].sum()


@jit
def summarise(
    found: Int32Array, distances: FloatArray, new_slots: IntArray, keep: IntArray, best: int, ids: IntArray,
    associations: IntArray, created: IntArray,
) -> tuple[int, int, int, float, int]:  # fmt: skip
    """Tell what became of measurements.

    Args:
        found: (n, P) slots to which the particles gave the used measurements, -1 = rejected.
        distances: (n, P) squared distances of matches.
        new_slots: (n,) slots of the landmarks that were started, -1 = none.
        keep: (n,) which of the caller's measurements were used.
        best: The most probable particle.
        ids: (slots,) stable names.
        associations: Written: the id to which the most probable particle gave each measurement, -1 = rejected.
        created: Written: the id of the landmark that each measurement created in any particle, -1 = none.

    Returns:
        How many started a landmark in any particle, how many the most probable particle started and matched, and the
        sum and number of its squared distances, without what it predicted behind the camera.
    """
    associations[:] = REJECTED
    created[:] = REJECTED
    num_created, num_new, num_matched, squares, judged = 0, 0, 0, 0.0, 0
    for b in range(len(keep)):
        slot = found[b, best]
        if new_slots[b] >= 0:
            created[keep[b]] = ids[new_slots[b]]
            num_created += 1
        if slot < 0:
            continue
        associations[keep[b]] = ids[slot]
        if slot == new_slots[b]:
            num_new += 1
        else:
            num_matched += 1
            if distances[b, best] < np.inf:
                squares += distances[b, best]
                judged += 1
    return num_created, num_new, num_matched, squares, judged


@jit
def conclude(
    log_likelihood: FloatArray, log_weights: FloatArray, path_log_weights: FloatArray, weights: FloatArray,
    means: FloatArray, covariances: FloatArray, mean: FloatArray, covariance: FloatArray,
    found: Int32Array, distances: FloatArray, new_slots: IntArray, keep: IntArray, ids: IntArray,
    associations: IntArray, created: IntArray,
) -> tuple[float, int, int, int, float, int]:  # fmt: skip
    """Do what `weigh`, `mixture` for each of K robots and, for the measurements of all, `summarise` do.

    Args:
        means, covariances: (K, 3, P), (K, 6, P).
        mean, covariance: (K, 3), (K, 3, 3), written.
        The others are as in those.

    Returns:
        The effective sample size, and what `summarise` returns by the most probable particle.
    """
    ess = weigh(log_likelihood, log_weights, path_log_weights, weights)
    for robot in range(len(means)):
        mixture(means[robot], covariances[robot], weights, mean[robot], covariance[robot])
    best = int(path_log_weights.argmax())
    made, new, matched, squares, judged = summarise(
        found, distances, new_slots, keep, best, ids, associations, created
    )  # fmt: skip
    return ess, made, new, matched, squares, judged
