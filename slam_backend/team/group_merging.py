"""Merging of two groups, detection of inconsistent merges, and separation of the groups before a merge."""

import math
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import rotate_covariances
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, Alignment, AlignmentOptions
from slam_backend.maps.fusion import check_inliers
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.joint_graphs import RelativeStart, relative_start
from slam_backend.team.branches import Branch, fork
from slam_backend.team.filter_merging.landmarks import merge_by_identity, renaming
from slam_backend.team.filter_merging.merging import merge_filters, pair_filters, transform_covariance
from slam_backend.team.filter_merging.pairing import Pairing
from slam_backend.team.groups import Group
from slam_backend.team.merge_monitor import (
    MergeMonitor,
    PreMergeSnapshot,
    begin_monitoring,
)
from slam_backend.team.merge_rollback import MergeRollback
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import LandmarkIdMap, MergeUndone
from slam_backend.team.shared_records import SharedRecords


def smoothed_graphs(a: FastSlam, b: FastSlam) -> tuple[SlamGraph, SlamGraph] | None:
    """Return the graphs of the smoothers of two filters; None if one has not smoothed yet, or cannot any more."""
    of_a, of_b = (slam.rejuvenation if slam.can_rejuvenate else None for slam in (a, b))
    if of_a is None or of_b is None or of_a.graph is None or of_b.graph is None:
        return None
    return of_a.graph, of_b.graph


