"""Weights of particles: a step's log-likelihoods are added and normalised."""

import math

import numpy as np

from slam_backend.core.jit import device, in_place
from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import layout as L


@device
@in_place
def weigh(weights: FloatArray, count: int) -> float:
    """Add a step's log-likelihood to the log-weights and normalise (Eqs. 3, 11, 12; Algorithm 1, l. 9).

    Args:
        weights: (4, P), see `layout`; all rows but the likelihood are written up to `count`.
        count: M.

    Returns:
        The effective sample size.
    """
    log_weights, path_log_weights, own = weights[L.LOG_WEIGHTS], weights[L.PATH_LOG_WEIGHTS], weights[L.WEIGHTS]
    log_likelihood, largest = weights[L.LOG_LIKELIHOOD], -np.inf
    for i in range(count):
        path_log_weights[i] += log_likelihood[i]  # Eq. 12
        log_weights[i] += log_likelihood[i]  # Eqs. 3, 11
        largest = max(largest, log_weights[i])
    total = 0.0
    for i in range(count):
        own[i] = math.exp(log_weights[i] - largest)
        total += own[i]
    log_total = math.log(total)
    squares = 0.0
    for i in range(count):
        log_weights[i] = log_weights[i] - largest - log_total  # one after the other: the largest may be huge
        own[i] /= total
        squares += own[i] * own[i]
    return 1.0 / squares
