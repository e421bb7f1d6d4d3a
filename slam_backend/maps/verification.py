"""Verification of an alignment: chance, rivals, perceptual aliasing, mirror images, spread and uncertainty."""

import math

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import transform_points, wrap_angle
from slam_backend.maps.alignment_types import DISTINCT_ROTATION, DISTINCT_TRANSLATION, AlignmentOptions
from slam_backend.maps.descriptor_matching import similar_pairs
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.match_table import match_table, mirrored, planar_points, planar_variances
from slam_backend.maps.ransac import search
from slam_backend.maps.registration import CHANCE_EXCESS, MEDIAN_CHI2_3, refine, squared_distances

MOST_RECURRING = 0.2  # share of the shared landmarks, without the two that a motion can always fit
NEEDLESS = 0.05  # rate of false refusals by a chance repetition; a later attempt may succeed
MOST_LANDMARKS = 200  # landmarks of a constellation to test, evenly subsampled
MAX_SIMILAR_LANDMARKS = 50  # landmarks with more similar ones carry no information
SAMPLES = 4000  # number of minimal samples
STRONGEST = 3  # number of refined motions


def has_perceptual_alias(landmarks: LandmarkMap, rows: IntArray, variance: float, options: AlignmentOptions) -> bool:
    """Return whether a constellation of landmarks occurs a second time in its map (perceptual aliasing).

    It does if some motion takes a fifth of its landmarks to similar landmarks, and as many would match by chance, with
    as many similar landmarks spread over the map, in less than one of twenty maps.

    Args:
        landmarks: Map to search.
        rows: (k,) int64. Rows of the constellation.
        variance: Scale of the differences between the two maps [m^2].
        options: Gates of descriptors and positions.
    """
    points, variance = landmarks.means, max(variance, options.position_floor**2)
    rows = rows[:: 1 + len(rows) // MOST_LANDMARKS]
    looks = landmarks.descriptors
    from scipy.special import bdtrc  # slow to import, and not always needed

    pairs = similar_pairs(looks[rows], looks, options.descriptor_gate, MAX_SIMILAR_LANDMARKS)
    matches = np.column_stack([rows[pairs[:, 0]], pairs[:, 1]])
    apart = points[matches[:, 0]] - points[matches[:, 1]]
    climb = landmarks.covariances[matches, 2, 2].sum(axis=1) + variance
    level = apart[:, 2] ** 2 <= options.position_gate * climb
    matches = matches[level & (np.hypot(apart[:, 0], apart[:, 1]) > DISTINCT_TRANSLATION)]
    beyond = max(3, math.ceil(MOST_RECURRING * (len(rows) - 2)))
    if len(np.unique(matches[:, 0])) < beyond + 2:
        return False
    table = match_table(landmarks, landmarks, matches[:, ::-1])  # motions take the constellation b to its repetition
    count = len(matches) * (len(matches) - 1) // 2
    samples = np.random.default_rng(0).integers(0, count, min(SAMPLES, count))
    found = search(
        table, samples, variance, options.position_gate, 0.25 * options.min_spread, beyond + 2, options.max_ratio,
        math.log(1.0 - options.success_probability),
    )  # fmt: skip
    found = found[are_distinct(found[:, :3], np.zeros(3), points[rows, :2].mean(axis=0))]
    chance = _chance(table, landmarks, matches, len(rows), variance, options)
    for start in found[np.argsort(-found[:, 3], kind="stable")[:STRONGEST], :3]:
        pose = refine(table, start, variance, options.position_gate)[0]
        more = np.count_nonzero(inlier_mask(table, matches, pose, variance, options.position_gate)) - 2
        if more >= beyond and count * bdtrc(more - 1, len(rows) - 2, chance) <= NEEDLESS:
            return True
    return False


def _chance(
    table: FloatArray, landmarks: LandmarkMap, matches: IntArray, size: int, variance: float, options: AlignmentOptions
) -> float:
    """Return the mean probability that a motion takes a landmark near a similar one by chance."""
    spread = planar_variances(table) + variance
    area = np.prod(np.ptp(landmarks.means[:, :2], axis=0))
    share = np.minimum(np.pi * options.position_gate * spread / max(area, 1e-9), 1.0)
    owners = np.unique(matches[:, 0], return_inverse=True)[1]
    return float((1.0 - np.exp(-np.bincount(owners, share))).sum() / size)


RIVALS = 5  # number of refined rivals, most promising first
FALSE_ALARMS = 1e-3  # expected number of equally good sets of similar landmarks by chance
# The mirror image is accepted if it fits at least `MIRRORED` more matches, and these are a tenth of the number of
# inliers, or three tenths of the matches that are no inliers.
MIRRORED, OF_INLIERS, OF_REST = 3, 0.1, 0.3


def one_to_one(matches: IntArray) -> bool:
    """Return whether no landmark appears twice in matches (k, 2)."""
    return all(len(set(rows)) == len(rows) for rows in matches.T.tolist())


def inlier_mask(table: FloatArray, matches: IntArray, pose: FloatArray, floor: float, gate: float) -> BoolArray:
    """Return the mask (k,) of candidates within the gate under `pose`, made one-to-one greedily by distance."""
    distances = squared_distances(table, pose, floor)
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
    """Return whether chance alone explains the number of inliers, given the number of similar landmarks.

    Null hypothesis: all pairs are wrong. A similar landmark is then any landmark of map a, and fits if it is near by
    chance; without appearance, a landmark of b lies anywhere in the area of map a, and fits if any landmark is near.
    The probability of at least the observed number of inliers, not counting the two that a motion can always fit, times
    the number of pairs that define a motion, is the expected number of false alarms (Moisan and Stival 2004). The scale
    of the test is the fitted `variance` between the maps. If candidates are one-to-one by appearance, `min_inliers`
    alone decides.
    """
    if one_to_one(matches):
        return False
    from scipy.spatial import KDTree
    from scipy.special import bdtrc

    inside = inlier_mask(table, matches, pose, variance, options.position_gate)
    spread = planar_variances(table) + variance
    reach = np.sqrt(options.position_gate * spread)
    if options.appearance:
        moved = transform_points(pose, planar_points(table)[1])
        near = KDTree(map_a.means[:, :2]).query_ball_point(moved, reach, return_length=True)
        fitted = np.isin(matches[:, 1], matches[inside, 1])  # one of the near landmarks is the inlier itself
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
    """Return the support of the best distinct hypothesis, after refinement, relative to `pose`: `Alignment.ratio`."""
    floor, gate = options.position_floor**2, options.position_gate

    ours = inlier_mask(table, matches, pose, variance, gate)
    others = hypotheses[are_distinct(hypotheses[:, :3], pose, centre_b), :3]
    promise = (squared_distances(table[~ours], others, floor) <= gate).sum(axis=1)
    strongest = 0.0
    for i in np.argsort(-promise, kind="stable")[:RIVALS]:
        refined = refine(table, others[i], floor, gate)[0]
        if are_distinct(refined[None], pose, centre_b)[0]:
            theirs = inlier_mask(table, matches, refined, variance, gate)
            exclusive = max(float(np.count_nonzero(ours & ~theirs)), 0.5 * float(np.count_nonzero(ours)), 1.0)
            strongest = max(strongest, float(np.count_nonzero(theirs & ~ours)) / exclusive)
    return strongest


def is_mirrored(
    table: FloatArray, matches: IntArray, pose: FloatArray, inside: BoolArray, options: AlignmentOptions
) -> bool:
    """Return whether the mirror image about the main axis of the inliers fits clearly more matches.

    One wall of a mirrored corridor also fits a motion; the other landmarks then fit the mirror image.
    """
    points = planar_points(table)[1][inside]
    centre = points.mean(axis=0)
    axis = np.linalg.eigh((points - centre).T @ (points - centre))[1][:, -1]
    image = mirrored(table, centre, axis)
    fits = inlier_mask(image, matches, pose, options.position_floor**2, options.position_gate)
    more = np.count_nonzero(fits & ~inside) - np.count_nonzero(inside & ~fits)
    share = min(OF_INLIERS * np.count_nonzero(inside), OF_REST * np.count_nonzero(~inside))
    return bool(more >= max(MIRRORED, share))


def are_distinct(poses: FloatArray, pose: FloatArray, centre_b: FloatArray) -> BoolArray:
    """Return the mask of `poses` (h, 3) that move the point `centre_b` (2,) or rotate differently than `pose`."""
    cos, sin = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    here = transform_points(pose, centre_b)
    x = poses[:, 0] + cos * centre_b[0] - sin * centre_b[1] - here[0]
    y = poses[:, 1] + sin * centre_b[0] + cos * centre_b[1] - here[1]
    turned = np.abs(wrap_angle(poses[:, 2] - pose[2]))
    return np.asarray((np.hypot(x, y) > DISTINCT_TRANSLATION) | (turned > DISTINCT_ROTATION))


def principal_extent(points: FloatArray) -> float:
    """Return the extent [m] of points (k, 2) [m] along their main axis."""
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
    median = np.median(squared_distances(table[members], pose, floor))
    ratio = float(median / (MEDIAN_CHI2_3 * (1.0 - 1.0 / k)))
    return ratio if ratio > 1.0 + CHANCE_EXCESS / math.sqrt(k) else 1.0


def covariance_of(h: FloatArray) -> FloatArray | None:
    """Return the covariance (3, 3) of a solution with information `h`; None if `h` is singular."""
    scale = np.sqrt(np.diag(h))
    if not (scale > 0.0).all() or np.linalg.eigvalsh(h / np.outer(scale, scale))[0] < 1e-12:
        return None
    covariance = np.linalg.solve(h, np.eye(3))
    return np.asarray(0.5 * (covariance + covariance.T))


def worst_bound(
    covariance: FloatArray | None, influence: tuple[float, float], options: AlignmentOptions
) -> tuple[str, float]:
    """Return the bound with the largest value over limit, one of `BOUNDS`, and this ratio; above 1 it is missed.

    Args:
        covariance: (3, 3) [m, m, rad] of the motion; None if the information is singular.
        influence: Largest change of the result by leaving one match out [m, rad].
        options: Limits of the motion's uncertainty.
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
