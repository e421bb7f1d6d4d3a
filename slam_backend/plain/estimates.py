"""What particles together say: mixtures of their Gaussians, of a pose and of landmarks."""

from collections.abc import Mapping, Sequence

import numpy as np

from slam_backend.errors import FloatArray
from slam_backend.geometry import wrap_angle
from slam_backend.landmark_map import LandmarkMap
from slam_backend.plain.frame import Landmark
from slam_backend.plain.particles import Particle
from slam_backend.plain.pose_belief import PoseBelief
from slam_backend.reports import PoseEstimate


def pose_mixture(beliefs: Sequence[PoseBelief], weights: FloatArray) -> PoseEstimate:
    """Return mean and covariance of a weighted mixture of Gaussian poses; headings are averaged on the circle.

    Args:
        beliefs: M Gaussians, all in one frame.
        weights: (M,) float64, summing to 1.
    """
    means = np.array([belief.mean for belief in beliefs])
    theta = np.arctan2(weights @ np.sin(means[:, 2]), weights @ np.cos(means[:, 2]))
    mean = np.array([weights @ means[:, 0], weights @ means[:, 1], wrap_angle(theta)])
    covariance = np.zeros((3, 3))
    for belief, weight in zip(beliefs, weights, strict=True):
        offset = belief.mean - mean
        offset[2] = wrap_angle(offset[2])
        covariance += weight * (belief.covariance + np.outer(offset, offset))
    return PoseEstimate(mean, covariance)


def landmark_mixture(landmarks: Sequence[Landmark], weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mixture of the particles' estimates of one landmark (Sec. 3.2, see `docs/errata.md`).

    Args:
        landmarks: Those of the particles that hold it (n).
        weights: (n,) float64, of these particles; they are scaled to sum to 1.

    Returns:
        Mean mu (3,) [m] and covariance (3, 3) [m^2], sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T), map frame.
    """
    shares = weights / weights.sum()
    mean: FloatArray = sum((share * one.mean for share, one in zip(shares, landmarks, strict=True)), np.zeros(3))
    covariance = np.zeros((3, 3))
    for share, one in zip(shares, landmarks, strict=True):
        covariance += share * (one.covariance + np.outer(one.mean - mean, one.mean - mean))
    return mean, covariance


def landmark_map(best: Particle, holders: Sequence[Particle], descriptors: Mapping[int, FloatArray]) -> LandmarkMap:
    """Return the landmarks of one particle, each as the mixture of what some particles hold of it.

    Args:
        best: Which says what landmarks there are, at least one, and how often they were measured.
        holders: Whose estimates are mixed; `best` among them.
        descriptors: (d,) by landmark.

    Returns:
        By ascending id, map frame.
    """
    names = sorted(best.landmarks)
    found = []
    for name in names:
        sharers = [particle for particle in holders if name in particle.landmarks]
        weights = np.exp([particle.log_weight for particle in sharers])
        found.append(landmark_mixture([particle.landmarks[name] for particle in sharers], weights))
    means, covariances = zip(*found, strict=True)
    looks = np.array([descriptors[name] for name in names], np.float32)
    counts = [best.landmarks[name].count for name in names]
    return LandmarkMap(np.array(means), np.array(covariances), looks, np.array(counts), np.array(names))
