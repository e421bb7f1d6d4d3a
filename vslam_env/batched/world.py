"""The simulated world in arrays of fixed shape: walls, landmarks, motion with contacts, odometry, cameras and scans.

Worlds are drawn by the environment and exported, so that all families and presets are the same; what a tick draws has
the same distribution as there. Contacts are resolved by moving discs out of walls and of each other, not by impulses.
"""

import math
from typing import Any, NamedTuple, Self

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from slam_backend.core.validation import argument_error
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from vslam_env.batched.belief import Frame, wrapped
from vslam_env.config import TICK, EnvConfig
from vslam_env.sensors._landmark_kernels import NEAREST, NEAREST_FALSE_POINT
from vslam_env.simulation.scenario import Scenario
from vslam_env.world.simulator import SHORTFALL, SKIN
from vslam_env.world.visibility import view_limits

FAR = 1e5  # [m] place of what only fills an array
TOUCH = 1e-3  # [m] what a ray meets this close to a landmark does not hide it
SUBSTEPS, PUSHES = 4, 3  # of a tick, and corrections after each


class Scene(NamedTuple):
    """World and starts of an episode; arrays have room for the largest of a batch.

    Attributes:
        walls: (S, 4) float32 [m], world frame. Segments.
        landmarks: (N, 3) float32 [m], world frame.
        normals: (N, 2) float32 [-], world frame. Normals of the faces that carry them.
        own_walls: (N,) int32. Walls that carry them.
        descriptors: (N, D) float32. Unit descriptors.
        observable: (N,) bool. Landmarks that are scored.
        common: (D,) float32. Part that all descriptors have in common, also those of false points.
        starts: (K, 3) float32 [m, m, rad], world frame.
        bias: (K, 2) float32. Odometry biases [m/m, rad/m].
    """

    walls: Array
    landmarks: Array
    normals: Array
    own_walls: Array
    descriptors: Array
    observable: Array
    common: Array
    starts: Array
    bias: Array

    @classmethod
    def of(cls, scenario: Scenario, num_walls: int, num_landmarks: int) -> Self:
        """Return the scene of an episode of the environment, with room for S walls and N landmarks.

        Raises:
            ValueError: If there is no room.
        """
        landmarks = scenario.world.landmarks
        assert landmarks is not None
        for name, room, needed in (
            ("num_walls", num_walls, len(scenario.world.walls)), ("num_landmarks", num_landmarks, len(landmarks))
        ):  # fmt: skip
            if room < needed:
                raise argument_error(name, f"at least {needed}", room, "Make room for the largest world of a batch.")

        def padded(values: Any, room: int, fill: float, dtype: Any = np.float32) -> Array:
            rows = np.asarray(values, dtype)
            return jnp.asarray(np.concatenate([rows, np.full((room - len(rows), *rows.shape[1:]), fill, dtype)]))

        count = num_landmarks
        return cls(
            padded(scenario.world.walls, num_walls, FAR), padded(landmarks.positions, count, FAR),
            padded(landmarks.normals, count, 0.0), padded(landmarks.walls, count, -1, np.int32),
            padded(landmarks.descriptors, count, 0.0), padded(scenario.observable_landmarks, count, 0, np.bool_),
            jnp.asarray(landmarks.descriptors.mean(axis=0), jnp.float32),
            jnp.asarray(scenario.true_starts, jnp.float32), jnp.asarray(scenario.bias, jnp.float32),
        )  # fmt: skip


