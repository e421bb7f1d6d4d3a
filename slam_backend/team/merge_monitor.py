"""Consistency check of a merge, and the snapshots that undo it.

A false merge hardly shows in the innovations of single measurements: descriptors distinguish landmarks, so that a robot
keeps matching its own, and a filter that must make two maps agree deforms both. Two tests are used.

*Shape.* Each side's map from before the merge is aligned with the present joint map by the rigid motion that most
landmarks agree on, and each landmark's innovation d^2 = r^T S^-1 r is compared with its chi-square gate (99 %; S is the
sum of both covariances and the noise floor of alignments). Information from the other side moves a landmark only within
its own uncertainty, so that hardly any lie beyond the gate; in maps deformed to agree, many do.

*Place.* The landmarks that only one side found are aligned with those of the other, by the test that every merge has to
pass. If another motion fits them, 0.5 m or 5 degrees from the present one, the merge was false, unless the pairs of
similar landmarks that it joined outnumber `max_ratio` times the inliers of the new motion. Thus a robot that gets lost
after a correct merge, and maps landmarks twice, does not undo it.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slam_backend.core.read_only import with_constants, with_read_only
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.reports import StepReport
from slam_backend.geometry import transform_points
from slam_backend.maps import _kernels as kernels
from slam_backend.maps.alignment import (
    DISTINCT_ROTATION,
    DISTINCT_TRANSLATION,
    Alignment,
    AlignmentOptions,
    align_candidates,
)
from slam_backend.maps.correspondences import candidates, has_enough_candidates, match_table, too_many
from slam_backend.maps.landmark_map import LandmarkMap, unchecked_map
from slam_backend.maps.near_pairs import Appearance, NearPairs, near_pairs
from slam_backend.team.options import MergeOptions


@dataclass(frozen=True, slots=True, eq=False)
class PreMergeSnapshot:
    """State of one group just before a merge; its arrays are read-only.

    Attributes:
        trunk: State of its joint filter's branch, with the monitors of earlier merges.
        oldest: First step that an undo of the merge, or of earlier ones, would replay.
    """

    trunk: Mapping[str, Any]
    oldest: int

    @classmethod
    def of(cls, trunk: Mapping[str, Any]) -> "PreMergeSnapshot":
        """Return the snapshot of a trunk's state, whose arrays are not to be changed afterwards."""
        earlier = [side.oldest for monitor in trunk["monitors"] for side in monitor.sides]
        return cls(with_read_only(trunk), min([1 + min(trunk["last_steps"].values()), *earlier]))

    def __post_init__(self) -> None:
        object.__setattr__(self, "trunk", with_constants(self.trunk))

    def __reduce__(self) -> tuple[Any, ...]:
        """Make copies and unpickled objects read-only, too."""
        return PreMergeSnapshot, (self.trunk, self.oldest)

    @property
    def robots(self) -> tuple[int, ...]:
        """Robots of the group."""
        robots: tuple[int, ...] = self.trunk["robots"]
        return robots

    @property
    def monitors(self) -> tuple["MergeMonitor", ...]:
        """Monitors of earlier merges in the group, as they were."""
        monitors: tuple[MergeMonitor, ...] = self.trunk["monitors"]
        return monitors


