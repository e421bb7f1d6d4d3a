"""True world: walls, landmarks, free space, odometry noise and the physics simulator.

Order of construction at a reset: `make_world` -> `FreeSpace` -> `place_landmarks` (unless the world has landmarks) ->
`draw_starts` or `check_starts` -> `Simulator`.
"""

from vslam_env.world.freespace import FreeSpace
from vslam_env.world.landmarks import LandmarkConfig, place_landmarks
from vslam_env.world.loaders.floorplan import load_floorplan, load_walls_json, save_walls_json
from vslam_env.world.loaders.ros_map import load_ros_map, save_ros_map
from vslam_env.world.loaders.splits import SPLITS, draw_world_seed
from vslam_env.world.odometry import OdometryNoise, draw_bias, read_odometry
from vslam_env.world.registry import (
    WORLD_FAMILIES,
    WorldSource,
    check_source,
    is_single_layout,
    make_world,
    portable_source,
)
from vslam_env.world.simulator import Simulator
from vslam_env.world.spec import Landmarks, World

__all__ = [
    "SPLITS",
    "WORLD_FAMILIES",
    "FreeSpace",
    "LandmarkConfig",
    "Landmarks",
    "OdometryNoise",
    "Simulator",
    "World",
    "WorldSource",
    "check_source",
    "draw_bias",
    "draw_world_seed",
    "is_single_layout",
    "load_floorplan",
    "load_ros_map",
    "load_walls_json",
    "make_world",
    "place_landmarks",
    "portable_source",
    "read_odometry",
    "save_ros_map",
    "save_walls_json",
]
