"""Scenario of an episode: everything drawn at its reset and constant afterwards."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np

from slam_backend.core.read_only import as_constant, as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.state import BOOL, FLOAT64, INT64, Array, Maybe, Record, Seed, Sizes, State, refuse
from slam_backend.state.format import parts_of
from vslam_env.config import EnvConfig
from vslam_env.evaluation.coverage import CoverageCells
from vslam_env.evaluation.map_scores import GroundTruthAssociation
from vslam_env.sensors import LandmarkSensor, RangeFinder, StereoSensor
from vslam_env.sensors.stereo.ground_truth import TextureCorners
from vslam_env.sensors.stereo.textures import WallTextures, check_textures
from vslam_env.simulation.memory import available_memory, check_memory
from vslam_env.world import FreeSpace, World, WorldSource, draw_bias, draw_world_seed, make_world, place_landmarks
from vslam_env.world.spec import FARTHEST_PLACE

STREAMS = ("odometry", "sensor", "scan", "radio")  # random streams of an episode


@short_repr
@dataclass(frozen=True, slots=True, kw_only=True, eq=False)
class Scenario:
    """World, start poses and sensors of an episode, shared with its snapshots; arrays are read-only.

    Attributes:
        world: Walls and landmarks.
        true_starts: (K, 3) float64 [m, m, rad], world frame. Start poses.
        bias: (K, 2) float64. Odometry biases of the robots, see `draw_bias`.
        belief_seed: Seed of the team's beliefs: entropy, spawn key, size of the pool and number of children.
        sensor: Cameras of the robots.
        scan: Range finders of the robots.
        coverage: Cells of the free floor in the robots' grids.
        observable_landmarks: (N',) bool. True for landmarks visible from some reachable place; only these are scored.
    """

    STATE: ClassVar[State] = State(
        world=Record(World),
        true_starts=Array(FLOAT64, "K 3", -FARTHEST_PLACE, FARTHEST_PLACE, constant=True),
        bias=Array(FLOAT64, "K 2", constant=True),
        belief_seed=Seed(),
        cells=Array(FLOAT64, "cells 2", -2.0 * FARTHEST_PLACE, 2.0 * FARTHEST_PLACE, constant=True),
        observable_landmarks=Array(BOOL, "landmarks", constant=True),
        textures=Maybe(Record(WallTextures)),
        corner_faces=Maybe(Array(INT64, "landmarks", constant=True)),
        corner_offsets=Maybe(Array(FLOAT64, "landmarks 2", constant=True)),
    )

    world: World
    true_starts: FloatArray
    bias: FloatArray
    belief_seed: tuple[Any, ...]
    sensor: LandmarkSensor | StereoSensor
    scan: RangeFinder
    coverage: CoverageCells
    observable_landmarks: np.ndarray

    def __post_init__(self) -> None:
        for name in ("true_starts", "bias", "observable_landmarks"):
            object.__setattr__(self, name, as_constant(getattr(self, name)))

    @property
    def cells(self) -> FloatArray:
        """(n, 2) float64 [m], world frame. Centres of the cells of the free floor."""
        return self.coverage.cells

    @property
    def textures(self) -> WallTextures | None:
        """Textures of the walls, if cameras render them."""
        return self.sensor.textures if isinstance(self.sensor, StereoSensor) else None

    @property
    def corner_faces(self) -> IntArray | None:
        """(N',) int64, ascending. Faces of the landmarks, if cameras render these."""
        return self.sensor.corners.faces if isinstance(self.sensor, StereoSensor) else None

    @property
    def corner_offsets(self) -> FloatArray | None:
        """(N', 2) float64 [m]. Position of each landmark along its wall, and height, if cameras render these."""
        return self.sensor.corners.offsets if isinstance(self.sensor, StereoSensor) else None

    @classmethod
    def from_parts(
        cls, config: EnvConfig, world: World, true_starts: FloatArray, bias: FloatArray, belief_seed: tuple[Any, ...],
        cells: FloatArray, observable_landmarks: np.ndarray, textures: WallTextures | None,
        corner_faces: IntArray | None, corner_offsets: FloatArray | None,
    ) -> Self:  # fmt: skip
        """Build a scenario, including its sensors, from the parts of its state.

        Raises:
            ValueError: If the parts are inconsistent.
        """
        landmarks, radius = world.landmarks, config.robot_radius
        if landmarks is None or len(landmarks) != len(observable_landmarks) or not observable_landmarks.any():
            raise ValueError("a world without observable landmarks")
        sensor: LandmarkSensor | StereoSensor
        if config.sensor == "stereo":
            if textures is None or corner_faces is None or corner_offsets is None:
                raise ValueError("walls without textures and corners")
            check_textures(textures, world.walls)
            if (np.diff(corner_faces) < 0).any() or corner_faces.max(initial=0) >= 2 * len(world.walls):
                raise ValueError("corners whose faces do not ascend")
            tolerance = config.stereo.tolerance
            corners = TextureCorners.found(world.walls, landmarks, corner_faces, corner_offsets, tolerance)
            sensor = StereoSensor.of_textures(config.stereo, world.walls, textures, corners, radius)
        else:
            sensor = LandmarkSensor(config.landmark_sensor, world.walls, landmarks, radius)
        return cls(
            world=world,
            true_starts=true_starts,
            bias=bias,
            belief_seed=belief_seed,
            sensor=sensor,
            scan=RangeFinder(config.scan, world.walls, radius),
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
) -> tuple[Scenario, dict[str, np.random.Generator]]:
    """Draw the scenario of an episode, with an independent random stream for each concern.

    Args:
        config: Configuration of the environment.
        source: Source of the world.
        seed: Seed of all streams.
        world_seed: Seed of layout and textures; None: derived from `seed` or drawn from the world split.
        start_poses: (K, 3) [m, m, rad], world frame; None: start poses of the world, or drawn ones.

    Returns:
        The scenario, and the random streams of the episode by name, see `STREAMS`.

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
    streams = dict(zip(STREAMS, map(np.random.default_rng, (odometry, detections, scan, radio)), strict=True))
    scenario = Scenario(
        world=world,
        true_starts=as_read_only(true_starts),
        bias=as_read_only(draw_bias(config.odometry, config.num_robots, streams["odometry"])),
        belief_seed=(belief_seed.entropy, belief_seed.spawn_key, belief_seed.pool_size, 0),
        sensor=sensor,
        scan=RangeFinder(config.scan, world.walls, config.robot_radius),
        coverage=CoverageCells(free_space.free_area_cells, true_starts),
        observable_landmarks=as_read_only(observable),
    )
    return scenario, streams


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


class ScenarioPart(Record):
    """A scenario, which is rebuilt from its parts unless it is the one given as the size `SCENARIO`.

    Sizes that follow: `WORLD` and `LANDMARKS`, the numbers of all and of the observable landmarks, `DESCRIPTOR`, the
    length of their descriptors, and `CELLS`, the number of cells of the free floor.
    """

    def __init__(self) -> None:
        super().__init__(Scenario)

    def check(self, name: str, value: Any, sizes: Sizes) -> Scenario:
        """Return the scenario, or raise; add the sizes that follow."""
        scenario: Scenario = value if value is sizes["SCENARIO"] else super().check(name, value, sizes)
        landmarks = scenario.world.landmarks
        assert landmarks is not None
        sizes |= {"WORLD": len(landmarks), "LANDMARKS": int(np.count_nonzero(scenario.observable_landmarks))}
        sizes |= {"DESCRIPTOR": landmarks.descriptors.shape[1], "CELLS": len(scenario.cells)}
        return scenario

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Scenario:
        found = parts_of(value) if type(value) is Scenario else value
        if not isinstance(found, Mapping):
            refuse(name, "a Scenario", f"a {type(value).__name__}")
        parts = {key: part.check(f"{name}.{key}", found[key], sizes) for key, part in Scenario.STATE.parts.items()}
        return Scenario.from_parts(sizes["CONFIG"], **parts)
