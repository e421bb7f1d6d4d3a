"""Consistency check of a merge by one filter.

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

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.reports import StepReport
from slam_backend.geometry import transform_points
from slam_backend.maps.alignment import (
    DISTINCT_ROTATION,
    DISTINCT_TRANSLATION,
    AlignmentOptions,
    align_maps,
)
from slam_backend.maps.correspondences import has_enough_candidates
from slam_backend.maps.landmark_map import LandmarkMap, unchecked_map
from slam_backend.maps.match_table import match_table
from slam_backend.maps.registration import count_moved_away
from slam_backend.state import Each, Int, Record, Row, State
from slam_backend.team.merge_scheduler import LANDMARK, PAIR, PairKey
from slam_backend.team.options import MergeOptions


@dataclass(slots=True, eq=False)
class MergeMonitor:
    """Evidence about one merge that a filter has, which each fork continues by itself. Ids are those of the joint map.

    Attributes:
        number: First number of the joint map; it names the merge.
        pair: Robots of the two groups before the merge.
        pre_merge_maps: Each side's map just before the merge, in its own frame, with mixture covariances.
        exclusive_landmarks: Landmarks found by each side alone, before the merge or since, without those that the merge
            fused.
        steps: Number of steps since the merge with robots of both sides in contact.
    """

    STATE = State(
        number=Int(), pair=PAIR, pre_merge_maps=Row(Record(LandmarkMap), Record(LandmarkMap)),
        exclusive_landmarks=Each(Each(LANDMARK, kind=set), "2"), steps=Int(),
    )  # fmt: skip

    number: int
    pair: PairKey
    pre_merge_maps: tuple[LandmarkMap, LandmarkMap]
    exclusive_landmarks: tuple[set[int], set[int]]
    steps: int = field(default=0)

    def copy(self, new_ids: Mapping[int, int] | None = None) -> "MergeMonitor":
        """Return an independent monitor, with landmarks renamed if needed; constant parts are shared."""
        before, exclusive = self.pre_merge_maps, (set(self.exclusive_landmarks[0]), set(self.exclusive_landmarks[1]))
        if new_ids is not None:
            before = (renamed_map(before[0], new_ids), renamed_map(before[1], new_ids))
            one, other = exclusive
            exclusive = ({new_ids[i] for i in one if i in new_ids}, {new_ids[i] for i in other if i in new_ids})
        return MergeMonitor(self.number, self.pair, before, exclusive, self.steps)

    def update(self, robots: Sequence[int], report: StepReport) -> None:
        """Add the landmarks that each side found in a step of the joint filter of `robots`."""
        for robot, row in zip(robots, report.rows, strict=True):
            if row >= 0:
                self.exclusive_landmarks[robot not in self.pair[0]].update(report.all_associations.created_ids(row))

    def both_sides_connected(self, active_robots: Sequence[int]) -> bool:
        """Return whether robots of both sides are among the active robots of the joint filter."""
        return are_both_connected(self.pair, active_robots)

    def is_inconsistent(self, joint: LandmarkMap, merging: MergeOptions, options: AlignmentOptions) -> bool:
        """Return whether the joint map, with mixture covariances, contradicts the merge in shape or place."""
        if any(deformed_fraction(old, joint, options) > merging.max_deformed for old in self.pre_merge_maps):
            return True
        ids = joint.ids.tolist()
        masks = [np.fromiter(map(side.__contains__, ids), np.bool_, len(ids)) for side in self.exclusive_landmarks]
        if min(map(np.count_nonzero, masks)) < options.min_inliers:
            return False
        if not has_enough_candidates(joint.descriptors[masks[0]], joint.descriptors[masks[1]], options):
            return False
        parts = joint.subset(masks[0]), joint.subset(masks[1])
        rival = align_maps(*parts, options=options)
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


def are_both_connected(pair: PairKey, active_robots: Sequence[int]) -> bool:
    """Return whether robots of both groups are among some active robots."""
    here = set(active_robots)
    return not (here.isdisjoint(pair[0]) or here.isdisjoint(pair[1]))


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
    return count_moved_away(table, options.position_floor**2, options.position_gate) / len(rows)


def is_significant_motion(motion: FloatArray, points: FloatArray) -> bool:
    """Return whether a motion (3,) moves points (n, 3), on average, by 0.5 m, or turns them by 5 degrees."""
    moved: FloatArray = transform_points(motion, points) - points
    return bool(np.hypot(*moved.mean(axis=0)[:2]) > DISTINCT_TRANSLATION or abs(motion[2]) > DISTINCT_ROTATION)


def renamed_map(landmarks: LandmarkMap, new_ids: Mapping[int, int]) -> LandmarkMap:
    """Return the landmarks that have new ids, under these ids."""
    ids = np.array([new_ids.get(landmark, -1) for landmark in landmarks.ids.tolist()], dtype=np.int64)
    rest = landmarks.subset(ids >= 0)
    return unchecked_map(rest.means, rest.covariances, rest.descriptors, rest.counts, ids[ids >= 0])


def begin_monitoring(
    number: int, pair: PairKey, maps: tuple[LandmarkMap, LandmarkMap], renamed: IntArray, common: IntArray
) -> MergeMonitor:
    """Return the monitor of a new merge.

    Args:
        number: Number of the joint map.
        pair: Robots of both groups.
        maps: Maps of the groups with mixture covariances, under their own ids.
        renamed: (k, 2) int64 rows (id in b's map, id in the joint map).
        common: (j,) int64 ids of the fused landmarks.
    """
    fused = set(common.tolist())
    exclusive = (set(maps[0].ids.tolist()) - fused, set(renamed[:, 1].tolist()) - fused)
    return MergeMonitor(number, pair, (maps[0], renamed_map(maps[1], dict(renamed.tolist()))), exclusive)
