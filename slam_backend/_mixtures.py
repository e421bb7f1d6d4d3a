"""What all particles together say: mixtures of their Gaussians, of a robot's pose and of landmarks."""

from typing import Any

import numpy as np

from slam_backend import _kernels
from slam_backend._packed import UNPACK
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


def map_mixture(
    maps: ParticleMaps, best: int, log_weights: FloatArray, min_count: int
) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return the landmarks of one particle with mean and covariance over all that hold them, by ascending id.

    The covariance is sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T), with the weights of those particles scaled to sum
    to 1 (Sec. 3.2, see `docs/errata.md`): Sigma_m alone is conditioned on the path of particle m.

    Args:
        maps: Of all particles; landmarks are brought up to date.
        best: The particle that says which landmarks there are.
        log_weights: (M,) normalised.
        min_count: Landmarks that it measured fewer times, 1 at least, are left out.

    Returns:
        Means (n, 3) [m] and covariances (n, 3, 3) [m^2], map frame, descriptors (n, d) float32, counts (n,) of
        particle `best`, and ids (n,): all fresh.
    """
    slots = maps.used_slots()
    counts = maps.of_particle(best, slots)[1]
    slots, counts = slots[counts >= min_count], counts[counts >= min_count]
    dense, times = maps.dense(slots)
    weights = np.exp(log_weights) * (times > 0)
    weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
    mixed = np.einsum("ncm,nm->nc", dense, weights)
    means = mixed[:, :3]
    offsets = dense[:, :3] - means[:, :, None]
    covariances = mixed[:, 3:][:, UNPACK] + np.einsum("nim,njm,nm->nij", offsets, offsets, weights)
    return means, covariances, maps.descriptors[slots], counts.astype(np.int64), maps.ids[slots]
