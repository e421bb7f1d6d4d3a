"""`MergeMonitor`: after a merge the team gathers evidence of whether it was right, and keeps what it takes to undo it.

A false merge hardly shows in the innovations of single measurements: descriptors tell landmarks apart, so that a robot
goes on matching its own, and a filter that has to make two maps agree bends both. So two things are watched.

*Shape.* Either side's map from before the merge is laid over the joint map as it is now, by the rigid motion that most
landmarks agree on, and each landmark's innovation d^2 = r^T S^-1 r is held against its chi-square gate (99 %; S is
the sum of both covariances and the floor that alignments have). What the other side knew can only move a landmark
within its own uncertainty, so that beyond the gate lies next to nothing; where maps are bent to agree, much does.

*Place.* Landmarks that either side found for itself are aligned with each other, by the test that every merge has to
pass. If they are seen to fit by another motion than the one in force (0.5 m or 5 degrees off), the merge was wrong,
unless it rests on more: for that test the pairs of landmarks alike that it joined are a rival, and may be no more than
`max_ratio` of those that fit now. So a robot that is lost after a right merge, and maps landmarks a second time, does
not undo it.
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
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, Alignment, AlignmentOptions, align_maps
from slam_backend.maps.correspondences import has_enough_candidates, match_table
from slam_backend.maps.landmark_map import LandmarkMap, unchecked_map
from slam_backend.team.options import MergeOptions


@dataclass(frozen=True, slots=True, eq=False)
class PreMergeSnapshot:
    """One group as it was just before a merge; its arrays are read-only.

    Attributes:
        trunk: State of its joint filter's branch, the watches of earlier merges among it.
        oldest: The first step that an undo of the merge, or of earlier ones, would take in.
    """

    trunk: Mapping[str, Any]
    oldest: int

    @classmethod
    def of(cls, trunk: Mapping[str, Any]) -> "PreMergeSnapshot":
        """Return a side with this trunk, whose arrays nobody is to write to afterwards."""
        earlier = [side.oldest for watch in trunk["monitors"] for side in watch.sides]
        return cls(with_read_only(trunk), min([1 + min(trunk["last_steps"].values()), *earlier]))

    def __post_init__(self) -> None:
        object.__setattr__(self, "trunk", with_constants(self.trunk))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let copies and what was pickled be read-only, too."""
        return PreMergeSnapshot, (self.trunk, self.oldest)

    @property
    def robots(self) -> tuple[int, ...]:
        """Of the group."""
        robots: tuple[int, ...] = self.trunk["robots"]
        return robots

    @property
    def watches(self) -> tuple["MergeMonitor", ...]:
        """Of earlier merges in it, as they stood."""
        watches: tuple[MergeMonitor, ...] = self.trunk["monitors"]
        return watches


