"""Merging of two groups, detection of inconsistent merges, and separation of the groups before a merge."""

import math
from collections.abc import Sequence
from typing import NamedTuple, Self

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import LandmarkIdMap, MergeUndone
from slam_backend.geometry import rotate_covariances
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, Alignment, AlignmentOptions
from slam_backend.maps.fusion import check_inliers
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.smoother.graph import SlamGraph, mean_pose, scattered
from slam_backend.smoother.joint_graphs import relative_start
from slam_backend.smoother.options import MANY_STEPS
from slam_backend.team.branches import Branch, ReplayedStep, fork
from slam_backend.team.filter_merging.landmarks import merge_by_identity, renaming
from slam_backend.team.filter_merging.merging import merge_filters, pair_filters, transform_covariance
from slam_backend.team.filter_merging.pairing import Pairing
from slam_backend.team.groups import Group
from slam_backend.team.merge_monitor import (
    MergeMonitor,
    PreMergeSnapshot,
    begin_monitoring,
    deformed_fraction,
    renamed_map,
)
from slam_backend.team.merge_rollback import MergeRollback
from slam_backend.team.options import MergeOptions
from slam_backend.team.shared_records import SharedRecords


def smoothed_maps(group_a: Group, group_b: Group) -> tuple[LandmarkMap, LandmarkMap] | None:
    """Rejuvenate both joint filters from their smoothed paths.

    A filter whose smoother finds no better paths does not change.

    Returns:
        Present maps of both with mixture covariances; None if neither filter has changed.
    """
    filters = group_a.trunk.filter, group_b.trunk.filter
    reports = [slam.rejuvenate() for slam in filters]
    return None if all(report.reason for report in reports) else (filters[0].map("mixture"), filters[1].map("mixture"))


def smoothed_graphs(a: FastSlam, b: FastSlam) -> tuple[SlamGraph, SlamGraph] | None:
    """Return the graphs of the smoothers of two filters; None if one has not smoothed yet, or cannot any more."""
    smoothers = (slam.state.rejuvenation for slam in (a, b))
    graphs = [None if smoother is None or smoother.is_disabled else smoother.graph for smoother in smoothers]
    return None if graphs[0] is None or graphs[1] is None else (graphs[0], graphs[1])


class PreparedTrunk(NamedTuple):
    """Branch of a joint filter, made some steps before the merge.

    Attributes:
        branch: The branch.
        renamed: (n, 2) int64 rows (id in b, id in the joint map) of the landmarks that b had then.
        end_of_common: Ids in the joint map below this one are those of landmarks that a had then.
        replayed: Steps replayed since.
    """

    branch: Branch
    renamed: IntArray
    end_of_common: int
    replayed: Sequence[ReplayedStep] = ()


