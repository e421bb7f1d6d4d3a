"""Two filters and an alignment become one joint filter, particle by particle, so that the path uncertainty survives.

Each new particle pairs one of either group. Its own motion between the two maps is estimated from the landmarks that
the consensus of the maps says are shared, with the means and covariances that this pair of particles holds:
Gauss-Newton on

    chi^2(T) = sum over pairs of r^T S^-1 r,    r = mu_a - (R mu_b + t),    S = Sigma_a + R Sigma_b R^T.

T is then drawn from N(T^, Lambda^-1): the pair's uncertainty about T becomes a spread of particles, and within a
particle T is known. Pairs are weighed by their evidence, the integral of exp(-chi^2 / 2) over T by Laplace's formula.
Landmarks in common are fused at the drawn T (Eqs. 13-15), the others of b are moved (Eq. 16).

Maps of particle filters are over-confident, and two of them then contradict each other. First the variance tau^2 is
found, up to (5 cm)^2, that has to be added to all S for chi^2 to be its degrees of freedom (Mandel and Paule 1970,
"Interlaboratory evaluation of a material with unequal numbers of replicates", Analytical Chemistry 42); the landmarks
of either map bear half of it. What then still contradicts is measured by phi = median over pairs of chi^2 / degrees of
freedom, and where that exceeds 1 both maps' covariances are scaled by it (the Birge ratio). So the joint filter starts
with uncertainties that explain what was seen. To scale from the start would make the worst known landmarks worse by as
much as the best known ones contradict each other: they would take anything for themselves.
"""

import math

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.state import FilterState
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
    stack_descriptors,
    write_joint,
)
from slam_backend.team.filter_merging.pairing import Pairing, pair_particles


def inverse_alignment(alignment: Alignment) -> Alignment:
    """Return the alignment seen from the other map: inverse motion, its covariance to first order, pairs swapped."""
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
        alignment: Motion a_from_b of the maps, successful; where Gauss-Newton starts, and what is used where two
            particles share fewer than three landmarks.
        pairs: (k, 2) int64 rows (landmark id in a, landmark id in b) in common, one-to-one. Where the caller has named
            landmarks on both sides, names decide: pairs of different names are left out, and landmarks of one name are
            one in the joint map, whether or not they are listed here. These say nothing of the motion.
        rng: For the pairing and the draws of T.
        num_particles: Of the joint filter; None: as many as the larger of the two.
        known: The motion is drawn from the alignment, whatever the landmarks in common say of it.
        pairing: What `paired` returned for these arguments; None: it is drawn.

    Returns:
        The joint filter, a's robots first; and (n, 2) int64 rows (id in b, id in the joint map) of all of b's
        landmarks.
    """
    if pairing is None:
        pairing = pair_filters(a, b, alignment, pairs, rng, num_particles, known)
    from_a, from_b, motion, evidence, extra, scale = pairing
    fitting, told = merge_by_identity(a.state.maps, b.state.maps, pairs)
    pairs = np.concatenate([fitting, told])
    joint = FilterState.joined(a.state, from_a, b.state, from_b, motion, evidence, rng)

    of_a, of_b = Landmarks.of(a.state.maps, from_a), Landmarks.of(b.state.maps, from_b)
    ids_a, ids_b = of_a.ids, of_b.ids
    shared_a, shared_b = np.searchsorted(ids_a, pairs[:, 0]), np.searchsorted(ids_b, pairs[:, 1])
    model = a.options.existence
    odds_a, odds_b = of_a.odds(model), of_b.odds(model)
    descriptors, identities, looks_b = of_a.descriptors, of_a.identities, of_b.descriptors
    if len(shared_a):
        seen_a, seen_b = of_a.counts[shared_a].max(axis=1), of_b.counts[shared_b].max(axis=1)
        descriptors[shared_a] = fuse_descriptors(
            descriptors[shared_a], np.maximum(seen_a, 1), looks_b[shared_b], np.maximum(seen_b, 1)
        )
        names = identities[shared_a]
        identities[shared_a] = np.where(names < 0, of_b.identities[shared_b], names)
        if model is not None:
            fuse_odds(model, odds_a, of_a.counts, shared_a, odds_b, of_b.counts, shared_b)
    own = np.setdiff1d(np.arange(len(ids_b)), shared_b)  # b's landmarks that a does not have
    rows_a, rows_b = np.arange(len(ids_a) + len(own)), np.full(len(ids_a) + len(own), -1)
    rows_a[len(ids_a) :], rows_b[len(ids_a) :], rows_b[shared_a] = -1, own, shared_b
    counts, names = joint_counts(of_a, of_b, rows_a, rows_b), np.concatenate([identities, of_b.identities[own]])
    drop_repeated_identities(counts, names)
    next_id = a.state.maps.next_id
    new_ids = next_id + np.arange(len(own))
    held = np.flatnonzero((counts > 0).any(axis=1))
    joint.maps.load_metadata(
        counts[held],
        stack_descriptors(descriptors, looks_b[own])[held],
        np.concatenate([ids_a, new_ids])[held],
        names[held],
        next_id + len(own),
        np.concatenate([odds_a, odds_b[own]])[held],
    )
    # Either map bears half of what they do not explain.
    scales = np.full(len(counts), scale)
    if len(told):
        sides = Landmarks.of(a.state.maps, from_a, told[:, 0]), Landmarks.of(b.state.maps, from_b, told[:, 1])
        scales[np.searchsorted(ids_a, told[:, 0])] = np.maximum(scale, birge_ratios(*sides, motion, 0.5 * extra))
    write_joint(of_a, of_b, rows_a[held], rows_b[held], motion, 0.5 * extra, scales[held], joint.maps.blocks)
    renamed = np.concatenate([pairs[:, ::-1], np.column_stack([ids_b[own], new_ids])]).astype(np.int64)
    joint.finish_join(a.state, b.state, renamed)
    return FastSlam.from_filter_state(joint), renamed


def pair_filters(
    a: FastSlam, b: FastSlam, alignment: Alignment, pairs: IntArray, rng: np.random.Generator,
    num_particles: int | None = None, known: bool = False,
) -> Pairing:  # fmt: skip
    """Draw which particles become joint ones and by which motions: all of a merge that is left to chance in its maps.

    Args:
        a, b, alignment, pairs, rng, num_particles, known: As of `merge_filters`, which draws it first of all.
    """
    count = max(a.num_particles, b.num_particles) if num_particles is None else num_particles
    pairs, _ = merge_by_identity(a.state.maps, b.state.maps, pairs)
    common_a, common_b = Landmarks.of(a.state.maps, ids=pairs[:, 0]), Landmarks.of(b.state.maps, ids=pairs[:, 1])
    return pair_particles(a.weights, common_a, b.weights, common_b, alignment, count, rng, known)


def transform_covariance(motion: FloatArray, alignment: Alignment) -> FloatArray:
    """Return how the motions between two maps differ among the particles that `merge_filters` makes.

    Where paths are uncertain this is more than the alignment of the two maps claims: landmarks of one map err together.

    Args:
        motion: (M, 3) of each particle [m, m, rad].
        alignment: About which headings are told apart.

    Returns:
        (3, 3) covariance of (tx, ty, theta) [m, m, rad].
    """
    turns = wrap_angle(motion[:, 2] - alignment.theta)
    return np.asarray(np.cov(np.column_stack([motion[:, :2], turns]).T, bias=True))
