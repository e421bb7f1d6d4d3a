"""What the robots believe: `TeamBelief` owns the team's filters and the seen grids, and hands out `Belief`s."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from slam_backend.alignment import Alignment, AlignmentOptions
from slam_backend.attempts import AttemptOptions
from slam_backend.errors import BoolArray, FloatArray, IntArray, check_int
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import compose, inverse, rotate_covariances
from slam_backend.landmark_map import LandmarkMap
from slam_backend.reports import MergeEvent, Renaming, TeamReport
from slam_backend.team import TeamSlam
from vslam_env.navigation import CandidateSlots, SeenGrid
from vslam_env.readings import Readings

CANDIDATE_TICKS = 10  # once a second


@dataclass(frozen=True, slots=True, kw_only=True)
class BeliefConfig:
    """What the robots assume about their sensors, and how they align their maps.

    Attributes:
        filter: Of each robot's FastSLAM; its camera and motion hold the assumed noise.
        alignment: When two maps are believed to fit together.
        attempts: When a pair of groups tries.
    """

    filter: FilterOptions = field(default_factory=FilterOptions)
    alignment: AlignmentOptions = field(default_factory=AlignmentOptions)
    attempts: AttemptOptions = field(default_factory=AttemptOptions)


@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Body:
    """What each robot knows of its own hardware.

    Attributes:
        radius: Of its disc [m].
        ray_angles: (R,) float64 [rad], robot frame, ascending. Directions of the range finder's rays.
        scan_range: A ray that meets nothing reads this [m].
    """

    radius: float
    ray_angles: FloatArray
    scan_range: float


@dataclass(frozen=True, slots=True, eq=False)
class Teammate:
    """Another robot of the same group, in the own start frame.

    Attributes:
        robot: Its index.
        pose: (3,) float64 [m, m, rad].
        covariance: (3, 3) float64 [m, m, rad].
    """

    robot: int
    pose: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """Sixteen places to explore, in stable slots; see `CandidateSlots`.

    Attributes:
        goals: (16, 2) float64 [m], start frame; NaN in empty slots.
        headings: (16,) float64 [rad], start frame; NaN in empty slots.
        lengths: (16,) float64 [m]. Of the path to each at the last update.
        valid: (16,) bool.
        features: (16, 5) float32 [m], robot frame; see `CandidateSlots.features`.
    """

    goals: FloatArray
    headings: FloatArray
    lengths: FloatArray
    valid: BoolArray
    features: NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class Belief:
    """What one robot believes after a tick; everything is in its own start frame, and nothing of it is the truth.

    Attributes:
        robot: Its index.
        tick: Ticks since the reset.
        frame: Identity of the group's map frame: the index of the group's first robot.
        group: The robots that share the map, itself included.
        pose: (3,) float64 [m, m, rad].
        covariance: (3, 3) float64 [m, m, rad].
        log_weights: (M,) float64, normalised.
        ess: Effective sample size, as a share of M.
        grid: The seen grid, read-only. It follows the robot: `copy()` it to keep it.
        candidates: Places to explore.
        teammates: The other robots of the group.
        start_from_group: (3,) float64 [m, m, rad]. Moves the group's map frame to the own start frame.
        group_map: The map in the group's frame; `map` has it in the own start frame.
        group_particles: (M, 3) float64 [m, m, rad], the group's frame; `particles` has them in the own start frame.
    """

    robot: int
    tick: int
    frame: int
    group: tuple[int, ...]
    pose: FloatArray
    covariance: FloatArray
    log_weights: FloatArray
    ess: float
    grid: SeenGrid
    candidates: Candidates
    teammates: tuple[Teammate, ...]
    start_from_group: FloatArray
    group_map: LandmarkMap
    group_particles: FloatArray

    @cached_property
    def map(self) -> LandmarkMap:
        """The landmarks of the group's most probable particle."""
        return self.group_map.moved(self.start_from_group)

    @cached_property
    def particles(self) -> FloatArray:
        """(M, 3) float64 [m, m, rad]. The robot's pose in each particle."""
        return compose(self.start_from_group, self.group_particles)


