"""`Episode`: one world with robots in it, what they perceive and believe, and the simulator's books; tick by tick."""

from collections.abc import Callable, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from slam_backend.errors import FloatArray, IntArray, bad_argument
from slam_backend.geometry import between, compose, wrap_angle
from vslam_env.belief import Body, TeamBelief
from vslam_env.config import TICK, EnvConfig
from vslam_env.coverage import CoverageMeter
from vslam_env.errors_of_maps import ClaimLedger, MapScores, world_from_group
from vslam_env.oracle import true_alignment
from vslam_env.readings import Readings
from vslam_env.reward import Standing
from vslam_env.sensors import Frame, LandmarkSensor, Scan
from vslam_env.world import (
    FreeSpace,
    Simulator,
    World,
    WorldSource,
    draw_bias,
    make_world,
    place_landmarks,
    read_odometry,
)

Recorder = Callable[[tuple[Readings, ...]], None]


class Episode:
    """From a reset to the next.

    Each concern draws from a stream of its own, so that a new draw in one never shifts another.

    Args:
        config: Of the environment.
        source: What the world is made from.
        seed: Of all streams.
        world_seed: Of the layout and its textures, if these are to differ from what `seed` would give.
        start_poses: (K, 3) [m, m, rad], world frame; None: those of the world, or drawn.
        recorder: Called with the readings of each tick, the first ones included.

    Attributes:
        world: Walls and landmarks.
        true_starts: (K, 3) float64 [m, m, rad], world frame.
        belief_seed: From which the team's beliefs draw.
        body: The robots' hardware.
        belief: What the robots believe.
        ledger: What their landmarks are in truth.
        tick: Ticks since the reset.
        readings: Of the last tick, one per robot.
        frames: Of the last tick, with the true landmarks behind the measurements.
        true_path: Poses (K, 3) after each tick, world frame.
        estimated_path: Poses (K, 3) as estimated after each tick, each in the robot's own start frame.
        merge_ticks: Tick and groups of each merge.
    """

    def __init__(
        self,
        config: EnvConfig,
        source: WorldSource,
        seed: np.random.SeedSequence,
        world_seed: int | None = None,
        start_poses: Any = None,
        recorder: Recorder | None = None,
    ) -> None:
        layout, textures, starts, odometry, sensor, scan, self.belief_seed = seed.spawn(7)
        if world_seed is not None:
            layout, textures = np.random.SeedSequence(world_seed).spawn(2)
        self._config = config
        self._recorder = recorder
        robots = config.num_robots

        bare = make_world(source, np.random.default_rng(layout))
        free_space = FreeSpace(bare, config.robot_radius)
        landmarks = bare.landmarks
        if landmarks is None:
            landmarks = place_landmarks(bare, np.random.default_rng(textures), config.landmarks, free_space)
        self.world = World(bare.name, bare.walls, landmarks, bare.start_poses)
        self.true_starts = self._starts(free_space, start_poses, np.random.default_rng(starts))

        self._simulator = Simulator(self.world, self.true_starts, config.robot_radius, TICK)
        self._sensor = LandmarkSensor(config.landmark_sensor, self.world.walls, landmarks, config.robot_radius)
        self._scan = Scan(config.scan, self.world.walls, config.robot_radius)
        self._odometry_rng, self._sensor_rng, self._scan_rng = (
            np.random.default_rng(stream) for stream in (odometry, sensor, scan)
        )
        self._bias = draw_bias(config.odometry, robots, self._odometry_rng)
        self._coverage = CoverageMeter(free_space.free_area_cells, self.true_starts)
        countable = free_space.visible_landmarks(
            landmarks, config.landmark_sensor.camera, config.landmark_sensor.max_incidence
        )
        self.ledger = ClaimLedger(robots, landmarks.positions, countable, config.map_error_cutoff)
        self.body = Body(
            radius=config.robot_radius, ray_angles=config.scan.ray_angles, scan_range=config.scan.max_range
        )
        self.belief = TeamBelief(
            config.belief,
            robots,
            self.belief_seed,
            self.body,
            decision_ticks=config.ticks_per_step if config.action_type == "goal" else None,
            attempts=not config.oracle_merge,
        )

        self.tick = 0
        self._collisions = np.zeros(robots, np.int64)
        self._distances = np.zeros(robots)
        self.true_path: list[FloatArray] = []
        self.estimated_path: list[FloatArray] = []
        self.merge_ticks: list[tuple[int, tuple[int, ...], tuple[int, ...]]] = []
        self.readings: tuple[Readings, ...] = ()
        self.frames: list[Frame] = []
        self._perceive(None)

    @property
    def true_poses(self) -> FloatArray:
        """(K, 3) float64 [m, m, rad], world frame. A copy."""
        return self._simulator.poses

    def advance(self, commands: Any) -> None:
        """Drive all robots with velocity commands (K, 2) [m/s, rad/s] for a tick, and let them perceive and believe."""
        before = self._simulator.poses
        self._simulator.step(commands)
        after = self._simulator.poses
        self.tick += 1
        self._distances += np.hypot(*(after - before)[:, :2].T)
        self._collisions += self._simulator.bumped
        self._perceive(read_odometry(before, after, self._bias, self._config.odometry, self._odometry_rng))

    def map_scores(self) -> list[MapScores]:
        """Score each robot's map as it stands."""
        scores = []
        for robot, start in enumerate(self.true_starts):
            placed = world_from_group(start, self.belief.start_from_group(robot))
            scores.append(self.ledger.score(self.belief.group(robot), self.belief.group_map(robot), placed))
        return scores

    def believed_poses(self) -> FloatArray:
        """Return where the robots believe to be (K, 3) [m, m, rad], laid at their true starts, world frame."""
        return compose(self.true_starts, self.estimated_path[-1])

    def pose_errors(self) -> FloatArray:
        """Return (K, 2): how far each robot is from where it believes to be [m], and its heading likewise [rad]."""
        difference = self.believed_poses() - self._simulator.poses
        return np.column_stack([np.hypot(*difference[:, :2].T), np.abs(wrap_angle(difference[:, 2]))])

    def standing(self, scores: Sequence[MapScores], pose_errors: FloatArray) -> Standing:
        """Return how the team stands, from what `map_scores` and `pose_errors` returned."""
        return Standing(
            map_errors=np.array([score.error for score in scores]),
            map_recalls=np.array([score.recall for score in scores]),
            pose_errors=pose_errors[:, 0],
            coverage=self._coverage.share([self.belief.cells(r) for r in range(len(scores))]),
            collisions=self._collisions.copy(),
            distances=self._distances.copy(),
            bytes_sent=self.belief.bytes_sent,
            merges=len(self.merge_ticks),
        )

    def _starts(self, free_space: FreeSpace, start_poses: Any, rng: np.random.Generator) -> FloatArray:
        config = self._config
        given = self.world.start_poses
        if start_poses is not None:
            return free_space.check_starts(start_poses, config.num_robots)
        if given is not None:
            if len(given) < config.num_robots:
                raise bad_argument(
                    "world.start_poses",
                    f"a row for each of {config.num_robots} robots",
                    f"shape {given.shape}",
                    "Add rows, use fewer robots, or leave them out to have starts drawn.",
                )
            return free_space.check_starts(given[: config.num_robots], config.num_robots)
        return free_space.draw_starts(
            config.num_robots,
            rng,
            config.min_start_distance,
            no_shared_view=None if config.shared_start_view else config.landmark_sensor.camera,
            landmarks=self.world.landmarks,
            max_incidence=config.landmark_sensor.max_incidence,
        )

    def _perceive(self, odometry: FloatArray | None) -> None:
        """Read all sensors at the true poses, and let the robots take it in."""
        config, poses, bumped = self._config, self._simulator.poses, self._simulator.bumped
        self.frames = self._sensor.measure(poses, self._sensor_rng)
        scans = self._scan.measure(poses, self._scan_rng)
        self.readings = tuple(
            Readings(
                odometry=None if odometry is None else odometry[robot],
                measurements=frame.measurements,
                scan=scans[robot],
                bump=bool(bumped[robot]),
                pose=between(self.true_starts[robot], poses[robot]) if config.oracle_pose else None,
                identities=frame.true_ids if config.oracle_association else None,
            )
            for robot, frame in enumerate(self.frames)
        )
        if self._recorder is not None:
            self._recorder(self.readings)
        report = self.belief.step(self.readings)
        self.ledger.record(report, [frame.true_ids for frame in self.frames])
        self.merge_ticks += [(self.tick, made.robots_a, made.robots_b) for made in report.renamings]
        if config.oracle_merge:
            self._merge_by_oracle()
        self.true_path.append(poses)
        self.estimated_path.append(self.belief.poses)

    def _merge_by_oracle(self) -> None:
        """Merge groups that share true landmarks until none do."""
        merged = True
        while merged:
            merged = False
            for a, b in combinations(self.belief.groups, 2):
                alignment = true_alignment(
                    self._claims(a), self._claims(b), self.true_starts[a[0]], self.true_starts[b[0]]
                )
                if alignment is not None:
                    self.ledger.rename(self.belief.merge(a[0], b[0], alignment))
                    self.merge_ticks.append((self.tick, a, b))
                    merged = True
                    break

    def _claims(self, group: tuple[int, ...]) -> IntArray:
        """Return which true landmark each row of a group's filter map claims."""
        return self.ledger.claims(group, self.belief.filter_map(group[0]).ids)
