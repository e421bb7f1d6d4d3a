"""The motion between two maps of unknown relative frame, or a reason why it is not known (Sec. 3.1)."""

import math

import numpy as np
from scipy.spatial import KDTree
from scipy.special import bdtrc

from slam_backend import _alignment_kernels as kernels
from slam_backend import _proposals as proposals
from slam_backend._matching import look_alikes, mutual_nearest, unlike_other_places
from slam_backend.alignment_types import REASONS, Alignment, AlignmentOptions, Reason
from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument, check_choice
from slam_backend.geometry import transform_points, wrap_angle
from slam_backend.landmark_map import LandmarkMap
from slam_backend.metrics import align_se2

__all__ = [
    "METHODS", "REASONS", "Alignment", "AlignmentOptions", "Reason", "align_maps", "candidate_matches",
    "propose_motion",
]  # fmt: skip

METHODS = ("ransac", "svd", "icp", "impicp", "gnc", "clique")
RIVAL_DISTANCE = 0.5  # [m]; beyond these two an alignment counts as another one, and as a false one
RIVAL_ANGLE = np.deg2rad(5.0)
RIVALS = 5  # most promising rivals that are refined
FALSE_ALARMS = 1e-3  # expected number of sets of look-alikes that fit by chance as well
MOST_PAIRS = 10_000  # candidates by geometry alone
MIRRORED = 3, 0.1  # the mirror image is believed if it fits so many more matches, and this share of the inliers more


def candidate_matches(map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions) -> IntArray:
    """Match landmarks by appearance, without regard to where they lie in the plane.

    Those that stand out: each is the other's nearest descriptor, within the gate, clearly nearer than any landmark of
    another place in either map. Beside them all pairs within the gate of landmarks that have few look-alikes: which of
    them is meant, geometry has to tell, and that there are several is evidence, too. Heights agree, because planar
    robots with one camera height share z (Sec. 3.1). Without appearance all pairs whose heights agree are candidates.

    Args:
        map_a: The one map.
        map_b: The other, in any other planar frame.
        options: Gates.

    Returns:
        (k, 2) int64 rows (index in map_a, index in map_b), by rising index in map_a, then in map_b. One-to-one where
        all landmarks look different.

    Raises:
        ValueError: If the maps' descriptors differ in size, or there are too many pairs to try without appearance.
    """
    return _candidates(map_a, map_b, options)[0]


