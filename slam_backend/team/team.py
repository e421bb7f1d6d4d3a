"""Multi-robot FastSLAM with unknown start poses: one filter per robot until maps can be aligned and merged.

A group is a set of robots that share a map frame and a joint filter (Sec. 4); initially each robot is its own group.
The frame of a group is the start frame of its first robot, the one of lowest index. At intervals one pair of groups
attempts to align its maps (Sec. 3.1); after a success their filters are merged particle by particle (Sec. 3.2). A merge
can be refused, with a reason: a false merge is worse than a late one. For a while after a merge the team checks whether
its maps contradict each other, and if so it undoes the merge. Robots that lose contact with their group use a fork of
the joint filter; on their return the joint filter replays their inputs.
"""

from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_int, check_kind, check_seed
from slam_backend.diagnosis import Cause
from slam_backend.fastslam.consistency import Consistency
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import MAX_ROBOTS, FilterOptions
from slam_backend.fastslam.particle_maps import write_summary
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.fastslam.reports import Associations, PoseEstimate, RejuvenationReport
from slam_backend.fastslam.step_input import StepInput, validate_step
from slam_backend.geometry import inverse
from slam_backend.maps.alignment import Alignment, AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap, TeamMapSummaries
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.pose_graph import PoseGraph
from slam_backend.state import Child, Each, Int, Sizes, Snapshot, State, accepted, restore, restored, take
from slam_backend.team.branches import Branch, process_step
from slam_backend.team.communication import TrafficCounter, check_contacts, contact_components
from slam_backend.team.filter_merging.merging import inverse_alignment
from slam_backend.team.group_merging import MergePlan
from slam_backend.team.groups import Group, TeamTopology
from slam_backend.team.merge import TeamMerges, branches_in
from slam_backend.team.merge_scheduler import AttemptOptions, MergeScheduler
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import (
    LandmarkIdMap,
    MapReleased,
    MergeEvent,
    PairAttempts,
    TeamReport,
    count_attempts,
    refusals_of,
)
from slam_backend.team.shared_records import SharedRecords

Rejuvenation = tuple[tuple[int, ...], RejuvenationReport]  # active robots of a filter, and outcome