class TeamBelief:
    """The filters and grids of a team, moved on by readings alone.

    Args:
        config: What is assumed.
        num_robots: K.
        seed: Of all random streams; the same seed gives the same beliefs from the same readings.
        body: The robots' hardware.
        decision_ticks: Where policies choose among the candidates: these are renewed at every decision. None: every
            ten ticks, the robots taking turns.
        attempts: Whether the team tries to align its maps by itself.
    """

    def __init__(
        self,
        config: BeliefConfig,
        num_robots: int,
        seed: int | np.random.SeedSequence,
        body: Body,
        decision_ticks: int | None = None,
        attempts: bool = True,
    ) -> None:
        if isinstance(seed, np.random.SeedSequence):
            # A sequence remembers how often it spawned: a fresh one makes the result depend on its seed alone.
            seed = np.random.SeedSequence(seed.entropy, spawn_key=seed.spawn_key)
        options = {f.name: getattr(config.filter, f.name) for f in fields(FilterOptions)}
        self._team = TeamSlam(num_robots, config.alignment, seed, attempts=config.attempts, **options)
        self._body = body
        self._decision_ticks = decision_ticks
        self._contacts = None if attempts else np.zeros((num_robots, num_robots), np.bool_)
        self._grids = [SeenGrid() for _ in range(num_robots)]
        self._slots = [CandidateSlots() for _ in range(num_robots)]
        self._tick = -1
        self._beliefs: dict[int, Belief] = {}  # of this tick, made when asked for
        self._maps: dict[int, LandmarkMap] = {}  # of this tick, by the group's first robot

    @property
    def num_robots(self) -> int:
        """K."""
        return len(self._grids)

    @property
    def groups(self) -> tuple[tuple[int, ...], ...]:
        """The groups, each in ascending order of robots."""
        return self._team.groups

    @property
    def events(self) -> tuple[MergeEvent, ...]:
        """All attempts and merges so far, in order."""
        return self._team.events

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) bytes that each robot has sent."""
        return self._team.bytes_sent

    def step(self, readings: Sequence[Readings]) -> TeamReport:
        """Take in one tick's readings (the first ones are those of the reset) of all K robots."""
        self._forget_tick()
        self._tick += 1
        report = self._team.step(
            [r.odometry for r in readings],
            [r.measurements for r in readings],
            self._contacts,
            [r.identities for r in readings] if readings[0].identities is not None else None,
            [r.pose for r in readings] if readings[0].pose is not None else None,
        )
        for renaming in report.renamings:
            self._join_grids(renaming)
        for group in report.groups:
            self._paint(group, readings)
        for robot in range(self.num_robots):
            if self._candidates_are_due(robot):
                pose, teammates = self.pose(robot), self._teammate_positions(robot)
                self._slots[robot].update(self._grids[robot].cells, pose, teammates)
        return report

    def merge(self, robot_a: int, robot_b: int, alignment: Alignment) -> Renaming:
        """Merge the groups of two robots with a given alignment of their maps; see `TeamSlam.merge`."""
        self._forget_tick()
        renaming = self._team.merge(robot_a, robot_b, alignment)
        self._join_grids(renaming)
        return renaming

    def group_map(self, robot: int) -> LandmarkMap:
        """Return the map of a robot's group, in the group's map frame."""
        first = self.group(robot)[0]
        if first not in self._maps:
            self._maps[first] = self._team.map(first)
        return self._maps[first]

    def start_from_group(self, robot: int) -> FloatArray:
        """Return (3,) the motion from the group's map frame to the robot's own start frame."""
        return self._team.start_from_group(robot)

    def pose(self, robot: int) -> FloatArray:
        """Return the estimated pose (3,) [m, m, rad] of a robot in its own start frame."""
        return compose(self._team.start_from_group(robot), self._team.pose(robot).mean)

    def cells(self, robot: int) -> NDArray[np.uint8]:
        """Return the cells (300, 300) uint8 of a robot's seen grid; a read-only view that follows its changes."""
        return self._grids[robot].cells

    def belief(self, robot: int) -> Belief:
        """Return what a robot believes after the last tick."""
        check_int("robot", robot, 0, "Count robots from 0.")
        if robot not in self._beliefs:
            self._beliefs[robot] = self._make_belief(robot)
        return self._beliefs[robot]

    def _make_belief(self, robot: int) -> Belief:
        group = self.group(robot)
        start_from_group = self._team.start_from_group(robot)
        teammates = []
        for other in group:
            estimate = self._team.pose(other)
            pose = compose(start_from_group, estimate.mean)
            teammates.append(Teammate(other, pose, rotate_covariances(start_from_group[2], estimate.covariance)))
        own = teammates.pop(group.index(robot))
        particles, log_weights = self._team.particles(robot)
        slots = self._slots[robot]
        positions = np.array([mate.pose[:2] for mate in teammates])
        return Belief(
            robot=robot,
            tick=self._tick,
            frame=group[0],
            group=group,
            pose=own.pose,
            covariance=own.covariance,
            log_weights=log_weights,
            ess=self._team.diagnostics[robot]["ess"] / len(log_weights),
            grid=self._grids[robot].frozen(),
            candidates=Candidates(
                slots.goals, slots.headings, slots.lengths, slots.valid, slots.features(own.pose, positions)
            ),
            teammates=tuple(teammates),
            start_from_group=start_from_group,
            group_map=self.group_map(robot),
            group_particles=particles,
        )

    def _forget_tick(self) -> None:
        self._beliefs.clear()
        self._maps.clear()

    def group(self, robot: int) -> tuple[int, ...]:
        """Return the robots that share a map with this one, itself included."""
        return next(group for group in self._team.groups if robot in group)

    def _teammate_positions(self, robot: int) -> FloatArray:
        """Return the positions (k, 2) [m] of the others of a robot's group, in its own start frame."""
        others = [other for other in self.group(robot) if other != robot]
        poses = np.array([self._team.pose(other).mean for other in others]).reshape(-1, 3)
        return compose(self._team.start_from_group(robot), poses)[:, :2]

    def _candidates_are_due(self, robot: int) -> bool:
        if self._tick == 0:
            return True
        if self._decision_ticks is not None:
            return self._tick % self._decision_ticks == 0
        return (self._tick - robot * CANDIDATE_TICKS // self.num_robots) % CANDIDATE_TICKS == 0

    def _join_grids(self, renaming: Renaming) -> None:
        """Give each robot of a new group the floor that the other side has seen.

        The members of a group have seen the same already, so one robot of each side stands for all of it.
        """
        sides = (renaming.robots_a, renaming.robots_b)
        seen = [self._grids[robots[0]].copy() for robots in sides]
        for robots, (others, grid) in zip(sides, zip(sides[::-1], seen[::-1], strict=True), strict=True):
            group_from_other = inverse(self._team.start_from_group(others[0]))
            for robot in robots:
                self._grids[robot].absorb(grid, compose(self._team.start_from_group(robot), group_from_other))

    def _paint(self, group: tuple[int, ...], readings: Sequence[Readings]) -> None:
        """Paint what each member of a group scans into the grids of all members."""
        body = self._body
        poses = np.array([self._team.pose(robot).mean for robot in group])
        for owner in group:
            grid = self._grids[owner]
            for robot, pose in zip(group, compose(self._team.start_from_group(owner), poses), strict=True):
                grid.paint_scan(pose, readings[robot].scan, body.ray_angles, body.scan_range)
                grid.clear_disc(pose, body.radius)
                if readings[robot].bump:
                    grid.bump(pose, body.radius)