class Hardware(NamedTuple):
    """True geometry and noise of robots, cameras and range finders, see `EnvConfig`."""

    radius: float
    sigma_distance: float
    sigma_turn: float
    mount: tuple[float, ...]
    focal: float
    baseline: float
    sigma_px: float
    sigma_disparity: float
    farthest: float
    descriptor_noise: float
    max_measurements: int
    detection_probability: float
    false_points: float
    view: tuple[float, ...]
    rays: tuple[float, ...]
    scan_range: float
    scan_sigma: float

    @classmethod
    def of(cls, config: EnvConfig) -> Self:
        """Return the hardware of an environment whose cameras measure landmarks."""
        sensor, scan, odometry = config.landmark_sensor, config.scan, config.odometry
        camera = sensor.camera
        return cls(
            config.robot_radius, odometry.sigma_distance, odometry.sigma_heading_per_metre, tuple(camera.mount),
            camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px, sensor.farthest,
            sensor.descriptor_noise, sensor.max_measurements, sensor.detection_probability, sensor.false_points,
            tuple(view_limits(camera, sensor.max_incidence).tolist()), tuple(scan.ray_angles.tolist()),
            scan.max_range, scan.sigma,
        )  # fmt: skip


# ---------------------------------------------------------------------- motion


def drive(poses: Array, commands: Array, scene: Scene, hardware: Hardware) -> tuple[Array, Array]:
    """Return the poses (K, 3) after a tick, and which robots (K,) were blocked.

    Args:
        poses: (K, 3) [m, m, rad], world frame.
        commands: (K, 2) [m/s, rad/s]. Forward speeds and turn rates.
    """
    turns = commands[:, 1] * TICK
    chords = commands[:, 0] * TICK * jnp.sinc(0.5 * turns / math.pi)
    middle = poses[:, 2] + 0.5 * turns
    motion = chords[:, None] * jnp.stack([jnp.cos(middle), jnp.sin(middle)], axis=1)
    places, radius = poses[:, :2], hardware.radius + SKIN
    for _ in range(SUBSTEPS):
        places = places + motion / SUBSTEPS
        for _ in range(PUSHES):
            places = _apart(_out_of_walls(places, scene.walls, radius), radius)
    achieved = ((places - poses[:, :2]) * motion).sum(axis=1)
    return (
        jnp.column_stack([places, wrapped(poses[:, 2] + turns)]),
        achieved < (1.0 - SHORTFALL) * (motion**2).sum(axis=1) - 1e-9,
    )


def _out_of_walls(places: Array, walls: Array, radius: float) -> Array:
    """Return places (K, 2) of discs moved out of the wall in which each is deepest."""
    along = walls[:, 2:] - walls[:, :2]
    away = places[:, None] - walls[:, :2]
    share = jnp.clip((away * along).sum(axis=-1) / jnp.maximum((along**2).sum(axis=-1), 1e-12), 0.0, 1.0)
    off = away - share[..., None] * along
    distances = jnp.sqrt((off**2).sum(axis=-1) + 1e-12)
    nearest = jnp.argmin(distances, axis=1)
    robots = jnp.arange(len(places))
    distance = distances[robots, nearest]
    return places + (jnp.maximum(radius - distance, 0.0) / distance)[:, None] * off[robots, nearest]


def _apart(places: Array, radius: float) -> Array:
    """Return places (K, 2) of discs that overlap moved apart, each by half."""
    off = places[:, None] - places
    distances = jnp.sqrt((off**2).sum(axis=-1) + 1e-12)
    overlap = jnp.maximum(2.0 * radius - distances, 0.0) * (1.0 - jnp.eye(len(places)))
    return places + ((0.5 * overlap / distances)[..., None] * off).sum(axis=1)


def read_odometry(before: Array, after: Array, scene: Scene, draws: Array, hardware: Hardware) -> Array:
    """Return readings (K, 3) of the motions between poses (K, 3), see `vslam_env.world.odometry`.

    Args:
        draws: (K, 2), standard normal.
    """
    shift, turned = after[:, :2] - before[:, :2], after[:, 2] - before[:, 2]
    distance = jnp.linalg.norm(shift, axis=1)
    stretch = 1.0 + scene.bias[:, 0] + hardware.sigma_distance * draws[:, 0]
    turn = distance * (scene.bias[:, 1] + hardware.sigma_turn * draws[:, 1])
    into_robot = 0.5 * turn - before[:, 2]
    c, s = stretch * jnp.cos(into_robot), stretch * jnp.sin(into_robot)
    ahead, left = c * shift[:, 0] - s * shift[:, 1], s * shift[:, 0] + c * shift[:, 1]
    return jnp.column_stack([ahead, left, wrapped(turned + turn)])


