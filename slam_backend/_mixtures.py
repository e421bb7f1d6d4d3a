"""What all particles together say: mixtures of their Gaussians, of a robot's pose and of landmarks."""

from typing import Any

import numpy as np

from slam_backend import _kernels
from slam_backend._best_map import slots_held
from slam_backend._jit import jit
from slam_backend._kernels import LANES
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.reports import PoseEstimate


def pose_mixture(means: FloatArray, covariances: FloatArray, weights: FloatArray) -> PoseEstimate:
    """Return mean and covariance of a weighted mixture of Gaussian poses; headings are averaged on the circle.

    Args:
        means: (3, P) float64 [m, m, rad], P >= M.
        covariances: (6, P) float64: xx, xy, xt, yy, yt, tt of each.
        weights: (M,) float64, summing to 1; lanes beyond M mean nothing.

    Returns:
        Both in the frame of `means`.
    """
    mean, covariance = np.empty(3), np.empty((3, 3))
    _kernels.mixture(means, covariances, weights, mean, covariance)
    return PoseEstimate(mean, covariance)


@jit
def _mix(
    slots: Any, row_of: Any, map_of: Any, maps: Any, values: Any, counts: Any, best: int, weights: FloatArray,
    lanes: int,
) -> tuple[FloatArray, FloatArray, IntArray]:  # fmt: skip
    """Return means (n, 3), covariances (n, 3, 3) and counts (n,) of landmarks, see `map_mixture`.

    The number of lanes is an argument, for a compiled kernel would not notice that it changed in another file.
    """
    padded = counts.shape[1]
    means, covariances = np.empty((len(slots), 3)), np.empty((len(slots), 3, 3))
    times = np.empty(len(slots), np.int64)
    where, shares, mixed, scatter = np.empty(len(weights), np.int64), np.empty(len(weights)), np.empty(9), np.empty(6)
    for i in range(len(slots)):
        row, ancestors = row_of[slots[i]], map_of[slots[i]]
        times[i] = counts[row, maps[ancestors, best] if ancestors > 0 else best]
        holders, whole = 0, 0.0
        for m in range(len(weights)):
            place = maps[ancestors, m] if ancestors > 0 else m
            if counts[row, place] > 0:
                where[holders] = row * 9 * padded + place // lanes * 9 * lanes + place % lanes
                shares[holders] = weights[m]
                whole += weights[m]
                holders += 1
        mixed[:], scatter[:] = 0.0, 0.0
        for h in range(holders):
            shares[h] /= max(whole, 1e-300)
            for c in range(9):
                mixed[c] += shares[h] * values[where[h] + c * lanes]
        means[i] = mixed[:3]
        for h in range(holders):
            x, y = values[where[h]] - mixed[0], values[where[h] + lanes] - mixed[1]
            z, share = values[where[h] + 2 * lanes] - mixed[2], shares[h]
            scatter[0] += share * x * x
            scatter[1] += share * x * y
            scatter[2] += share * x * z
            scatter[3] += share * y * y
            scatter[4] += share * y * z
            scatter[5] += share * z * z
        entry = 0
        for j in range(3):
            for k in range(j, 3):
                covariances[i, j, k] = covariances[i, k, j] = mixed[3 + entry] + scatter[entry]
                entry += 1
    return means, covariances, times


def map_mixture(
    maps: ParticleMaps, best: int, log_weights: FloatArray, min_count: int
) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return the landmarks of one particle with mean and covariance over all that hold them, by ascending id.

    The covariance is sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T), with the weights of those particles scaled to sum
    to 1 (Sec. 3.2, see `docs/errata.md`): Sigma_m alone is conditioned on the path of particle m.

    Args:
        maps: Of all particles; only looked at.
        best: The particle that says which landmarks there are.
        log_weights: (M,) normalised.
        min_count: Landmarks that it measured fewer times, 1 at least, are left out.

    Returns:
        Means (n, 3) [m] and covariances (n, 3, 3) [m^2], map frame, descriptors (n, d) float32, counts (n,) of
        particle `best`, and ids (n,): all fresh.
    """
    slots = slots_held(maps, best, min_count)
    means, covariances, times = _mix(
        slots, maps.row_of, maps.map_of, maps.maps, maps.values, maps.counts, best, np.exp(log_weights), LANES
    )
    return means, covariances, maps.descriptors[slots], times, maps.ids[slots]
