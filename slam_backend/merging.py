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
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend._packed import UNPACK, UPPER
from slam_backend.alignment import Alignment
from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.existence import ExistenceModel
from slam_backend.filter import FastSlam
from slam_backend.fusion import fuse_descriptors, fuse_landmarks
from slam_backend.geometry import compose, inverse, rotation, wrap_angle
from slam_backend.resampling import systematic

MIN_PAIRS = 3  # fewer shared landmarks in a particle do not fix a motion better than the consensus does
_UNIT = np.array([1.0, 0.0, 0.0, 1.0, 0.0, 1.0])[:, None]  # a packed identity, where a particle lacks a landmark
CANDIDATES = 4  # pairs of particles weighed for each that is kept
ROUNDS = 8  # of looking for what two maps' covariances do not explain
MOST_EXTRA = 0.05**2  # [m^2] two robots may place what they take for one corner so far apart; more is a contradiction
DIAGONAL = np.array([3, 6, 8])  # where a landmark's nine numbers hold its variances


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
) -> tuple[FastSlam, IntArray]:
    """Merge two filters into a joint one in a's map frame (Secs. 3.2 and 4).

    Args:
        a: Filter whose map frame and landmark ids stay.
        b: The other filter.
        alignment: Motion a_from_b of the maps, successful; where Gauss-Newton starts, and what is used where two
            particles share fewer than three landmarks.
        pairs: (k, 2) int64 rows (landmark id in a, landmark id in b) in common, one-to-one.
        rng: For the pairing and the draws of T.
        num_particles: Of the joint filter; None: as many as the larger of the two.
        known: The motion is drawn from the alignment, whatever the landmarks in common say of it.

    Returns:
        The joint filter, a's robots first; and (n, 2) int64 rows (id in b, id in the joint map) of all of b's
        landmarks.
    """
    count = max(a.num_particles, b.num_particles) if num_particles is None else num_particles
    side_a, side_b = _side(a, pairs[:, 0]), _side(b, pairs[:, 1])
    from_a, from_b, motion, evidence, extra, scale = _pair_up(side_a, side_b, alignment, count, rng, known)
    (_, dense_a, shared_a), (_, dense_b, shared_b) = side_a, side_b

    joint = joined_robots(a, from_a, b, from_b, motion, rng)
    joint._path_log_weights[:] = a._path_log_weights[from_a] + b._path_log_weights[from_b] + evidence

    values_a, counts_a = np.take(dense_a.values, from_a, axis=2), np.take(dense_a.counts, from_a, axis=1)
    values_b, counts_b = np.take(dense_b.values, from_b, axis=2), np.take(dense_b.counts, from_b, axis=1)
    model = a.options.existence
    odds_a, odds_b = _odds_of(dense_a, from_a, model), _odds_of(dense_b, from_b, model)
    for values in (values_a, values_b):  # either map bears half of what they do not explain
        values[:, DIAGONAL] += 0.5 * extra
        values[:, 3:] *= scale
    _move_landmarks(values_b, motion)
    descriptors, identities = dense_a.descriptors.copy(), dense_a.identities.copy()
    if len(shared_a):
        seen_a, seen_b = counts_a[shared_a].max(axis=1), counts_b[shared_b].max(axis=1)
        descriptors[shared_a] = fuse_descriptors(
            descriptors[shared_a], np.maximum(seen_a, 1), dense_b.descriptors[shared_b], np.maximum(seen_b, 1)
        )
        names = identities[shared_a]
        identities[shared_a] = np.where(names < 0, dense_b.identities[shared_b], names)
        if model is not None:
            _fuse_odds(model, odds_a, counts_a, shared_a, odds_b, counts_b, shared_b)
        _fuse_rows((values_a, counts_a), shared_a, (values_b, counts_b), shared_b)
    own = np.setdiff1d(np.arange(len(dense_b.ids)), shared_b)  # b's landmarks that a does not have
    next_id = a._maps.next_id
    new_ids = next_id + np.arange(len(own))
    joint._maps.load(
        np.concatenate([values_a, values_b[own]]),
        np.concatenate([counts_a, counts_b[own]]),
        stack_descriptors(descriptors, dense_b.descriptors[own]),
        np.concatenate([dense_a.ids, new_ids]),
        np.concatenate([identities, dense_b.identities[own]]),
        next_id + len(own),
        np.concatenate([odds_a, odds_b[own]]),
    )
    renamed = np.concatenate([pairs[:, ::-1], np.column_stack([dense_b.ids[own], new_ids])]).astype(np.int64)
    finish(joint, a, b, renamed)
    return joint, renamed