@dataclass(slots=True, eq=False)
class MergeMonitor:
    """The evidence about one merge. Landmarks bear their names in the joint map.

    Attributes:
        number: Of the joint map when it was made; it names the merge.
        alignment: By which the sides were merged.
        sides: As they were before.
        pre_merge_maps: Each side's map just before the merge, in its own frame, with mixture covariances.
        exclusive_landmarks: Landmarks that each side found for itself, before the merge or since, without those that
            the merge took for common.
        steps: In which robots of both sides were in contact since.
    """

    number: int
    alignment: Alignment
    sides: tuple[PreMergeSnapshot, PreMergeSnapshot]
    pre_merge_maps: tuple[LandmarkMap, LandmarkMap]
    exclusive_landmarks: tuple[set[int], set[int]]
    steps: int = field(default=0)

    def copy(self, new_ids: Mapping[int, int] | None = None) -> "MergeMonitor":
        """Return a watch that goes on by itself, with landmarks renamed if need be; what does not change is shared."""
        before, own = self.pre_merge_maps, (set(self.exclusive_landmarks[0]), set(self.exclusive_landmarks[1]))
        if new_ids is not None:
            before = (renamed_map(before[0], new_ids), renamed_map(before[1], new_ids))
            own = ({new_ids[i] for i in own[0] if i in new_ids}, {new_ids[i] for i in own[1] if i in new_ids})
        return MergeMonitor(self.number, self.alignment, self.sides, before, own, self.steps)

    def update(self, robots: Sequence[int], report: StepReport) -> None:
        """Note which side has found which landmarks, from a step of the joint filter of `robots`."""
        for robot, row in zip(robots, report.rows, strict=True):
            if row >= 0:
                self.exclusive_landmarks[robot not in self.sides[0].robots].update(
                    report.all_associations.created_ids(row)
                )

    def both_sides_connected(self, live: Sequence[int]) -> bool:
        """Tell whether robots of both sides are among those that go by the joint filter."""
        here = set(live)
        return not (here.isdisjoint(self.sides[0].robots) or here.isdisjoint(self.sides[1].robots))

    def is_inconsistent(self, joint: LandmarkMap, merging: MergeOptions, options: AlignmentOptions) -> bool:
        """Tell whether the joint map, with mixture covariances, contradicts the merge by its shape or by its places."""
        if any(deformed_fraction(old, joint, options) > merging.max_deformed for old in self.pre_merge_maps):
            return True
        ids = joint.ids.tolist()
        masks = [np.fromiter(map(own.__contains__, ids), np.bool_, len(ids)) for own in self.exclusive_landmarks]
        looks = [joint.descriptors[mask] for mask in masks]
        if min(map(len, looks)) < options.min_inliers or not has_enough_candidates(looks[0], looks[1], options):
            return False
        parts = [joint.subset(mask) for mask in masks]
        rival = align_maps(parts[0], parts[1], options=options)
        if not rival.success or self._joined(options) > options.max_ratio * len(rival.inliers):
            return False
        return is_significant_motion(rival.transform, parts[1].means[rival.inliers[:, 1]])

    def _joined(self, options: AlignmentOptions) -> int:
        """Return how many landmarks the merge joined that look alike."""
        _, rows, others = np.intersect1d(self.pre_merge_maps[0].ids, self.pre_merge_maps[1].ids, return_indices=True)
        apart = np.linalg.norm(
            self.pre_merge_maps[0].descriptors[rows] - self.pre_merge_maps[1].descriptors[others], axis=1
        )
        alike = apart <= options.descriptor_gate
        return int(np.count_nonzero(alike)) if options.appearance else len(rows)


def deformed_fraction(old: LandmarkMap, joint: LandmarkMap, options: AlignmentOptions) -> float:
    """Return the share of a map's landmarks that have left their places among each other.

    Args:
        old: The map as it was, in any planar frame.
        joint: The map that holds it now; landmarks are found by their ids.
        options: `position_gate` and `position_floor` of the innovations; with fewer than `min_inliers` landmarks left
            the share is 0.

    Returns:
        In [0, 1]: of the landmarks that both maps hold, those beyond the gate at the rigid motion on which most agree.
    """
    rows = np.column_stack(np.intersect1d(joint.ids, old.ids, return_indices=True)[1:])
    if len(rows) < options.min_inliers:
        return 0.0
    table = match_table(joint, old, rows)
    return kernels.moved_away(table, options.position_floor**2, options.position_gate) / len(rows)


def is_significant_motion(motion: FloatArray, points: FloatArray) -> bool:
    """Tell whether a motion (3,) moves points (n, 3), on average, by 0.5 m, or turns them by 5 degrees."""
    moved: FloatArray = transform_points(motion, points) - points
    return bool(np.hypot(*moved.mean(axis=0)[:2]) > DISTINCT_TRANSLATION or abs(motion[2]) > DISTINCT_ROTATION)


def renamed_map(landmarks: LandmarkMap, new_ids: Mapping[int, int]) -> LandmarkMap:
    """Return the landmarks that have new names, under these."""
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
    """Return the watch of a fresh merge.

    Args:
        number: Of the joint map.
        alignment: By which the sides were merged.
        sides: Whose ids stay, and the other.
        before: Their maps with mixture covariances, under their own ids.
        renamed: (k, 2) int64 rows (id in b's map, id in the joint map).
        pairs: (j, 2) int64 rows (id in a, id in b) of landmarks taken for common.
    """
    common = set(pairs[:, 0].tolist())
    own = (set(before[0].ids.tolist()) - common, set(renamed[:, 1].tolist()) - common)
    return MergeMonitor(number, alignment, sides, (before[0], renamed_map(before[1], dict(renamed.tolist()))), own)
