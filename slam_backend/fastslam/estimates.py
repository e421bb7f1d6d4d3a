"""Estimates over all particles: Gaussian mixtures of the pose of a robot and of landmarks."""

from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels.particles.map_mixture import mix
from slam_backend.fastslam.particle_maps import ParticleMaps, present_slots
from slam_backend.fastslam.reports import PoseEstimates


def pose_mixtures(means: FloatArray, covariances: FloatArray, weights: FloatArray) -> PoseEstimates:
    """Return means and covariances of weighted mixtures of Gaussian poses; headings are averaged on the circle.

    Args:
        means: (K, 3, P) float64 [m, m, rad], P >= M whole blocks of lanes.
        covariances: (K, 6, P) float64: xx, xy, xt, yy, yt, tt of each.
        weights: (M,) float64, summing to 1; lanes beyond M are unused.

    Returns:
        Means and covariances in the frame of `means`. Fresh arrays.
    """
    mixed = PoseEstimates(np.empty((len(means), 3)), np.empty((len(means), 3, 3)))
    for robot in range(len(means)):
        _kernels.mixture(means[robot], covariances[robot], weights, mixed.means[robot], mixed.covariances[robot])
    return mixed


def map_mixture(
    maps: ParticleMaps, best: int, log_weights: FloatArray, scatter: FloatArray, min_count: int
) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return the landmarks of one particle with mean and covariance over all particles that hold them, by ascending id.

    The covariance is sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T), with the weights of those particles scaled to sum
    to 1 (Sec. 3.2, see `docs/reference/errata.md`): Sigma_m alone is conditioned on the path of particle m. The
    uncertainty of the map's frame (gauge) is added.

    Args:
        maps: Maps of all particles; not changed.
        best: Index of the particle whose landmarks are returned.
        log_weights: (M,) normalised.
        scatter: (3, 3) [m, m, rad] covariance of the map's frame about its origin; 0 if the particles represent it.
        min_count: Least number of measurements of a landmark in the result.

    Returns:
        Means (n, 3) [m] and covariances (n, 3, 3) [m^2], map frame, descriptors (n, d) float32, counts (n,) of
        particle `best`, and ids (n,): all fresh.
    """
    slots, weights = present_slots(maps, best, min_count), np.exp(log_weights)
    means, covariances, times, names = mix(slots, maps.arrays, best, weights, scatter)
    return means, covariances, maps.descriptors[slots], times, names