# ---------------------------------------------------------------------- sight


def _to_walls(rays: Array, eye: Array, walls: Array) -> Array:
    """Return for rays (R, 2) from an eye (2,) how many of their lengths away they meet walls (R, S); inf: never."""
    first, along = walls[:, :2] - eye, walls[:, 2:] - walls[:, :2]
    cross = rays[:, :1] * along[:, 1] - rays[:, 1:] * along[:, 0]
    divisor = jnp.where(cross == 0.0, 1.0, cross)
    of_wall = (first[:, 0] * rays[:, 1:] - first[:, 1] * rays[:, :1]) / divisor
    of_ray = (first[:, 0] * along[:, 1] - first[:, 1] * along[:, 0]) / divisor
    meets = (cross != 0.0) & (of_wall >= -1e-6) & (of_wall <= 1.0 + 1e-6) & (of_ray >= 0.0)
    return jnp.where(meets, of_ray, jnp.inf)


def _to_discs(rays: Array, eye: Array, discs: Array, others: Array, radius: float) -> Array:
    """Return the distances (R, K) [m] along unit rays (R, 2) to discs (K, 2); inf: never, and for this robot's own."""
    off = discs - eye
    along = rays @ off.T
    inside = radius**2 - ((off**2).sum(axis=1) - along**2)
    is_met = (along > 0.0) & (inside > 0.0) & others
    return jnp.where(is_met, jnp.maximum(along - jnp.sqrt(jnp.maximum(inside, 0.0)), 0.0), jnp.inf)


def visible(poses: Array, robot: Array, scene: Scene, hardware: Hardware) -> Array:
    """Return which landmarks (N,) the camera of a robot sees, see `vslam_env.world.visibility`."""
    forward, aside, height, max_range, tan_half, tan_vertical, cos_incidence = hardware.view
    pose = poses[robot]
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    eye = pose[:2] + jnp.stack([c * forward - s * aside, s * forward + c * aside])
    off, up = scene.landmarks[:, :2] - eye, scene.landmarks[:, 2] - height
    ahead, left = off @ jnp.stack([c, s]), off @ jnp.stack([-s, c])
    length = jnp.linalg.norm(off, axis=1)
    distance = jnp.sqrt(length**2 + up**2)
    in_image = (ahead > 0.0) & (jnp.abs(left) <= tan_half * ahead) & (jnp.abs(up) <= tan_vertical * ahead)
    faces = -(off * scene.normals).sum(axis=1) > cos_incidence * distance
    met = _to_walls(off, eye, scene.walls)
    own = scene.own_walls[:, None] == jnp.arange(len(scene.walls))
    hidden = (~own & (met * length[:, None] < length[:, None] - TOUCH)).any(axis=1)
    rays, others = off / jnp.maximum(length, 1e-6)[:, None], jnp.arange(len(poses)) != robot
    free = (_to_discs(rays, eye, poses[:, :2], others, hardware.radius) >= length[:, None]).all(axis=1)
    return in_image & (distance <= max_range) & faces & ~hidden & free


