"""Verification of an alignment: its evidence, its rivals, and whether the scene repeats itself."""

import math

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import transform_points, wrap_angle
from slam_backend.maps import _kernels as kernels
from slam_backend.maps.alignment_types import DISTINCT_ROTATION, DISTINCT_TRANSLATION, AlignmentOptions
from slam_backend.maps.correspondences import match_table, similar_pairs
from slam_backend.maps.landmark_map import LandmarkMap

MOST_RECURRING = 0.2  # of the shared landmarks, but for the two that any motion can be made to fit
NEEDLESS = 0.05  # how often a right alignment may be refused because chance makes a double: it is tried again later
MOST_LANDMARKS = 200  # of a constellation that are looked at, every so many-th of it
MOST_ALIKE = 50  # landmarks with more look-alikes than this tell nothing
SAMPLES = 4000  # pairs of pairs that are tried
STRONGEST = 3  # motions that are refined


def has_perceptual_alias(landmarks: LandmarkMap, rows: IntArray, variance: float, options: AlignmentOptions) -> bool:
    """Tell whether a constellation of a map occurs in it a second time, as far as two maps of one place agree.

    It does if by some motion a fifth of its landmarks come to lie on landmarks that look like them, and so many would
    do so by chance, among as many look-alikes spread over the map, in less than one of twenty maps.

    Args:
        landmarks: The map.
        rows: (k,) int64. The constellation.
        variance: Scale of the differences between the two maps [m^2].
        options: Gates.
    """
    points, variance = landmarks.means, max(variance, options.position_floor**2)
    rows = rows[:: 1 + len(rows) // MOST_LANDMARKS]
    looks = landmarks.descriptors
    from scipy.special import bdtrc  # slow to import, and not always needed

    pairs = similar_pairs(looks[rows], looks, options.descriptor_gate, MOST_ALIKE)
    matches = np.column_stack([rows[pairs[:, 0]], pairs[:, 1]])
    apart = points[matches[:, 0]] - points[matches[:, 1]]
    climb = landmarks.covariances[matches, 2, 2].sum(axis=1) + variance
    level = apart[:, 2] ** 2 <= options.position_gate * climb
    matches = matches[level & (np.hypot(apart[:, 0], apart[:, 1]) > DISTINCT_TRANSLATION)]
    beyond = max(3, math.ceil(MOST_RECURRING * (len(rows) - 2)))
    if len(np.unique(matches[:, 0])) < beyond + 2:
        return False
    table = match_table(landmarks, landmarks, matches[:, ::-1])  # motions take the constellation, as b, to its double
    count = len(matches) * (len(matches) - 1) // 2
    samples = np.random.default_rng(0).integers(0, count, min(SAMPLES, count))
    found = kernels.search(
        table, samples, variance, options.position_gate, 0.25 * options.min_spread, beyond + 2, options.max_ratio,
        math.log(1.0 - options.success_probability),
    )  # fmt: skip
    found = found[are_distinct(found[:, :3], np.zeros(3), points[rows, :2].mean(axis=0))]
    chance = _chance(table, landmarks, matches, len(rows), variance, options)
    for start in found[np.argsort(-found[:, 3], kind="stable")[:STRONGEST], :3]:
        pose = kernels.refine(table, start.copy(), variance, options.position_gate)[0]
        more = np.count_nonzero(inlier_mask(table, matches, pose, variance, options.position_gate)) - 2
        if more >= beyond and count * bdtrc(more - 1, len(rows) - 2, chance) <= NEEDLESS:
            return True
    return False


def _chance(
    table: FloatArray, landmarks: LandmarkMap, matches: IntArray, size: int, variance: float, options: AlignmentOptions
) -> float:
    """Return the mean probability that a landmark has a look-alike near where some motion takes it, by chance."""
    spread = kernels.planar_variances(table) + variance
    area = np.prod(np.ptp(landmarks.means[:, :2], axis=0))
    share = np.minimum(np.pi * options.position_gate * spread / max(area, 1e-9), 1.0)
    owners = np.unique(matches[:, 0], return_inverse=True)[1]
    return float((1.0 - np.exp(-np.bincount(owners, share))).sum() / size)


RIVALS = 5  # most promising rivals that are refined
FALSE_ALARMS = 1e-3  # expected number of sets of look-alikes that fit by chance as well
# The mirror image is believed if it fits so many more matches, and these are a tenth of the inliers' number, or three
# tenths of all that the motion leaves unexplained.
MIRRORED, OF_INLIERS, OF_REST = 3, 0.1, 0.3


def one_to_one(matches: IntArray) -> bool:
    """Tell whether no landmark appears twice in matches (k, 2)."""
    return all(len(set(rows)) == len(rows) for rows in matches.T.tolist())


def inlier_mask(table: FloatArray, matches: IntArray, pose: FloatArray, floor: float, gate: float) -> BoolArray:
    """Tell which candidates (k,) lie within the gate under `pose`; of several of one landmark the closest, greedily."""
    distances = kernels.squared_distances(table, pose, floor)
    inside = distances <= gate
    rows = np.flatnonzero(inside)
    if not one_to_one(matches[rows]):
        taken_a, taken_b = set[int](), set[int]()
        for i in rows[np.argsort(distances[rows], kind="stable")].tolist():
            a, b = matches[i].tolist()
            inside[i] = a not in taken_a and b not in taken_b
            if inside[i]:
                taken_a.add(a)
                taken_b.add(b)
    return inside


def is_chance_alignment(
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
    if one_to_one(matches):
        return False
    from scipy.spatial import KDTree
    from scipy.special import bdtrc

    inside = inlier_mask(table, matches, pose, variance, options.position_gate)
    spread = kernels.planar_variances(table) + variance
    reach = np.sqrt(options.position_gate * spread)
    if options.appearance:
        moved = transform_points(pose, kernels.planar_points(table)[1])
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


def runner_up_ratio(
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

    ours = inlier_mask(table, matches, pose, variance, gate)
    others = np.ascontiguousarray(hypotheses[are_distinct(hypotheses[:, :3], pose, centre_b), :3])
    promise = kernels.own_support(table, others, ours, floor, gate)
    strongest = 0.0
    for i in np.argsort(-promise, kind="stable")[:RIVALS]:
        refined = kernels.refine(table, others[i].copy(), floor, gate)[0]
        if are_distinct(refined[None], pose, centre_b)[0]:
            theirs = inlier_mask(table, matches, refined, variance, gate)
            own = max(float(np.count_nonzero(ours & ~theirs)), 0.5 * float(np.count_nonzero(ours)), 1.0)
            strongest = max(strongest, float(np.count_nonzero(theirs & ~ours)) / own)
    return strongest


def is_mirrored(
    table: FloatArray, matches: IntArray, pose: FloatArray, inside: BoolArray, options: AlignmentOptions
) -> bool:
    """Tell whether the mirror image about the line on which the inliers lie fits clearly more matches.

    The one wall of a mirrored corridor fits a motion, too; but then all the rest fits the image.
    """
    points = kernels.planar_points(table)[1][inside]
    centre = points.mean(axis=0)
    axis = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, -1]
    image = kernels.mirrored(table, centre, axis)
    fits = inlier_mask(image, matches, pose, options.position_floor**2, options.position_gate)
    more = np.count_nonzero(fits & ~inside) - np.count_nonzero(inside & ~fits)
    share = min(OF_INLIERS * np.count_nonzero(inside), OF_REST * np.count_nonzero(~inside))
    return bool(more >= max(MIRRORED, share))


def are_distinct(poses: FloatArray, pose: FloatArray, centre_b: FloatArray) -> BoolArray:
    """Tell which of `poses` (h, 3) put the point `centre_b` (2,) elsewhere than `pose` does, or turn otherwise."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    here = transform_points(pose, centre_b)
    x = poses[:, 0] + cos * centre_b[0] - sin * centre_b[1] - here[0]
    y = poses[:, 1] + sin * centre_b[0] + cos * centre_b[1] - here[1]
    turned = np.abs(wrap_angle(poses[:, 2] - pose[2]))
    return np.asarray((np.hypot(x, y) > DISTINCT_TRANSLATION) | (turned > DISTINCT_ROTATION))


def principal_extent(points: FloatArray) -> float:
    """Return how far points (k, 2) [m] reach along their main axis [m]."""
    centred = points - points.mean(axis=0)
    main_axis = np.linalg.eigh(centred.T @ centred)[1][:, -1]
    return float(np.ptp(centred @ main_axis))


def unexplained(table: FloatArray, members: BoolArray, pose: FloatArray, floor: float) -> float:
    """Return by how much, at least 1, the members' median D exceeds that of 3 degrees of freedom (a Birge ratio).

    Above 1 only by chance, and where covariances are more over-confident than any variance that may be added explains.
    """
    k = np.count_nonzero(members)
    if k < 2:
        return 1.0
    median = np.median(kernels.squared_distances(table[members], pose, floor))
    ratio = float(median / (kernels.MEDIAN_CHI2_3 * (1.0 - 1.0 / k)))
    return ratio if ratio > 1.0 + kernels.CHANCE_EXCESS / math.sqrt(k) else 1.0


def covariance_of(h: FloatArray) -> FloatArray | None:
    """Return the covariance (3, 3) of a solution with information `h`; None if that leaves a direction open."""
    scale = np.sqrt(np.diag(h))
    if not (scale > 0.0).all() or np.linalg.eigvalsh(h / np.outer(scale, scale))[0] < 1e-12:
        return None
    covariance = np.linalg.solve(h, np.eye(3))
    return np.asarray(0.5 * (covariance + covariance.T))


def worst_bound(
    covariance: FloatArray | None, influence: tuple[float, float], options: AlignmentOptions
) -> tuple[str, float]:
    """Return which bound an alignment keeps worst, one of `BOUNDS`, and its figure over the bound; above 1 is a miss.

    Args:
        covariance: (3, 3) [m, m, rad] of the motion; None if it leaves a direction open.
        influence: By how much leaving one match out moves the result at most [m, rad].
        options: The bounds of the motion.
    """
    if covariance is None:
        return "translation", math.inf
    position = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    figures = {
        "translation": position / options.max_sigma_position,
        "rotation": math.sqrt(covariance[2, 2]) / options.max_sigma_heading,
        "one match": max(influence[0] / (0.5 * DISTINCT_TRANSLATION), influence[1] / (0.5 * DISTINCT_ROTATION)),
    }
    name = max(figures, key=lambda bound: figures[bound])
    return name, figures[name]
