"""Merging of two aligned filters into one joint filter, particle by particle, which keeps the path uncertainty.

Each new particle pairs one of each group. Its own motion between the two maps is estimated from the landmarks shared by
the consensus set of the alignment, with the means and covariances of this pair of particles: Gauss-Newton on

    chi^2(T) = sum over pairs of r^T S^-1 r,    r = mu_a - (R mu_b + t),    S = Sigma_a + R Sigma_b R^T.

T is then drawn from N(T^, Lambda^-1): the pair's uncertainty about T becomes a scatter of particles, and within a
particle T is known. Pairs are weighted by their evidence, the integral of exp(-chi^2 / 2) over T by Laplace's method.
Common landmarks are fused at the drawn T (Eqs. 13-15), the others of b are moved (Eq. 16).

Maps of particle filters are over-confident, so that two of them contradict each other. The first remedy is a variance
tau^2, at most (5 cm)^2, added to all S such that chi^2 equals its degrees of freedom (Mandel and Paule 1970,
"Interlaboratory evaluation of a material with unequal numbers of replicates", Analytical Chemistry 42); the landmarks
of each map take half of it. The remaining contradiction is measured by phi = median over pairs of chi^2 / degrees of
freedom; if it exceeds 1, both maps' covariances are scaled by it (the Birge ratio). Thus the initial uncertainties of
the joint filter explain the differences. Scaling alone would inflate the least certain landmarks by as much as the most
certain ones contradict each other, and their gates would accept any measurement.
"""

import math

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.joining import joined_filter
from slam_backend.geometry import inverse, wrap_angle
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.fusion import fuse_descriptors
from slam_backend.team.filter_merging.landmarks import (
    Landmarks,
    birge_ratios,
    drop_repeated_identities,
    fuse_odds,
    joint_counts,
    merge_by_identity,
    renaming,
    stack_descriptors,
    write_joint,
)
from slam_backend.team.filter_merging.pairing import Pairing, pair_particles


def inverse_alignment(alignment: Alignment) -> Alignment:
    """Return the alignment from the other map: inverse motion, its covariance to first order, pairs swapped."""
    x, y, theta = inverse(alignment.transform)
    c, s = math.cos(alignment.theta), math.sin(alignment.theta)
    jacobian = np.array([[-c, -s, y], [s, -c, -x], [0.0, 0.0, -1.0]])
    covariance = jacobian @ alignment.covariance @ jacobian.T
    return Alignment(
        alignment.success, alignment.reason, x, y, theta, covariance, alignment.inliers[:, ::-1], alignment.ratio
    )


