"""Merging of two groups, and their separation when the merge is undone."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self

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
from slam_backend.state import Each, Int, Record, Saved, Sizes, Snapshot, State, take
from slam_backend.team.branches import Branch, fork
from slam_backend.team.filter_merging.landmarks import merge_by_identity, renaming
from slam_backend.team.filter_merging.merging import merge_filters, pair_filters, transform_covariance
from slam_backend.team.filter_merging.pairing import Pairing
from slam_backend.team.groups import Group
from slam_backend.team.merge_monitor import begin_monitoring
from slam_backend.team.merge_scheduler import PairKey
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import LandmarkIdMap
from slam_backend.team.shared_records import SharedRecords


def smoothed_graphs(a: FastSlam, b: FastSlam) -> tuple[SlamGraph, SlamGraph] | None:
    """Return the graphs of the smoothers of two filters; None if one has not smoothed yet, or cannot any more."""
    of_a, of_b = (slam.rejuvenation if slam.can_rejuvenate else None for slam in (a, b))
    if of_a is None or of_b is None or of_a.graph is None or of_b.graph is None:
        return None
    return of_a.graph, of_b.graph


class MergePlan(NamedTuple):
    """Two groups with an alignment of their maps.

    Attributes:
        groups: Group whose map frame and landmark ids stay, and the other.
        maps: Maps of their joint filters, with mixture covariances.
        alignment: Motion from b's map frame to a's; `inliers` are rows of the maps.
    """

    groups: tuple[Group, Group]
    maps: tuple[LandmarkMap, LandmarkMap]
    alignment: Alignment

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

    def pair_particles(self, merging: MergeOptions, rng: np.random.Generator, known: bool = False) -> Pairing:
        """Draw the pairs of particles of the joint filter; see `merge_filters` for `known`."""
        return pair_filters(*self.filters, self.alignment, self.pairs, rng, merging.merged_particles, known)

    def relative_start(self) -> RelativeStart | None:
        """Return the motion at the mode of the joint graph of both groups; None without smoothers or a mode.

        Each map constrains the other robots' paths between their starts and the common landmarks, so that the joint
        graph of both groups may know their relative start well where neither map does.
        """
        graphs = smoothed_graphs(*self.filters)
        if graphs is None:
            return None
        maps_a, maps_b = (slam.maps for slam in self.filters)
        renamed = renaming(maps_a, maps_b, np.concatenate(merge_by_identity(maps_a, maps_b, self.pairs)))
        slam = self.filters[0]
        return relative_start(*graphs, self.alignment.transform, renamed, slam.packed_camera, slam.options.smoothing)

    def with_motion(self, start: RelativeStart) -> Self:
        """Return the plan with the motion of the joint graph."""
        x, y, theta = start.motion.tolist()
        return self._replace(alignment=replace(self.alignment, tx=x, ty=y, theta=theta, covariance=start.covariance))


def transform_uncertainty(plan: MergePlan, pairing: Pairing) -> float:
    """Return the `relative_uncertainty` of the motion between two groups over paired particles.

    The errors of landmarks in one map are correlated where its paths are uncertain, which neither their covariances nor
    the alignment's include. The scatter of the motion over particles does; gauge covariances are added.
    """
    a, b = plan.filters
    covariance = transform_covariance(pairing.motion, plan.alignment)
    covariance += _gauge_covariance(a.gauge_covariance, b.gauge_covariance, plan.alignment)
    return relative_uncertainty(covariance)


def relative_uncertainty(covariance: FloatArray) -> float:
    """Return the uncertainty of a motion relative to the limits of a false merge.

    It is the standard deviation in the least certain direction over 0.5 m, or in heading over 5 degrees, whichever is
    more [-].
    """
    position, heading = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), math.sqrt(covariance[2, 2])
    return max(position / DISTINCT_TRANSLATION, heading / DISTINCT_ROTATION)


@dataclass(frozen=True, slots=True, eq=False)
class JoinedGroups:
    """Two groups that have been joined, and what it takes to separate them.

    Attributes:
        number: Number of the joint map when it began; it names the merge.
        alignment: Alignment by which they were joined.
        sides: States of their trunks just before, with monitors of earlier merges.
    """

    STATE = State(number=Int(), alignment=Record(Alignment), sides=Each(Saved(Branch), "2"))
    number: int
    alignment: Alignment
    sides: tuple[Snapshot, Snapshot]

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise if a robot is on both sides."""
        a, b = parts["sides"]
        if set(a["robots"]) & set(b["robots"]):
            raise ValueError("sides with a common robot")

    @classmethod
    def of(cls, plan: MergePlan, number: int) -> Self:
        """Return what it takes to separate the groups of a plan that have been joined to map `number`."""
        a, b = (take(group.trunk) for group in plan.groups)
        return cls(number, plan.alignment, (a, b))

    @property
    def oldest_step(self) -> int:
        """First step that a separation would replay."""
        oldest: int = min(last for side in self.sides for last in side["last_steps"].values())
        return 1 + oldest

    @property
    def map_numbers(self) -> tuple[int, int]:
        """Numbers of the maps that a separation would restore."""
        return self.sides[0]["number"], self.sides[1]["number"]

    @property
    def earlier(self) -> tuple[list[int], list[int]]:
        """Numbers of the earlier merges that each side monitored, oldest first."""
        a, b = ([monitor["number"] for monitor in side["monitors"]] for side in self.sides)
        return a, b

    @property
    def pair(self) -> PairKey:
        """Robots of both groups."""
        return self.sides[0]["robots"], self.sides[1]["robots"]


