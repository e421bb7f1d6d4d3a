"""Episode: simulation of the world, the sensors, the beliefs and the ground-truth association, tick by tick."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from operator import add
from typing import Any

import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only, with_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import between, compose, inverse, transform_points
from slam_backend.maps.alignment import Alignment
from slam_backend.state import (
    BOOL,
    FLOAT64,
    Array,
    Child,
    Dict,
    Each,
    Generator,
    Int,
    Maybe,
    OneOf,
    Row,
    Sizes,
    State,
    Text,
)
from slam_backend.team.communication import contact_components
from vslam_env.belief.observation_keys import READ_CANDIDATES
from vslam_env.belief.readings import Readings, TeamReadings
from vslam_env.belief.team_belief import RobotHardware, TeamBelief
from vslam_env.config import TICK, EnvConfig
from vslam_env.evaluation.coverage import CoverageTracker
from vslam_env.evaluation.map_scores import GroundTruthAssociation, check_claims
from vslam_env.evaluation.recall_credits import RecallCredits
from vslam_env.evaluation.team_metrics import BeliefSummary, RobotCounts, RobotMetrics, TeamMetrics
from vslam_env.navigation import CELL
from vslam_env.reward import OWN_RECALL, RUNNING_COST
from vslam_env.sensors import RenderedFrame, SensorFrame, TeamRenderedFrames, TeamSensorFrames
from vslam_env.simulation.communication import contacts, next_failures
from vslam_env.simulation.scenario import STREAMS, Scenario, ScenarioPart
from vslam_env.world import Simulator, read_odometry

MIN_SHARED = 3
AROUND = 1.0  # [m] tolerated distance of a robot outside the bounds of the walls
SIGMA = 1e-4  # [m, rad] standard deviation of a true alignment


def points_along(walls: FloatArray, spacing: float) -> FloatArray:
    """Return points (n, 2) [m] on walls (S, 4) [m], their ends included, at most so far apart [m].

    >>> points_along(np.array([[0.0, 0.0, 0.0, 1.0]]), 0.5).tolist()
    [[0.0, 0.0], [0.0, 0.5], [0.0, 1.0]]
    """
    return np.concatenate([
        np.linspace(wall[:2], wall[2:], 1 + max(1, math.ceil(float(np.hypot(*(wall[2:] - wall[:2]))) / spacing)))
        for wall in walls
    ])  # fmt: skip


def true_alignment(
    claims_a: IntArray, claims_b: IntArray, true_start_a: FloatArray, true_start_b: FloatArray
) -> Alignment | None:
    """Return the true alignment of two groups' maps, or None if they share fewer than three true landmarks.

    Args:
        claims_a: (n,) int64. True landmark of each row of map a, negative for none.
        claims_b: (m,) int64. True landmark of each row of map b, negative for none.
        true_start_a: (3,) [m, m, rad]. True start pose of a's first robot, whose start frame is the map frame.
        true_start_b: (3,) [m, m, rad]. True start pose of b's first robot.
    """
    unique_a, unique_b = (np.where(claims >= 0, claims, -1 - np.arange(len(claims))) for claims in (claims_a, claims_b))
    # The first of duplicates is taken; negative numbers are unique in a map and must not match across maps.
    shared, rows_a, rows_b = np.intersect1d(unique_a, unique_b, return_indices=True)
    inliers = np.column_stack([rows_a, rows_b])[shared >= 0]
    if len(inliers) < MIN_SHARED:
        return None
    tx, ty, theta = between(true_start_a, true_start_b).tolist()
    return Alignment(True, "", tx, ty, theta, SIGMA**2 * np.eye(3), inliers, 0.0)


Recorder = Callable[[tuple[Readings, ...]], None]


@dataclass(slots=True)
class ReadingsHook:
    """Hook for a recorder of readings, kept by an environment over its episodes."""

    recorder: Recorder | None = None


class Episode:
    """Simulation from one reset to the next, with an independent random stream for each concern.

    Args:
        config: Configuration of the environment.
        scenario: Scenario drawn at the reset.
        streams: Random streams by name; none if a state is restored next.
        hook: Hook whose recorder receives the readings of each tick, including the reset.

    Attributes:
        scenario: Scenario of the episode.
        world: Walls and landmarks.
        true_starts: (K, 3) float64 [m, m, rad], world frame. Start poses.
        belief_seed: Seed of the team's beliefs.
        body: Hardware of the robots.
        belief: Beliefs of the team.
        ground_truth: Ground-truth association of the estimated landmarks.
        coverage: Floor that the robots had seen at its last update.
        tick: Ticks since the reset.
        readings: Readings of the last tick; unset before `begin`.
        last_frames: Frames of the last tick with their true landmarks, read-only; unset before `begin`.
        merge_ticks: Tick and groups of each merge.
    """

    STATE = State(
        scenario=ScenarioPart(),
        tick=Int(),
        simulator=Child(Simulator),
        streams=Dict(Text(STREAMS), Generator()),
        belief=Child(TeamBelief),
        ground_truth=Child(GroundTruthAssociation),
        coverage=Child(CoverageTracker),
        credits=Child(RecallCredits),
        collisions=Each(Int(), "K"),
        metric_rows=Array(FLOAT64, f"{len(RobotMetrics._fields)} K", nan=True),
        odometry=Maybe(Array(FLOAT64, "K 3", renewed=True)),
        in_contact=Maybe(Array(BOOL, "K K", renewed=True)),
        failing=Maybe(Array(BOOL, "K K", renewed=True)),
        last_frames=OneOf(TeamSensorFrames, TeamRenderedFrames),
        paths=Array(FLOAT64, "TICKS 2 K 3", renewed=True),
        merge_ticks=Each(Row(Int(), Each(Int(high="K")), Each(Int(high="K"))), kind=list),
    )

    def __init__(
        self,
        config: EnvConfig,
        scenario: Scenario,
        streams: Mapping[str, np.random.Generator],
        hook: ReadingsHook | None = None,
    ) -> None:
        self._config = config
        self._hook = ReadingsHook() if hook is None else hook
        self._all_hear_all = config.always_in_contact
        self._streams = dict(streams)
        self.scenario = scenario
        self.world, self.true_starts = scenario.world, scenario.true_starts
        entropy, spawn_key, *_ = scenario.belief_seed
        self.belief_seed = np.random.SeedSequence(entropy, spawn_key=spawn_key)
        self._simulator = Simulator(scenario.world, scenario.true_starts, config.robot_radius, TICK)
        self.ground_truth = scenario.new_ground_truth(config.map_error_cutoff)
        self.coverage = CoverageTracker(scenario.coverage)
        self._credits = RecallCredits(config.num_robots, len(self.ground_truth.true_positions))
        self.body = RobotHardware(
            radius=config.robot_radius, ray_angles=config.scan.ray_angles, scan_range=config.scan.max_range
        )
        self.belief = TeamBelief(
            config.belief,
            config.num_robots,
            self.belief_seed,
            self.body,
            decision_ticks=config.ticks_per_step if config.action_type == "goal" else None,
            attempts=not config.oracle_merge,
            keeps_candidates=not READ_CANDIDATES.isdisjoint(config.observed),
        )

        self.tick = 0
        self._collisions: tuple[int, ...] = (0,) * config.num_robots
        self._metric_rows = np.zeros((len(RobotMetrics._fields), config.num_robots))  # some of them accumulate
        self._metrics: RobotMetrics[FloatArray] = RobotMetrics(*self._metric_rows)
        self._path_buffer = np.empty((64, 2, config.num_robots, 3))  # true and estimated poses; rows up to `tick`
        self.merge_ticks: list[tuple[int, tuple[int, ...], tuple[int, ...]]] = []
        self._odometry: FloatArray | None = None
        self._in_contact: BoolArray | None = None
        self._failing: BoolArray | None = None  # links between robots
        self.readings: TeamReadings  # set by `begin`
        self.last_frames: TeamSensorFrames | TeamRenderedFrames  # set by `begin`

    def begin(self) -> None:
        """Take the first measurements; robots that shall know the floor plan do so from now on."""
        if self._config.oracle_floor:
            frames = [inverse(start) for start in self.true_starts]
            walls = points_along(self.world.walls, 0.5 * CELL)
            self.belief.know_floor(
                *([transform_points(frame, places) for frame in frames] for places in (self.scenario.cells, walls))
            )
        no_goals = np.full((len(self.true_starts), 2), np.nan)
        self._perceive(None, no_goals if self._config.action_type == "goal" else None)

    @property
    def true_poses(self) -> FloatArray:
        """(K, 3) float64 [m, m, rad], world frame. Copy of the true poses."""
        return self._simulator.poses.copy()

    @property
    def true_path(self) -> FloatArray:
        """(T, K, 3) float64 [m, m, rad], world frame. True poses after each tick since the reset; read-only."""
        return as_read_only(self._paths[:, 0])

    @property
    def estimated_path(self) -> FloatArray:
        """(T, K, 3) float64 [m, m, rad], own start frames. Poses as estimated after each tick; read-only."""
        return as_read_only(self._paths[:, 1])

    @property
    def frames(self) -> Sequence[SensorFrame | RenderedFrame]:
        """Frames of all robots in the last tick, with the true landmarks of their measurements."""
        return self.last_frames.per_robot()

    def advance(self, commands: FloatArray, goals: FloatArray | None = None) -> None:
        """Execute velocity commands (K, 2) [m/s, rad/s] for a tick, read the sensors and update the beliefs.

        Args:
            commands: (K, 2) [m/s, rad/s]. Speed and turn rate of each robot.
            goals: (K, 2) [m], own start frames. Goals to which the robots drive, NaN: none; None: not `goal` actions.

        Raises:
            ValueError: If `Simulator.step` rejects the commands; the episode is then unchanged.
        """
        simulator, noise, stream = self._simulator, self._config.odometry, self._streams["odometry"]
        before = simulator.poses
        if simulator.step(commands):
            self._collisions = tuple(map(add, self._collisions, simulator.bumped.tolist()))
        self.tick += 1
        odometry = read_odometry(before, simulator.poses, self.scenario.bias, noise, stream, self._metrics.distances)
        self._perceive(odometry, goals)
        if RUNNING_COST in self._config.reward:  # scoring every tick is slow
            self._score(simulator.poses)
            self._metrics.error_integrals[:] += self._metrics.map_errors * TICK

    def estimated_poses(self) -> FloatArray:
        """Return the estimated poses (K, 3) [m, m, rad], moved by the true start poses to the world frame."""
        return compose(self.true_starts, self.estimated_path[-1])

    def team_metrics(self, with_beliefs: bool = False, with_coverage: bool = True) -> TeamMetrics:
        """Score the team now, update credits, and return the metrics.

        Args:
            with_beliefs: Whether they include the beliefs, which takes longer.
            with_coverage: Whether the coverage is updated; if not, it is that of the last update.
        """
        belief, poses = self.belief, self._simulator.poses
        self._score(poses)
        if OWN_RECALL in self._config.reward:
            self._credits.update(self.ground_truth.accurate)
            self._metrics.own_recalls[:] = self._credits.shares
        if with_coverage:
            self._metrics.discovered[:] = self.coverage.update(belief.grids, poses)
        counts, metrics = (
            RobotCounts(self._collisions, tuple(belief.team.exchange.sent)),
            RobotMetrics(*[row.tolist() for row in self._metrics]),
        )
        beliefs = tuple(map(self._summary, range(len(poses)))) if with_beliefs else ()
        return TeamMetrics(metrics, counts, self.coverage.share, len(self.merge_ticks), self.tick * TICK, beliefs)

    # ------------------------------------------------------------------ snapshots

    @property
    def _paths(self) -> FloatArray:
        """(T, 2, K, 3). True and estimated poses after each tick; later ticks change none of them."""
        return self._path_buffer[: self.tick + 1]

    @_paths.setter
    def _paths(self, paths: FloatArray) -> None:
        self._path_buffer = paths

    def rebuild(self) -> None:
        """Gather the readings of the last tick."""
        self.readings = self._gathered(self.last_frames, self.belief.scans, self.belief.goals)

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless the parts belong to one tick and all robots are inside the world."""
        tick, (x_min, y_min, x_max, y_max) = parts["tick"], parts["scenario"].world.bounds
        if set(parts["streams"]) != set(STREAMS):
            raise ValueError(f"streams {', '.join(parts['streams'])}")
        if not tick == parts["belief"]["tick"] == len(parts["paths"]) - 1:
            raise ValueError(f"other parts than those of tick {tick}")
        if isinstance(parts["last_frames"], TeamRenderedFrames) != (sizes["CONFIG"].sensor == "stereo"):
            raise ValueError("frames of another sensor")
        places = parts["simulator"]["poses"][:, :2]  # far outside, the physics would not terminate
        if ((places < (x_min - AROUND, y_min - AROUND)) | (places > (x_max + AROUND, y_max + AROUND))).any():
            raise ValueError("robots outside the world")
        check_claims(parts["ground_truth"], parts["belief"]["team"], tick)

    # ------------------------------------------------------------------ helpers

    def _score(self, poses: FloatArray) -> None:
        """Score all maps and poses, given the true poses (K, 3), into the first rows of the metrics."""
        belief = self.belief
        self.ground_truth.score(belief.map_summaries, belief.team_poses, self.true_starts, poses, self._metrics)

    def _summary(self, robot: int) -> BeliefSummary:
        """Return what reward terms may read of a robot's belief."""
        group_map, truth = self.belief.group_map(robot), self.ground_truth
        covariance, claims = self.belief.team_poses.covariances[robot], truth.true_ids(robot, group_map.ids)
        return BeliefSummary(as_constant(covariance), group_map.counts, group_map.covariances, as_constant(claims))

    def _perceive(self, odometry: FloatArray | None, goals: FloatArray | None = None) -> None:
        """Read the sensors at the true poses and update the beliefs and the ground-truth association."""
        config, poses = self._config, self._simulator.poses
        frames = self.scenario.sensor.measure(poses, self._streams["sensor"])
        self._odometry, scans = odometry, self.scenario.scan.measure(poses, self._streams["scan"])
        self._in_contact = in_contact = None if self._all_hear_all else self._contacts(poses)
        self.last_frames, self.readings = with_read_only(frames), self._gathered(frames, scans, goals)
        if self._hook.recorder is not None:
            self._hook.recorder(self.readings.per_robot())
        report = self.belief.step(self.readings)
        padded_ids = frames.padded_ids
        self.ground_truth.record(report, padded_ids)
        if OWN_RECALL in self._config.reward:
            for robot, (associated, created) in enumerate(zip(report.associations, report.created, strict=True)):
                true_ids = padded_ids[robot, : len(associated)]
                used = np.maximum(associated, created) >= 0
                self._credits.record(robot, self.ground_truth.rows_of(true_ids[used]))
        for id_map in report.id_maps:
            self.merge_ticks.append((self.tick, id_map.robots_a, id_map.robots_b))
        if config.oracle_merge:
            self._merge_by_oracle(contact_components(in_contact, config.num_robots))
        if self.tick == len(self._path_buffer):
            self._path_buffer = np.concatenate([self._path_buffer, np.empty_like(self._path_buffer)])
        self._path_buffer[self.tick, 0], self._path_buffer[self.tick, 1] = poses, self.belief.team_poses.own

    def _gathered(
        self, frames: TeamSensorFrames | TeamRenderedFrames, scans: FloatArray, goals: FloatArray | None
    ) -> TeamReadings:
        """Return the readings of a tick, given frames, scans (K, R) [m] and goals (K, 2) [m], if any, of all robots."""
        config = self._config
        return TeamReadings(
            self._odometry,
            frames.measurements,
            scans,
            self._simulator.bumped,
            between(self.true_starts, self._simulator.poses) if config.oracle_pose else None,
            frames.true_ids if config.oracle_association else None,
            self._in_contact,
            frames.left if config.observe_images and isinstance(frames, TeamRenderedFrames) else None,
            goals if config.action_type == "goal" else None,
        )

    def _contacts(self, poses: FloatArray) -> BoolArray:
        """Return the matrix of contacts (K, K)."""
        config = self._config
        if config.comm_loss > 0.0:
            self._failing = next_failures(
                self._failing, len(poses), config.comm_loss, config.comm_outage_seconds / TICK, self._streams["radio"]
            )
        return contacts(poses, self.world.walls, config.comm_range, config.comm_line_of_sight, self._failing)

    def _merge_by_oracle(self, networks: IntArray) -> None:
        """Merge all groups in contact that share true landmarks; robots with equal `networks` (K,) are in contact."""
        merged = True
        while merged:
            merged = False
            for a, b in combinations(self.belief.team.groups, 2):
                robots = self.belief.representative(a), self.belief.representative(b)
                if networks[robots[0]] != networks[robots[1]]:
                    continue
                alignment = true_alignment(
                    self._true_ids(a), self._true_ids(b), self.true_starts[a[0]], self.true_starts[b[0]]
                )
                if alignment is not None:
                    self.ground_truth.merge(self.belief.merge(*robots, alignment, known=True))
                    self.merge_ticks.append((self.tick, a, b))
                    merged = True
                    break

    def _true_ids(self, group: tuple[int, ...]) -> IntArray:
        """Return the true landmark of each row of a group's filter map."""
        robot = self.belief.representative(group)
        return self.ground_truth.true_ids(robot, self.belief.team.map(robot).ids)
