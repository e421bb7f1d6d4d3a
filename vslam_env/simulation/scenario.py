"""`Scenario`: all of an episode that is drawn at its reset and never changes afterwards."""

from dataclasses import dataclass
from typing import Any, Self

import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.validation import FloatArray, argument_error
from vslam_env.config import EnvConfig
from vslam_env.evaluation.coverage import CoverageCells
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.sensors import LandmarkSensor, RangeFinder, ScanConfig, StereoSensor, StereoSensorConfig
from vslam_env.sensors.stereo.ground_truth import TextureCorners
from vslam_env.sensors.stereo.textures import check_textures
from vslam_env.world import FreeSpace, World, WorldSource, draw_bias, draw_world_seed, make_world, place_landmarks


@dataclass(frozen=True, slots=True, weakref_slot=True, kw_only=True, eq=False)
class Scenario:
    """A world with the robots' starts and sensors in it. Episodes and their snapshots share it; arrays are read-only.

    Attributes:
        world: Walls and landmarks.
        true_starts: (K, 3) float64 [m, m, rad], world frame.
        bias: (K, 2) float64. What each robot's odometry misreads throughout the episode, see `draw_bias`.
        belief_seed: From which the team's beliefs draw.
        stream_states: Where the random streams (odometry, sensor, scan, radio) stand before the first frame, by name.
        sensor: The cameras.
        scan: The range finders.
        coverage: Where the free floor lies in the robots' grids.
        observable_landmarks: (N',) bool. Landmarks that some robot could ever see: only they count.
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
        """Return what the setting is made of; what follows from that is left out."""
        sensor = self.sensor
        painted = None
        if isinstance(sensor, StereoSensor):
            painted = sensor.textures, sensor.corners.faces, sensor.corners.offsets
        return (
            self.world, self.true_starts, self.bias, self.belief_seed, self.stream_states, sensor.config,
            sensor.robot_radius, painted, self.scan.config, self.coverage.cells, self.observable_landmarks,
        )  # fmt: skip

    @classmethod
    def from_parts(
        cls, world: World, true_starts: FloatArray, bias: FloatArray, belief_seed: np.random.SeedSequence,
        stream_states: dict[str, Any], sensor: Any, robot_radius: float, painted: Any, scan: ScanConfig,
        cells: FloatArray, countable: np.ndarray,
    ) -> Self:  # fmt: skip
        """Return the setting that is made of these parts; its sensors are built again.

        Raises:
            ValueError: If the parts do not fit together.
        """
        landmarks = world.landmarks
        if landmarks is None:
            raise ValueError("a world without landmarks")
        eyes: LandmarkSensor | StereoSensor
        if isinstance(sensor, StereoSensorConfig):
            textures, faces, offsets = painted
            check_textures(textures, world.walls)
            corners = TextureCorners.found(world.walls, landmarks, faces, offsets, sensor.tolerance)
            eyes = StereoSensor.of_textures(sensor, world.walls, textures, corners, robot_radius)
        else:
            eyes = LandmarkSensor(sensor, world.walls, landmarks, robot_radius)
        return cls(
            world=world,
            true_starts=true_starts,
            bias=bias,
            belief_seed=belief_seed,
            stream_states=stream_states,
            sensor=eyes,
            scan=RangeFinder(scan, world.walls, robot_radius),
            coverage=CoverageCells(cells, true_starts),
            observable_landmarks=countable,
        )

    def new_ground_truth(self, cutoff: float) -> GroundTruthAssociation:
        """Return empty books for this world's landmarks; `cutoff` is c of the map error [m]."""
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
    """Draw an episode's setting. Each concern draws from a stream of its own, so that none shifts another.

    Args:
        config: Of the environment.
        source: What the world is made from.
        seed: Of all streams.
        world_seed: Of the layout and its textures, if these are to differ from what `seed` would give.
        start_poses: (K, 3) [m, m, rad], world frame; None: those of the world, or drawn.

    Raises:
        ValueError: If there is no such world, robots cannot start there, or no landmark can be seen.
    """
    layout, textures, starts, odometry, sensor, scan, belief_seed, radio = seed.spawn(8)
    if world_seed is None and config.world_split is not None:
        world_seed = draw_world_seed(config.world_split, np.random.default_rng(layout))
    if world_seed is not None:
        layout, textures = np.random.SeedSequence(world_seed).spawn(2)
    bare = make_world(source, np.random.default_rng(layout), config.world_split)
    free_space = FreeSpace(bare, config.robot_radius)
    paint = np.random.default_rng(textures)
    eyes: LandmarkSensor | StereoSensor
    if config.sensor == "stereo":
        eyes = StereoSensor(config.stereo, bare, free_space, paint, config.robot_radius)
        landmarks = eyes.landmarks
    else:
        given = bare.landmarks
        landmarks = place_landmarks(bare, paint, config.landmarks, free_space) if given is None else given
        eyes = LandmarkSensor(config.landmark_sensor, bare.walls, landmarks, config.robot_radius)
    countable = free_space.visible_landmarks(landmarks, eyes.config.camera, eyes.config.max_incidence)
    if not countable.any():
        got, cure = f"no such landmark among {len(landmarks)} in {bare.name!r}", "Put some on walls that robots pass."
        raise argument_error("world", "landmarks that robots can see", got, cure)
    world = World(bare.name, bare.walls, landmarks, bare.start_poses)
    true_starts = _starts(config, world, free_space, start_poses, np.random.default_rng(starts))
    streams = {
        name: np.random.default_rng(stream)
        for name, stream in (("odometry", odometry), ("sensor", sensor), ("scan", scan), ("radio", radio))
    }
    return Scenario(
        world=world,
        true_starts=as_read_only(true_starts),
        bias=as_read_only(draw_bias(config.odometry, config.num_robots, streams["odometry"])),
        belief_seed=belief_seed,
        stream_states={name: stream.bit_generator.state for name, stream in streams.items()},
        sensor=eyes,
        scan=RangeFinder(config.scan, world.walls, config.robot_radius),
        coverage=CoverageCells(free_space.free_area_cells, true_starts),
        observable_landmarks=as_read_only(countable),
    )


def _starts(
    config: EnvConfig,
    world: World,
    free_space: FreeSpace,
    start_poses: Any,
    rng: np.random.Generator,
) -> FloatArray:
    given = world.start_poses
    sight = config.stereo if config.sensor == "stereo" else config.landmark_sensor
    if start_poses is not None:
        return free_space.check_starts(start_poses, config.num_robots)
    if given is not None:
        if len(given) < config.num_robots:
            raise argument_error(
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
        no_shared_view=None if config.shared_start_view else sight.camera,
        landmarks=world.landmarks,
        max_incidence=sight.max_incidence,
    )
