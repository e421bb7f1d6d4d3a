"""Of which classes objects may stand in states of environments that are kept in files."""

from typing import Any

import numpy as np

from slam_backend.errors import FloatArray
from slam_backend.frontend import CornerOptions, FrontEndOptions, StereoFrame
from slam_backend.frontend.stereo import StereoMatches
from slam_backend.state_codec import Kind, Kinds
from slam_backend.state_kinds import BACKEND_KINDS
from vslam_env.config import EnvConfig
from vslam_env.coverage import CoverageMeter
from vslam_env.readings import TeamReadings
from vslam_env.robot_belief import BeliefConfig
from vslam_env.sensors import (
    EyeFrames,
    Frames,
    LandmarkSensor,
    LandmarkSensorConfig,
    Scan,
    ScanConfig,
    StereoSensor,
    StereoSensorConfig,
)
from vslam_env.sensors.stereo_camera import ImagingConfig
from vslam_env.sensors.stereo_textures import TextureConfig, WallTextures, check_textures
from vslam_env.sensors.stereo_truth import TextureCorners
from vslam_env.setting import Setting
from vslam_env.shared_grids import Kept
from vslam_env.standing import Standing
from vslam_env.strokes import Strokes
from vslam_env.world import LandmarkConfig, Landmarks, OdometryNoise, World

CONFIGURATIONS = (
    BeliefConfig, CornerOptions, EnvConfig, FrontEndOptions, ImagingConfig, LandmarkConfig, LandmarkSensorConfig,
    OdometryNoise, ScanConfig, StereoSensorConfig, TextureConfig,
)  # fmt: skip
RECORDS = (
    EyeFrames, Frames, Kept, Landmarks, Standing, StereoFrame, StereoMatches, Strokes, TeamReadings, WallTextures,
    World,
)  # fmt: skip


def _parts_of_setting(setting: Setting) -> tuple[Any, ...]:
    """Return what a setting is made of; what follows from that is left out."""
    sensor = setting.sensor
    painted = None
    if isinstance(sensor, StereoSensor):
        painted = sensor.textures, sensor.corners.faces, sensor.corners.offsets
    return (
        setting.world, setting.true_starts, setting.bias, setting.belief_seed, setting.stream_states, sensor.config,
        sensor.robot_radius, painted, setting.scan.config, setting.coverage.cells, setting.countable,
    )  # fmt: skip


def _setting_of(
    world: World, true_starts: FloatArray, bias: FloatArray, belief_seed: np.random.SeedSequence,
    stream_states: dict[str, Any], sensor: Any, robot_radius: float, painted: Any, scan: ScanConfig, cells: FloatArray,
    countable: np.ndarray,
) -> Setting:  # fmt: skip
    """Return the setting that is made of these."""
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
    return Setting(
        world=world,
        true_starts=true_starts,
        bias=bias,
        belief_seed=belief_seed,
        stream_states=stream_states,
        sensor=eyes,
        scan=Scan(scan, world.walls, robot_radius),
        coverage=CoverageMeter(cells, true_starts),
        countable=countable,
    )


ENV_KINDS = Kinds((*CONFIGURATIONS, *RECORDS), {Setting: Kind("Setting", _parts_of_setting, _setting_of)}).with_others(
    BACKEND_KINDS
)
"""All classes whose objects may stand in the state of an environment."""
