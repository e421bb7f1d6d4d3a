"""Beliefs of a team: its filters, occupancy grids and candidates."""

import math
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any
from weakref import WeakValueDictionary

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import Float32Array, FloatArray, argument_error
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.relative_poses import TeamPoses
from slam_backend.geometry import rotate_covariances
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.landmark_map import LandmarkMap, TeamMapSummaries
from slam_backend.state import FLOAT64, Array, Child, Flag, Int, Sizes, State
from slam_backend.team.merge import branches_in
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import LandmarkIdMap, TeamReport
from slam_backend.team.team import TeamSlam
from vslam_env.belief.belief import Belief, BeliefBatch, BeliefConfig, Candidates, RobotHardware, Teammate
from vslam_env.belief.observation_keys import KEYS, READ_CANDIDATES, READ_GLOBAL_GRIDS
from vslam_env.belief.readings import Readings, TeamReadings
from vslam_env.belief.rendezvous import Rendezvous
from vslam_env.belief.shared_grids import SharedGrids
from vslam_env.navigation import CANDIDATE_FEATURES, CandidateKind, OccupancyGrid, TeamCandidates
from vslam_env.navigation._grid_kernels import LARGEST_HALF_WIDTH
from vslam_env.navigation._planning_kernels import FrontierColumns
from vslam_env.navigation._view_kernels import write_goals
from vslam_env.navigation.candidates import SLOT_KINDS
from vslam_env.navigation.global_grids import GlobalGrids

__all__ = ["Belief", "BeliefConfig", "Candidates", "RobotHardware", "TeamBelief", "Teammate"]

CANDIDATE_TICKS = 10  # once a second


