"""Alignment: the motion between two maps of unknown relative frame, or a refusal with its reason (Sec. 3.1)."""

import math

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error, check_choice
from slam_backend.maps import initial_estimates as proposals
from slam_backend.maps.alignment_types import (
    DISTINCT_ROTATION,
    DISTINCT_TRANSLATION,
    REASONS,
    Alignment,
    AlignmentOptions,
    Reason,
)
from slam_backend.maps.correspondences import candidates, too_many
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.match_table import match_table, planar_points
from slam_backend.maps.ransac import search
from slam_backend.maps.registration import information, largest_influence, refine
from slam_backend.maps.verification import (
    covariance_of,
    has_perceptual_alias,
    inlier_mask,
    is_chance_alignment,
    is_mirrored,
    one_to_one,
    principal_extent,
    runner_up_ratio,
    unexplained,
    worst_bound,
)
from slam_backend.metrics import align_se2

__all__ = [
    "DISTINCT_ROTATION",
    "DISTINCT_TRANSLATION",
    "METHODS",
    "REASONS",
    "Alignment",
    "AlignmentOptions",
    "Reason",
    "align_maps",
    "candidate_matches",
    "propose_motion",
]  # fmt: skip

METHODS = ("ransac", "svd", "icp", "impicp")
REMOVED = ("gnc", "clique")  # methods of version 0.3


def candidate_matches(map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions) -> IntArray:
    """Return candidate matches of landmarks by appearance, whatever their positions in the plane.

    Distinctive candidates are mutual nearest neighbours within the descriptor gate that pass the ratio test in both
    maps. Further candidates are all pairs within the gate of landmarks with few similar ones; geometry decides between
    them later. Heights agree, because planar robots with one camera height share z (Sec. 3.1). Without appearance all
    pairs with equal heights are candidates.

    Args:
        map_a: First map.
        map_b: Second map, in any other planar frame.
        options: Gates.

    Returns:
        (k, 2) int64 rows (index in map_a, index in map_b), by rising index in map_a, then in map_b. One-to-one if all
        landmarks have different descriptors.

    Raises:
        ValueError: If the maps' descriptors differ in size, or there are too many pairs to try without appearance.
    """
    return candidates(map_a, map_b, options)[0]


def align_maps(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    method: str = "ransac",
    rng: np.random.Generator | None = None,
    options: AlignmentOptions | None = None,
) -> Alignment:
    """Estimate the planar motion between two maps from similar landmarks; refuse uncertain results.

    Methods differ in the initial estimate (`propose_motion`). The following stages are common to all: selection of
    inliers by a Mahalanobis gate, heights included, alternates with weighted Gauss-Newton until convergence to the
    maximum of the likelihood; then covariance, best distinct alignment, and refusals.

    Args:
        map_a: Map in the target frame a.
        map_b: Map in frame b.
        method: `"ransac"`: search over pairs of candidate matches, each hypothesis locally optimised. `"svd"`: closed
            form over all candidates. `"icp"`: pairs of closest landmarks, starting from `"svd"`. `"impicp"`: ICP from
            two starts. `initial_estimates` names the sources; `docs/explanation/merging.md` compares the methods.
        rng: Generator of the search order; None: a fixed order. The same generator state gives the same result.
        options: Gates and refusal limits; None: the defaults.

    Returns:
        The alignment, or a refusal with its reason.

    Raises:
        ValueError: If the method is unknown, the maps' descriptors differ in size or `rng` is not a generator.
    """
    options, rng = _checked(map_a, map_b, method, rng, options)
    if too_many(map_a, map_b, options):
        return Alignment.refused("too many candidates")
    matches, distinctive = candidates(map_a, map_b, options)
    if len(matches) < options.min_inliers:
        return Alignment.refused("too few candidates")
    table = match_table(map_a, map_b, matches)
    floor, gate = options.position_floor**2, options.position_gate
    hypotheses = _search(table, rng, options)
    start = _propose(method, map_a, map_b, matches, distinctive, table, hypotheses, options)
    if start is None:
        return Alignment.refused("too few inliers")
    pose, members, variance = refine(table, start, floor, gate)
    inside = inlier_mask(table, matches, pose, floor, gate)
    if not one_to_one(matches):  # of several matches of one landmark, only the closest is used
        members = np.zeros(len(matches), np.bool_)
        pose, members[inside], variance = refine(table[inside], pose, floor, gate)
        inside = inlier_mask(table, matches, pose, floor, gate)
    inliers = matches[inside]
    if len(inliers) < options.min_inliers or is_chance_alignment(table, map_a, matches, pose, variance, options):
        return Alignment.refused("too few inliers")
    points_b = map_b.means[inliers[:, 1], :2]
    ratio = runner_up_ratio(table, matches, hypotheses, pose, variance, points_b.mean(axis=0), options)
    if ratio > options.max_ratio:
        return Alignment.refused("ambiguous", ratio)
    if options.appearance and any(
        has_perceptual_alias(landmarks, rows, variance, options)
        for landmarks, rows in zip((map_a, map_b), inliers.T, strict=True)
    ):
        return Alignment.refused("ambiguous", ratio)
    if is_mirrored(table, matches, pose, inside, options):
        return Alignment.refused("mirrored", ratio)
    if principal_extent(points_b) < options.min_spread:
        return Alignment.refused("poorly spread", ratio)
    contradiction = unexplained(table, members, pose, variance)
    covariance = covariance_of(information(table, members, pose, variance)[0] / contradiction)
    influence = largest_influence(table, members, pose, variance)
    missed, excess = worst_bound(covariance, influence, options)
    if covariance is None or not excess <= 1.0:
        return Alignment.refused("too uncertain", ratio, missed, excess)
    return Alignment(True, "", pose[0], pose[1], pose[2], covariance, inliers, ratio)