def merge_filters(
    a: FastSlam,
    b: FastSlam,
    alignment: Alignment,
    pairs: IntArray,
    rng: np.random.Generator,
    num_particles: int | None = None,
    known: bool = False,
    pairing: Pairing | None = None,
) -> tuple[FastSlam, IntArray]:
    """Merge two filters into a joint one in a's map frame (Secs. 3.2 and 4).

    Args:
        a: Filter whose map frame and landmark ids stay.
        b: The other filter.
        alignment: Motion a_from_b of the maps, successful; initial value of Gauss-Newton, and motion of pairs of
            particles that share fewer than three landmarks.
        pairs: (k, 2) int64 rows (landmark id in a, landmark id in b) of common landmarks, one-to-one. Caller's names
            take precedence where both sides have them: pairs of different names are dropped, and landmarks of one name
            are joined even if not listed, but then do not affect the motion.
        rng: Generator for the pairing and the draws of T.
        num_particles: Number of particles of the joint filter; None: the larger of the two.
        known: Whether the motion is drawn from the alignment alone, ignoring the common landmarks.
        pairing: Result of `pair_filters` for these filters and all or some of the pairs; None: a new draw.

    Returns:
        The joint filter, a's robots first; and (n, 2) int64 rows (id in b, id in the joint map) of all of b's
        landmarks.
    """
    if pairing is None:
        pairing = pair_filters(a, b, alignment, pairs, rng, num_particles, known)
    from_a, from_b, motion, evidence, extra, scale = pairing
    fitting, named = merge_by_identity(a.maps, b.maps, pairs)
    pairs = np.concatenate([fitting, named])
    joint = joined_filter(a, from_a, b, from_b, motion, evidence, rng)

    of_a, of_b = Landmarks.of(a.maps, from_a), Landmarks.of(b.maps, from_b)
    ids_a, ids_b = of_a.ids, of_b.ids
    shared_a, shared_b = np.searchsorted(ids_a, pairs[:, 0]), np.searchsorted(ids_b, pairs[:, 1])
    descriptors, identities, descriptors_b = of_a.descriptors, of_a.identities, of_b.descriptors
    if len(shared_a):
        seen_a, seen_b = of_a.counts[shared_a].max(axis=1), of_b.counts[shared_b].max(axis=1)
        descriptors[shared_a] = fuse_descriptors(
            descriptors[shared_a], np.maximum(seen_a, 1), descriptors_b[shared_b], np.maximum(seen_b, 1)
        )
        identities_a = identities[shared_a]
        identities[shared_a] = np.where(identities_a < 0, of_b.identities[shared_b], identities_a)
    exclusive = np.setdiff1d(np.arange(len(ids_b)), shared_b)  # b's landmarks that a lacks
    n_a, n = len(ids_a), len(ids_a) + len(exclusive)
    rows_a, rows_b = np.arange(n), np.full(n, -1)
    rows_a[n_a:], rows_b[n_a:], rows_b[shared_a] = -1, exclusive, shared_b
    counts = joint_counts(of_a, of_b, rows_a, rows_b)
    identities = np.concatenate([identities, of_b.identities[exclusive]])
    drop_repeated_identities(counts, identities)
    renamed = renaming(a.maps, b.maps, pairs)
    new_ids = renamed[len(pairs) :, 1]
    held = np.flatnonzero((counts > 0).any(axis=1))
    odds, model = None, a.options.existence
    if model is not None:
        odds_a, odds_b = of_a.odds(model), of_b.odds(model)
        fuse_odds(model, odds_a, of_a.counts, shared_a, odds_b, of_b.counts, shared_b)
        odds = np.concatenate([odds_a, odds_b[exclusive]])[held]
    descriptors = stack_descriptors(descriptors, descriptors_b[exclusive])[held]
    columns = descriptors, np.concatenate([ids_a, new_ids])[held], identities[held]
    joint.maps.load_metadata(counts[held], *columns, a.maps.next_id + len(exclusive), odds)
    # Each map takes half of the extra variance.
    scales = np.full(len(counts), scale)
    if len(named):
        sides = Landmarks.of(a.maps, from_a, named[:, 0]), Landmarks.of(b.maps, from_b, named[:, 1])
        scales[np.searchsorted(ids_a, named[:, 0])] = np.maximum(scale, birge_ratios(*sides, motion, 0.5 * extra))
    write_joint(of_a, of_b, rows_a[held], rows_b[held], motion, 0.5 * extra, scales[held], joint.maps.blocks)
    joint.finish_join(a, b, renamed)
    return joint, renamed


def pair_filters(
    a: FastSlam, b: FastSlam, alignment: Alignment, pairs: IntArray, rng: np.random.Generator,
    num_particles: int | None = None, known: bool = False,
) -> Pairing:  # fmt: skip
    """Draw pairs of particles and their motions: the first random part of a merge.

    Args:
        a, b, alignment, pairs, rng, num_particles, known: Arguments of `merge_filters`, which makes this draw first.
    """
    count = max(a.num_particles, b.num_particles) if num_particles is None else num_particles
    pairs, _ = merge_by_identity(a.maps, b.maps, pairs)
    common_a, common_b = Landmarks.of(a.maps, ids=pairs[:, 0]), Landmarks.of(b.maps, ids=pairs[:, 1])
    return pair_particles(a.weights, common_a, b.weights, common_b, alignment, count, rng, known)


def transform_covariance(motion: FloatArray, alignment: Alignment) -> FloatArray:
    """Return the covariance of the motion between two maps over the particles that `merge_filters` makes.

    With uncertain paths it exceeds that of the alignment, as the errors of landmarks in one map are correlated.

    Args:
        motion: (M, 3) [m, m, rad]. Motion of each particle.
        alignment: Reference of the headings' differences.

    Returns:
        (3, 3) covariance of (tx, ty, theta) [m, m, rad].
    """
    turns = wrap_angle(motion[:, 2] - alignment.theta)
    return np.asarray(np.cov(np.column_stack([motion[:, :2], turns]).T, bias=True))
