"""Two groups become one, a merge is doubted, and taken back."""

import math
from typing import NamedTuple, Self

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import MergeUndone, Renaming
from slam_backend.geometry import rotate_covariances
from slam_backend.maps.alignment import RIVAL_ANGLE, RIVAL_DISTANCE, Alignment, AlignmentOptions
from slam_backend.maps.fusion import check_inliers
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.smoother.graph import mean_pose, scattered
from slam_backend.team.branches import Branch, fork
from slam_backend.team.filter_merging.merging import merge_filters, motion_covariance, paired
from slam_backend.team.filter_merging.pairing import Pairing
from slam_backend.team.groups import Group
from slam_backend.team.merge_monitor import Side, Watch, begin_watch, moved_share, renamed_map
from slam_backend.team.merge_rollback import Undoing
from slam_backend.team.options import MergeOptions
from slam_backend.team.shared_records import Records


def straightened(group_a: Group, group_b: Group) -> tuple[LandmarkMap, LandmarkMap] | None:
    """Draw the particles of both joint filters anew from their smoothed paths.

    Where a smoother finds nothing better the filter stays as it is.

    Returns:
        Their maps with mixture covariances as they are now; None if neither filter has changed.
    """
    filters = group_a.trunk.filter, group_b.trunk.filter
    reports = [slam.rejuvenate() for slam in filters]
    return None if all(report.reason for report in reports) else (filters[0].map("mixture"), filters[1].map("mixture"))


class MergePlan(NamedTuple):
    """Two groups whose maps align, and what is known of their merge before it is made.

    Attributes:
        groups: Whose map frame and landmark ids stay, and the other.
        maps: Of their joint filters as they are, with mixture covariances.
        alignment: Motion from b's map frame to a's; `inliers` are rows of the maps.
        pairing: Of the joint filters' particles, if that is drawn already.
        joint: Filter that `merge_filters` made of it, if that is done already.
    """

    groups: tuple[Group, Group]
    maps: tuple[LandmarkMap, LandmarkMap]
    alignment: Alignment
    pairing: Pairing | None = None
    joint: tuple[FastSlam, IntArray] | None = None

    @classmethod
    def of(cls, group_a: Group, group_b: Group, alignment: Alignment) -> Self:
        """Return a plan by an alignment from outside.

        Raises:
            ValueError: If the inliers name rows that do not exist or the same one twice.
        """
        maps = group_a.trunk.filter.map("mixture"), group_b.trunk.filter.map("mixture")
        check_inliers(alignment.inliers, len(maps[0]), len(maps[1]))
        return cls((group_a, group_b), maps, alignment)

    @property
    def filters(self) -> tuple[FastSlam, FastSlam]:
        """The joint filters."""
        return self.groups[0].trunk.filter, self.groups[1].trunk.filter

    @property
    def pairs(self) -> IntArray:
        """(k, 2) int64 rows (landmark id in a, landmark id in b) in common."""
        rows = self.alignment.inliers
        return np.column_stack([self.maps[0].ids[rows[:, 0]], self.maps[1].ids[rows[:, 1]]])

    def paired(self, merging: MergeOptions, rng: np.random.Generator) -> Self:
        """Return the plan with the particles paired, as a merge of particles would draw it from `rng`."""
        pairing = paired(*self.filters, self.alignment, self.pairs, rng, merging.merged_particles)
        return self._replace(pairing=pairing)

    def on_trial(
        self, merging: MergeOptions, options: AlignmentOptions, rng: np.random.Generator
    ) -> tuple[Self, float] | None:
        """Merge both filters into one whose particles are drawn from its smoothed paths; both stay as they are.

        Each map tells of the other robots' ways from their starts to what both have in common, so that the joint filter
        may know well how the groups began where neither map does.

        Returns:
            The plan by the motion that the joint filter has, and the doubt about that, see `doubt_about`: infinite
            where the merge would be undone for the shape of the joint map. None if the smoother finds nothing.
        """
        a, b = self.filters
        joint, renamed = merge_filters(
            a, b, self.alignment, self.pairs, rng, merging.merged_particles, pairing=self.pairing
        )  # fmt: skip
        if joint.rejuvenate().reason:
            return None
        starts = joint.state.starts[a.num_robots, :, : joint.num_particles]
        motion = mean_pose(starts)
        own = rotate_covariances(float(motion[2]), joint.state.start_covariances[a.num_robots])
        covariance = scattered(starts) + own
        _kernels.add_share(joint.state.gauge_covariance, motion[None], covariance[None])
        x, y, theta = motion.tolist()
        alignment = Alignment(True, "", x, y, theta, covariance, self.alignment.inliers, self.alignment.ratio)
        sides, straight = (self.maps[0], renamed_map(self.maps[1], dict(renamed.tolist()))), joint.map("mixture")
        bent = any(moved_share(old, straight, options) > merging.max_moved for old in sides)
        plan = self._replace(alignment=alignment, joint=(joint, renamed))
        return plan, math.inf if bent else _in_bounds(covariance)


