"""Landmarks that one map holds twice: found by place and appearance, and fused (Eqs. 13-15)."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from slam_backend.errors import (
    BoolArray,
    FloatArray,
    IntArray,
    bad_argument,
    check_array,
    check_float,
    check_kind,
    known_names,
)
from slam_backend.fusion import fuse_descriptors, fuse_landmarks
from slam_backend.landmark_map import LandmarkMap


@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class DuplicateOptions:
    """When two landmarks of one map are taken for the same one.

    Attributes:
        descriptor_gate: Largest L2 distance of their descriptors [-].
        position_gate: Largest squared Mahalanobis distance under the sum of their covariances [-].
        position_floor: Standard deviation added to it, because filters' maps are over-confident [m].
        same_place: Largest distance, however uncertain they are [m].
    """

    descriptor_gate: float = 0.45
    position_gate: float = 11.34
    position_floor: float = 0.05
    same_place: float = 1.0

    def __post_init__(self) -> None:
        for name in ("descriptor_gate", "position_gate", "same_place"):
            check_float(f"options.{name}", getattr(self, name), "Give a positive number.", above=0.0)
        check_float("options.position_floor", self.position_floor, "Give a distance in metres.", at_least=0.0)


def find_duplicates(landmarks: LandmarkMap, options: DuplicateOptions | None = None) -> IntArray:
    """Find landmarks that look alike and lie, within their uncertainty, at one place.

    The landmark made of most measurements keeps its place; what lies around it is its duplicate. So duplicates never
    form chains, in which the last is far from the first.

    Args:
        landmarks: The map.
        options: Gates; None: the defaults.

    Returns:
        (k, 2) int64 rows (kept, duplicate), by rising duplicate. No duplicate is kept or appears twice.
    """
    options = DuplicateOptions() if options is None else check_kind("options", options, DuplicateOptions)
    check_kind("landmarks", landmarks, LandmarkMap)
    if len(landmarks) < 2:
        return np.empty((0, 2), np.int64)
    near = KDTree(landmarks.means).query_pairs(options.same_place, output_type="ndarray").astype(np.int64)
    alike = near[_same(landmarks, near[:, 0], near[:, 1], options)]
    friends: dict[int, list[int]] = {}
    for one, two in alike.tolist():
        friends.setdefault(one, []).append(two)
        friends.setdefault(two, []).append(one)
    keeper: dict[int, int] = {}
    kept: set[int] = set()
    for row in sorted(friends, key=lambda r: (-int(landmarks.counts[r]), r)):
        if row not in keeper:
            kept.add(row)
            for other in friends[row]:
                if other not in keeper and other not in kept:
                    keeper[other] = row
    pairs = [[keeper[row], row] for row in sorted(keeper)]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def fuse_duplicates(landmarks: LandmarkMap, pairs: Any, independent: bool = True) -> LandmarkMap:
    """Fuse duplicates into the landmarks that are kept.

    Args:
        landmarks: The map.
        pairs: (k, 2) rows (kept, duplicate), as `find_duplicates` gives them.
        independent: Whether the errors of two landmarks are, as given the path they are (`FastSlam.map("best")`): then
            Eqs. 13-15 hold. False, for maps whose covariances hold a common uncertainty of the path ("mixture"):
            covariance intersection (Julier and Uhlmann 1997), which claims no more than either estimate proves.

    Returns:
        A new map without the duplicates, the others in their order, with their ids; counts are added, descriptors
        averaged by them.

    Raises:
        ValueError: If a row does not exist, a duplicate appears twice, or a kept one is a duplicate, too.
    """
    check_kind("landmarks", landmarks, LandmarkMap)
    rows = check_array("pairs", pairs, (None, 2), "Give rows (kept, duplicate).", dtype=np.int64)
    _check(rows, len(landmarks))
    means, covariances = landmarks.means.copy(), landmarks.covariances.copy()
    descriptors, counts = landmarks.descriptors.copy(), landmarks.counts.copy()
    for one, two in rows.tolist():
        first, second = covariances[one], covariances[two]
        if not independent:
            share = np.trace(second) / max(np.trace(first) + np.trace(second), 1e-300)
            first, second = first / max(share, 1e-9), second / max(1.0 - share, 1e-9)
        means[one], covariances[one] = fuse_landmarks(means[one], first, means[two], second)
        descriptors[one] = fuse_descriptors(descriptors[one], counts[one], descriptors[two], counts[two])
        counts[one] += counts[two]
    rest = np.setdiff1d(np.arange(len(landmarks)), rows[:, 1])
    whole = replace(landmarks, means=means, covariances=covariances, descriptors=descriptors, counts=counts)
    return whole.subset(rest)


def _same(landmarks: LandmarkMap, one: IntArray, two: IntArray, options: DuplicateOptions) -> BoolArray:
    """Tell which pairs of rows (k,) look alike and agree in place."""
    unlike = np.linalg.norm(landmarks.descriptors[one] - landmarks.descriptors[two], axis=1)
    apart = landmarks.means[one] - landmarks.means[two]
    covariance: FloatArray = landmarks.covariances[one] + landmarks.covariances[two]
    covariance = covariance + max(options.position_floor**2, 1e-12) * np.eye(3)
    distances = np.einsum("ki,ki->k", apart, np.linalg.solve(covariance, apart[..., None])[..., 0])
    return np.asarray((unlike <= options.descriptor_gate) & (distances <= options.position_gate))


def _check(rows: IntArray, size: int) -> None:
    """Raise unless rows (kept, duplicate) exist, no duplicate repeats and none is kept."""
    cure = "Take them from find_duplicates of this very map."
    if rows.size and (rows.min() < 0 or rows.max() >= size):
        raise bad_argument("pairs", f"rows from 0 to {size - 1}", "a row outside", cure)
    if len(np.unique(rows[:, 1])) < len(rows) or np.isin(rows[:, 0], rows[:, 1]).any():
        raise bad_argument("pairs", "each duplicate once, and none of them kept", "a row that repeats", cure)