class MergePlan(NamedTuple):
    """Two groups with an alignment of their maps, ready to merge.

    Attributes:
        groups: Group whose map frame and landmark ids stay, and the other.
        maps: Maps of their joint filters, with mixture covariances.
        alignment: Motion from b's map frame to a's; `inliers` are rows of the maps.
        pairing: Pairing of the joint filters' particles, if drawn already.
    """

    groups: tuple[Group, Group]
    maps: tuple[LandmarkMap, LandmarkMap]
    alignment: Alignment
    pairing: Pairing | None = None

    @classmethod
    def of(cls, group_a: Group, group_b: Group, alignment: Alignment) -> Self:
        """Return a plan for a given alignment.

        Raises:
            ValueError: If the inliers name rows that do not exist or repeat one.
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
        """(k, 2) int64 rows (landmark id in a, landmark id in b) of the common landmarks."""
        rows = self.alignment.inliers
        return np.column_stack([self.maps[0].ids[rows[:, 0]], self.maps[1].ids[rows[:, 1]]])

    def with_motion(self, merging: MergeOptions, rng: np.random.Generator) -> tuple[Self, float]:
        """Return the plan with the motion between the maps as the robots' whole paths tell it, and its uncertainty.

        Each map constrains the other robots' paths between their starts and the common landmarks, so that the joint
        graph of both groups may know their relative start well where neither map does. Without smoothers, or if the
        joint graph has no mode, particles of both groups are paired as in a merge, and their scatter tells.

        Args:
            merging: Options of merges.
            rng: Generator for the pairing.

        Returns:
            The plan, and the standard deviation of the motion in its least certain direction over 0.5 m, or in heading
            over 5 degrees, whichever is more [-].
        """
        start = self._relative_start()
        if start is None:
            pairing = pair_filters(*self.filters, self.alignment, self.pairs, rng, merging.merged_particles)
            plan = self._replace(pairing=pairing)
            return plan, transform_uncertainty(plan)
        x, y, theta = start.motion.tolist()
        found = replace(self.alignment, tx=x, ty=y, theta=theta, covariance=start.covariance)
        return self._replace(alignment=found), _relative_uncertainty(start.covariance)

    def _relative_start(self) -> RelativeStart | None:
        """Return the motion at the mode of the joint graph of both groups; None if there is none."""
        graphs = smoothed_graphs(*self.filters)
        if graphs is None:
            return None
        of_a, of_b = (slam.maps for slam in self.filters)
        renamed = renaming(of_a, of_b, np.concatenate(merge_by_identity(of_a, of_b, self.pairs)))
        slam = self.filters[0]
        return relative_start(*graphs, self.alignment.transform, renamed, slam.packed_camera, slam.options.smoothing)


def transform_uncertainty(plan: MergePlan) -> float:
    """Return the uncertainty of the motion over the paired particles of a plan, see `MergePlan.with_motion`.

    The errors of landmarks in one map are correlated where its paths are uncertain, which neither their covariances nor
    the alignment's include. The scatter of the motion over particles does; gauge covariances are added.
    """
    assert plan.pairing is not None
    a, b = plan.filters
    covariance = transform_covariance(plan.pairing.motion, plan.alignment)
    covariance += _gauge_covariance(a.gauge_covariance, b.gauge_covariance, plan.alignment)
    return _relative_uncertainty(covariance)


def _relative_uncertainty(covariance: FloatArray) -> float:
    """Return the largest standard deviation of a motion relative to that of a distinct motion."""
    position, heading = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), math.sqrt(covariance[2, 2])
    return max(position / DISTINCT_TRANSLATION, heading / DISTINCT_ROTATION)


def merge_groups(
    plan: MergePlan,
    merging: MergeOptions,
    records: SharedRecords,
    rng: np.random.Generator,
    epoch: int,
    known: bool = False,
) -> tuple[Group, LandmarkIdMap]:
    """Merge the joint filters of two groups; robots out of contact keep their forks. The merge is then monitored.

    Args:
        plan: Plan of the merge; its groups are not to be used afterwards.
        merging: Options of merges.
        records: Records of the team.
        rng: Generator for pairing and draws.
        epoch: Epoch of the joint filter.
        known: Whether the motion is known from the alignment, see `merge_filters`.
    """
    group_a, group_b = plan.groups
    a, b = group_a.trunk, group_b.trunk
    joint, renamed = merge_filters(
        a.filter, b.filter, plan.alignment, plan.pairs, rng, merging.merged_particles, known, plan.pairing
    )
    joint.reorder(np.argsort(a.robots + b.robots))
    active = tuple(sorted(a.active_robots + b.active_robots))
    number = records.new_number()
    trunk = Branch(tuple(sorted(a.robots + b.robots)), active, joint, a.last_steps | b.last_steps, number, epoch)
    new_ids = dict(renamed.tolist())
    older = [*(monitor.copy() for monitor in a.monitors), *(monitor.copy(new_ids) for monitor in b.monitors)]
    trunk.monitors = sorted(older, key=lambda monitor: monitor.number)
    if merging.watch_steps:
        sides = PreMergeSnapshot.of(a.get_state()), PreMergeSnapshot.of(b.get_state())
        common = renamed[renamed[:, 1] < a.filter.maps.next_id, ::-1]
        trunk.monitors.append(begin_monitoring(number, plan.alignment, sides, plan.maps, renamed, common))
    id_map = LandmarkIdMap(a.robots, b.robots, renamed, (a.number, b.number, number))
    records.entries.append(id_map)
    return Group(trunk, [*group_a.branches[1:], *group_b.branches[1:]]), id_map


def find_inconsistent_merge(trunk: Branch, merging: MergeOptions, options: AlignmentOptions) -> MergeMonitor | None:
    """Return the oldest merge that contradicts the evidence and can be undone now, with those on top of it.

    To be undone, each of them needs robots of both sides in contact.
    """
    monitors = [
        w for w in trunk.monitors if w.steps <= merging.watch_steps and w.both_sides_connected(trunk.active_robots)
    ]
    if not monitors:
        return None
    joint = trunk.filter.map("mixture")
    for monitor in monitors:
        above = [newer for newer in trunk.monitors if newer.number > monitor.number]
        if all(newer.both_sides_connected(trunk.active_robots) for newer in above) and monitor.is_inconsistent(
            joint, merging, options
        ):
            return monitor
    return None


def separate_groups(group: Group, undoing: MergeRollback, records: SharedRecords, epoch: int) -> list[Group]:
    """Undo a merge of a group, and those on top of it: all sides continue as if they had never merged.

    Robots out of contact keep their forks until they return.

    Args:
        group: The group; not to be used afterwards.
        undoing: Rollback of the group's merge; its sides have caught up with the group's joint filter.
        records: Records of the team.
        epoch: Epoch of the separated filters.
    """
    now = group.trunk
    for monitor in undoing.merges(now):
        number_a, number_b = (side.trunk["number"] for side in monitor.sides)
        records.entries.append(MergeUndone((number_a, number_b, monitor.number)))
    separated = []
    for trunk, replayed in zip(undoing.sides, undoing.replayed, strict=True):
        trunk.active_robots, trunk.epoch = tuple(robot for robot in trunk.robots if robot in now.active_robots), epoch
        records.note_replay(trunk.number, replayed)
        separated.append(Group(trunk))
    for branch in group.branches[1:]:
        _reassign_branch(branch, separated, records)
    return separated


def _reassign_branch(branch: Branch, separated: list[Group], records: SharedRecords) -> None:
    """Assign a fork to the group of its robots; a fork needed by several is copied."""
    homes = [group for group in separated if any(robot in group.robots for robot in branch.active_robots)]
    for group in homes[1:]:
        members = tuple(robot for robot in branch.active_robots if robot in group.robots)
        copied = fork(branch, members, records.new_number(), records.rng, records.take_spare())
        records.copied(branch.number, copied.number)
        group.branches.append(copied)
    branch.active_robots = tuple(robot for robot in branch.active_robots if robot in homes[0].robots)
    homes[0].branches.append(branch)


def _gauge_covariance(frame_a: FloatArray, frame_b: FloatArray, alignment: Alignment) -> FloatArray:
    """Return the covariance of the motion between two groups' starts due to their gauge covariances (3, 3)."""
    covariance = rotate_covariances(alignment.theta, frame_b)
    transform = alignment.transform.copy()  # writable, as the kernel is compiled for
    _kernels.add_gauge_covariance(frame_a, transform[None], covariance[None])
    return covariance