class _Pairing(NamedTuple):
    """Which particles of a and of b become joint ones (M,), their motions (M, 3), and their log-evidences (M,).

    Before it moves, each landmark that is shared takes half of `extra` [m^2], then all are scaled by `scale`.
    """

    from_a: IntArray
    from_b: IntArray
    motion: FloatArray
    evidence: FloatArray
    extra: float
    scale: float


def _side(slam: FastSlam, shared: IntArray) -> "tuple[FloatArray, _Dense, IntArray]":
    """Return a filter's weights (M,), its landmarks, and the rows (k,) of those with these ids."""
    dense = _Dense.of(slam)
    return slam.weights, dense, np.searchsorted(dense.ids, shared)


def _pair_up(
    side_a: "tuple[FloatArray, _Dense, IntArray]", side_b: "tuple[FloatArray, _Dense, IntArray]",
    alignment: Alignment, count: int, rng: np.random.Generator, known: bool = False,
) -> _Pairing:  # fmt: skip
    """Draw pairs of particles and their motions; a side is its weights, its landmarks, and the rows shared."""
    (weights_a, dense_a, shared_a), (weights_b, dense_b, shared_b) = side_a, side_b
    from_a = systematic(weights_a, rng, CANDIDATES * count)
    from_b = rng.permutation(systematic(weights_b, rng, CANDIDATES * count))
    common = (
        dense_a.values[shared_a], dense_a.counts[shared_a] > 0, dense_b.values[shared_b], dense_b.counts[shared_b] > 0
    )  # fmt: skip
    extra = _unexplained(*common, from_a[::CANDIDATES], from_b[::CANDIDATES], alignment.transform)
    aligned = _align_pairs(*common, from_a, from_b, alignment.transform, extra)
    motions, informations, chi2, log_dets, shared = aligned
    scale = _contradiction(chi2, shared) if extra == MOST_EXTRA else 1.0
    evidence, factors = _weigh(motions, informations, chi2, log_dets, shared, scale, alignment, known)
    weights = np.exp(evidence - evidence.max())
    chosen = systematic(weights / weights.sum(), rng, count)
    draws = rng.standard_normal((count, 3))
    motion = motions[chosen] + np.einsum("mij,mj->mi", factors[chosen], draws)
    return _Pairing(from_a[chosen], from_b[chosen], motion, evidence[chosen], extra, scale)


def motion_covariance(
    a: FastSlam, b: FastSlam, alignment: Alignment, pairs: IntArray, rng: np.random.Generator
) -> FloatArray:
    """Return how the motions between the maps differ among the particles that `merge_filters` would make.

    Where paths are uncertain this is more than the alignment of the two maps claims: landmarks of one map err together.

    Args:
        a, b, alignment, pairs: As of `merge_filters`.
        rng: For the pairing and the draws.

    Returns:
        (3, 3) covariance of (tx, ty, theta) [m, m, rad].
    """
    side_a, side_b = _side(a, pairs[:, 0]), _side(b, pairs[:, 1])
    motion = _pair_up(side_a, side_b, alignment, max(a.num_particles, b.num_particles), rng).motion
    turns = wrap_angle(motion[:, 2] - alignment.theta)
    return np.asarray(np.cov(np.column_stack([motion[:, :2], turns]).T, bias=True))


def joined_robots(
    a: FastSlam, from_a: IntArray, b: FastSlam, from_b: IntArray, motion: FloatArray, rng: np.random.Generator
) -> FastSlam:
    """Return a filter of both groups' robots, a's first, without a map.

    Args:
        a, b: The filters of either group.
        from_a, from_b: (M,) which particle of either each joint particle pairs.
        motion: (M, 3) by which each joint particle moves what stems from b into a's map frame.
        rng: From which the joint filter's own stream is seeded.
    """
    joint = FastSlam.from_options(
        a.num_robots + b.num_robots,
        replace(a.options, num_particles=len(motion)),
        np.random.default_rng(rng.integers(2**63, size=4)),
    )
    _join_poses(joint, a, from_a, b, from_b, motion)
    joint._blind[:] = np.concatenate([a._blind, b._blind])
    return joint