def propose_motion(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    method: str,
    rng: np.random.Generator | None = None,
    options: AlignmentOptions | None = None,
) -> FloatArray | None:
    """Return a method's initial estimate of the motion, without refinement and refusals, as compared in the paper.

    Args:
        map_a: Map in the target frame a.
        map_b: Map in frame b.
        method: One of `METHODS`, see `align_maps`.
        rng: Generator of the search order, see `align_maps`.
        options: Gates of candidates; None: the defaults.

    Returns:
        (3,) a_from_b [m, m, rad]; None if there are too few candidates.

    Raises:
        ValueError: As `align_maps`.
    """
    options, rng = _checked(map_a, map_b, method, rng, options)
    matches, distinctive = candidates(map_a, map_b, options)
    if len(matches) < 2:
        return None
    table = match_table(map_a, map_b, matches)
    hypotheses = _search(table, rng, options) if method == "ransac" else np.empty((0, 5))
    return _propose(method, map_a, map_b, matches, distinctive, table, hypotheses, options)


def _checked(
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    method: str,
    rng: np.random.Generator | None,
    options: AlignmentOptions | None,
) -> tuple[AlignmentOptions, np.random.Generator]:
    """Return options and generator, or raise if an argument has the wrong type."""
    hint = "ransac replaces it: it is right wherever that was." if method in REMOVED else "Choose one of these names."
    check_choice("method", method, METHODS, hint)
    options = AlignmentOptions() if options is None else options
    for name, value, kind in (
        ("map_a", map_a, LandmarkMap), ("map_b", map_b, LandmarkMap), ("options", options, AlignmentOptions)
    ):  # fmt: skip
        if not isinstance(value, kind):
            raise argument_error(name, f"a {kind.__name__}", value, f"Build one: {kind.__name__}(...).")
    rng = np.random.default_rng(0) if rng is None else rng
    if not isinstance(rng, np.random.Generator):
        raise argument_error("rng", "a numpy.random.Generator or None", rng, "Give np.random.default_rng(seed).")
    return options, rng


def _propose(
    method: str,
    map_a: LandmarkMap,
    map_b: LandmarkMap,
    matches: IntArray,
    distinctive: BoolArray,
    table: FloatArray,
    hypotheses: FloatArray,
    options: AlignmentOptions,
) -> FloatArray | None:
    """Return a method's initial estimate of the motion (3,); None if it finds none.

    Methods that cannot choose between similar landmarks use the distinctive candidates, if there are enough.
    """
    floor, gate = options.position_floor**2, options.position_gate
    if method != "ransac" and np.count_nonzero(distinctive) >= options.min_inliers:
        matches, table = matches[distinctive], table[distinctive]
    if method == "ransac":
        return hypotheses[hypotheses[:, 4].argmax(), :3].copy() if len(hypotheses) else None
    if method == "impicp":
        return proposals.improved_icp(map_a, map_b, matches, table, floor, gate)
    fit = align_se2(*planar_points(table))
    return fit if method == "svd" else proposals.icp(map_a, map_b, fit)


def _search(table: FloatArray, rng: np.random.Generator, options: AlignmentOptions) -> FloatArray:
    """Return the hypotheses (h, 5) of a random search over pairs of candidates, or of all pairs if there are few."""
    pairs = len(table) * (len(table) - 1) // 2
    few = pairs <= options.max_samples
    samples = rng.permutation(pairs) if few else rng.integers(0, pairs, options.max_samples)
    return search(
        table,
        samples,
        options.position_floor**2,
        options.position_gate,
        0.5 * options.min_spread,  # closer pairs hardly constrain the rotation
        options.min_inliers,
        options.max_ratio,
        math.log(1.0 - options.success_probability),
    )
