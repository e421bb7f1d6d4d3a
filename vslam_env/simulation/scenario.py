"""Scenario of an episode: everything drawn at its reset and constant afterwards."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, argument_error
from vslam_env.config import EnvConfig
from vslam_env.evaluation.coverage import CoverageCells
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.sensors import LandmarkSensor, RangeFinder, ScanConfig, StereoSensor, StereoSensorConfig
from vslam_env.sensors.stereo.ground_truth import TextureCorners
from vslam_env.sensors.stereo.textures import check_textures
from vslam_env.simulation.memory import available_memory, check_memory
from vslam_env.world import FreeSpace, World, WorldSource, draw_bias, draw_world_seed, make_world, place_landmarks


@short_repr
@dataclass(frozen=True, slots=True, weakref_slot=True, kw_only=True, eq=False)
class Scenario:
    """World, start poses and sensors of an episode, shared with its snapshots; arrays are read-only.

    Attributes:
        world: Walls and landmarks.
        true_starts: (K, 3) float64 [m, m, rad], world frame. Start poses.
        bias: (K, 2) float64. Odometry biases of the robots, see `draw_bias`.
        belief_seed: Seed of the team's beliefs.
        stream_states: Initial states of the random streams (odometry, sensor, scan, radio) by name.
        sensor: Cameras of the robots.
        scan: Range finders of the robots.
        coverage: Cells of the free floor in the robots' grids.
        observable_landmarks: (N',) bool. True for landmarks visible from some reachable place; only these are scored.
    """

    world: World
    true_starts: FloatArray
    bias: FloatArray
    belief_seed: np.random.SeedSequence
    stream_states: dict[str, Any]
    sensor: LandmarkSensor | StereoSensor
    scan: RangeFinder
    coverage: CoverageCells
    observable_landmarks: np.ndarray

    def __post_init__(self) -> None:
        for name in ("true_starts", "bias", "observable_landmarks"):
            object.__setattr__(self, name, as_constant(getattr(self, name)))

    def to_parts(self) -> tuple[Any, ...]:
        """Return the parts that define the scenario, without derived ones."""
        sensor = self.sensor
        texture_parts = None
        if isinstance(sensor, StereoSensor):
            texture_parts = sensor.textures, sensor.corners.faces, sensor.corners.offsets
        return (
            self.world, self.true_starts, self.bias, self.belief_seed, self.stream_states, sensor.config,
            sensor.robot_radius, texture_parts, self.scan.config, self.coverage.cells, self.observable_landmarks,
        )  # fmt: skip

    @classmethod
    def from_parts(
        cls, world: World, true_starts: FloatArray, bias: FloatArray, belief_seed: np.random.SeedSequence,
        stream_states: dict[str, Any], sensor_config: Any, robot_radius: float, texture_parts: Any, scan: ScanConfig,
        cells: FloatArray, observable_landmarks: np.ndarray,
    ) -> Self:  # fmt: skip
        """Rebuild a scenario, including its sensors, from the result of `to_parts`.

        Raises:
            ValueError: If the parts are inconsistent.
        """
        landmarks = world.landmarks
        if landmarks is None:
            raise ValueError("a world without landmarks")
        sensor: LandmarkSensor | StereoSensor
        if isinstance(sensor_config, StereoSensorConfig):
            textures, faces, offsets = texture_parts
            check_textures(textures, world.walls)
            corners = TextureCorners.found(world.walls, landmarks, faces, offsets, sensor_config.tolerance)
            sensor = StereoSensor.of_textures(sensor_config, world.walls, textures, corners, robot_radius)
        else:
            sensor = LandmarkSensor(sensor_config, world.walls, landmarks, robot_radius)
        return cls(
            world=world,
            true_starts=true_starts,
            bias=bias,
            belief_seed=belief_seed,
            stream_states=stream_states,
            sensor=sensor,
            scan=RangeFinder(scan, world.walls, robot_radius),
            coverage=CoverageCells(cells, true_starts),
            observable_landmarks=observable_landmarks,
        )

    def new_ground_truth(self, cutoff: float) -> GroundTruthAssociation:
        """Return an empty ground-truth association for this world; `cutoff` is c of the map error [m]."""
        landmarks = self.world.landmarks
        assert landmarks is not None
        return GroundTruthAssociation(len(self.true_starts), landmarks.positions, self.observable_landmarks, cutoff)


def sample_scenario(
    config: EnvConfig,
    source: WorldSource,
    seed: np.random.SeedSequence,
    world_seed: int | None = None,
    start_poses: Any = None,
) -> Scenario:
    """Draw the scenario of an episode, with an independent random stream for each concern.

    Args:
        config: Configuration of the environment.
        source: Source of the world.
        seed: Seed of all streams.
        world_seed: Seed of layout and textures; None: derived from `seed` or drawn from the world split.
        start_poses: (K, 3) [m, m, rad], world frame; None: start poses of the world, or drawn ones.

    Raises:
        ValueError: If the world does not exist, robots cannot start there, no landmark is observable, or the landmarks
            of all particles would exceed the memory.
    """
    layout, textures, starts, odometry, detections, scan, belief_seed, radio = seed.spawn(8)
    if world_seed is None and config.world_split is not None:
        world_seed = draw_world_seed(config.world_split, np.random.default_rng(layout))
    if world_seed is not None:
        layout, textures = np.random.SeedSequence(world_seed).spawn(2)
    bare = make_world(source, np.random.default_rng(layout), config.world_split)
    free_space = FreeSpace(bare, config.robot_radius)
    texture_rng = np.random.default_rng(textures)
    sensor: LandmarkSensor | StereoSensor
    if config.sensor == "stereo":
        sensor = StereoSensor(config.stereo, bare, free_space, texture_rng, config.robot_radius)
        landmarks = sensor.landmarks
    else:
        given = bare.landmarks
        landmarks = place_landmarks(bare, texture_rng, config.landmarks, free_space) if given is None else given
        sensor = LandmarkSensor(config.landmark_sensor, bare.walls, landmarks, config.robot_radius)
    observable = free_space.visible_landmarks(landmarks, sensor.config.camera, sensor.config.max_incidence)
    if not observable.any():
        got, hint = f"no such landmark among {len(landmarks)} in {bare.name!r}", "Put some on walls that robots pass."
        raise argument_error("world", "landmarks that robots can see", got, hint)
    check_memory(int(np.count_nonzero(observable)), config.belief.filter.num_particles, available_memory())
    world = World(bare.name, bare.walls, landmarks, bare.start_poses)
    true_starts = _starts(config, world, free_space, start_poses, np.random.default_rng(starts))
    streams = {
        name: np.random.default_rng(stream)
        for name, stream in (("odometry", odometry), ("sensor", detections), ("scan", scan), ("radio", radio))
    }
    return Scenario(
        world=world,
        true_starts=as_read_only(true_starts),
        bias=as_read_only(draw_bias(config.odometry, config.num_robots, streams["odometry"])),
        belief_seed=belief_seed,
        stream_states={name: stream.bit_generator.state for name, stream in streams.items()},
        sensor=sensor,
        scan=RangeFinder(config.scan, world.walls, config.robot_radius),
        coverage=CoverageCells(free_space.free_area_cells, true_starts),
        observable_landmarks=as_read_only(observable),
    )


def _starts(
    config: EnvConfig,
    world: World,
    free_space: FreeSpace,
    start_poses: Any,
    rng: np.random.Generator,
) -> FloatArray:
    given = world.start_poses
    sensor = config.stereo if config.sensor == "stereo" else config.landmark_sensor
    if start_poses is not None:
        return free_space.check_starts(start_poses, config.num_robots)
    if given is not None:
        if len(given) < config.num_robots:
            raise argument_error(
                "world.start_poses",
                f"a row for each of {config.num_robots} robots",
                f"shape {given.shape}",
                "Add rows, use fewer robots, or omit them to draw starts.",
            )
        return free_space.check_starts(given[: config.num_robots], config.num_robots)
    return free_space.draw_starts(
        config.num_robots,
        rng,
        config.min_start_distance,
        no_shared_view=None if config.shared_start_view else sensor.camera,
        landmarks=world.landmarks,
        max_incidence=sensor.max_incidence,
    )
