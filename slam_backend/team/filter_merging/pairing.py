"""Pairing of the particles of two filters, with the motion and the weight of each pair.

Pairs are weighted by their evidence, the integral of exp(-chi^2 / 2) over T by Laplace's method; see `merging`, also
for tau^2 and phi.
"""

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.registration import gauss_newton_step, information, residuals
from slam_backend.resampling import systematic
from slam_backend.team.filter_merging.landmarks import Landmarks

MIN_PAIRS = 3  # landmarks; fewer in a particle do not fix a motion better than the consensus does
CANDIDATES = 4  # pairs of particles weighted for each one kept
ITERATIONS = 3  # Gauss-Newton iterations for each pair
ROUNDS = 8  # iterations for the variance between two maps
# [m^2] Two robots may place the same corner this far apart; more is a contradiction.
MAX_BETWEEN_MAP_VARIANCE = 0.05**2
BLOCK = 2**17  # matches of pairs of particles that are looked at together
LOG_2PI = math.log(2.0 * math.pi)
NO_MATCH = np.zeros(18)  # of a table, with unit covariances
NO_MATCH[[6, 9, 11]] = 1.0


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
    extra = _between_map_variance(*reduced_chi2(common, some_a, some_b, alignment.transform, ROUNDS))
    motions, informations, chi2, log_dets, shared = fit(
        common, from_a, from_b, alignment.transform, extra, ITERATIONS
    )  # fmt: skip
    scale = _birge_ratio(chi2, shared) if extra == MAX_BETWEEN_MAP_VARIANCE else 1.0
    evidence, covariances = _weigh(motions, informations, chi2, log_dets, shared, scale, alignment, known)
    weights = np.exp(evidence - evidence.max())
    chosen = systematic(weights / weights.sum(), rng, count)
    draws = rng.standard_normal((count, 3))
    motion = motions[chosen] + np.einsum("mij,mj->mi", _factors(covariances[chosen]), draws)
    return Pairing(from_a[chosen], from_b[chosen], motion, evidence[chosen], extra, scale)


Common = tuple[FloatArray, BoolArray, FloatArray, BoolArray]  # values and mask of a's and b's landmarks, by particle


def _tables(common: Common, from_a: IntArray, from_b: IntArray) -> Iterator[tuple[FloatArray, BoolArray]]:
    """Yield tables of matches (c, k, 18) of some pairs of particles, and which landmarks both hold (c, k)."""
    values_a, held_a, values_b, held_b = common
    block = max(BLOCK // max(held_a.shape[1], 1), 1)
    for first in range(0, len(from_a), block):
        a, b = from_a[first : first + block], from_b[first : first + block]
        held = held_a[a] & held_b[b]
        table = np.concatenate([values_a[a, :, :3], values_b[b, :, :3], values_a[a, :, 3:], values_b[b, :, 3:]], axis=2)
        table[~held] = NO_MATCH
        yield table, held


def fit(
    common: Common, from_a: IntArray, from_b: IntArray, start: FloatArray, extra: float, iterations: int
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Fit the motions of pairs of particles to the landmarks that both of each hold.

    Args:
        common: (M_a, k, 9) shared landmarks of one filter in the order of `Landmarks`, and (M_a, k) whether each
            particle has them; the same of the other filter.
        from_a, from_b: (c,) particles of each pair.
        start: (3,) motion from which all begin.
        extra: tau^2, added to the variances of all differences [m^2].
        iterations: Number of Gauss-Newton steps.

    Returns:
        Motions (c, 3), information matrices (c, 3, 3), chi^2 (c,), sums of log|2 pi S| (c,), and how many landmarks
        both particles of a pair hold (c,).
    """
    parts = []
    for table, held in _tables(common, from_a, from_b):
        shared, motions = held.sum(axis=1), np.tile(start, (len(table), 1))
        enough = (shared >= MIN_PAIRS)[:, None]
        for _ in range(iterations):
            motions = np.where(enough, gauss_newton_step(table, held, motions, extra), motions)
        at = residuals(table, motions, extra)
        chi2, log_dets = (np.where(held, each, 0.0).sum(axis=1) for each in (at.distances, np.log(at.determinants)))
        informations = information(table, held, motions, extra)[0]
        parts.append((motions, informations, chi2, log_dets + 3.0 * LOG_2PI * shared, shared))
    motions, informations, chi2, log_dets, shared = map(np.concatenate, zip(*parts, strict=True))
    return motions, informations, chi2, log_dets, shared


def reduced_chi2(
    common: Common, from_a: IntArray, from_b: IntArray, start: FloatArray, rounds: int
) -> tuple[FloatArray, IntArray]:
    """Seek tau^2 (c,) [m^2] of each pair of particles for which chi^2 is its degrees of freedom, at least 0.

    By Newton's method on the latter over the former, which is concave in tau^2: it rises to the root and not beyond.

    The arguments are those of `fit`.

    Returns:
        tau^2, and how many landmarks both particles of a pair hold (c,).
    """
    parts = []
    for table, held in _tables(common, from_a, from_b):
        shared, motions, extra = held.sum(axis=1), np.tile(start, (len(table), 1)), np.zeros(len(table))
        enough, freedom = (shared >= MIN_PAIRS)[:, None], np.maximum(3.0 * shared - 3.0, 1.0)
        for _ in range(rounds):
            motions = np.where(enough, gauss_newton_step(table, held, motions, extra[:, None]), motions)
            at = residuals(table, motions, extra[:, None])
            chi2 = np.where(held, at.distances, 0.0).sum(axis=1)
            slope = np.where(held, sum(pull * pull for pull in at.pulls), 0.0).sum(axis=1)  # how fast it falls
            extra = np.maximum(extra + chi2 * (chi2 - freedom) / np.maximum(freedom * slope, 1e-300), 0.0)
        parts.append((extra, shared))
    extra, shared = map(np.concatenate, zip(*parts, strict=True))
    return extra, shared


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
