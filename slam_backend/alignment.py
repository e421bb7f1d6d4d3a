"""The motion between two maps of unknown relative frame, or a reason why it is not known (Sec. 3.1)."""

import math

import numpy as np

from slam_backend import _alignment_kernels as kernels
from slam_backend._matching import mutual_nearest, unlike_other_places
from slam_backend.alignment_types import REASONS, Alignment, AlignmentOptions, Reason
from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument, check_choice
from slam_backend.geometry import transform_points, wrap_angle
from slam_backend.landmark_map import LandmarkMap
from slam_backend.metrics import align_se2

__all__ = ["METHODS", "REASONS", "Alignment", "AlignmentOptions", "Reason", "align_maps", "candidate_matches"]

METHODS = ("ransac", "svd")
RIVAL_DISTANCE = 0.5  # [m]; beyond these two an alignment counts as another one, and as a false one
RIVAL_ANGLE = np.deg2rad(5.0)


def candidate_matches(map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions) -> IntArray:
    """Match landmarks by appearance, without regard to where they lie in the plane.

    Each is the other's nearest descriptor, within the gate, clearly nearer than any landmark of another place in
    either map; and their heights agree, because planar robots with one camera height share z (Sec. 3.1).

    Args:
        map_a: The one map.
        map_b: The other, in any other planar frame.
        options: Gates.

    Returns:
        (k, 2) int64 rows (index in map_a, index in map_b), one-to-one, by rising index in map_a.

    Raises:
        ValueError: If the maps' descriptors differ in size.
    """
    if map_a.descriptors.shape[1] != map_b.descriptors.shape[1]:
        raise bad_argument(
            "map_b",
            f"descriptors of size {map_a.descriptors.shape[1]}, as in map_a",
            map_b.descriptors.shape[1],
            "Describe the landmarks of both maps with the same front end.",
        )
    matches = mutual_nearest(map_a.descriptors, map_b.descriptors, options.descriptor_gate)
    for one, other, here, there in ((map_a, map_b, 0, 1), (map_b, map_a, 1, 0)):
        descriptors, partners = one.descriptors[matches[:, here]], matches[:, there]
        limits = (options.same_place, options.descriptor_ratio)
        matches = matches[unlike_other_places(descriptors, partners, other.descriptors, other.means, *limits)]
    rows_a, rows_b = matches.T
    climb = map_a.means[rows_a, 2] - map_b.means[rows_b, 2]
    variance = map_a.covariances[rows_a, 2, 2] + map_b.covariances[rows_b, 2, 2] + options.position_floor**2
    level: IntArray = matches[climb**2 <= options.position_gate * variance]
    return level


def align_maps(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    method: str = "ransac",
    rng: np.random.Generator | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Estimate the planar motion between two maps from landmarks that look alike; refuse when in doubt.

    Args:
        map_a: The map whose frame the result leads to.
        map_b: The other map.
        method: `"ransac"`: search over pairs of candidate matches, each hypothesis locally optimised, then weighted
            Gauss-Newton to convergence. `"svd"`: closed form and weighted Gauss-Newton over ALL candidate matches,
            without any rejection of outliers, for comparison.
        rng: Order of the search; None: a fixed one. The same generator state gives the same result.
        options: Gates and refusals; None: the defaults.

    Returns:
        The alignment, or a refusal with its reason. A refusal is cheap, a false merge is not.

    Raises:
        ValueError: If the method is unknown, the maps' descriptors differ in size or `rng` is no generator.
    """
    check_choice("method", method, METHODS)
    options = AlignmentOptions() if options is None else options
    for name, value, kind in (
        ("map_a", map_a, LandmarkMap), ("map_b", map_b, LandmarkMap), ("options", options, AlignmentOptions)
    ):
        if not isinstance(value, kind):
            raise bad_argument(name, f"a {kind.__name__}", value, f"Build one: {kind.__name__}(...).")
    rng = np.random.default_rng(0) if rng is None else rng
    if not isinstance(rng, np.random.Generator):
        raise bad_argument("rng", "a numpy.random.Generator or None", rng, "Give np.random.default_rng(seed).")
    matches = candidate_matches(map_a, map_b, options)
    if len(matches) < options.min_inliers:
        return Alignment.refused("too few candidates")
    table = _match_table(map_a, map_b, matches)
    floor = options.position_floor**2
    if method == "ransac":
        hypotheses = _search(table, rng, options)
        if not len(hypotheses):
            return Alignment.refused("too few inliers")
        pose, members, variance = kernels.refine(
            table, hypotheses[hypotheses[:, 4].argmax(), :3].copy(), floor, options.position_gate
        )
    else:
        hypotheses = np.empty((0, 5))
        pose, members, variance = _fit_all(table, floor)
    inside = kernels.squared_distances(table, pose, floor) <= options.position_gate
    inliers = matches[inside]
    if len(inliers) < options.min_inliers:
        return Alignment.refused("too few inliers")
    points_b = map_b.means[inliers[:, 1], :2]
    ratio = _strongest_rival(table, hypotheses, pose, points_b.mean(axis=0), options) / len(inliers)
    if ratio > options.max_ratio:
        return Alignment.refused("ambiguous", ratio)
    if _extent(points_b) < options.min_spread:
        return Alignment.refused("poorly spread", ratio)
    covariance = _covariance(kernels.information(table, members, pose, variance)[0])
    if covariance is None or not _certain(covariance, options):
        return Alignment.refused("too uncertain", ratio)
    return Alignment(True, "", pose[0], pose[1], pose[2], covariance, inliers, ratio)


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
    few = 4 * pairs <= options.max_samples
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


def _fit_all(table: FloatArray, floor: float) -> tuple[FloatArray, BoolArray, float]:
    """Return the motion (3,) fitted to all candidates alike, all of them as members, and the added variance."""
    pose = align_se2(table[:, :2], table[:, 3:5])
    members, variance = np.ones(len(table), np.bool_), floor
    for _ in range(kernels.MAX_ROUNDS):
        variance = kernels.fitted_variance(table, members, pose, floor)
        pose = kernels.gauss_newton_step(table, members, pose, variance)
    return pose, members, variance


def _strongest_rival(
    table: FloatArray, hypotheses: FloatArray, pose: FloatArray, centre_b: FloatArray, options: AlignmentOptions
) -> int:
    """Return how many inliers the best hypothesis has that differs from `pose` even when both are refined."""
    floor, gate = options.position_floor**2, options.position_gate
    rivals = hypotheses[_differ(hypotheses[:, :3], pose, centre_b)]
    for rival in rivals[np.argsort(-rivals[:, 3], kind="stable")]:
        refined = kernels.refine(table, rival[:3].copy(), floor, gate)[0]
        if _differ(refined[None], pose, centre_b)[0]:
            return int(np.count_nonzero(kernels.squared_distances(table, refined, floor) <= gate))
    return 0


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


def _certain(covariance: FloatArray, options: AlignmentOptions) -> bool:
    """Tell whether an alignment is certain enough to be believed."""
    position = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return position <= options.max_sigma_position and math.sqrt(covariance[2, 2]) <= options.max_sigma_heading
