"""Candidate correspondences of two maps."""

import numpy as np

from slam_backend.core.validation import BoolArray, Float32Array, IntArray, argument_error
from slam_backend.maps import descriptor_matching as matching
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap

MAX_PAIRS = 10_000  # candidates without appearance


def too_many(map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions) -> bool:
    """Return whether two maps have more than `MAX_PAIRS` pairs without appearance."""
    return not options.appearance and len(map_a) * len(map_b) > MAX_PAIRS


def candidates(map_a: LandmarkMap, map_b: LandmarkMap, options: AlignmentOptions) -> tuple[IntArray, BoolArray]:
    """Return the candidates (k, 2), and the mask (k,) of distinctive ones, which are one-to-one."""
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
    if options.appearance:
        clear = matching.mutual_nearest(map_a.descriptors, map_b.descriptors, options.descriptor_gate)
        for one, other, here, there in ((map_a, map_b, 0, 1), (map_b, map_a, 1, 0)):
            descriptors, partners = one.descriptors[clear[:, here]], clear[:, there]
            limits = options.same_place, options.descriptor_ratio
            clear = clear[matching.passes_ratio_test(descriptors, partners, other.descriptors, other.means, *limits)]
        looks = map_a.descriptors, map_b.descriptors
        alike = matching.similar_pairs(*looks, options.descriptor_gate, options.max_similar)
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


def has_enough_candidates(descriptors_a: Float32Array, descriptors_b: Float32Array, options: AlignmentOptions) -> bool:
    """Return whether two maps with descriptors (n, d), (m, d) may have enough candidates for an alignment.

    With appearance every candidate is a pair within the gate; with too few of them no maps need to be built.
    """
    if not options.appearance or descriptors_a.shape[1] != descriptors_b.shape[1]:
        return True
    return matching.count_similar(descriptors_a, descriptors_b, options.descriptor_gate) >= options.min_inliers
