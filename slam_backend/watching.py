"""`Watch`: after a merge the team gathers evidence of whether it was right, and keeps what it takes to undo it.

Descriptors make the filter's gates blind to a false merge: a robot goes on matching its own landmarks, which moved
along with it, and takes those of the other side for new ones. The contradiction shows in what is NOT matched. A
landmark that one side alone has measured, and one that the other side alone has measured, cannot be the same if the
merge is right, for then both would have been matched to one. So the landmarks of one side alone are aligned with those
of the other side alone, by the same strict test that every merge has to pass: innovations in Mahalanobis units against
the chi-square gate, and consensus. If another motion than the one in force (0.5 m or 5 degrees off) passes it, with
more than twice as many inliers as there are landmarks by which the merge has proved itself since, the merge is undone.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from slam_backend.alignment import RIVAL_ANGLE, RIVAL_DISTANCE, Alignment, AlignmentOptions, align_maps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.geometry import transform_points
from slam_backend.landmark_map import LandmarkMap
from slam_backend.merge_options import MergeOptions
from slam_backend.reports import StepReport


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """One group as it was just before a merge; nothing of it is written to.

    Attributes:
        trunk: State of its joint filter's branch, the watches of earlier merges among it.
    """

    trunk: Mapping[str, Any]

    @property
    def robots(self) -> tuple[int, ...]:
        """Of the group."""
        robots: tuple[int, ...] = self.trunk["robots"]
        return robots

    @property
    def watches(self) -> tuple["Watch", ...]:
        """Of earlier merges in it, as they stood."""
        watches: tuple[Watch, ...] = self.trunk["watches"]
        return watches


@dataclass(slots=True, eq=False)
class Watch:
    """The evidence about one merge.

    Attributes:
        number: Of the joint map when it was made; it names the merge.
        alignment: By which the sides were merged.
        sides: As they were before.
        seen: Landmarks (ids in the joint map) that each side has measured, before or since the merge.
        fused: Those that the merge itself took for common; they prove nothing.
        steps: In which robots of both sides were in contact since.
    """

    number: int
    alignment: Alignment
    sides: tuple[Side, Side]
    seen: tuple[set[int], set[int]]
    fused: frozenset[int]
    steps: int = field(default=0)

    def copy(self, new_ids: Mapping[int, int] | None = None) -> "Watch":
        """Return a watch that goes on by itself, with landmarks renamed; snapshots are shared."""

        def renamed(ids: set[int] | frozenset[int]) -> set[int]:
            return set(ids) if new_ids is None else {new_ids[name] for name in ids if name in new_ids}

        seen = (renamed(self.seen[0]), renamed(self.seen[1]))
        return Watch(self.number, self.alignment, self.sides, seen, frozenset(renamed(self.fused)), self.steps)

    def note(self, robots: Sequence[int], report: StepReport) -> None:
        """Note which side has measured which landmarks, from a step of the joint filter of `robots`."""
        for robot, ids in zip(robots, report.associations, strict=True):
            if len(ids):
                self.seen[robot not in self.sides[0].robots].update(ids[ids >= 0].tolist())

    @property
    def agreement(self) -> int:
        """Landmarks that both sides have measured, without those that the merge itself took for common."""
        return len((self.seen[0] & self.seen[1]) - self.fused)

    def together(self, live: Sequence[int]) -> bool:
        """Tell whether robots of both sides are among those that go by the joint filter."""
        return all(any(robot in side.robots for robot in live) for side in self.sides)

    def contradiction(self, joint: LandmarkMap, merging: MergeOptions, options: AlignmentOptions) -> Alignment | None:
        """Return another motion between the sides than the one in force, if the evidence for it is better.

        Args:
            joint: The joint map with mixture covariances.
            merging: How much better.
            options: When an alignment is believed.

        Returns:
            Where b's landmarks should lie, seen from where they lie now; None: nothing contradicts the merge.
        """
        ids = joint.ids.tolist()
        alone = [
            np.array([name in own and name not in other for name in ids], dtype=np.bool_)
            for own, other in (self.seen, self.seen[::-1])
        ]
        maps = [joint.subset(np.flatnonzero(rows)) for rows in alone]
        if min(len(part) for part in maps) < options.min_inliers:
            return None
        rival = align_maps(maps[0], maps[1], options=options)
        if not rival.success or self.agreement > merging.max_agreement * len(rival.inliers):
            return None
        return rival if differs(rival.transform, maps[1].means[rival.inliers[:, 1]]) else None


def differs(motion: FloatArray, points: FloatArray) -> bool:
    """Tell whether a motion (3,) moves points (n, 3), on average, by 0.5 m, or turns them by 5 degrees."""
    moved: FloatArray = transform_points(motion, points) - points
    return bool(np.hypot(*moved.mean(axis=0)[:2]) > RIVAL_DISTANCE or abs(motion[2]) > RIVAL_ANGLE)


def begin_watch(
    number: int, alignment: Alignment, side_a: Side, side_b: Side, ids_a: IntArray, renamed: IntArray, pairs: IntArray
) -> Watch:
    """Return the watch of a fresh merge.

    Args:
        number: Of the joint map.
        alignment: By which the sides were merged.
        side_a: Whose ids stay.
        side_b: The other.
        ids_a: (n,) int64. Landmarks of a's map.
        renamed: (k, 2) int64 rows (id in b's map, id in the joint map).
        pairs: (j, 2) int64 rows (id in a, id in b) of landmarks taken for common.
    """
    seen = (set(ids_a.tolist()), set(renamed[:, 1].tolist()))
    return Watch(number, alignment, (side_a, side_b), seen, frozenset(pairs[:, 0].tolist()))