class MergePlan(NamedTuple):
    """Two groups with an alignment of their maps, ready to merge.

    Attributes:
        groups: Group whose map frame and landmark ids stay, and the other.
        maps: Maps of their joint filters, with mixture covariances.
        alignment: Motion from b's map frame to a's; `inliers` are rows of the maps.
        pairing: Pairing of the joint filters' particles, if drawn already.
        joint: Result of `merge_filters`, if merged already.
        prepared: Branch of the joint filter that has caught up with both groups, if it was prepared.
    """

    groups: tuple[Group, Group]
    maps: tuple[LandmarkMap, LandmarkMap]
    alignment: Alignment
    pairing: Pairing | None = None
    joint: tuple[FastSlam, IntArray] | None = None
    prepared: PreparedTrunk | None = None

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

    def by_graphs(self) -> tuple[Self, float] | None:
        """Estimate the motion by the joint graph of both groups alone, as a trial does before it draws particles.

        Returns:
            The plan with the motion at the mode, and its uncertainty, see `transform_uncertainty`; that of a trial
            hardly falls below it. None where `relative_start` is.
        """
        graphs = smoothed_graphs(*self.filters)
        if graphs is None:
            return None
        of_a, of_b = (slam.state.maps for slam in self.filters)
        renamed = renaming(of_a, of_b, np.concatenate(merge_by_identity(of_a, of_b, self.pairs)))
        state, found = self.filters[0].state, self.alignment
        start = relative_start(*graphs, found.transform, renamed, state.packed_camera, state.options.smoothing)
        if start is None:
            return None
        covariance = _variance_factor(np.concatenate([graph.latest for graph in graphs])) * start.covariance
        x, y, theta = start.motion.tolist()
        alignment = Alignment(True, "", x, y, theta, covariance, found.inliers, found.ratio)
        return self._replace(alignment=alignment), _relative_uncertainty(covariance)

    def with_pairing(self, merging: MergeOptions, rng: np.random.Generator) -> Self:
        """Return the plan with the particles paired by draws from `rng`, as in a merge."""
        pairing = pair_filters(*self.filters, self.alignment, self.pairs, rng, merging.merged_particles)
        return self._replace(pairing=pairing)

    def on_trial(
        self, merging: MergeOptions, options: AlignmentOptions, rng: np.random.Generator
    ) -> tuple[Self, float] | None:
        """Merge both filters into one and rejuvenate it from its smoothed paths; the filters do not change.

        Each map constrains the other robots' paths between their starts and the common landmarks. The joint filter may
        therefore know the relative start of the groups well where neither map does.

        Args:
            merging, options: Options of merges and alignments.
            rng: Generator for the draws.

        Returns:
            The plan with the result of `judge_trial`. None if the smoother fails.
        """
        a, b = self.filters
        joint, renamed = merge_filters(
            a, b, self.alignment, self.pairs, rng, merging.merged_particles, pairing=self.pairing, on_trial=True
        )
        if joint.rejuvenate().reason:
            return None
        found, uncertainty = judge_trial(joint, a.num_robots, self.maps, renamed, self.alignment, merging, options)
        return self._replace(alignment=found, joint=(joint, renamed)), uncertainty


def judge_trial(
    joint: FastSlam, robot: int, maps: tuple[LandmarkMap, LandmarkMap], renamed: IntArray, alignment: Alignment,
    merging: MergeOptions, options: AlignmentOptions,
) -> tuple[Alignment, float]:  # fmt: skip
    """Return the motion between two maps by a joint filter that was rejuvenated on trial, and how uncertain it is.

    Args:
        joint: The joint filter, a's robots first.
        robot: Index of b's first robot, whose start defines b's frame.
        maps: Maps of a and b before, with mixture covariances.
        renamed: (n, 2) int64 rows (id in b, id in the joint map).
        alignment: Alignment by which they were merged.
        merging, options: Options of merges and alignments.

    Returns:
        The alignment with this motion, and its uncertainty, see `transform_uncertainty`; infinite if the shape of the
        joint map is inconsistent.
    """
    starts = joint.state.starts[robot, :, : joint.num_particles]
    motion = mean_pose(starts)
    start = rotate_covariances(float(motion[2]), joint.state.start_covariances[robot])
    covariance = scattered(starts) + start
    _kernels.add_gauge_covariance(joint.state.gauge_covariance, motion[None], covariance[None])
    covariance = _cautious(covariance, joint, robot)
    x, y, theta = motion.tolist()
    found = Alignment(True, "", x, y, theta, covariance, alignment.inliers, alignment.ratio)
    before, after = (maps[0], renamed_map(maps[1], dict(renamed.tolist()))), joint.map("mixture")
    deformed = any(deformed_fraction(old, after, options) > merging.max_deformed for old in before)
    return found, math.inf if deformed else _relative_uncertainty(covariance)


# Factor by which the standard deviations of a start in a large map are too small, as keyframes have been joined: with
# 2,000 instead of 180 per robot they are 1.3 times as large after eight minutes (docs/lab/scale.md).
JOINED_KEYFRAMES = 1.3
# The same for what has been joined since the smoother widens it (`graph_reduction.WIDENED`): claims agree with errors,
# and merges at 2.4 standard deviations instead of 3 come in time.
WIDENED_KEYFRAMES = 0.8