class TeamSlam:
    """Visual FastSLAM for a team of robots with unknown start poses.

    Args:
        num_robots: K.
        alignment: Options of map alignments.
        attempts: Options that schedule the attempts of groups.
        merging: Options of merges and of their undo.
        seed: Seed of all random streams of the team: an int or a `numpy.random.SeedSequence`.
        **fastslam_options: Options of each filter; the fields of `FilterOptions`.

    Raises:
        ValueError: If an argument is unknown or out of its range; the text names it.
    """

    STATE = State(
        num_robots=Int(1, MAX_ROBOTS, size="K"), step=Int(size="STEPS"), records=Child(SharedRecords),
        merges=Child(TeamMerges), numbers=Each(Int(), kind=frozenset),
    )  # fmt: skip

    def __init__(
        self,
        num_robots: int,
        alignment: AlignmentOptions | None = None,
        seed: int | np.random.SeedSequence = 0,
        attempts: AttemptOptions | None = None,
        merging: MergeOptions | None = None,
        **fastslam_options: Any,
    ) -> None:
        count = check_int("num_robots", num_robots, 1, "Use at least one robot.", MAX_ROBOTS)
        known = {field.name for field in fields(FilterOptions)}
        for name in fastslam_options:
            if name not in known:
                hint = f"Filters have the options {', '.join(sorted(known))}."
                raise argument_error(name, "a known argument", "a name that is not an option", hint)
        options = FilterOptions(**fastslam_options)
        for name, value, kind in (
            ("alignment", alignment, AlignmentOptions),
            ("attempts", attempts, AttemptOptions),
            ("merging", merging, MergeOptions),
        ):
            if value is not None and not isinstance(value, kind):
                raise argument_error(name, f"{kind.__name__} or None", value, f"Build one: {kind.__name__}(...).")
        if isinstance(seed, np.random.Generator):
            raise argument_error(
                "seed", "an int >= 0 or a SeedSequence", seed, "The team spawns a stream for each robot."
            )
        sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(check_seed(seed))
        stream, *streams, of_forks = sequence.spawn(2 + count)
        schedule = MergeScheduler(
            AttemptOptions() if attempts is None else attempts, AlignmentOptions() if alignment is None else alignment
        )
        groups = [
            Group(Branch((robot,), (robot,), FastSlam.from_options(1, options, rng), {robot: -1}, robot))
            for robot, rng in enumerate(map(np.random.default_rng, streams))
        ]
        self._num_robots, self._records = count, SharedRecords(count, of_forks)
        merging = MergeOptions() if merging is None else merging
        self._merges = TeamMerges(groups, self._records, schedule, merging, np.random.default_rng(stream))
        self._together = contact_components(None, count)
        self._numbers = frozenset(range(count))
        self._refresh_topology()
        self._last_topology: TeamTopology | None = None
        self._step = 0
        self._size = 0

    # ------------------------------------------------------------------ one step

    def step(
        self,
        odometry: FloatArray | Sequence[ArrayLike | None],
        measurements: Sequence[Measurements | None] | TeamMeasurements,
        contacts: ArrayLike | None = None,
        identities: Sequence[ArrayLike | None] | None = None,
        poses: Sequence[ArrayLike | None] | None = None,
    ) -> TeamReport:
        """Update contacts, step each filter, check recent merges, and run an attempt of one pair of groups.

        Robots relay messages: two robots are in contact if others connect them. Where robots of a group lose contact,
        the largest part (of equal ones that with the lowest robot) keeps the joint filter; each other part uses a fork
        of it, and the joint filter keeps their last poses. On return the joint filter replays their inputs, at most 20
        steps of them per step; until it has caught up they use their fork. Forks that meet without the joint filter
        rejoin in the same way. Only the robots that use the joint filter align and merge.

        Args:
            odometry: One (3,) [m, m, rad] per robot, or None; see `FastSlam.step`. (K, 3) if all have moved.
            measurements: One frame per robot, or None; or the frames of all robots in one object.
            contacts: (K, K) bool, symmetric. Pairs of robots in contact now; the diagonal is ignored. None = all.
            identities: One (n_i,) int per robot, see `FastSlam.step`.
            poses: One (3,) per robot, see `FastSlam.step`.

        Raises:
            ValueError: If an argument is ill-formed; the team is then unchanged.
        """
        count, networks = self._num_robots, self._together
        if contacts is not None:
            networks = contact_components(check_contacts(contacts, count), count)
        topology, size = self.topology, self._size or self._descriptor_size()
        camera = topology.branches[0].filter.options.camera
        inputs = validate_step(count, size, camera, odometry, measurements, identities, poses)
        records, before = self._records, len(self._merges.events)
        if contacts is not None or topology.is_split:
            topology = self._update_groups(networks)
        if topology.oldest is not None:
            records.log.record(self._step, inputs)
        associations, rejuvenations = self._advance(topology, inputs)
        num_changes = len(records.entries)
        self._merges.advance(self._step, networks)
        id_maps = tuple(change for change in records.entries[num_changes:] if isinstance(change, LandmarkIdMap))
        if self._merges.is_stale:
            self._refresh_topology()
            topology = self.topology
        oldest = self._step + 1 if topology.oldest is None else topology.oldest
        if topology is not self._last_topology:
            self._note_dropped(topology)
            records.log.forget_before(oldest)
        events, entries = tuple(self._merges.events[before:]), tuple(records.entries)
        report = TeamReport(
            self._step, associations, topology.groups, events, id_maps, topology.maps, entries, oldest, rejuvenations
        )
        records.entries.clear()
        self._step += 1
        return report

    def _update_groups(self, networks: IntArray) -> TeamTopology:
        """Update the contacts of each group, and return the topology."""
        was_split = self.topology.is_split
        for group in self._groups:
            group.update_connectivity(networks, self._records)
        if was_split or any(len(group.branches) > 1 for group in self._groups):
            self._refresh_topology()
        return self.topology

    def _advance(self, topology: TeamTopology, inputs: StepInput) -> tuple[Associations, tuple[Rejuvenation, ...]]:
        """Step all filters with the inputs of their robots; return data association and rejuvenations."""
        step, records = self._step, self._records
        associations, buffer = Associations.allocate(inputs)
        rejuvenations: tuple[Rejuvenation, ...] = ()
        for branch, routing in zip(topology.branches, topology.routings, strict=True):
            report = process_step(branch, step, routing, inputs, associations, buffer)
            if report.num_created:
                records.note_created(branch.number, step, report)
            if len(routing.robots) > 1:  # a robot without contact sends nothing
                records.exchange.record_step(report, branch.filter.descriptor_size)
            if report.rejuvenation is not None:
                rejuvenations += ((routing.robots, report.rejuvenation.renumbered(branch.robots)),)
        return associations, rejuvenations

    def rejuvenate(self) -> tuple[Rejuvenation, ...]:
        """Sample the particles of all filters with `rejuvenate_every` from the posterior of whole paths now.

        Maps are then those of paths smoothed up to the last step, not up to the last scheduled rejuvenation.

        Returns:
            The robots and outcome of each filter; if an outcome has a reason, the particles are unchanged.
        """
        if self.filter_options.rejuvenate_every is None:
            return ()
        branches = [branch for group in self._groups for branch in group.branches]
        return tuple((each.active_robots, each.filter.rejuvenate().renumbered(each.robots)) for each in branches)

    def merge(self, robot_a: int, robot_b: int, alignment: Alignment, known: bool = False) -> LandmarkIdMap:
        """Merge the joint filters of two robots' groups with a given alignment, without verification.

        The merge is then monitored like any other; `MergeOptions(watch_steps=0)` makes it final.

        Args:
            robot_a: Robot of one group that uses its joint filter.
            robot_b: Such a robot of the other group.
            alignment: Motion from the map frame of b's group to that of a's; `inliers` are rows of `map(robot_a)` and
                `map(robot_b)`, none if the common landmarks are unknown.
            known: Whether the motion is drawn from the alignment's covariance as it is. Otherwise the common landmarks
                correct it, separately for each pair of particles, and the covariance counts where they are few.

        Returns:
            Renaming of the landmarks; `robots_a` is the group whose frame stays, the one with the lowest robot.

        Raises:
            ValueError: If the robots share a group, or one is out of contact with its joint filter, or the alignment is
                a refusal or names rows that do not exist or repeat; the team is then unchanged.
        """
        groups = self._group_of(robot_a), self._group_of(robot_b)
        if groups[0] is groups[1]:
            expected = f"a robot outside the group {groups[0].robots}"
            raise argument_error("robot_b", expected, robot_b, "These robots already share a map.")
        for name, robot, group in zip(("robot_a", "robot_b"), (robot_a, robot_b), groups, strict=True):
            if robot not in group.trunk.active_robots:
                hint = "Merge through a robot that uses the joint filter."
                raise argument_error(name, f"one of {group.trunk.active_robots}", robot, hint)
        if not isinstance(alignment, Alignment) or not alignment.success:
            got = f"a refusal ({alignment.reason})" if isinstance(alignment, Alignment) else alignment
            raise argument_error("alignment", "a successful Alignment", got, "Align the two maps first.")
        if groups[1].robots < groups[0].robots:
            groups, alignment = groups[::-1], inverse_alignment(alignment)
        id_map = self._merges.merge(MergePlan.of(*groups, alignment), self._step, known)
        self._refresh_topology()
        return id_map

    def _note_dropped(self, topology: TeamTopology) -> None:
        """Record the maps that have ended since the last topology."""
        self._records.entries += [MapReleased(number) for number in sorted(self._numbers - topology.numbers)]
        self._last_topology, self._numbers = topology, topology.numbers

    def _descriptor_size(self) -> int:
        """Return the length of the descriptors in use, 0 before the first one; it is constant from then on."""
        self._size = max([branch.filter.descriptor_size for branch in self.topology.branches])
        return self._size

    def _refresh_topology(self) -> None:
        """Recompute the assignment of robots to filters."""
        self.topology = self._merges.topology()

    # ------------------------------------------------------------------ estimates

    @property
    def num_robots(self) -> int:
        """Number of robots, K."""
        return self._num_robots

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The groups, each in ascending order of robots, by ascending first robot."""
        return self.topology.groups

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """All attempts, merges and undos so far, in order."""
        return tuple(self._merges.events)

    @property
    def pair_attempts(self) -> tuple[PairAttempts, ...]:
        """Outcomes of the attempts of each pair of groups so far, with the reason of the last refusal."""
        return count_attempts(self._merges.events)

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) bytes that each robot has sent; `slam_backend.team.communication` says what is counted. A copy."""
        return np.array(self.exchange.sent, np.int64)

    @property
    def exchange(self) -> TrafficCounter:
        """Traffic counter of the team; not to be changed."""
        return self._records.exchange

    @property
    def maps(self) -> tuple[int, ...]:
        """Number of each robot's map; see `TeamReport`."""
        return self.topology.maps

    @property
    def diagnostics(self) -> tuple[dict[str, float], ...]:
        """Per robot: ESS, NIS, landmarks held, and its accepted, new and rejected measurements of the last step.

        Over the lifetime of its filter: `nis_mean`, `nis_share`, `ess_share` and `rejected_share` of `Consistency`, and
        the number of `warnings`; `consistency` has their texts.
        Over all steps: the attempts of its groups to align maps, and the number of refusals by reason.
        """
        rows: list[dict[str, float]] = []
        for robot in range(self.num_robots):
            branch, index = self._find(robot)
            report = branch.report
            associated = np.empty(0, np.int64) if report is None else report.associations[index]
            created = np.empty(0, np.int64) if report is None else report.created[index]
            new = int(np.count_nonzero((associated >= 0) & (associated == created)))
            summary = branch.filter.consistency
            rows.append(
                {
                    "ess": self.ess(robot),
                    "nis": float("nan") if report is None else report.nis,
                    "landmarks": float(branch.filter.map_size),
                    "accepted": float(np.count_nonzero(associated >= 0) - new),
                    "new": float(new),
                    "rejected": float(np.count_nonzero(associated < 0)),
                    "nis_mean": summary.nis_mean,
                    "nis_share": summary.nis_share,
                    "ess_share": summary.ess_share,
                    "rejected_share": summary.rejected_share,
                    "warnings": float(len(summary.warnings)),
                    **refusals_of(self._merges.events, robot),
                }
            )
        return tuple(rows)

    def consistency(self, robot: int) -> Consistency:
        """Return the consistency of the filter that a robot uses; see `FastSlam.consistency`."""
        return self._find(robot)[0].filter.consistency

    def diagnose(self, robot: int) -> tuple[Cause, ...]:
        """Return the likely mistakes in the set-up of a robot's readings so far; see `FastSlam.diagnose`."""
        branch, index = self._find(robot)
        return branch.filter.diagnose(index)

    def known_robots(self, robot: int) -> tuple[int, ...]:
        """Return the robots in the robot's filter, itself included, in ascending order.

        They are its group, unless the robot has been out of contact since before a merge or an undo, which its filter
        then lacks. The map frame is the start frame of the first of them.
        """
        return self._find(robot)[0].robots

    def same_filter(self, robot: int) -> tuple[int, ...]:
        """Return the robots that use the same filter now, itself included, in ascending order."""
        return self._find(robot)[0].active_robots

    def trunk_robots(self, robot: int) -> tuple[int, ...]:
        """Return the robots that use the joint filter of a robot's group, in ascending order: only they can merge."""
        return self._group_of(robot).trunk.active_robots

    def ess(self, robot: int) -> float:
        """Return the effective sample size of the robot's filter at its last step, in [1, M]."""
        branch = self._find(robot)[0]
        return float(branch.filter.num_particles) if branch.report is None else branch.report.ess

    def pose(self, robot: int, seen_by: int | None = None) -> PoseEstimate:
        """Return the robot's pose in the map frame.

        Args:
            robot: Index of the robot.
            seen_by: Robot whose filter gives the pose, one of whose `known_robots` is `robot`; None: `robot` itself. In
                other filters a robot out of contact has its last pose before contact was lost.

        Raises:
            ValueError: If a robot does not exist or is not in that filter.
        """
        branch, index = self._find(robot)
        if seen_by is not None:
            branch = self._find(seen_by)[0]
            if robot not in branch.robots:
                raise argument_error("robot", f"one of {branch.robots}", robot, "Name a robot in this filter.")
            index = branch.robots.index(robot)
        return branch.filter.pose(index)

    def particles(self, robot: int) -> tuple[FloatArray, FloatArray]:
        """Return the robot's poses (M, 3), map frame of its group, and their log-weights (M,). Copies."""
        branch, index = self._find(robot)
        return branch.filter.particles(index)

    def pose_from_start(self, robot: int) -> PoseEstimate:
        """Return the robot's pose in its own start frame; see `FastSlam.pose_from_start`."""
        branch, index = self._find(robot)
        return branch.filter.pose_from_start(index)

    def particles_from_start(self, robot: int) -> FloatArray:
        """Return the robot's poses (M, 3) in its own start frame; see `FastSlam.particles_from_start`."""
        branch, index = self._find(robot)
        return branch.filter.particles_from_start(index)

    def map(self, robot: int, estimate: Literal["best", "mixture"] = "best", min_count: int = 1) -> LandmarkMap:
        """Return the robot's map in its map frame; see `FastSlam.map`."""
        return self._find(robot)[0].filter.map(estimate, min_count)

    def graph(self, robot: int, covariances: bool = True) -> PoseGraph:
        """Return the smoothed graph of the robots of `known_robots(robot)`, in this order; see `FastSlam.graph`."""
        return self._find(robot)[0].filter.graph(covariances)

    def merged_maps(self, merge: MergeEvent) -> tuple[LandmarkMap, LandmarkMap]:
        """Return the two maps joined by a merge as they were just before it, smoothed if the attempt smoothed them.

        Each is in its own frame, under its own ids, and has the rows that the inliers of `merge.alignment` name.

        Raises:
            ValueError: If the event is not a merge that is still monitored.
        """
        check_kind("merge", merge, MergeEvent, "Give one of the events of a step's report.")
        for joined in self._merges.watched:
            if joined.alignment is merge.alignment:
                map_a, map_b = (restored(side["filter"]).map() for side in joined.sides)
                return map_a, map_b
        expected, got = "a merge still monitored", f"the {merge.kind} of step {merge.step}"
        raise argument_error("merge", expected, got, "Call this in the step of the merge.")

    def start_from_group(self, robot: int) -> FloatArray:
        """Return (3,) the motion from the map frame of the robot's filter to the robot's own start frame.

        The start pose is that in the most probable particle, as for `map(robot)`.
        """
        branch, index = self._find(robot)
        return inverse(branch.filter.start_pose(index))

    def map_summaries(self, min_count: int = 1, into: TeamMapSummaries | None = None) -> TeamMapSummaries:
        """Return the summaries of `map(robot, min_count=min_count)` of all robots, much faster.

        Args:
            min_count: Least number of measurements of a landmark in the result.
            into: Earlier result, overwritten if it is large enough. None: fresh arrays.
        """
        summaries = TeamMapSummaries.allocate(self._num_robots, 0) if into is None else into
        (rows, parts), last = summaries, 0
        for branch in self.topology.branches:
            slam = branch.filter
            first, last = last, write_summary(slam.maps, slam.best_particle, min_count, rows, last)
            for robot in branch.active_robots:
                parts[robot, 0], parts[robot, 1] = first, last
        if last > len(rows.counts_and_ids):
            return self.map_summaries(min_count, TeamMapSummaries.allocate(self._num_robots, 2 * last))
        return summaries

    def team_poses(self, into: TeamPoses | None = None) -> TeamPoses:
        """Return the poses of all robots: `pose_from_start`, `start_from_group` and `pose` at once.

        Args:
            into: Earlier result, overwritten. None: fresh arrays.
        """
        poses = TeamPoses(self._num_robots) if into is None else into
        for branch in self.topology.branches:
            slam, report = branch.filter, branch.report
            ess = 1.0 if report is None else report.ess / slam.num_particles
            slam.write_team_poses(branch.robots, branch.active_robots, ess, poses)
        return poses

    def _group_of(self, robot: int) -> Group:
        """Return the robot's group."""
        return self._place(robot)[0]

    def _find(self, robot: int) -> tuple[Branch, int]:
        """Return the branch that the robot uses, and its index there."""
        return self._place(robot)[1:]

    def _place(self, robot: int) -> tuple[Group, Branch, int]:
        """Return the robot's group, its branch, and its index in the branch."""
        if type(robot) is int and 0 <= robot < self._num_robots:
            return self.topology.places[robot]
        if isinstance(robot, (int, np.integer)) and not isinstance(robot, bool) and 0 <= robot < self._num_robots:
            return self.topology.places[robot]
        raise argument_error("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")

    # ------------------------------------------------------------------ snapshots

    @property
    def filter_options(self) -> FilterOptions:
        """Options of all filters, except for their number of particles."""
        return self._groups[0].trunk.filter.options

    @property
    def _groups(self) -> list[Group]:
        """The groups, by ascending robots."""
        return self._merges.groups

    def get_state(self) -> Snapshot:
        """Return the complete state of the team, random streams included."""
        return take(self)

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `get_state`; the team then continues identically.

        Raises:
            ValueError: If `state` is not from `get_state`, or from a team of another size.
        """
        snapshot = accepted(TeamSlam, "state", state)
        if snapshot["num_robots"] != self._num_robots:
            expected = f"one of {self._num_robots} robots"
            raise argument_error("state", expected, snapshot["num_robots"], "Build a team of the same size.")
        restore(self, snapshot)

    def rebuild(self) -> None:
        """Recompute the assignment of robots to filters."""
        self._refresh_topology()
        self._last_topology, self._size = None, 0

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise if a number of a map is not known, an input to replay is missing, or descriptors differ in length."""
        step, merges, inputs = parts["step"], parts["merges"], parts["records"]["log"]["steps"]
        branches = list(branches_in(merges))
        numbers = {*parts["numbers"], *merges["joined"], *(branch["number"] for branch in branches)}
        if max(numbers) >= parts["records"]["next_number"]:
            raise ValueError("a number of a map that is to come")
        first = 1 + min(last for branch in branches for last in branch["last_steps"].values())
        if list(inputs) != list(range(step - len(inputs), step)) or first < step - len(inputs):
            raise ValueError("inputs that lack a step")
        descriptors = [branch["filter"]["maps"].descriptors for branch in branches]
        descriptors += [of_step.descriptors for of_step in inputs.values()]
        if len({rows.shape[1] for rows in descriptors if len(rows)}) > 1:
            raise ValueError("descriptors of several lengths")

    def __reduce__(self) -> tuple[Any, ...]:
        """Copy and pickle the team as its state."""
        return _unpickled, (self.get_state(),)


def _unpickled(state: Mapping[str, Any]) -> TeamSlam:
    """Return a team in a state."""
    team = TeamSlam(state["num_robots"])
    team.set_state(state)
    return team