class TeamBelief:
    """Filters and occupancy grids of a team, updated by readings alone.

    Args:
        config: Configuration of the beliefs.
        num_robots: Number of robots K.
        seed: Seed of all random streams; the same seed and readings give the same beliefs.
        body: Hardware of the robots.
        decision_ticks: Ticks between updates of the candidates, for policies that choose among them; None: each robot
            every ten ticks, in turn.
        attempts: Whether the team attempts merges itself; if not, merges from outside are final.
        keeps_candidates: Whether candidates are found from the first tick on; if not, from when they are first read.

    Attributes:
        team: Filters of the team; it is changed by the methods of this class alone.
        team_poses: Pose estimates; overwritten in the next step.
        goals: (K, 2) float64 [m]. Goal of each robot in its own start frame; NaN: none.
        scans: (K, R) float64 [m]. Last scans.
        known_groups: Robots known to share a map with each robot, itself included.
        grids: Occupancy grids of the robots; read-only.
        keeps_candidates: Whether candidates are found every second, or at decisions.
    """

    STATE = State(
        tick=Int(),
        team=Child(TeamSlam),
        grids=Child(SharedGrids),
        keeps_candidates=Flag(),
        candidates=Child(TeamCandidates),
        rendezvous=Child(Rendezvous),
        goals=Array(FLOAT64, "K 2", -LARGEST_HALF_WIDTH, LARGEST_HALF_WIDTH, nan=True, renewed=True),
        scans=Array(FLOAT64, "K RAYS", 0.0, renewed=True),
    )

    def __init__(
        self,
        config: BeliefConfig,
        num_robots: int,
        seed: int | np.random.SeedSequence,
        body: RobotHardware,
        decision_ticks: int | None = None,
        attempts: bool = True,
        keeps_candidates: bool = False,
    ) -> None:
        if isinstance(seed, np.random.SeedSequence):
            # A new sequence: the number of children spawned before must not matter.
            seed = np.random.SeedSequence(seed.entropy, spawn_key=seed.spawn_key)
        options = {f.name: getattr(config.filter, f.name) for f in fields(FilterOptions)}
        schedule, merging = merge_options(config, attempts)
        self.team = TeamSlam(num_robots, config.alignment, seed, schedule, merging, **options)
        camera = config.filter.camera
        self.keeps_candidates = keeps_candidates
        self._grids = SharedGrids(num_robots, body, camera)
        self.grids = self._grids.team
        self._global_grids = GlobalGrids(num_robots)
        self._candidates = TeamCandidates(num_robots, (camera.half_fov, camera.max_range, body.radius))
        self._rendezvous = Rendezvous(num_robots)
        self.goals = np.full((num_robots, 2), np.nan)
        self._seconds_left = math.inf
        self._robots = np.arange(num_robots)
        self._no_features = np.empty((num_robots, 0, len(CANDIDATE_FEATURES)), np.float32)
        self.scans = np.zeros((num_robots, len(body.ray_angles)))
        self._turns = _candidate_schedule(num_robots, decision_ticks)
        self._tick = -1
        self._confirm_after = config.confirm_after
        self._beliefs: WeakValueDictionary[int, Belief] = WeakValueDictionary()  # of this tick
        self._version = 0  # of what beliefs are made from
        self._maps: dict[int, LandmarkMap] = {}  # maps of this tick by number
        self.team_poses = TeamPoses(num_robots)
        self._map_summaries = TeamMapSummaries.allocate(num_robots, 0)  # of this tick, filled on demand
        self._has_summaries = False
        self._whole_map_summaries = TeamMapSummaries.allocate(num_robots, 0)  # with unconfirmed landmarks
        self._refresh_poses()

    @property
    def poses(self) -> FloatArray:
        """(K, 3) float64 [m, m, rad]. Copy of the pose estimates, each in the robot's own start frame."""
        return self.team_poses.own.copy()

    def step(self, readings: TeamReadings | Sequence[Readings]) -> TeamReport:
        """Update all beliefs with the readings of one tick, beginning with the reset.

        Args:
            readings: Readings of all K robots, stacked or one record per robot.

        Raises:
            ValueError: If a reading is malformed, or robots differ in the kinds of readings.
        """
        if not isinstance(readings, TeamReadings):
            readings = TeamReadings.stack(readings)
        if readings.scans.shape != self.scans.shape:
            got, hint = f"shape {readings.scans.shape}", "Give one range per ray and robot."
            raise argument_error("readings.scans", f"an array of shape {self.scans.shape}", got, hint)
        if len(readings.bumps) != len(self._robots):
            got, hint = f"shape {readings.bumps.shape}", "Give one bool per robot."
            raise argument_error("readings.bumps", f"an array of shape ({len(self._robots)},)", got, hint)
        report = self.team.step(
            [None] * len(self._robots) if readings.odometry is None else readings.odometry,
            readings.measurements,
            readings.contacts,
            readings.identities,
            None if readings.poses is None else list(readings.poses),
        )
        self._tick += 1
        self._refresh_poses()
        self._grids.step(
            self._tick, report, self._topology.same_filter, self.team_poses, readings.scans, readings.bumps
        )
        self.scans = readings.scans.copy()
        if readings.goals is not None:
            self.goals = readings.goals
        if self.keeps_candidates:
            turns = self._turns[self._tick % len(self._turns)] if self._tick else range(len(self._robots))
            if len(turns):
                self._renew_candidates(turns)
        return report

    def know_floor(self, free: Sequence[FloatArray], walls: Sequence[FloatArray]) -> None:
        """Enter a floor plan into the grid of each robot.

        Args:
            free: (n, 2) float64 [m] for each robot, its start frame. Places on the free floor.
            walls: (m, 2) float64 [m] for each robot, its start frame. Places on walls.
        """
        for grid, *places in zip(self.grids.grids, free, walls, strict=True):
            grid.enter(*places)

    def _renew_candidates(self, robots: Iterable[int]) -> None:
        """Find the candidates of some robots."""
        team_poses = self.team_poses
        self._whole_map_summaries = rows, parts = self.team.map_summaries(1, self._whole_map_summaries)
        for robot in robots:
            first, last = parts[robot]
            landmarks = rows.positions[first:last], rows.counts_and_ids[first:last], team_poses.starts[robot]
            known, shared = self._topology.known_robots[robot], self._grids.shared[robot]
            places = self._rendezvous.update(robot, team_poses, known, shared, landmarks)
            self._candidates.update(robot, self.grids, self._grids.looks, team_poses.poses, landmarks, places)

    def _kept_candidates(self) -> TeamCandidates:
        """Return the candidates, which are found from the first call on."""
        if not self.keeps_candidates:
            self.keeps_candidates = True
            self._renew_candidates(range(len(self._robots)))
        return self._candidates

    def merge(self, robot_a: int, robot_b: int, alignment: Alignment, known: bool = False) -> LandmarkIdMap:
        """Merge the groups of two robots with a given alignment of their filter maps; see `TeamSlam.merge`."""
        id_map = self.team.merge(robot_a, robot_b, alignment, known)
        self._refresh_poses()
        self._grids.save_for_undo(self._tick + 1, id_map)
        self._grids.share_on_contact(self._tick + 1, self._topology.same_filter, self.team_poses.starts)
        return id_map

    def rejuvenate(self) -> None:
        """Smooth paths and maps of all filters that have a smoother now; see `TeamSlam.rejuvenate`."""
        self.team.rejuvenate()
        self._refresh_poses()

    def representative(self, group: tuple[int, ...]) -> int:
        """Return the first robot of a group that uses the joint filter, which merges need."""
        return self.team.trunk_robots(group[0])[0]

    def group_map(self, robot: int) -> LandmarkMap:
        """Return the confirmed landmarks of a robot's group, in the group's map frame; `team.map` has all."""
        number = self._topology.maps[robot]
        if number not in self._maps:
            self._maps[number] = self.team.map(robot, min_count=self._confirm_after)
        return self._maps[number]

    @property
    def map_summaries(self) -> TeamMapSummaries:
        """Summaries of `group_map` for all robots, computed faster; valid until the next step."""
        if not self._has_summaries:
            self._map_summaries = self.team.map_summaries(self._confirm_after, self._map_summaries)
            self._has_summaries = True
        return self._map_summaries

    def grid(self, robot: int) -> OccupancyGrid:
        """Return the occupancy grid of a robot, updated in later ticks."""
        return self._grids[robot]

    def looks(self, robot: int) -> NDArray[np.uint8]:
        """Return the looks (S, S) of a robot at walls, see `TeamLooks`; a read-only view."""
        return as_read_only(self._grids.looks.counts[robot])

    def set_seconds_left(self, seconds: float) -> None:
        """Set the time until the episode is truncated [s], which beliefs and observations contain."""
        if seconds != self._seconds_left:
            self._seconds_left = seconds
            self._beliefs.clear()

    def candidate(self, robot: int, slot: int) -> tuple[FloatArray, float] | None:
        """Return goal (2,) [m] and heading [rad] of the candidate in a robot's slot; None if the slot is empty."""
        x, y, heading, _, _ = self._candidates.rows(robot)[slot].tolist()
        return None if math.isnan(x) else (np.array([x, y]), heading)

    def belief(self, robot: int) -> Belief:
        """Return the belief of a robot after the last tick."""
        if robot not in self._beliefs:
            self._beliefs[robot] = belief = self._make_belief(robot)
            return belief
        return self._beliefs[robot]

    def view(self, keys: Collection[str] = KEYS) -> BeliefBatch:
        """Return what these keys of observations read of all robots' beliefs, sharing memory with the grids."""
        grids, describes = self.grids, not READ_CANDIDATES.isdisjoint(keys)
        if not READ_GLOBAL_GRIDS.isdisjoint(keys):
            self._global_grids.update(grids, self._grids.looks)
        return BeliefBatch(
            robots=self._robots,
            team_poses=self.team_poses,
            map_summaries=self.map_summaries,
            cells=grids.cells,
            global_grids=self._global_grids,
            features=self._features() if describes else self._no_features,
            scans=self.scans,
            seconds_left=self._seconds_left,
        )

    def rebuild(self) -> None:
        """Restore what follows from the filters."""
        self._refresh_poses()

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless the filters are as old as the grids, and their options those of the environment."""
        team, config = parts["team"], sizes["CONFIG"]
        if team["step"] != parts["tick"] + 1:
            raise ValueError(f"filters at step {team['step']}, grids at tick {parts['tick']}")
        merges, schedule = team["merges"], team["merges"]["schedule"]
        filters = [branch["filter"] for branch in branches_in(merges)]
        given = schedule["alignment"], schedule["options"], merges["merging"], *(each["options"] for each in filters)
        attempts, merging = merge_options(config.belief, not config.oracle_merge)
        if given != (config.belief.alignment, attempts, merging, *[config.belief.filter] * len(filters)):
            raise ValueError("options that differ from the environment's configuration")
        lengths = {each["maps"].descriptors.shape[1] for each in filters if len(each["maps"].ids)}
        if config.sensor == "landmark" and not lengths <= {sizes["DESCRIPTOR"]}:
            raise ValueError(f"descriptors of length {max(lengths)} in a world with {sizes['DESCRIPTOR']}")

    def _refresh_poses(self) -> None:
        """Update groups and poses after a step or a merge, and clear cached beliefs and maps."""
        self._topology = self.team.topology
        self.known_groups = self._topology.known_robots
        self.team.team_poses(self.team_poses)
        self._beliefs.clear()
        self._version += 1
        self._maps.clear()
        self._has_summaries = False

    def _others(self, robot: int) -> list[int]:
        """Return the other known members of a robot's group, ascending."""
        return [mate for mate in self._topology.known_robots[robot] if mate != robot]

    def _known_goals(self) -> FloatArray:
        """Return the current goal (K, K, 2) [m] of robot j in the start frame of robot i; NaN: none, or not known."""
        goals = np.empty((len(self._robots), len(self._robots), 2))
        write_goals(self.team_poses.starts, self.goals, self._grids.shared, goals)
        return goals

    def teammates(self, robot: int) -> tuple[Teammate, ...]:
        """Return a robot's teammates; those out of contact with their last known pose."""
        team_poses, team = self.team_poses, self.team
        turn, goals = float(team_poses.starts[robot, 2]), self._known_goals()[robot]
        others = self._others(robot)
        covariances = [rotate_covariances(turn, team.pose(mate, robot).covariance) for mate in others]
        return tuple(
            Teammate(mate, team_poses.poses[robot, mate], covariance, goals[mate])
            for mate, covariance in zip(others, covariances, strict=True)
        )

    def candidates(self, robot: int) -> Candidates:
        """Build the candidates of a robot."""
        kept, features = self._kept_candidates(), self._features()[robot]
        rows = FrontierColumns.of(kept.rows(robot))
        valid = ~np.isnan(rows.x)
        return Candidates(
            goals=rows.goals,
            headings=rows.heading,
            lengths=rows.length,
            valid=valid,
            kinds=np.where(valid, SLOT_KINDS, CandidateKind.NONE),
            sizes=rows.size,
            gains=kept.gains(robot),
            teammate_lengths=kept.lengths(robot)[:, self._others(robot)],
            own_goal=features[:, CANDIDATE_FEATURES.index("own_goal")] > 0.0,
            teammate_goal=features[:, CANDIDATE_FEATURES.index("teammate_goal")] > 0.0,
            features=features,
        )

    def _features(self) -> Float32Array:
        """Return the features (K, C, F) float32 of all robots' candidates; a new array."""
        return self._kept_candidates().features(self.team_poses.poses, self._known_goals())

    def _make_belief(self, robot: int) -> Belief:
        """Return the belief of a robot, whose attributes are made on demand."""
        tick, version = self._tick, self._version

        def make(name: str) -> Any:
            if self._version != version:
                hint = "Read it before the next step, or call materialise()."
                raise RuntimeError(f"belief of tick {tick}: {name!r} was not read in time. {hint}")
            return BELIEF_FIELDS[name](self, robot)

        return Belief.on_demand(make, robot=robot, tick=tick, seconds_left=self._seconds_left)


