"""`TeamSlam`: robots that start at unknown places, one filter each, until their maps can be aligned and merged.

A group is a set of robots that share a map frame and a joint filter (Sec. 4); at the start each robot is its own
group. The frame of a group is the start frame of its first robot, the one of lowest index. From time to time one pair
of groups tries to align its maps (Sec. 3.1); when that succeeds their filters are merged particle by particle
(Sec. 3.2). A merge can be refused, with a reason: a false merge is worse than a late one. For a while after a merge the
team watches whether its maps contradict each other, and if they do it undoes the merge. Robots that lose contact with
their group go on with a fork of the joint filter, which is told on their return what they have read meanwhile.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from slam_backend._step_input import check_step
from slam_backend.alignment import Alignment, AlignmentOptions, align_maps
from slam_backend.attempts import AttemptOptions, AttemptSchedule, PairKey
from slam_backend.branches import Branch, take_in
from slam_backend.contacts import check_contacts, reach
from slam_backend.errors import FloatArray, IntArray, bad_argument, check_int, check_seed
from slam_backend.filter import FastSlam
from slam_backend.filter_options import FilterOptions
from slam_backend.fusion import check_inliers
from slam_backend.geometry import inverse
from slam_backend.groups import Group, undone
from slam_backend.input_log import RobotInput
from slam_backend.landmark_map import LandmarkMap
from slam_backend.measurements import Measurements
from slam_backend.merge_options import MergeOptions
from slam_backend.merging import inverse_alignment, merge_filters
from slam_backend.mixture_merging import merge_mixtures
from slam_backend.records import Records
from slam_backend.reports import MapDropped, MergeEvent, PoseEstimate, Renaming, TeamReport
from slam_backend.watching import Side, Watch, begin_watch


class TeamSlam:
    """Visual FastSLAM for a team whose robots do not know where they start.

    Args:
        num_robots: K.
        alignment: When two maps are believed to fit together.
        attempts: When a pair of groups tries.
        merging: How filters are merged, and when a merge is undone.
        seed: Of all random streams of the team: an int or a `numpy.random.SeedSequence`.
        **fastslam_options: Of each filter; the fields of `FilterOptions`.

    Raises:
        ValueError: If an argument is unknown or out of its range; the text names it.
    """

    def __init__(
        self,
        num_robots: int,
        alignment: AlignmentOptions | None = None,
        seed: int | np.random.SeedSequence = 0,
        attempts: AttemptOptions | None = None,
        merging: MergeOptions | None = None,
        **fastslam_options: Any,
    ) -> None:
        count = check_int("num_robots", num_robots, 1, "A team has at least one robot.")
        known = {field.name for field in fields(FilterOptions)}
        for name in fastslam_options:
            if name not in known:
                cure = f"Options of the filters are {', '.join(sorted(known))}."
                raise bad_argument(name, "a known argument", "a name that no option has", cure)
        options = FilterOptions(**fastslam_options)
        for name, value, kind in (
            ("alignment", alignment, AlignmentOptions),
            ("attempts", attempts, AttemptOptions),
            ("merging", merging, MergeOptions),
        ):
            if value is not None and not isinstance(value, kind):
                raise bad_argument(name, f"{kind.__name__} or None", value, f"Build one: {kind.__name__}(...).")
        if isinstance(seed, np.random.Generator):
            raise bad_argument("seed", "an int >= 0 or a SeedSequence", seed, "A team spawns a stream for each robot.")
        sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(check_seed(seed))
        own, *streams, of_forks = sequence.spawn(2 + count)
        self._rng = np.random.default_rng(own)
        self._alignment = AlignmentOptions() if alignment is None else alignment
        self._merging = MergeOptions() if merging is None else merging
        self._schedule = AttemptSchedule(AttemptOptions() if attempts is None else attempts, self._alignment)
        self._groups = [
            Group(Branch((robot,), (robot,), FastSlam.from_options(1, options, rng), {robot: -1}, robot))
            for robot, rng in enumerate(map(np.random.default_rng, streams))
        ]
        self._records = Records(count, of_forks)
        self._numbers = set(range(count))
        self._num_robots = count
        self._step = 0
        self._epoch = 0
        self._events: list[MergeEvent] = []

    # ------------------------------------------------------------------ what the team knows

    @property
    def num_robots(self) -> int:
        """K."""
        return self._num_robots

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The groups, each in ascending order of robots, by ascending first robot."""
        return tuple(group.robots for group in self._groups)

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """All attempts, merges and undos so far, in order."""
        return tuple(self._events)

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) bytes that each robot has sent; `slam_backend.exchange` says what is counted. A copy."""
        return self._records.exchange.bytes_sent.copy()

    @property
    def maps(self) -> tuple[int, ...]:
        """Per robot the number of the map that it goes by; see `TeamReport`."""
        return tuple(self._branch(robot).number for robot in range(self._num_robots))

    @property
    def diagnostics(self) -> tuple[dict[str, float], ...]:
        """Per robot: ESS, NIS, landmarks held, and its accepted, new and rejected measurements of the last step."""
        rows: list[dict[str, float]] = []
        for robot in range(self.num_robots):
            branch, index = self._find(robot)
            report = branch.report
            found = np.empty(0, np.int64) if report is None else report.associations[index]
            made = np.empty(0, np.int64) if report is None else report.created[index]
            new = int(np.count_nonzero((found >= 0) & (found == made)))
            rows.append(
                {
                    "ess": self.ess(robot),
                    "nis": float("nan") if report is None else report.nis,
                    "landmarks": float(branch.filter.map_size),
                    "accepted": float(np.count_nonzero(found >= 0) - new),
                    "new": float(new),
                    "rejected": float(np.count_nonzero(found < 0)),
                }
            )
        return tuple(rows)

    def members(self, robot: int) -> tuple[int, ...]:
        """Return the robots whose places the robot's filter knows, itself included, in ascending order.

        They are its group, but for a robot that has been out of contact since before a merge or an undo: it knows of
        neither. The map frame is the start frame of the first of them.
        """
        return self._find(robot)[0].robots

    def mates(self, robot: int) -> tuple[int, ...]:
        """Return the robots that go by the same filter as this one now, itself included, in ascending order."""
        return self._find(robot)[0].live

    def keepers(self, robot: int) -> tuple[int, ...]:
        """Return the robots that go by the joint filter of a robot's group, in ascending order: it merges by them."""
        return self._group_of(robot).trunk.live

    def ess(self, robot: int) -> float:
        """Return the effective sample size of the robot's filter at its last step, in [1, M]."""
        branch = self._find(robot)[0]
        return float(branch.filter.num_particles) if branch.report is None else branch.report.ess

    def pose(self, robot: int, seen_by: int | None = None) -> PoseEstimate:
        """Return the robot's pose in the map frame.

        Args:
            robot: Whose.
            seen_by: In whose filter, one of whose `members` is the robot; None: its own. Of a robot out of contact
                others know where it was when contact was lost.

        Raises:
            ValueError: If a robot does not exist or that filter does not know it.
        """
        branch, index = self._find(robot)
        if seen_by is not None:
            branch = self._find(seen_by)[0]
            if robot not in branch.robots:
                raise bad_argument("robot", f"one of {branch.robots}", robot, "Ask about members of its filter.")
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

    def map(
        self, robot: int, estimate: Literal["best", "mixture"] = "best", min_count: int = 1
    ) -> LandmarkMap:
        """Return the map that the robot goes by in its map frame; see `FastSlam.map`."""
        return self._find(robot)[0].filter.map(estimate, min_count)

    def start_from_group(self, robot: int) -> FloatArray:
        """Return (3,) the motion from the map frame of the robot's filter to the robot's own start frame.

        It is that of the most probable particle, so that it fits `map(robot)`.
        """
        branch, index = self._find(robot)
        return inverse(branch.filter.start_pose(index))

    # ------------------------------------------------------------------ one step

    def step(
        self,
        odometry: Sequence[ArrayLike | None],
        measurements: Sequence[Measurements | None],
        contacts: ArrayLike | None = None,
        identities: Sequence[ArrayLike | None] | None = None,
        poses: Sequence[ArrayLike | None] | None = None,
    ) -> TeamReport:
        """Let robots lose and find each other, step each filter, weigh the last merges, and let one pair of groups try.

        Robots pass on what they hear: who reaches another through others is in contact with it. Where robots of a
        group lose contact, the largest part (of equal ones that with the lowest robot) keeps the joint filter; each
        other part goes on with a fork of it, and the joint filter holds their poses. On return the joint filter takes
        in what they have read meanwhile, at most 20 steps of it per step; until it has caught up they go by their
        fork. Parts that meet away from the joint filter join likewise. Only the robots that keep the joint filter
        align and merge.

        Args:
            odometry: Per robot (3,) [m, m, rad], or None; see `FastSlam.step`.
            measurements: Per robot its frame, or None.
            contacts: (K, K) bool, symmetric: who hears whom now; the diagonal means nothing. None = all.
            identities: Per robot (n_i,) int, see `FastSlam.step`.
            poses: Per robot (3,), see `FastSlam.step`.

        Raises:
            ValueError: If an argument is ill-formed; the team is then as before.
        """
        networks = reach(check_contacts(contacts, self._num_robots), self._num_robots)
        camera = self._groups[0].trunk.filter.options.camera
        size = self._descriptor_size()
        checked = check_step(self._num_robots, size, camera, odometry, measurements, identities, poses)
        inputs = [RobotInput(*reading) for reading in zip(*checked, strict=True)]
        records, before = self._records, len(self._events)
        records.log.record(self._step, inputs)
        for group in self._groups:
            group.regroup(networks, records)
        associations: list[IntArray] = [np.empty(0, np.int64)] * self._num_robots
        created = list(associations)
        for group in self._groups:
            for branch in group.branches:
                self._advance(branch, inputs)
                if branch.report is not None:
                    for index, robot in enumerate(branch.robots):
                        if robot in branch.live:
                            associations[robot] = branch.report.associations[index]
                            created[robot] = branch.report.created[index]
        self._doubt()
        renamings = self._attempt(networks)
        records.log.forget_before(oldest := min(group.oldest_unknown(self._step) for group in self._groups))
        report = TeamReport(
            step=self._step,
            associations=tuple(associations),
            created=tuple(created),
            groups=self.groups,
            events=tuple(self._events[before:]),
            renamings=renamings,
            maps=self.maps,
            entries=(*records.entries, *self._dropped()),
            oldest_step=oldest,
        )
        records.entries.clear()
        self._step += 1
        return report

    def _advance(self, branch: Branch, inputs: Sequence[RobotInput]) -> None:
        """Step a filter with what its robots have just read."""
        report = take_in(branch, self._step, branch.live, [inputs[robot] for robot in branch.live])
        self._records.note_created(branch, branch.live, self._step, report)
        self._records.exchange.record_step(branch.robots, report, branch.filter.descriptor_size, branch.live)

    def merge(self, robot_a: int, robot_b: int, alignment: Alignment) -> Renaming:
        """Merge the joint filters of two robots' groups with a given alignment, unasked whether it is right.

        The merge is then watched like any other; `MergeOptions(watch_steps=0)` makes it final.

        Args:
            robot_a: A robot of one group that goes by its joint filter.
            robot_b: Such a robot of the other.
            alignment: Motion from the map frame of b's group to that of a's; `inliers` are rows of `map(robot_a)` and
                `map(robot_b)`, none if the landmarks in common are not known.

        Returns:
            How landmark ids changed; `robots_a` is the group whose frame stays, the one with the lowest robot.

        Raises:
            ValueError: If the robots share a group already, or one is out of contact with its joint filter, or the
                alignment is a refusal or names rows that do not exist or the same one twice; the team is then as
                before.
        """
        groups = self._group_of(robot_a), self._group_of(robot_b)
        if groups[0] is groups[1]:
            expected = f"a robot outside the group {groups[0].robots}"
            raise bad_argument("robot_b", expected, robot_b, "They share a map already.")
        for name, robot, group in zip(("robot_a", "robot_b"), (robot_a, robot_b), groups, strict=True):
            if robot not in group.trunk.live:
                cure = "Merge through a robot that goes by the joint filter."
                raise bad_argument(name, f"one of {group.trunk.live}", robot, cure)
        if not isinstance(alignment, Alignment) or not alignment.success:
            got = f"a refusal ({alignment.reason})" if isinstance(alignment, Alignment) else alignment
            raise bad_argument("alignment", "a successful Alignment", got, "Align the two maps first.")
        if groups[1].robots < groups[0].robots:
            groups, alignment = groups[::-1], inverse_alignment(alignment)
        a, b = (group.trunk for group in groups)
        ids_a, ids_b = a.filter.map().ids, b.filter.map().ids
        check_inliers(alignment.inliers, len(ids_a), len(ids_b))
        pairs = np.column_stack([ids_a[alignment.inliers[:, 0]], ids_b[alignment.inliers[:, 1]]])
        combine = merge_filters if self._merging.method == "particles" else merge_mixtures
        count = self._merging.merged_particles
        joint, renamed = combine(a.filter, b.filter, alignment, pairs, self._rng, count)
        robots, live = a.robots + b.robots, a.live + b.live
        joint.reorder(np.argsort(robots))
        number = self._records.new_number()
        self._epoch += 1
        trunk = Branch(tuple(sorted(robots)), tuple(sorted(live)), joint, a.known | b.known, number, self._epoch)
        forks = [branch for group in groups for branch in group.branches[1:]]
        if self._merging.watch_steps:
            new_ids = dict(renamed.tolist())
            older = [*(w.copy() for w in a.watches), *(w.copy(new_ids) for w in b.watches)]
            sides = (Side(a.get_state()), Side(b.get_state()))
            before = (a.filter.map("mixture"), b.filter.map("mixture"))
            fresh = begin_watch(number, alignment, sides, before, renamed, pairs)
            trunk.watches = [*sorted(older, key=lambda watch: watch.number), fresh]
        renaming = Renaming(a.robots, b.robots, renamed, (a.number, b.number, number))
        self._records.entries.append(renaming)
        self._events.append(MergeEvent(self._step, "merge", a.robots, b.robots, alignment))
        self._replace(groups, [Group(trunk, forks)])
        return renaming

    def _replace(self, old: Sequence[Group], new: Sequence[Group]) -> None:
        """Put some groups in the place of others."""
        self._groups = [group for group in self._groups if all(group is not other for other in old)] + list(new)
        self._groups.sort(key=lambda group: group.robots)

    def _doubt(self) -> None:
        """Weigh the evidence about the merges that can still be undone, and undo what contradicts itself."""
        due = self._step % self._merging.watch_every == 0
        for group in list(self._groups):
            false = self._contradicted(group.trunk) if due and group.trunk.watches else None
            if false is not None:
                self._undo(group, false.number)
                continue
            for branch in group.branches:
                while branch.watches and branch.watches[0].steps >= self._merging.watch_steps:
                    branch.watches.pop(0)

    def _contradicted(self, trunk: Branch) -> Watch | None:
        """Return the oldest merge that the evidence contradicts, and that can be undone with those on top of it now."""
        watches = [w for w in trunk.watches if w.steps <= self._merging.watch_steps and w.together(trunk.live)]
        joint = trunk.filter.map("mixture") if watches else None
        for watch in watches:
            above = [newer for newer in trunk.watches if newer.number > watch.number]
            if joint is None or not all(newer.together(trunk.live) for newer in above):
                continue
            if watch.is_contradicted(joint, self._merging, self._alignment):
                return watch
        return None

    def _undo(self, group: Group, number: int) -> None:
        """Take back a merge of a group, and first those on top of it, the last one first."""
        watch, self._epoch = group.trunk.watches[-1], self._epoch + 1
        pair = (watch.sides[0].robots, watch.sides[1].robots)
        sides = undone(group, self._records, self._epoch)
        self._replace([group], sides)
        self._events.append(MergeEvent(self._step, "undo", *pair, watch.alignment))
        if watch.number == number:
            self._schedule.bar(pair, self._step + self._merging.barred_steps)
            return
        below = next(side for side in sides if any(older.number == number for older in side.trunk.watches))
        self._undo(below, number)

    def _attempt(self, networks: IntArray) -> tuple[Renaming, ...]:
        """Let the most promising pair of groups try, if it is time."""
        if not self._schedule.is_due(self._step) or len(self._groups) < 2:
            return ()
        maps: dict[tuple[int, ...], LandmarkMap] = {}
        pairs: dict[PairKey, tuple[Group, Group]] = {}
        for i, a in enumerate(self._groups):
            for b in self._groups[i + 1 :]:
                touch = networks[a.trunk.live[0]] == networks[b.trunk.live[0]]
                if touch and self._schedule.may_try((a.robots, b.robots), self._step):
                    pairs[a.robots, b.robots] = (a, b)
                    for group in (a, b):
                        if group.robots not in maps:
                            maps[group.robots] = group.trunk.filter.map("mixture")
        chosen = self._schedule.choose({key: (maps[key[0]], maps[key[1]]) for key in pairs}, self._step)
        if chosen is None:
            return ()
        a, b = pairs[chosen]
        alignment = align_maps(maps[a.robots], maps[b.robots], rng=self._rng, options=self._alignment)
        speakers = a.trunk.live[0], b.trunk.live[0]
        self._records.exchange.record_maps(*speakers, maps[a.robots], maps[b.robots])
        self._events.append(MergeEvent(self._step, "attempt", a.robots, b.robots, alignment))
        self._schedule.record(chosen, self._step, alignment.success)
        return (self.merge(*speakers, alignment),) if alignment.success else ()

    def _dropped(self) -> list[MapDropped]:
        """Return the maps that are gone since this was asked last."""
        numbers = set[int]().union(*(group.numbers() for group in self._groups))
        gone, self._numbers = sorted(self._numbers - numbers), self._numbers | numbers
        self._numbers -= set(gone)
        return [MapDropped(number) for number in gone]

    def _descriptor_size(self) -> int:
        """Return the length of the descriptors in use, 0 before the first one."""
        return max(branch.filter.descriptor_size for group in self._groups for branch in group.branches)

    def _group_of(self, robot: int) -> Group:
        if isinstance(robot, (int, np.integer)) and not isinstance(robot, bool):
            for group in self._groups:
                if robot in group.robots:
                    return group
        raise bad_argument("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")

    def _branch(self, robot: int) -> Branch:
        return self._group_of(robot).branch_of(robot)

    def _find(self, robot: int) -> tuple[Branch, int]:
        """Return the branch that the robot goes by, and its place in it."""
        branch = self._branch(robot)
        return branch, branch.robots.index(robot)

    # ------------------------------------------------------------------ snapshots

    _KEYS = ("step", "epoch", "rng", "events", "groups", "numbers", "alignment", "merging", "schedule", "records")

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the team goes on, random streams included.

        What is never written to (snapshots kept for an undo, readings, reports) is shared, all else is copied.
        """
        return {
            "step": self._step,
            "epoch": self._epoch,
            "rng": copy.deepcopy(self._rng.bit_generator.state),
            "events": tuple(self._events),
            "groups": [group.get_state() for group in self._groups],
            "numbers": sorted(self._numbers),
            "alignment": self._alignment,
            "merging": self._merging,
            "schedule": self._schedule.get_state(),
            "records": self._records.get_state(),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the team that gave `state`.

        Raises:
            ValueError: If `state` is not one of `get_state`, or of a team of another size.
        """
        missing = [key for key in self._KEYS if not isinstance(state, Mapping) or key not in state]
        if missing:
            raise bad_argument("state", "a dict from TeamSlam.get_state", f"no {missing[0]!r}", "Pass it unchanged.")
        count = sum(len(group[0]["robots"]) for group in state["groups"])
        if count != self.num_robots:
            raise bad_argument("state", f"one of {self.num_robots} robots", count, "Build a team of the same size.")
        self._step, self._epoch = state["step"], state["epoch"]
        self._rng.bit_generator.state = copy.deepcopy(state["rng"])
        self._events = list(state["events"])
        at_hand = {group.robots: group.trunk.filter for group in self._groups}  # filling is faster than building
        self._groups = [Group.from_state(group, at_hand) for group in state["groups"]]
        self._numbers = set(state["numbers"])
        self._alignment, self._merging = state["alignment"], state["merging"]
        self._schedule.set_state(state["schedule"])
        self._records.set_state(state["records"])
