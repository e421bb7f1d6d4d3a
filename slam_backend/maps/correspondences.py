"""Candidate correspondences of two maps by descriptor, and their table for the alignment kernels."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray, argument_error
from slam_backend.maps import _kernels as kernels
from slam_backend.maps import near_pairs
from slam_backend.maps._kernels import descriptor_matching
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.near_pairs import NearPairs

MAX_PAIRS = 10_000  # candidates without appearance
ALL = 2**62  # as good as no limit to a number of pairs


def too_many(map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions) -> bool:
    """Return whether two maps have more than `MAX_PAIRS` pairs without appearance."""
    return not options.appearance and len(map_a) * len(map_b) > MAX_PAIRS


def candidates(
    map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions, near: NearPairs | None = None
) -> tuple[IntArray, BoolArray]:
    """Return the candidates (k, 2), and the mask (k,) of distinctive ones, which are one-to-one.

    With the near pairs of the two maps, descriptors are not compared again; the result is the same.
    """
    if map_a.descriptors.shape[1] != map_b.descriptors.shape[1]:
        raise argument_error(
            "map_b",
            f"descriptors of size {map_a.descriptors.shape[1]}, as in map_a",
            map_b.descriptors.shape[1],
            "Describe the landmarks of both maps with the same front end.",
        )
    if too_many(map_a, map_b, options):
        raise argument_error(
            "map_b", f"at most {MAX_PAIRS} pairs of landmarks without appearance", len(map_a) * len(map_b),
            "Give smaller maps, or use appearance.",
        )  # fmt: skip
    if near is not None:
        clear = near_pairs.mutual_pairs(near, options)
        for side, other in ((1, map_b), (0, map_a)):
            clear = clear[near_pairs.passes_ratio_test(near, clear, side, other.means, options)]
        alike = near_pairs.similar_pairs(near, options) if options.max_similar else clear[:0]
    elif options.appearance:
        clear = mutual_nearest(map_a.descriptors, map_b.descriptors, options.descriptor_gate)
        for one, other, here, there in ((map_a, map_b, 0, 1), (map_b, map_a, 1, 0)):
            descriptors, partners = one.descriptors[clear[:, here]], clear[:, there]
            limits = (options.same_place, options.descriptor_ratio)
            clear = clear[passes_ratio_test(descriptors, partners, other.descriptors, other.means, *limits)]
        alike = clear[:0]
        if options.max_similar:
            alike = similar_pairs(map_a.descriptors, map_b.descriptors, options.descriptor_gate, options.max_similar)
    else:
        clear, alike = np.empty((0, 2), np.int64), np.argwhere(np.ones((len(map_a), len(map_b)), np.bool_))
    codes = np.concatenate([clear, alike]) @ np.array([max(len(map_b), 1), 1])
    unique, first = np.unique(codes, return_index=True)
    matches = np.column_stack([unique // max(len(map_b), 1), unique % max(len(map_b), 1)])
    distinctive = first < len(clear)
    rows_a, rows_b = matches.T
    climb = map_a.means[rows_a, 2] - map_b.means[rows_b, 2]
    variance = map_a.covariances[rows_a, 2, 2] + map_b.covariances[rows_b, 2, 2] + options.position_floor**2
    level = climb**2 <= options.position_gate * variance
    return matches[level], distinctive[level]


def has_enough_candidates(
    descriptors_a: Float32Array, descriptors_b: Float32Array, options: AlignmentOptions, near: NearPairs | None = None
) -> bool:
    """Return whether two maps with descriptors (n, d), (m, d) may have enough candidates for an alignment.

    With appearance every candidate is a pair within the gate; with too few of them no maps need to be built. With the
    near pairs of the two maps, descriptors are not compared again.
    """
    if near is not None:
        gate = options.descriptor_gate * options.descriptor_gate
        return int(np.count_nonzero(near.squares.astype(np.float64) <= gate)) >= options.min_inliers
    if not options.appearance or descriptors_a.shape[1] != descriptors_b.shape[1]:
        return True
    least = options.min_inliers
    return count_similar(descriptors_a, descriptors_b, options.descriptor_gate, least) >= least


def match_table(map_a: LandmarkMap, map_b: LandmarkMap, matches: IntArray) -> FloatArray:
    """Return the table of matched landmarks for the alignment kernels.

    Args:
        map_a, map_b: Both maps.
        matches: (k, 2) int64 rows (row in a, row in b).

    Returns:
        (k, 18) float64, see `_kernels.match_table`.
    """
    a, b = matches.T
    return kernels.table_of(map_a.means[a], map_a.covariances[a], map_b.means[b], map_b.covariances[b])


Scalar = TypeVar("Scalar", bound=np.generic)


def similar_pairs(a: Float32Array, b: Float32Array, gate: float, most: int) -> IntArray:
    """Pair all descriptors within `gate`, except those with more than `most` partners.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].
        most: Maximum number of partners of a descriptor.

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a, then in b; k <= n `most`.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    return descriptor_matching.alike(_fresh(a), _fresh(b.T), gate * gate, most, ALL)[0]


def count_similar(a: Float32Array, b: Float32Array, gate: float, enough: int = ALL) -> int:
    """Return the number of pairs of descriptors (n, d) and (m, d) within `gate`, or some number >= `enough`."""
    return descriptor_matching.alike(_fresh(a), _fresh(b.T), gate * gate, 0, enough)[1] if len(a) and len(b) else 0


def mutual_nearest(a: Float32Array, b: Float32Array, gate: float) -> IntArray:
    """Pair descriptors that are mutual nearest neighbours within `gate`.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a; no index appears twice.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    return descriptor_matching.mutual_pairs(_fresh(a), _fresh(b.T), gate * gate)


def passes_ratio_test(
    descriptors: Float32Array,
    partners: IntArray,
    others: Float32Array,
    positions: FloatArray,
    same_place: float,
    ratio: float,
) -> BoolArray:
    """Return the mask of matches that pass the ratio test against landmarks at other places.

    Args:
        descriptors: (k, d) float32 [-]. Descriptors of the matched landmarks in one map.
        partners: (k,) int64. Matched rows in the other map.
        others: (m, d) float32 [-]. All descriptors of the other map.
        positions: (m, 3) float64 [m]. All positions in the other map.
        same_place: Distance [m] from the partner within which landmarks may be duplicates and do not compete.
        ratio: Largest distance of a match over that of the best competitor [-].

    Returns:
        Mask (k,) of the matches that pass; a match without competitors passes.
    """
    arrays = _fresh(descriptors), _fresh(partners), _fresh(others.T), _fresh(positions)
    return descriptor_matching.ratio_test_mask(*arrays, same_place, ratio)


def _fresh(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a writable C-ordered copy, because numba compiles a kernel for each array layout."""
    return np.array(array, order="C")