def doubt_about(plan: MergePlan) -> float:
    """Return how uncertain the motion between two maps is, as the particles of a merge have it, which are paired.

    Landmarks of one map err together where its paths are uncertain. Their covariances, and the alignment's, do not say
    so; that particles differ in the motion does, with what these do not show where the frames of the maps are held.

    Returns:
        The standard deviation of the motion in its least certain direction over 0.5 m, or in heading over 5 degrees,
        whichever is more [-].
    """
    assert plan.pairing is not None
    a, b = plan.filters
    covariance = motion_covariance(plan.pairing.motion, plan.alignment)
    covariance += _of_frames(a.state.gauge_covariance, b.state.gauge_covariance, plan.alignment)
    return _in_bounds(covariance)


def _in_bounds(covariance: FloatArray) -> float:
    """Return the largest standard deviation of a motion over what makes it another one."""
    position, heading = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), math.sqrt(covariance[2, 2])
    return max(position / RIVAL_DISTANCE, heading / RIVAL_ANGLE)


def merge_groups(
    plan: MergePlan,
    merging: MergeOptions,
    records: Records,
    rng: np.random.Generator,
    epoch: int,
    known: bool = False,
) -> tuple[Group, Renaming]:
    """Merge the joint filters of two groups; robots out of contact keep their forks. The merge is then watched.

    Args:
        plan: Of the groups, which are not to be used any more.
        merging: How.
        records: Of the team.
        rng: For pairing and draws.
        epoch: Of the joint filter.
        known: As of `merge_filters`.
    """
    (group_a, group_b), alignment, pairs = plan.groups, plan.alignment, plan.pairs
    a, b = group_a.trunk, group_b.trunk
    joint, renamed = plan.joint or merge_filters(
        a.filter, b.filter, alignment, pairs, rng, merging.merged_particles, known, plan.pairing
    )
    robots, live = a.robots + b.robots, a.live + b.live
    joint.reorder(np.argsort(robots))
    number = records.new_number()
    trunk = Branch(tuple(sorted(robots)), tuple(sorted(live)), joint, a.known | b.known, number, epoch)
    if merging.watch_steps:
        new_ids = dict(renamed.tolist())
        older = [*(watch.copy() for watch in a.watches), *(watch.copy(new_ids) for watch in b.watches)]
        sides = Side.of(a.get_state()), Side.of(b.get_state())
        common = renamed[np.isin(renamed[:, 1], a.filter.state.maps.ids), ::-1]
        fresh = begin_watch(number, alignment, sides, plan.maps, renamed, common)
        trunk.watches = [*sorted(older, key=lambda watch: watch.number), fresh]
    renaming = Renaming(a.robots, b.robots, renamed, (a.number, b.number, number))
    records.entries.append(renaming)
    return Group(trunk, [*group_a.branches[1:], *group_b.branches[1:]]), renaming


def contradicted(trunk: Branch, merging: MergeOptions, options: AlignmentOptions) -> Watch | None:
    """Return the oldest merge that the evidence contradicts, and that can be undone with those on top of it now.

    For that, robots of both sides of each of them have to be in contact.
    """
    watches = [w for w in trunk.watches if w.steps <= merging.watch_steps and w.together(trunk.live)]
    if not watches:
        return None
    joint = trunk.filter.map("mixture")
    for watch in watches:
        above = [newer for newer in trunk.watches if newer.number > watch.number]
        if all(newer.together(trunk.live) for newer in above) and watch.is_contradicted(joint, merging, options):
            return watch
    return None


def undone(group: Group, undoing: Undoing, records: Records, epoch: int) -> list[Group]:
    """Take back a merge of a group, and those on top of it: all sides go on as if they had not been.

    Robots out of contact keep their forks until they return.

    Args:
        group: Not to be used any more.
        undoing: Of it; its sides have caught up with the group's joint filter.
        records: Of the team.
        epoch: Of the restored filters.
    """
    now = group.trunk
    for watch in undoing.merges(now):
        number_a, number_b = (side.trunk["number"] for side in watch.sides)
        records.entries.append(MergeUndone((number_a, number_b, watch.number)))
    restored = []
    for trunk, replayed in zip(undoing.sides, undoing.replayed, strict=True):
        trunk.live, trunk.epoch = tuple(robot for robot in trunk.robots if robot in now.live), epoch
        records.note_replay(trunk.number, replayed)
        restored.append(Group(trunk))
    for branch in group.branches[1:]:
        _hand_over(branch, restored, records)
    return restored


def _hand_over(branch: Branch, restored: list[Group], records: Records) -> None:
    """Give a fork to the restored group of its robots; one that several need is copied."""
    homes = [group for group in restored if any(robot in group.robots for robot in branch.live)]
    for group in homes[1:]:
        own = tuple(robot for robot in branch.live if robot in group.robots)
        copied = fork(branch, own, records.new_number(), records.rng)
        records.copied(branch.number, copied.number)
        group.branches.append(copied)
    branch.live = tuple(robot for robot in branch.live if robot in homes[0].robots)
    homes[0].branches.append(branch)


def _of_frames(frame_a: FloatArray, frame_b: FloatArray, alignment: Alignment) -> FloatArray:
    """Return what two frames that are held, (3, 3) each, leave open of the motion between where the groups began."""
    covariance = rotate_covariances(alignment.theta, frame_b)
    transform = alignment.transform.copy()  # can be written: the kernel is compiled for such arrays alone
    _kernels.add_share(frame_a, transform[None], covariance[None])
    return covariance
