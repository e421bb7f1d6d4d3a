"""Pairing of the particles of two filters, with the motion and the weight of each pair.

Pairs are weighted by their evidence, the integral of exp(-chi^2 / 2) over T by Laplace's method; see `merging`, also
for tau^2 and phi.
"""

import math
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.maps.alignment import Alignment
from slam_backend.resampling import systematic
from slam_backend.team.filter_merging._kernels.pairing import MIN_PAIRS, fit, reduced_chi2
from slam_backend.team.filter_merging.landmarks import Landmarks

CANDIDATES = 4  # pairs of particles weighted for each one kept
ITERATIONS = 3  # Gauss-Newton iterations for each pair
ROUNDS = 8  # iterations for the variance between two maps
# [m^2] Two robots may place the same corner this far apart; more is a contradiction.
MAX_BETWEEN_MAP_VARIANCE = 0.05**2


class Pairing(NamedTuple):
    """Particles of a and b that become joint ones (M,), their motions (M, 3), and their log-evidences (M,).

    Before it moves, each shared landmark gets half of `between_map_variance` [m^2], then all are scaled by `scale`.
    """

    from_a: IntArray
    from_b: IntArray
    motion: FloatArray
    evidence: FloatArray
    between_map_variance: float
    scale: float


def pair_particles(
    weights_a: FloatArray, common_a: Landmarks, weights_b: FloatArray, common_b: Landmarks, alignment: Alignment,
    count: int, rng: np.random.Generator, known: bool = False,
) -> Pairing:  # fmt: skip
    """Draw pairs of particles and their motions.

    Args:
        weights_a: (M_a,) weights of one filter's particles, summing to 1.
        common_a: Common landmarks in this filter.
        weights_b, common_b: Weights and common landmarks of the other filter, in the same order.
        alignment: Initial value of Gauss-Newton, and motion of pairs that share too few landmarks.
        count: M, number of pairs.
        rng: Generator for the pairing and the draws of T.
        known: Whether the motion is drawn from the alignment alone, ignoring the common landmarks.
    """
    from_a = systematic(weights_a, rng, CANDIDATES * count)
    from_b = rng.permutation(systematic(weights_b, rng, CANDIDATES * count))
    common = (
        common_a.values_by_particle, common_a.held_by_particle, common_b.values_by_particle, common_b.held_by_particle
    )  # fmt: skip
    some_a, some_b = from_a[::CANDIDATES].copy(), from_b[::CANDIDATES].copy()
    extra = _between_map_variance(*reduced_chi2(*common, some_a, some_b, alignment.transform, ROUNDS))
    motions, informations, chi2, log_dets, shared = fit(
        *common, from_a, from_b, alignment.transform, extra, ITERATIONS
    )  # fmt: skip
    scale = _birge_ratio(chi2, shared) if extra == MAX_BETWEEN_MAP_VARIANCE else 1.0
    evidence, covariances = _weigh(motions, informations, chi2, log_dets, shared, scale, alignment, known)
    weights = np.exp(evidence - evidence.max())
    chosen = systematic(weights / weights.sum(), rng, count)
    draws = rng.standard_normal((count, 3))
    motion = motions[chosen] + np.einsum("mij,mj->mi", _factors(covariances[chosen]), draws)
    return Pairing(from_a[chosen], from_b[chosen], motion, evidence[chosen], extra, scale)


def _between_map_variance(extra: FloatArray, shared: IntArray) -> float:
    """Return tau^2 [m^2], the median over pairs of particles (c,), at most `MAX_BETWEEN_MAP_VARIANCE`."""
    enough = shared >= MIN_PAIRS
    return min(float(np.median(extra[enough])), MAX_BETWEEN_MAP_VARIANCE) if enough.any() else 0.0


def _birge_ratio(chi2: FloatArray, shared: IntArray) -> float:
    """Return phi >= 1, the ratio of the differences between maps to the widened covariances."""
    enough = shared >= MIN_PAIRS
    if not enough.any():
        return 1.0
    return max(1.0, float(np.median(chi2[enough] / (3.0 * shared[enough] - 3.0))))


def _weigh(
    motions: FloatArray,
    informations: FloatArray,
    chi2: FloatArray,
    log_dets: FloatArray,
    shared: IntArray,
    scale: float,
    alignment: Alignment,
    known: bool,
) -> tuple[FloatArray, FloatArray]:
    """Return log-evidences (c,) and the covariance of each pair's motion (c, 3, 3).

    Pairs of particles that share too few landmarks get the motion of the alignment, and the smallest evidence of the
    others. If the motion is `known`, all do.
    """
    poor = (shared < MIN_PAIRS) | known
    informations = np.where(poor[:, None, None], np.eye(3), informations)
    covariances = scale * np.linalg.inv(informations)
    motions[poor] = alignment.transform
    covariances[poor] = alignment.covariance
    log_evidence = -0.5 * (chi2 / scale + log_dets + 3.0 * shared * math.log(scale))
    log_evidence += 0.5 * np.linalg.slogdet(np.where(poor[:, None, None], np.eye(3), covariances))[1]
    if poor.any():
        log_evidence[poor] = log_evidence[~poor].min() if (~poor).any() else 0.0
    return log_evidence, np.asarray(covariances)


def _factors(covariances: FloatArray) -> FloatArray:
    """Return factors C (c, 3, 3) with C C^T = covariance."""
    values, vectors = np.linalg.eigh(0.5 * (covariances + covariances.transpose(0, 2, 1)))
    return np.asarray(vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :])