BELIEF_FIELDS: dict[str, Callable[[TeamBelief, int], Any]] = {  # what makes each attribute of a belief
    "frame": lambda team, robot: team.known_groups[robot][0],
    "group": lambda team, robot: team.known_groups[robot],
    "pose": lambda team, robot: team.team_poses.own[robot],
    "covariance": lambda team, robot: team.team_poses.covariances[robot],
    "particles": lambda team, robot: team.team.particles_from_start(robot),
    "log_weights": lambda team, robot: team.team.particles(robot)[1],
    "ess": lambda team, robot: float(team.team_poses.ess[robot]),
    "grid": lambda team, robot: team.grid(robot).read_only_view(),
    "candidates": TeamBelief.candidates,
    "teammates": TeamBelief.teammates,
    "looks": TeamBelief.looks,
    "scan": lambda team, robot: team.scans[robot],
    "start_from_group": lambda team, robot: team.team_poses.starts[robot],
    "group_map": TeamBelief.group_map,
}


def merge_options(config: BeliefConfig, attempts: bool) -> tuple[AttemptOptions, MergeOptions]:
    """Return the options of merge attempts and merges; without attempts, merges are final."""
    if attempts:
        return config.attempts, config.merging
    return replace(config.attempts, enabled=False), replace(config.merging, watch_steps=0)


def _candidate_schedule(num_robots: int, decision_ticks: int | None) -> Sequence[Sequence[int]]:
    """Return for each tick of a cycle the robots whose candidates are updated."""
    if decision_ticks is not None:
        return [range(num_robots), *[()] * (decision_ticks - 1)]
    return [
        [robot for robot in range(num_robots) if robot * CANDIDATE_TICKS // num_robots == tick]
        for tick in range(CANDIDATE_TICKS)
    ]