@dataclass(slots=True, eq=False)
class MergeMonitor:
    """Evidence about one merge. Landmarks have their names in the joint map.

    Attributes:
        number: First number of the joint map; it names the merge.
        alignment: Alignment by which the sides were merged.
        sides: Snapshots of the two groups before the merge.
        pre_merge_maps: Each side's map just before the merge, in its own frame, with mixture covariances.
        exclusive_landmarks: Landmarks found by each side alone, before the merge or since, without those that the merge
            fused.
        steps: Number of steps since the merge with robots of both sides in contact.
    """

    number: int
    alignment: Alignment
    sides: tuple[PreMergeSnapshot, PreMergeSnapshot]
    pre_merge_maps: tuple[LandmarkMap, LandmarkMap]
    exclusive_landmarks: tuple[set[int], set[int]]
    steps: int = field(default=0)
    # Pairs of landmarks with near descriptors in the last check; not part of a state.
    _near: NearPairs | None = field(default=None, init=False, repr=False)

    def copy(self, new_ids: Mapping[int, int] | None = None) -> "MergeMonitor":
        """Return an independent monitor, with landmarks renamed if needed; constant parts are shared."""
        before, exclusive = self.pre_merge_maps, (set(self.exclusive_landmarks[0]), set(self.exclusive_landmarks[1]))
        if new_ids is not None:
            before = (renamed_map(before[0], new_ids), renamed_map(before[1], new_ids))
            one, other = exclusive
            exclusive = ({new_ids[i] for i in one if i in new_ids}, {new_ids[i] for i in other if i in new_ids})
        return MergeMonitor(self.number, self.alignment, self.sides, before, exclusive, self.steps)

    def update(self, robots: Sequence[int], report: StepReport) -> None:
        """Add the landmarks that each side found in a step of the joint filter of `robots`."""
        for robot, row in zip(robots, report.rows, strict=True):
            if row >= 0:
                self.exclusive_landmarks[robot not in self.sides[0].robots].update(
                    report.all_associations.created_ids(row)
                )

    def both_sides_connected(self, active_robots: Sequence[int]) -> bool:
        """Return whether robots of both sides are among the active robots of the joint filter."""
        here = set(active_robots)
        return not (here.isdisjoint(self.sides[0].robots) or here.isdisjoint(self.sides[1].robots))

    def is_inconsistent(self, joint: LandmarkMap, merging: MergeOptions, options: AlignmentOptions) -> bool:
        """Return whether the joint map, with mixture covariances, contradicts the merge in shape or place."""
        if any(deformed_fraction(old, joint, options) > merging.max_deformed for old in self.pre_merge_maps):
            return True
        ids = joint.ids.tolist()
        masks = [np.fromiter(map(found.__contains__, ids), np.bool_, len(ids)) for found in self.exclusive_landmarks]
        found = [Appearance(joint.ids[mask], joint.descriptors[mask]) for mask in masks]
        if min(len(side.ids) for side in found) < options.min_inliers:
            return False
        self._near = near_pairs(found[0], found[1], options, self._near)
        if not has_enough_candidates(found[0].descriptors, found[1].descriptors, options, self._near):
            return False
        parts = joint.subset(masks[0]), joint.subset(masks[1])
        if too_many(*parts, options):
            return False
        pairs = candidates(*parts, options, self._near)
        rival = align_candidates(*parts, pairs, "ransac", np.random.default_rng(0), options)
        if not rival.success or self._joined(options) > options.max_ratio * len(rival.inliers):
            return False
        return is_significant_motion(rival.transform, parts[1].means[rival.inliers[:, 1]])

    def _joined(self, options: AlignmentOptions) -> int:
        """Return how many pairs of similar landmarks the merge fused."""
        _, rows, others = np.intersect1d(self.pre_merge_maps[0].ids, self.pre_merge_maps[1].ids, return_indices=True)
        apart = np.linalg.norm(
            self.pre_merge_maps[0].descriptors[rows] - self.pre_merge_maps[1].descriptors[others], axis=1
        )
        alike = apart <= options.descriptor_gate
        return int(np.count_nonzero(alike)) if options.appearance else len(rows)


def deformed_fraction(old: LandmarkMap, joint: LandmarkMap, options: AlignmentOptions) -> float:
    """Return the share of a map's landmarks that have moved relative to each other.

    Args:
        old: The map before, in any planar frame.
        joint: The joint map; landmarks are matched by their ids.
        options: `position_gate` and `position_floor` of the innovations, and `min_inliers`: with fewer landmarks in
            both maps the share is 0.

    Returns:
        Share in [0, 1] of the landmarks in both maps that lie beyond the gate at the rigid motion on which most agree.
    """
    rows = np.column_stack(np.intersect1d(joint.ids, old.ids, return_indices=True)[1:])
    if len(rows) < options.min_inliers:
        return 0.0
    table = match_table(joint, old, rows)
    return kernels.moved_away(table, options.position_floor**2, options.position_gate) / len(rows)


def is_significant_motion(motion: FloatArray, points: FloatArray) -> bool:
    """Return whether a motion (3,) moves points (n, 3), on average, by 0.5 m, or turns them by 5 degrees."""
    moved: FloatArray = transform_points(motion, points) - points
    return bool(np.hypot(*moved.mean(axis=0)[:2]) > DISTINCT_TRANSLATION or abs(motion[2]) > DISTINCT_ROTATION)


def renamed_map(landmarks: LandmarkMap, new_ids: Mapping[int, int]) -> LandmarkMap:
    """Return the landmarks that have new ids, under these ids."""
    names = np.array([new_ids.get(name, -1) for name in landmarks.ids.tolist()], dtype=np.int64)
    kept = landmarks.subset(names >= 0)
    return unchecked_map(kept.means, kept.covariances, kept.descriptors, kept.counts, names[names >= 0])


def begin_monitoring(
    number: int,
    alignment: Alignment,
    sides: tuple[PreMergeSnapshot, PreMergeSnapshot],
    before: tuple[LandmarkMap, LandmarkMap],
    renamed: IntArray,
    pairs: IntArray,
) -> MergeMonitor:
    """Return the monitor of a new merge.

    Args:
        number: Number of the joint map.
        alignment: Alignment by which the sides were merged.
        sides: Snapshots of the side whose ids stay and of the other.
        before: Maps of the sides with mixture covariances, under their own ids.
        renamed: (k, 2) int64 rows (id in b's map, id in the joint map).
        pairs: (j, 2) int64 rows (id in a, id in b) of the fused landmarks.
    """
    common = set(pairs[:, 0].tolist())
    exclusive = (set(before[0].ids.tolist()) - common, set(renamed[:, 1].tolist()) - common)
    maps = before[0], renamed_map(before[1], dict(renamed.tolist()))
    return MergeMonitor(number, alignment, sides, maps, exclusive)