def _cautious(covariance: FloatArray, joint: FastSlam, robot: int) -> FloatArray:
    """Return the covariance of a robot's start, or in large maps that of the Gaussian at the mode, if that is larger.

    Along long paths few samples carry weight, and the scatter of these few understates the uncertainty.
    """
    smoother = joint.state.rejuvenation
    if smoother is None or smoother.starts_at_mode is None or smoother.graph is None:
        return covariance
    larger: FloatArray = max(covariance, smoother.starts_at_mode[robot], key=_relative_uncertainty)
    return _variance_factor(smoother.graph.latest) * larger


def _variance_factor(latest: IntArray) -> float:
    """Return the factor on covariances of starts in a large map, the mean of two by their shares of a run.

    Keyframes joined in the first `MANY_STEPS` steps may not be widened, later ones are.

    Args:
        latest: (K,) int64. Last step of each robot.
    """
    before = min(MANY_STEPS * len(latest) / max(int(latest.sum()), 1), 1.0)
    return before * JOINED_KEYFRAMES**2 + (1.0 - before) * WIDENED_KEYFRAMES**2


def transform_uncertainty(plan: MergePlan) -> float:
    """Return the uncertainty of the motion between two maps over the paired particles of a merge.

    The errors of landmarks in one map are correlated where its paths are uncertain, which neither their covariances nor
    the alignment's include. The scatter of the motion over particles does; gauge covariances are added.

    Returns:
        The standard deviation of the motion in its least certain direction over 0.5 m, or in heading over 5 degrees,
        whichever is more [-].
    """
    assert plan.pairing is not None
    a, b = plan.filters
    covariance = transform_covariance(plan.pairing.motion, plan.alignment)
    covariance += _gauge_covariance(a.state.gauge_covariance, b.state.gauge_covariance, plan.alignment)
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
    prepared = plan.prepared
    if prepared is None:
        joint, renamed = plan.joint or merge_filters(
            a.filter, b.filter, plan.alignment, plan.pairs, rng, merging.merged_particles, known, plan.pairing
        )
        joint.reorder(np.argsort(a.robots + b.robots))
        branch = joint_trunk(plan.groups, joint, renamed, records.new_number())
        prepared = PreparedTrunk(branch, renamed, a.filter.state.maps.next_id)
    trunk, renamed, end_of_common, replayed = prepared
    trunk.active_robots, trunk.epoch = tuple(sorted(a.active_robots + b.active_robots)), epoch
    watched = {monitor.number for monitor in (*a.monitors, *b.monitors)}
    trunk.monitors = [monitor for monitor in trunk.monitors if monitor.number in watched]  # some ended meanwhile
    if merging.watch_steps:
        sides = PreMergeSnapshot.of(a.get_state()), PreMergeSnapshot.of(b.get_state())
        common = renamed[renamed[:, 1] < end_of_common, ::-1]
        fresh = begin_monitoring(trunk.number, plan.alignment, sides, plan.maps, renamed, common)
        for done in replayed:
            fresh.update(trunk.robots, done.report)
        trunk.monitors.append(fresh)
    trunk.filter.state.write_landmarks(a.filter.state.maps)
    id_map = LandmarkIdMap(a.robots, b.robots, renamed, (a.number, b.number, trunk.number))
    records.entries.append(id_map)
    records.note_replay(trunk.number, replayed)
    return Group(trunk, [*group_a.branches[1:], *group_b.branches[1:]]), id_map


def joint_trunk(groups: tuple[Group, Group], joint: FastSlam, renamed: IntArray, number: int) -> Branch:
    """Return the branch of the joint filter of two groups, which still uses none of its robots' inputs.

    Args:
        groups: Groups a and b.
        joint: Joint filter of their robots, in any order.
        renamed: (n, 2) int64 rows (id in b, id in the joint map).
        number: Number of the joint map.
    """
    a, b = (group.trunk for group in groups)
    new_ids = dict(renamed.tolist())
    older = [*(monitor.copy() for monitor in a.monitors), *(monitor.copy(new_ids) for monitor in b.monitors)]
    trunk = Branch(tuple(sorted(a.robots + b.robots)), (), joint, a.last_steps | b.last_steps, number)
    trunk.monitors = sorted(older, key=lambda monitor: monitor.number)
    return trunk


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