def measure(poses: Array, robot: Array, scene: Scene, key: Array, hardware: Hardware) -> Frame:
    """Return a frame of a robot's camera, see `vslam_env.sensors.LandmarkSensor`."""
    keys, most = jax.random.split(key, 6), hardware.max_measurements
    order = jax.random.uniform(keys[0], (len(scene.landmarks),))
    is_seen = visible(poses, robot, scene, hardware) & (order < hardware.detection_probability)
    costs, rows = jax.lax.top_k(-jnp.where(is_seen, order, jnp.inf), most)
    num_false = jnp.minimum(jax.random.poisson(keys[1], hardware.false_points), most)
    is_false = jnp.arange(most) >= most - num_false
    pose, height = poses[robot], hardware.mount[2]
    c, s = jnp.cos(pose[2]), jnp.sin(pose[2])
    off = scene.landmarks[rows, :2] - pose[:2]
    local = jnp.column_stack([off @ jnp.stack([c, s]), off @ jnp.stack([-s, c]), scene.landmarks[rows, 2]])
    true_points = (local - jnp.array([*hardware.mount[:2], height])) @ jnp.asarray(ROBOT_FROM_CAMERA, jnp.float32)
    points, looks = _false_points(scene, keys[2], hardware)
    points = jnp.where(is_false[:, None], points, true_points)
    noise = jax.random.normal(keys[3], (most, 3))
    scale = hardware.focal / jnp.where(points[:, 2] == 0.0, 1.0, points[:, 2])
    disparity = hardware.baseline * scale + hardware.sigma_disparity * noise[:, 2]
    per_pixel = hardware.baseline / jnp.where(disparity > 0.0, disparity, 1.0)
    pixels = points[:, :2] * scale[:, None] + hardware.sigma_px * noise[:, :2]
    found = jnp.column_stack([pixels * per_pixel[:, None], hardware.focal * per_pixel])
    reported = (disparity > 0.0) & (found[:, 2] >= NEAREST) & ((found**2).sum(axis=1) <= hardware.farthest**2)
    valid = (jnp.isfinite(costs) | is_false) & reported
    looks = jnp.where(is_false[:, None], looks, scene.descriptors[rows])
    spread = hardware.descriptor_noise / math.sqrt(looks.shape[1])
    looks = _unit(looks + spread * jax.random.normal(keys[4], looks.shape))
    return Frame(
        jnp.where(valid[:, None], found, jnp.array([0.0, 0.0, 1.0])), jnp.where(valid[:, None], looks, 0.0),
        jnp.where(valid & ~is_false, rows, -1).astype(jnp.int32), valid,
    )  # fmt: skip


def _false_points(scene: Scene, key: Array, hardware: Hardware) -> tuple[Array, Array]:
    """Return B points [m], camera frame, that are no landmarks, and their descriptors; see `false_points`."""
    of_place, of_look = jax.random.split(key)
    max_range, across, upright = hardware.view[3:6]
    right, down, depth = jax.random.uniform(of_place, (3, hardware.max_measurements))
    right, down = (2.0 * right - 1.0) * across, (2.0 * down - 1.0) * upright
    ahead = jnp.maximum(min(NEAREST_FALSE_POINT, max_range), depth * max_range / jnp.sqrt(right**2 + down**2 + 1.0))
    looks = _unit(jax.random.normal(of_look, (hardware.max_measurements, scene.descriptors.shape[1])))
    own_share = jnp.sqrt(jnp.maximum(1.0 - scene.common @ scene.common, 0.0))
    return jnp.column_stack([right * ahead, down * ahead, ahead]), _unit(own_share * looks + scene.common)


def _unit(vectors: Array) -> Array:
    """Return vectors (n, D) of length one."""
    return vectors / jnp.linalg.norm(vectors, axis=1, keepdims=True)


def scan(poses: Array, robot: Array, scene: Scene, draws: Array, hardware: Hardware) -> Array:
    """Return the ranges (R,) [m] of a robot's rays, see `vslam_env.sensors.RangeFinder`.

    Args:
        draws: (R,), standard normal.
    """
    angles = poses[robot, 2] + jnp.asarray(hardware.rays)
    rays, eye = jnp.column_stack([jnp.cos(angles), jnp.sin(angles)]), poses[robot, :2]
    others = jnp.arange(len(poses)) != robot
    nearest = jnp.minimum(
        _to_walls(rays, eye, scene.walls).min(axis=1),
        _to_discs(rays, eye, poses[:, :2], others, hardware.radius).min(axis=1),
    )
    read = jnp.clip(nearest * (1.0 + hardware.scan_sigma * draws), 0.0, hardware.scan_range)
    return jnp.where(nearest < hardware.scan_range, read, hardware.scan_range)