def finish(joint: FastSlam, a: FastSlam, b: FastSlam, renamed: IntArray) -> None:
    """Give a joint filter, whose map is loaded, its step count, estimates and logs; `renamed` as of `merge_filters`."""
    joint._steps = max(a._steps, b._steps)
    joint._estimates = [joint._mixture(robot) for robot in range(joint.num_robots)]
    joint._logs = [log.copy() for log in a._logs] + [log.renamed(renamed[:, 0], renamed[:, 1]) for log in b._logs]
    if joint._rejuvenation is not None and a._rejuvenation is not None and b._rejuvenation is not None:
        starts = [slam._starts[:, :, : slam.num_particles] for slam in (a, b, joint)]
        joint._rejuvenation.join(a._rejuvenation, b._rejuvenation, starts, renamed, joint._assumed.camera)


class _Dense(NamedTuple):
    """A filter's landmarks by ascending id: values (n, 9, M), counts (n, M), and one row each of the others.

    The log-odds of existence are (n, M), None where the filter does not keep them.
    """

    ids: IntArray
    values: FloatArray
    counts: IntArray
    odds: FloatArray | None
    descriptors: NDArray[np.float32]
    identities: IntArray

    @classmethod
    def of(cls, slam: FastSlam) -> "_Dense":
        maps = slam._maps
        slots = maps.used_slots()
        values, counts = maps.dense(slots)
        return cls(
            maps.ids[slots], values, counts.astype(np.int64), maps.dense_odds(slots), maps.descriptors[slots],
            maps.identities[slots],
        )  # fmt: skip


def _odds_of(dense: _Dense, chosen: IntArray, model: ExistenceModel | None) -> FloatArray:
    """Return the log-odds of existence (n, M) that the chosen particles (M,) have: the prior, where they have none."""
    if dense.odds is not None:
        return np.take(dense.odds, chosen, axis=1)
    return np.full((len(dense.ids), len(chosen)), 0.0 if model is None else model.log_odds_prior)


