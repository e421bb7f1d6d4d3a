"""How probable many vectors at a time are under one Gaussian, and weights from logarithms of such densities."""

import math

from slam_backend._jit import fused, in_place
from slam_backend.errors import FloatArray


@fused
def weigh_deviations(covariance: FloatArray, off: FloatArray, log_densities: FloatArray) -> bool:
    """Write the logarithms of a Gaussian's density, up to a constant: 0 at its mean.

    Of L L^T the covariance, the squares of L^-1 d add up to the squared distance of a deviation d.

    Args:
        covariance: (n, n), positive definite.
        off: (n, M) deviations from the mean; changed: L^-1 times these.
        log_densities: (M,), result.

    Returns:
        Whether the covariance is positive definite; if not, what is written means nothing.
    """
    lower, m = covariance.copy(), off.shape[1]
    log_densities[:] = 0.0
    for i in range(len(lower)):
        row = lower[i]
        for j in range(i):
            for k in range(j):
                row[j] -= row[k] * lower[j, k]
            row[j] /= lower[j, j]
            row[i] -= row[j] * row[j]
            for p in range(m):
                off[i, p] -= row[j] * off[j, p]
        if not row[i] > 0.0:
            return False
        row[i] = math.sqrt(row[i])
        scale = 1.0 / row[i]
        for p in range(m):
            off[i, p] *= scale
            log_densities[p] -= 0.5 * off[i, p] * off[i, p]
    return True


@in_place
def normalise(log_weights: FloatArray, weights: FloatArray) -> float:
    """Write weights (M,) that sum to 1 from their logarithms (M,); return their effective sample size, 1 / sum w^2.

    Where one is NaN, or infinitely large, all are NaN, as is the size.
    """
    top, total, squares = -math.inf, 0.0, 0.0
    for log_weight in log_weights:
        top = max(top, log_weight)
    for i in range(len(weights)):
        weights[i] = math.exp(log_weights[i] - top)
        total += weights[i]
    for i in range(len(weights)):
        weights[i] /= total
        squares += weights[i] * weights[i]
    return 1.0 / squares