def join_groups(
    plan: MergePlan, pairing: Pairing, merging: MergeOptions, records: SharedRecords, rng: np.random.Generator,
    epoch: int,
) -> tuple[Group, LandmarkIdMap]:  # fmt: skip
    """Merge the joint filters of two groups; robots out of contact keep their forks.

    Args:
        plan: Plan of the merge; its groups are not to be used afterwards.
        pairing: Pairing of the joint filters' particles.
        merging: Options of merges.
        records: Records of the team.
        rng: Generator that seeds the joint filter's own stream.
        epoch: Epoch of the joint filter.
    """
    group_a, group_b = plan.groups
    a, b = group_a.trunk, group_b.trunk
    joint, renamed = merge_filters(a.filter, b.filter, plan.alignment, plan.pairs, rng, pairing=pairing)
    joint.reorder(np.argsort(a.robots + b.robots))
    active = tuple(sorted(a.active_robots + b.active_robots))
    number = records.new_number()
    trunk = Branch(tuple(sorted(a.robots + b.robots)), active, joint, a.last_steps | b.last_steps, number, epoch)
    new_ids = dict(renamed.tolist())
    older = [*(monitor.copy() for monitor in a.monitors), *(monitor.copy(new_ids) for monitor in b.monitors)]
    trunk.monitors = sorted(older, key=lambda monitor: monitor.number)
    if merging.watch_steps:
        common = renamed[renamed[:, 1] < a.filter.maps.next_id, 1]
        trunk.monitors.append(begin_monitoring(number, (a.robots, b.robots), plan.maps, renamed, common))
    id_map = LandmarkIdMap(a.robots, b.robots, renamed, (a.number, b.number, number))
    records.entries.append(id_map)
    return Group(trunk, [*group_a.branches[1:], *group_b.branches[1:]]), id_map


def is_refuted(number: int, trunk: Branch, merging: MergeOptions, options: AlignmentOptions) -> bool:
    """Return whether a merge that a filter monitors contradicts the evidence and can be undone now.

    To be undone, this merge and those on top of it need robots of both sides in contact.
    """
    place = [monitor.number for monitor in trunk.monitors].index(number)
    monitor = trunk.monitors[place]
    return (
        monitor.steps <= merging.watch_steps
        and all(each.both_sides_connected(trunk.active_robots) for each in trunk.monitors[place:])
        and monitor.is_inconsistent(trunk.filter.map("mixture"), merging, options)
    )


def separate_groups(group: Group, trunks: Sequence[Branch], epoch: int, records: SharedRecords) -> list[Group]:
    """Return the groups of some trunks, which continue as if they had never been merged.

    Robots out of contact keep their forks until they return.

    Args:
        group: The joint group; not to be used afterwards.
        trunks: Trunks from before its merges that have caught up with its own.
        epoch: Epoch of the separated filters.
        records: Records of the team.
    """
    active = set(group.trunk.active_robots)
    for trunk in trunks:
        trunk.active_robots, trunk.epoch = tuple(robot for robot in trunk.robots if robot in active), epoch
    separated = [Group(trunk) for trunk in trunks]
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