def _join_poses(
    joint: FastSlam, a: FastSlam, from_a: IntArray, b: FastSlam, from_b: IntArray, motion: FloatArray
) -> None:
    """Write the poses of both groups, those of b moved by each particle's `motion` (M, 3)."""
    k, count = a.num_robots, len(motion)
    for name in ("_poses", "_starts", "_means"):
        target, of_a, of_b = getattr(joint, name), getattr(a, name), getattr(b, name)
        target[:k, :, :count] = of_a[:, :, from_a]
        target[k:, :, :count] = compose(motion, of_b[:, :, from_b].transpose(0, 2, 1)).transpose(0, 2, 1)
    turn = np.zeros((count, 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = rotation(motion[:, 2]), 1.0
    spread_b = b._covariances[:, :, from_b].transpose(0, 2, 1)[..., UNPACK]
    moved = turn @ spread_b @ turn.transpose(0, 2, 1)
    joint._covariances[:k, :, :count] = a._covariances[:, :, from_a]
    joint._covariances[k:, :, :count] = moved[..., *UPPER].transpose(0, 2, 1)


def stack_descriptors(a: NDArray[np.float32], b: NDArray[np.float32]) -> NDArray[np.float32]:
    """Stack the descriptors of two maps, one of which may still be empty and of unknown width."""
    if not len(a) or not len(b):
        return np.array(a if len(a) else b)
    return np.concatenate([a, b])


def _unexplained(
    landmarks_a: FloatArray, present_a: BoolArray, landmarks_b: FloatArray, present_b: BoolArray,
    from_a: IntArray, from_b: IntArray, initial: FloatArray,
) -> float:  # fmt: skip
    """Return tau^2 [m^2], what the differences of shared landmarks need beyond both maps' covariances.

    For each pair of particles chi^2(tau^2) = degrees of freedom, by Newton's method on the latter over the former,
    which is concave in tau^2: it rises to the root and not beyond. The median over pairs is taken; 0 where maps agree,
    and `MOST_EXTRA` at most. The arguments are those of `_align_pairs`.
    """
    extra = np.zeros(len(from_a))
    arguments = (landmarks_a, present_a, landmarks_b, present_b, from_a, from_b)
    motions = np.tile(initial, (len(from_a), 1))
    for _ in range(ROUNDS):
        motions, _, chi2, _, shared, slope = _fit_pairs(*arguments, motions, extra, 1)
        freedom = np.maximum(3.0 * shared - 3.0, 1.0)
        extra = np.maximum(extra + chi2 * (chi2 - freedom) / np.maximum(freedom * slope, 1e-300), 0.0)
    enough = shared >= MIN_PAIRS
    return min(float(np.median(extra[enough])), MOST_EXTRA) if enough.any() else 0.0


def _contradiction(chi2: FloatArray, shared: IntArray) -> float:
    """Return phi >= 1, by how much the widened covariances still understate the differences between maps."""
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
    """Return log-evidences (c,) and factors (c, 3, 3) with C C^T the covariance of each pair's motion.

    Pairs of particles that share too little take the consensus motion, and the smallest evidence of the others. Where
    the motion is `known`, all do.
    """
    poor = (shared < MIN_PAIRS) | known
    informations = np.where(poor[:, None, None], np.eye(3), informations)
    covariances = scale * np.linalg.inv(informations)
    motions[poor] = alignment.transform
    covariances[poor] = alignment.covariance
    values, vectors = np.linalg.eigh(0.5 * (covariances + covariances.transpose(0, 2, 1)))
    factors = vectors * np.sqrt(np.maximum(values, 0.0))[:, None, :]
    log_evidence = -0.5 * (chi2 / scale + log_dets + 3.0 * shared * math.log(scale))
    log_evidence += 0.5 * np.linalg.slogdet(np.where(poor[:, None, None], np.eye(3), covariances))[1]
    if poor.any():
        log_evidence[poor] = log_evidence[~poor].min() if (~poor).any() else 0.0
    return log_evidence, factors


def _move_landmarks(landmarks: FloatArray, motion: FloatArray) -> None:
    """Move landmarks (n, 9, M) in place, each particle by its own motion (M, 3); covariances by Eq. 16 corrected."""
    c, s = np.cos(motion[:, 2]), np.sin(motion[:, 2])
    x, y = landmarks[:, 0].copy(), landmarks[:, 1].copy()
    landmarks[:, 0] = c * x - s * y + motion[:, 0]
    landmarks[:, 1] = s * x + c * y + motion[:, 1]
    xx, xy, xz, yy, yz = (landmarks[:, i].copy() for i in range(3, 8))
    landmarks[:, 3] = c * c * xx - 2.0 * c * s * xy + s * s * yy  # Eq. 16 *: R Sigma R^T
    landmarks[:, 4] = c * s * (xx - yy) + (c * c - s * s) * xy
    landmarks[:, 5] = c * xz - s * yz
    landmarks[:, 6] = s * s * xx + 2.0 * c * s * xy + c * c * yy
    landmarks[:, 7] = s * xz + c * yz


def _fuse_rows(
    a: tuple[FloatArray, IntArray], rows_a: IntArray, b: tuple[FloatArray, IntArray], rows_b: IntArray
) -> None:
    """Fuse b's rows into a's, in place, where a particle holds both; where it holds b's alone, take that.

    Each side is (landmarks (n, 9, M), counts (n, M), 0 = not held).
    """
    landmarks_a, landmarks_b = (side[0][rows].transpose(0, 2, 1) for side, rows in ((a, rows_a), (b, rows_b)))
    in_a, in_b = a[1][rows_a] > 0, b[1][rows_b] > 0
    row, particle = np.nonzero(in_a & in_b)
    one, two = landmarks_a[row, particle], landmarks_b[row, particle]
    means, covariances = fuse_landmarks(one[:, :3], one[:, 3:][:, UNPACK], two[:, :3], two[:, 3:][:, UNPACK])
    fused = np.where((in_b & ~in_a)[..., None], landmarks_b, landmarks_a)
    fused[row, particle] = np.concatenate([means, covariances[:, *UPPER]], axis=1)
    a[0][rows_a] = fused.transpose(0, 2, 1)
    a[1][rows_a] += b[1][rows_b]


def _fuse_odds(
    model: ExistenceModel, odds_a: FloatArray, counts_a: IntArray, rows_a: IntArray,
    odds_b: FloatArray, counts_b: IntArray, rows_b: IntArray,
) -> None:  # fmt: skip
    """Fuse the log-odds of existence (n, M) of b's rows into a's, in place, like `_fuse_rows`, and before it.

    What either filter saw is independent given whether the landmark exists: log-odds add up, and the prior that both
    hold counts once. What then lies below the floor is given one more chance: it stays there until the next miss.
    """
    in_a, in_b = counts_a[rows_a] > 0, counts_b[rows_b] > 0
    one, two = odds_a[rows_a], odds_b[rows_b]
    both = np.clip(one + two - model.log_odds_prior, model.log_odds_floor, model.log_odds_cap)
    odds_a[rows_a] = np.where(in_a & in_b, both, np.where(in_b, two, one))


def _align_pairs(
    landmarks_a: FloatArray, present_a: BoolArray, landmarks_b: FloatArray, present_b: BoolArray,
    from_a: IntArray, from_b: IntArray, initial: FloatArray, extra: float,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray]:  # fmt: skip
    """Estimate the motion between the maps of each pair of particles by Gauss-Newton on the shared landmarks.

    Args:
        landmarks_a: (k, 9, M_a) shared landmarks, with `present_a` (k, M_a); those of b in the same order.
        from_a: (c,) particle of a in each pair; `from_b` likewise.
        initial: (3,) where to start.
        extra: tau^2, added to the variances of all differences [m^2].

    Returns:
        Motions (c, 3), information matrices (c, 3, 3), chi^2 (c,), sums of log|2 pi S| (c,), and how many landmarks
        both particles of a pair hold (c,).
    """
    starts, widened = np.tile(initial, (len(from_a), 1)), np.full(len(from_a), extra)
    return _fit_pairs(landmarks_a, present_a, landmarks_b, present_b, from_a, from_b, starts, widened, 3)[:5]


def _fit_pairs(
    landmarks_a: FloatArray, present_a: BoolArray, landmarks_b: FloatArray, present_b: BoolArray,
    from_a: IntArray, from_b: IntArray, starts: FloatArray, extra: FloatArray, iterations: int,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, IntArray, FloatArray]:  # fmt: skip
    """Fit motions (c, 3) from `starts`, with variances widened by `extra` (c,).

    Returns:
        As `_align_pairs`, and by how much chi^2 (c,) falls with tau^2, motions held [1/m^2].
    """
    a, b = landmarks_a[:, :, from_a], landmarks_b[:, :, from_b]
    both = present_a[:, from_a] & present_b[:, from_b]
    shared = np.count_nonzero(both, axis=0)
    enough = np.flatnonzero(shared >= MIN_PAIRS)
    motions = starts.copy()
    for iteration in range(iterations + 1):
        moved = b.copy()
        _move_landmarks(moved, motions)
        residual = a[:, :3] - moved[:, :3]
        spread = np.where(both[:, None], a[:, 3:] + moved[:, 3:], _UNIT)
        spread[:, DIAGONAL - 3] += extra
        information, log_det = _inverse(spread)
        information *= both[:, None]
        jacobian = np.stack([motions[:, 1] - moved[:, 1], moved[:, 0] - motions[:, 0]])  # dR/dtheta p_b
        xx, xy, xz, yy, yz, zz = information.transpose(1, 0, 2)
        rx, ry, rz = residual.transpose(1, 0, 2)
        weighted = np.stack([xx * rx + xy * ry + xz * rz, xy * rx + yy * ry + yz * rz, xz * rx + yz * ry + zz * rz])
        chi2 = np.sum(weighted[0] * rx + weighted[1] * ry + weighted[2] * rz, axis=0)
        turned = np.stack([xx * jacobian[0] + xy * jacobian[1], xy * jacobian[0] + yy * jacobian[1]])
        rows = [xx, xy, turned[0], yy, turned[1], jacobian[0] * turned[0] + jacobian[1] * turned[1]]
        normal = np.array([row.sum(axis=0) for row in rows]).T[:, UNPACK]
        if iteration < iterations:
            gradient = np.stack([weighted[0], weighted[1], np.sum(jacobian * weighted[:2], axis=0)]).sum(axis=1).T
            motions[enough] += np.linalg.solve(normal[enough], gradient[enough][..., None])[..., 0]
    log_dets = np.sum(both * (log_det + 3.0 * math.log(2.0 * math.pi)), axis=0)
    return motions, normal, chi2, log_dets, shared, np.sum(weighted * weighted, axis=(0, 1))


def _inverse(packed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return inverses (n, 6, c) and log-determinants (n, c) of symmetric 3 x 3 matrices (n, 6, c), upper triangles."""
    a, b, c, d, e, f = packed.transpose(1, 0, 2)
    cofactors = np.stack([d * f - e * e, c * e - b * f, b * e - c * d, a * f - c * c, b * c - a * e, a * d - b * b])
    det = a * cofactors[0] + b * cofactors[1] + c * cofactors[2]
    return (cofactors / det).transpose(1, 0, 2), np.log(det)
