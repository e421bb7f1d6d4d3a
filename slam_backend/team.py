"""`TeamSlam`: robots that start at unknown places, one filter each, until their maps can be aligned and merged.

A group is a set of robots that share a map frame and a joint filter (Sec. 4); at the start each robot is its own
group. The frame of a group is the start frame of its first robot, the one of lowest index. From time to time one pair
of groups tries to align its maps (Sec. 3.1); when that succeeds their filters are merged particle by particle
(Sec. 3.2). A merge can be refused, with a reason: a false merge is worse than a late one.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from slam_backend._step_input import check_step
from slam_backend.alignment import Alignment, AlignmentOptions, align_maps
from slam_backend.attempts import AttemptOptions, AttemptSchedule, PairKey
from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument, check_array, check_int, check_seed
from slam_backend.exchange import ExchangeLedger
from slam_backend.filter import FastSlam
from slam_backend.filter_options import FilterOptions
from slam_backend.fusion import check_inliers
from slam_backend.geometry import inverse
from slam_backend.landmark_map import LandmarkMap
from slam_backend.measurements import Measurements
from slam_backend.merging import inverse_alignment, merge_filters
from slam_backend.reports import MergeEvent, PoseEstimate, Renaming, StepReport, TeamReport


@dataclass(slots=True, eq=False)
class _Group:
    """Robots in ascending order, and their joint filter, whose robots stand in the same order."""

    robots: tuple[int, ...]
    filter: FastSlam
    report: StepReport | None = None


class TeamSlam:
    """Visual FastSLAM for a team whose robots do not know where they start.

    Args:
        num_robots: K.
        alignment: When two maps are believed to fit together.
        attempts: When a pair of groups tries.
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
            ("alignment", alignment, AlignmentOptions), ("attempts", attempts, AttemptOptions)
        ):
            if value is not None and not isinstance(value, kind):
                raise bad_argument(name, f"{kind.__name__} or None", value, f"Build one: {kind.__name__}(...).")
        if isinstance(seed, np.random.Generator):
            raise bad_argument("seed", "an int >= 0 or a SeedSequence", seed, "A team spawns a stream for each robot.")
        sequence = seed if isinstance(seed, np.random.SeedSequence) else np.random.SeedSequence(check_seed(seed))
        own, *streams = sequence.spawn(1 + count)
        self._rng = np.random.default_rng(own)
        self._alignment = AlignmentOptions() if alignment is None else alignment
        self._schedule = AttemptSchedule(AttemptOptions() if attempts is None else attempts, self._alignment)
        self._groups = [
            _Group((robot,), FastSlam.from_options(1, options, np.random.default_rng(streams[robot])))
            for robot in range(count)
        ]
        self._exchange = ExchangeLedger(count)
        self._step = 0
        self._events: list[MergeEvent] = []

    # ------------------------------------------------------------------ what the team knows

    @property
    def num_robots(self) -> int:
        """K."""
        return sum(len(group.robots) for group in self._groups)

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The groups, each in ascending order of robots, by ascending first robot."""
        return tuple(group.robots for group in self._groups)

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """All attempts and merges so far, in order."""
        return tuple(self._events)

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) bytes that each robot has sent. A copy."""
        return self._exchange.bytes_sent.copy()

    @property
    def diagnostics(self) -> tuple[dict[str, float], ...]:
        """Per robot: ESS, NIS, landmarks held, and its accepted, new and rejected measurements of the last step."""
        rows: list[dict[str, float]] = []
        for robot in range(self.num_robots):
            group, index = self._find(robot)
            report = group.report
            found = np.empty(0, np.int64) if report is None else report.associations[index]
            made = np.empty(0, np.int64) if report is None else report.created[index]
            new = int(np.count_nonzero((found >= 0) & (found == made)))
            rows.append(
                {
                    "ess": self.ess(robot),
                    "nis": float("nan") if report is None else report.nis,
                    "landmarks": float(group.filter.map_size),
                    "accepted": float(np.count_nonzero(found >= 0) - new),
                    "new": float(new),
                    "rejected": float(np.count_nonzero(found < 0)),
                }
            )
        return tuple(rows)

    def ess(self, robot: int) -> float:
        """Return the effective sample size of the robot's filter at its last step, in [1, M]."""
        group = self._find(robot)[0]
        return float(group.filter.num_particles) if group.report is None else group.report.ess

    def pose(self, robot: int) -> PoseEstimate:
        """Return the robot's pose in the map frame of its group."""
        group, index = self._find(robot)
        return group.filter.pose(index)

    def particles(self, robot: int) -> tuple[FloatArray, FloatArray]:
        """Return the robot's poses (M, 3), map frame of its group, and their log-weights (M,). Copies."""
        group, index = self._find(robot)
        return group.filter.particles(index)

    def pose_from_start(self, robot: int) -> PoseEstimate:
        """Return the robot's pose in its own start frame; see `FastSlam.pose_from_start`."""
        group, index = self._find(robot)
        return group.filter.pose_from_start(index)

    def particles_from_start(self, robot: int) -> FloatArray:
        """Return the robot's poses (M, 3) in its own start frame; see `FastSlam.particles_from_start`."""
        group, index = self._find(robot)
        return group.filter.particles_from_start(index)

    def map(self, robot: int, estimate: Literal["best", "mixture"] = "best") -> LandmarkMap:
        """Return the map of the robot's group in the group's map frame; see `FastSlam.map`."""
        return self._find(robot)[0].filter.map(estimate)

    def start_from_group(self, robot: int) -> FloatArray:
        """Return (3,) the motion from the map frame of the robot's group to the robot's own start frame.

        It is that of the most probable particle, so that it fits `map(robot)`.
        """
        group, index = self._find(robot)
        return inverse(group.filter.start_pose(index))

    # ------------------------------------------------------------------ one step

    def step(
        self,
        odometry: Sequence[ArrayLike | None],
        measurements: Sequence[Measurements | None],
        contacts: ArrayLike | None = None,
        identities: Sequence[ArrayLike | None] | None = None,
        poses: Sequence[ArrayLike | None] | None = None,
    ) -> TeamReport:
        """Step each group's filter, then let at most one pair of groups try to align its maps.

        Args:
            odometry: Per robot (3,) [m, m, rad], or None; see `FastSlam.step`.
            measurements: Per robot its frame, or None.
            contacts: (K, K) bool, who can exchange data now; None = all. Groups that have no contact do not try.
            identities: Per robot (n_i,) int, see `FastSlam.step`.
            poses: Per robot (3,), see `FastSlam.step`.

        Raises:
            ValueError: If an argument is ill-formed; the team is then as before.
        """
        touch = self._check_contacts(contacts)
        camera = self._groups[0].filter.options.camera
        check_step(self.num_robots, self._descriptor_size(), camera, odometry, measurements, identities, poses)
        associations: list[IntArray] = [np.empty(0, np.int64)] * self.num_robots
        created = list(associations)
        for group in self._groups:
            done = group.filter.step(
                [odometry[robot] for robot in group.robots],
                [measurements[robot] for robot in group.robots],
                None if identities is None else [identities[robot] for robot in group.robots],
                None if poses is None else [poses[robot] for robot in group.robots],
            )
            group.report = done
            for index, robot in enumerate(group.robots):
                associations[robot], created[robot] = done.associations[index], done.created[index]
            self._exchange.record_step(group.robots, done, group.filter.descriptor_size)
        before = len(self._events)
        renamings = self._attempt(touch)
        report = TeamReport(
            step=self._step,
            associations=tuple(associations),
            created=tuple(created),
            groups=self.groups,
            events=tuple(self._events[before:]),
            renamings=renamings,
        )
        self._step += 1
        return report

    def merge(self, robot_a: int, robot_b: int, alignment: Alignment) -> Renaming:
        """Merge the groups of two robots with a given alignment, unasked whether it is right.

        Args:
            robot_a: A robot of one group.
            robot_b: A robot of the other.
            alignment: Motion from the map frame of b's group to that of a's; `inliers` are rows of `map(robot_a)` and
                `map(robot_b)`, none if the landmarks in common are not known.

        Returns:
            How landmark ids changed; `robots_a` is the group whose frame stays, the one with the lowest robot.

        Raises:
            ValueError: If the robots share a group already, or the alignment is a refusal or names rows that do not
                exist or the same one twice; the team is then as before.
        """
        a, b = self._find(robot_a)[0], self._find(robot_b)[0]
        if a is b:
            raise bad_argument("robot_b", f"a robot outside the group {a.robots}", robot_b, "They share a map already.")
        if not isinstance(alignment, Alignment) or not alignment.success:
            got = f"a refusal ({alignment.reason})" if isinstance(alignment, Alignment) else alignment
            raise bad_argument("alignment", "a successful Alignment", got, "Align the two maps first.")
        if b.robots < a.robots:
            a, b, alignment = b, a, inverse_alignment(alignment)
        ids_a, ids_b = a.filter.map().ids, b.filter.map().ids
        check_inliers(alignment.inliers, len(ids_a), len(ids_b))
        pairs = np.column_stack([ids_a[alignment.inliers[:, 0]], ids_b[alignment.inliers[:, 1]]])
        joint, renamed = merge_filters(a.filter, b.filter, alignment, pairs, self._rng)
        robots = a.robots + b.robots
        joint.reorder(np.argsort(robots))
        renaming = Renaming(a.robots, b.robots, renamed)
        self._events.append(MergeEvent(self._step, "merge", a.robots, b.robots, alignment))
        self._groups = [group for group in self._groups if group is not a and group is not b]
        self._groups.append(_Group(tuple(sorted(robots)), joint))
        self._groups.sort(key=lambda group: group.robots)
        return renaming

    def _attempt(self, touch: BoolArray) -> tuple[Renaming, ...]:
        """Let the most promising pair of groups try, if it is time."""
        if not self._schedule.is_due(self._step) or len(self._groups) < 2:
            return ()
        maps: dict[tuple[int, ...], LandmarkMap] = {}
        pairs: dict[PairKey, tuple[_Group, _Group]] = {}
        for i, a in enumerate(self._groups):
            for b in self._groups[i + 1 :]:
                if touch[np.ix_(a.robots, b.robots)].any() and self._schedule.may_try((a.robots, b.robots), self._step):
                    pairs[a.robots, b.robots] = (a, b)
                    for group in (a, b):
                        if group.robots not in maps:
                            maps[group.robots] = group.filter.map("mixture")
        chosen = self._schedule.choose({key: (maps[key[0]], maps[key[1]]) for key in pairs}, self._step)
        if chosen is None:
            return ()
        a, b = pairs[chosen]
        alignment = align_maps(maps[a.robots], maps[b.robots], rng=self._rng, options=self._alignment)
        self._exchange.record_maps(a.robots[0], b.robots[0], maps[a.robots], maps[b.robots])
        self._events.append(MergeEvent(self._step, "attempt", a.robots, b.robots, alignment))
        self._schedule.record(chosen, self._step, alignment.success)
        return (self.merge(a.robots[0], b.robots[0], alignment),) if alignment.success else ()

    def _check_contacts(self, contacts: ArrayLike | None) -> BoolArray:
        count = self.num_robots
        if contacts is None:
            return np.ones((count, count), dtype=np.bool_)
        cure = "Say for each pair of robots whether it can exchange data."
        touch = check_array("contacts", contacts, (count, count), cure, dtype=None, finite=False)
        if touch.dtype != np.bool_ or not np.array_equal(touch, touch.T):
            got = f"an array of {touch.dtype}" if touch.dtype != np.bool_ else "a matrix that is not symmetric"
            raise bad_argument("contacts", "a symmetric array of bools", got, cure)
        return touch

    def _descriptor_size(self) -> int:
        """Return the length of the descriptors in use, 0 before the first one."""
        return max(group.filter.descriptor_size for group in self._groups)

    def _find(self, robot: int) -> tuple[_Group, int]:
        """Return the robot's group and its place in it."""
        if isinstance(robot, (int, np.integer)) and not isinstance(robot, bool):
            for group in self._groups:
                if robot in group.robots:
                    return group, group.robots.index(robot)
        raise bad_argument("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the team goes on, random streams included. Shares nothing with it."""
        return {
            "step": self._step,
            "rng": copy.deepcopy(self._rng.bit_generator.state),
            "events": tuple(self._events),
            "groups": [(group.robots, group.filter.get_state(), group.report) for group in self._groups],
            "alignment": self._alignment,
            "schedule": self._schedule.get_state(),
            "exchange": self._exchange.get_state(),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the team that gave `state`.

        Raises:
            ValueError: If `state` is not one of `get_state`, or of a team of another size.
        """
        keys = ("step", "rng", "events", "groups", "alignment", "schedule", "exchange")
        missing = [key for key in keys if not isinstance(state, Mapping) or key not in state]
        if missing:
            raise bad_argument("state", "a dict from TeamSlam.get_state", f"no {missing[0]!r}", "Pass it unchanged.")
        count = sum(len(robots) for robots, _, _ in state["groups"])
        if count != self.num_robots:
            raise bad_argument("state", f"one of {self.num_robots} robots", count, "Build a team of the same size.")
        self._step = state["step"]
        self._rng.bit_generator.state = copy.deepcopy(state["rng"])
        self._events = list(state["events"])
        at_hand = {group.robots: group.filter for group in self._groups}  # a filter takes longer to build than to fill
        self._groups = []
        for robots, filter_state, report in state["groups"]:
            slam = at_hand.get(robots) or FastSlam.from_options(len(robots), filter_state["options"])
            slam.set_state(filter_state)
            self._groups.append(_Group(robots, slam, report))
        self._alignment = state["alignment"]
        self._schedule.set_state(state["schedule"])
        self._exchange.set_state(state["exchange"])