def _candidates(map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions) -> tuple[IntArray, BoolArray]:
    """Return the candidates (k, 2), and which of them stand out (k,): these are one-to-one."""
    if map_a.descriptors.shape[1] != map_b.descriptors.shape[1]:
        raise bad_argument(
            "map_b",
            f"descriptors of size {map_a.descriptors.shape[1]}, as in map_a",
            map_b.descriptors.shape[1],
            "Describe the landmarks of both maps with the same front end.",
        )
    if options.appearance:
        clear = mutual_nearest(map_a.descriptors, map_b.descriptors, options.descriptor_gate)
        for one, other, here, there in ((map_a, map_b, 0, 1), (map_b, map_a, 1, 0)):
            descriptors, partners = one.descriptors[clear[:, here]], clear[:, there]
            limits = (options.same_place, options.descriptor_ratio)
            clear = clear[unlike_other_places(descriptors, partners, other.descriptors, other.means, *limits)]
        alike = clear[:0]
        if options.look_alikes:
            alike = look_alikes(map_a.descriptors, map_b.descriptors, options.descriptor_gate, options.look_alikes)
    else:
        if len(map_a) * len(map_b) > MOST_PAIRS:
            raise bad_argument(
                "map_b", f"at most {MOST_PAIRS} pairs of landmarks without appearance", len(map_a) * len(map_b),
                "Give smaller maps, or tell landmarks apart.",
            )  # fmt: skip
        clear, alike = np.empty((0, 2), np.int64), np.argwhere(np.ones((len(map_a), len(map_b)), np.bool_))
    names = np.concatenate([clear, alike]) @ np.array([max(len(map_b), 1), 1])
    unique, first = np.unique(names, return_index=True)
    matches = np.column_stack([unique // max(len(map_b), 1), unique % max(len(map_b), 1)])
    stands_out = first < len(clear)
    rows_a, rows_b = matches.T
    climb = map_a.means[rows_a, 2] - map_b.means[rows_b, 2]
    variance = map_a.covariances[rows_a, 2, 2] + map_b.covariances[rows_b, 2, 2] + options.position_floor**2
    level = climb**2 <= options.position_gate * variance
    return matches[level], stands_out[level]


def align_maps(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    method: str = "ransac",
    rng: np.random.Generator | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Estimate the planar motion between two maps from landmarks that look alike; refuse when in doubt.

    Methods differ in where they begin (`propose_motion`). What follows is common to all: inliers within a Mahalanobis
    gate, heights included, and weighted Gauss-Newton over them in turn until both rest, which is the maximum of the
    likelihood; its covariance; the best alignment that differs; and the refusals.

    Args:
        map_a: The map whose frame the result leads to.
        map_b: The other map.
        method: `"ransac"`: search over pairs of candidate matches, each hypothesis locally optimised. `"svd"`: closed
            form over all candidates. `"icp"`: pairs of closest landmarks, from there on. `"impicp"`: ICP from two
            starts. `"gnc"`: truncated least squares by graduated non-convexity. `"clique"`: largest set of candidates
            that agree pairwise. Sources are named in `_proposals` and `_clique_kernels`; `docs/alignment.md` compares.
        rng: Order of the search; None: a fixed one. The same generator state gives the same result.
        options: Gates and refusals; None: the defaults.

    Returns:
        The alignment, or a refusal with its reason. A refusal is cheap, a false merge is not.

    Raises:
        ValueError: If the method is unknown, the maps' descriptors differ in size or `rng` is no generator.
    """
    options, rng = _checked(map_a, map_b, method, rng, options)
    if not options.appearance and len(map_a) * len(map_b) > MOST_PAIRS:
        return Alignment.refused("too many candidates")
    matches, stands_out = _candidates(map_a, map_b, options)
    if len(matches) < options.min_inliers:
        return Alignment.refused("too few candidates")
    table = _match_table(map_a, map_b, matches)
    floor, gate = options.position_floor**2, options.position_gate
    hypotheses = _search(table, rng, options)
    start = _propose(method, map_a, map_b, matches, stands_out, table, hypotheses, options)
    if start is None:
        return Alignment.refused("too few inliers")
    pose, members, variance = kernels.refine(table, start, floor, gate)
    inside = _fitting(table, matches, pose, floor, gate)
    members &= inside | _one_to_one(matches)  # of look-alikes that all fit, one shapes the motion
    inliers = matches[inside]
    if len(inliers) < options.min_inliers or _by_chance(table, map_a, matches, pose, variance, options):
        return Alignment.refused("too few inliers")
    points_b = map_b.means[inliers[:, 1], :2]
    ratio = _strongest_rival(table, matches, hypotheses, pose, variance, points_b.mean(axis=0), options)
    if ratio > options.max_ratio:
        return Alignment.refused("ambiguous", ratio)
    if _is_mirrored(table, matches, pose, inside, options):
        return Alignment.refused("mirrored", ratio)
    if _extent(points_b) < options.min_spread:
        return Alignment.refused("poorly spread", ratio)
    covariance = _covariance(kernels.information(table, members, pose, variance)[0])
    influence = kernels.largest_influence(table, members, pose, variance)
    if covariance is None or not _certain(covariance, influence, options):
        return Alignment.refused("too uncertain", ratio)
    return Alignment(True, "", pose[0], pose[1], pose[2], covariance, inliers, ratio)


def propose_motion(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    method: str,
    rng: np.random.Generator | None = None,
    options: AlignmentOptions | None = None,
) -> FloatArray | None:
    """Return a method's own estimate of the motion, before any refinement or refusal, as the paper compares them.

    Args:
        map_a: The map whose frame the result leads to.
        map_b: The other map.
        method: As in `align_maps`.
        rng: Likewise.
        options: Likewise.

    Returns:
        (3,) a_from_b [m, m, rad]; None if the candidates do not suffice for one.

    Raises:
        ValueError: As `align_maps`.
    """
    options, rng = _checked(map_a, map_b, method, rng, options)
    matches, stands_out = _candidates(map_a, map_b, options)
    if len(matches) < 2:
        return None
    table = _match_table(map_a, map_b, matches)
    hypotheses = _search(table, rng, options) if method == "ransac" else np.empty((0, 5))
    return _propose(method, map_a, map_b, matches, stands_out, table, hypotheses, options)


def _checked(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    method: str,
    rng: np.random.Generator | None,
    options: AlignmentOptions | None,
) -> tuple[AlignmentOptions, np.random.Generator]:
    """Return options and generator, or raise if an argument is of the wrong kind."""
    check_choice("method", method, METHODS)
    options = AlignmentOptions() if options is None else options
    for name, value, kind in (
        ("map_a", map_a, LandmarkMap), ("map_b", map_b, LandmarkMap), ("options", options, AlignmentOptions)
    ):  # fmt: skip
        if not isinstance(value, kind):
            raise bad_argument(name, f"a {kind.__name__}", value, f"Build one: {kind.__name__}(...).")
    rng = np.random.default_rng(0) if rng is None else rng
    if not isinstance(rng, np.random.Generator):
        raise bad_argument("rng", "a numpy.random.Generator or None", rng, "Give np.random.default_rng(seed).")
    return options, rng


def _propose(
    method: str,
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    matches: IntArray,
    stands_out: BoolArray,
    table: FloatArray,
    hypotheses: FloatArray,
    options: AlignmentOptions,
) -> FloatArray | None:
    """Return the motion (3,) at which a method begins; None if it finds none.

    Those that cannot choose among look-alikes begin with the candidates that stand out, where there are enough.
    """
    floor, gate = options.position_floor**2, options.position_gate
    if method not in ("ransac", "clique") and np.count_nonzero(stands_out) >= options.min_inliers:
        matches, table = matches[stands_out], table[stands_out]
    if method == "ransac":
        return hypotheses[hypotheses[:, 4].argmax(), :3].copy() if len(hypotheses) else None
    if method == "gnc":
        return proposals.graduated(table, floor, gate)
    if method == "clique":
        unlike = np.linalg.norm(map_a.descriptors[matches[:, 0]] - map_b.descriptors[matches[:, 1]], axis=1)
        return proposals.consistent(table, matches, unlike, floor, gate)
    if method == "impicp":
        return proposals.two_starts(map_a, map_b, matches, table, floor, gate)
    fit = align_se2(table[:, :2], table[:, 3:5])
    return fit if method == "svd" else proposals.closest_points(map_a, map_b, fit)


def _match_table(map_a: LandmarkMap, map_b: LandmarkMap, matches: IntArray) -> FloatArray:
    """Return the (k, 18) table of matched landmarks that the kernels read."""
    upper = np.triu_indices(3)
    table = np.empty((len(matches), kernels.MATCH_COLUMNS))
    for offset, source, rows in ((0, map_a, matches[:, 0]), (1, map_b, matches[:, 1])):
        table[:, 3 * offset : 3 * offset + 3] = source.means[rows]
        table[:, 6 + 6 * offset : 12 + 6 * offset] = source.covariances[rows][:, upper[0], upper[1]]
    return table


def _search(table: FloatArray, rng: np.random.Generator, options: AlignmentOptions) -> FloatArray:
    """Return the hypotheses (h, 5) of a random search over pairs of candidates; over all of them if they are few."""
    pairs = len(table) * (len(table) - 1) // 2
    few = pairs <= options.max_samples
    samples = rng.permutation(pairs) if few else rng.integers(0, pairs, options.max_samples)
    return kernels.search(
        table,
        samples,
        options.position_floor**2,
        options.position_gate,
        0.5 * options.min_spread,  # pairs that lie closer say little about the rotation
        options.min_inliers,
        options.max_ratio,
        math.log(1.0 - options.success_probability),
    )


def _one_to_one(matches: IntArray) -> bool:
    """Tell whether no landmark appears twice in matches (k, 2)."""
    return len(np.unique(matches[:, 0])) == len(np.unique(matches[:, 1])) == len(matches)


def _fitting(table: FloatArray, matches: IntArray, pose: FloatArray, floor: float, gate: float) -> BoolArray:
    """Tell which candidates (k,) lie within the gate under `pose`; of several of one landmark the closest, greedily."""
    distances = kernels.squared_distances(table, pose, floor)
    inside = distances <= gate
    rows = np.flatnonzero(inside)
    if not _one_to_one(matches[rows]):
        taken_a, taken_b = set[int](), set[int]()
        for i in rows[np.argsort(distances[rows], kind="stable")].tolist():
            a, b = matches[i].tolist()
            inside[i] = a not in taken_a and b not in taken_b
            if inside[i]:
                taken_a.add(a)
                taken_b.add(b)
    return inside


def _by_chance(
    table: FloatArray,
    map_a: LandmarkMap,
    matches: IntArray,
    pose: FloatArray,
    variance: float,
    options: AlignmentOptions,
) -> bool:
    """Tell whether so many inliers would come together by chance somewhere among so many look-alikes.

    Were all pairs wrong, a look-alike would be any landmark of map a, and fit if it lay near by chance; without
    appearance, a landmark of b would lie anywhere in the area of map a, and fit if one is near there. The chance that
    as many of b's landmarks fit as do, two of which any motion can be made to fit, times the number of pairs that a
    motion can be made from, is how often that is expected at all: a number of false alarms (Moisan and Stival 2004).
    All this at the scale of what is left between the maps, the fitted `variance`. Where candidates are one-to-one by
    appearance, `min_inliers` alone decides.
    """
    if _one_to_one(matches):
        return False
    inside = _fitting(table, matches, pose, variance, options.position_gate)
    spread = (table[:, 6] + table[:, 9] + table[:, 12] + table[:, 15]) / 2.0 + variance
    reach = np.sqrt(options.position_gate * spread)
    if options.appearance:
        moved = transform_points(pose, table[:, 3:5])
        near = KDTree(map_a.means[:, :2]).query_ball_point(moved, reach, return_length=True)
        fitted = np.isin(matches[:, 1], matches[inside, 1])  # one of those near is the partner found, not chance
        share = (np.asarray(near, dtype=np.float64) - fitted).clip(min=0.0) / len(map_a)
    else:
        area = np.prod(np.ptp(map_a.means[:, :2], axis=0) + 2.0 * reach.mean())
        share = np.pi * reach**2 / area
    _, owner = np.unique(matches[:, 1], return_inverse=True)
    chances = 1.0 - np.exp(-np.bincount(owner, share))
    beyond = np.count_nonzero(inside) - 3
    tail = bdtrc(beyond, max(len(chances) - 2, 1), chances.mean()) if beyond >= 0 else 1.0
    return bool(0.5 * len(matches) * (len(matches) - 1.0) * tail > FALSE_ALARMS)


def _strongest_rival(
    table: FloatArray,
    matches: IntArray,
    hypotheses: FloatArray,
    pose: FloatArray,
    variance: float,
    centre_b: FloatArray,
    options: AlignmentOptions,
) -> float:
    """Return how near the best hypothesis that differs even when refined comes to `pose`, as `Alignment.ratio` says."""
    floor, gate = options.position_floor**2, options.position_gate

    ours = _fitting(table, matches, pose, variance, gate)
    others = np.ascontiguousarray(hypotheses[_differ(hypotheses[:, :3], pose, centre_b), :3])
    promise = kernels.own_support(table, others, ours, floor, gate)
    strongest = 0.0
    for i in np.argsort(-promise, kind="stable")[:RIVALS]:
        refined = kernels.refine(table, others[i].copy(), floor, gate)[0]
        if _differ(refined[None], pose, centre_b)[0]:
            theirs = _fitting(table, matches, refined, variance, gate)
            own = max(float(np.count_nonzero(ours & ~theirs)), 0.5 * float(np.count_nonzero(ours)), 1.0)
            strongest = max(strongest, float(np.count_nonzero(theirs & ~ours)) / own)
    return strongest


def _is_mirrored(
    table: FloatArray, matches: IntArray, pose: FloatArray, inside: BoolArray, options: AlignmentOptions
) -> bool:
    """Tell whether the mirror image about the line on which the inliers lie fits clearly more matches.

    The one wall of a mirrored corridor fits a motion, too; but then all the rest fits the image.
    """
    points = table[inside, 3:5]
    centre = points.mean(axis=0)
    axis = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, -1]
    mirror = np.eye(3)
    mirror[:2, :2] = 2.0 * np.outer(axis, axis) - np.eye(2)
    image = table.copy()
    image[:, 3:5] = centre + (table[:, 3:5] - centre) @ mirror[:2, :2]
    upper = np.triu_indices(3)
    full = np.empty((len(table), 3, 3))
    full[:, upper[0], upper[1]] = full[:, upper[1], upper[0]] = table[:, 12:]
    image[:, 12:] = (mirror @ full @ mirror)[:, upper[0], upper[1]]
    fits = _fitting(image, matches, pose, options.position_floor**2, options.position_gate)
    more = np.count_nonzero(fits & ~inside) - np.count_nonzero(inside & ~fits)
    return bool(more >= max(MIRRORED[0], MIRRORED[1] * np.count_nonzero(inside)))


def _differ(poses: FloatArray, pose: FloatArray, centre_b: FloatArray) -> BoolArray:
    """Tell which of `poses` (h, 3) put the point `centre_b` (2,) elsewhere than `pose` does, or turn otherwise."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    here = transform_points(pose, centre_b)
    x = poses[:, 0] + cos * centre_b[0] - sin * centre_b[1] - here[0]
    y = poses[:, 1] + sin * centre_b[0] + cos * centre_b[1] - here[1]
    turned = np.abs(wrap_angle(poses[:, 2] - pose[2]))
    return np.asarray((np.hypot(x, y) > RIVAL_DISTANCE) | (turned > RIVAL_ANGLE))


def _extent(points: FloatArray) -> float:
    """Return how far points (k, 2) [m] reach along their main axis [m]."""
    centred = points - points.mean(axis=0)
    main_axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return float(np.ptp(centred @ main_axis))


def _covariance(h: FloatArray) -> FloatArray | None:
    """Return the covariance (3, 3) of a solution with information `h`; None if that leaves a direction open."""
    scale = np.sqrt(np.diag(h))
    if not (scale > 0.0).all() or np.linalg.eigvalsh(h / np.outer(scale, scale))[0] < 1e-12:
        return None
    covariance = np.linalg.solve(h, np.eye(3))
    return np.asarray(0.5 * (covariance + covariance.T))


def _certain(covariance: FloatArray, influence: tuple[float, float], options: AlignmentOptions) -> bool:
    """Tell whether an alignment is certain enough to be believed, and no single match, left out, says otherwise."""
    position = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    sure = position <= options.max_sigma_position and math.sqrt(covariance[2, 2]) <= options.max_sigma_heading
    return sure and influence[0] <= 0.5 * RIVAL_DISTANCE and influence[1] <= 0.5 * RIVAL_ANGLE
