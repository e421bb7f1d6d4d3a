"""Messages of ROS 2 as arrays and back, steps of a filter from stamped messages, and what all nodes share.

The functions read and fill messages by their fields alone: this module needs no ROS.
"""

import hashlib
import math
import sys
from array import array
from bisect import bisect_left
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend import Measurements
from slam_backend.core.validation import FloatArray, argument_error, check_array, check_float, check_int
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import between, compose, transform_points
from slam_backend.models.camera import StereoCamera
from vslam_env.belief.belief import default_filter_options
from vslam_env.navigation import CELL, FREE, OCCUPIED, UNKNOWN, OccupancyGrid, cell_of

MOST_TILT = 0.2  # of a robot that moves in the plane [rad]
FARTHEST = 1e8  # coordinate of a pose [m]
FREE_UP_TO, OCCUPIED_FROM = 25, 65  # per cent, as map_saver writes maps
COARSEST = 1.0  # resolution of a map [m]
MOST_POINTS = 1000  # of a message of landmarks
MOST_WAITING = 64  # messages of landmarks that wait for odometry
MOST_SAID = 1000  # different warnings of a node
SIZE = 64  # of the descriptor of a marker's id
FLOAT32 = 7  # `PointField.FLOAT32`
ARROW, DELETE_ALL = 0, 3  # `Marker.ARROW`, `Marker.DELETEALL`
SENSING = {
    "particles": 100,
    "wait": 0.5,
    "sigma": 0.05,
    "mount": [0.0, 0.0, 0.0],
}  # parameters of odometry and landmarks


def seconds(stamp: Any) -> float:
    """Return a `builtin_interfaces/Time` as seconds."""
    return float(stamp.sec) + 1e-9 * stamp.nanosec


def planar_pose(place: Any, q: Any, name: str) -> FloatArray:
    """Return the pose (3,) [m, m, rad] of a `Point` or `Vector3` and a `Quaternion` of `geometry_msgs`.

    Raises:
        ValueError: If it is not finite, or tilted by more than `MOST_TILT`.
    """
    values, hint = (place.x, place.y, q.x, q.y, q.z, q.w), "Check who publishes it."
    x, y, *quat_xyzw = check_array(name, values, (6,), hint, within=FARTHEST)
    length = float(np.linalg.norm(quat_xyzw))
    if not 0.99 < length < 1.01:
        raise argument_error(name, "a unit quaternion", f"a length of {length:.3g}", hint)
    qx, qy, qz, qw = np.divide(quat_xyzw, length)
    tilt = math.acos(max(-1.0, 1.0 - 2.0 * (qx * qx + qy * qy)))
    if tilt > MOST_TILT:
        hint = "Only robots that move in the plane are mapped."
        raise argument_error(name, f"a tilt of at most {MOST_TILT} rad", f"a tilt of {tilt:.2f} rad", hint)
    return np.array([x, y, math.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))])


def write_pose(pose: FloatArray, message: Any) -> None:
    """Fill a `geometry_msgs/Pose` with a pose (3,) [m, m, rad]."""
    message.position.x, message.position.y = float(pose[0]), float(pose[1])
    message.orientation.z, message.orientation.w = math.sin(0.5 * pose[2]), math.cos(0.5 * pose[2])


def grid_of_map(message: Any, frame: str, start_from_map: FloatArray) -> OccupancyGrid:
    """Return a `nav_msgs/OccupancyGrid` of any resolution as a grid in the start frame of a robot.

    Args:
        message: The map.
        frame: Expected frame of the map.
        start_from_map: (3,) float64 [m, m, rad]. Pose of the map frame in the start frame of the robot.

    Raises:
        ValueError: If frame, resolution, size or origin do not fit.
    """
    info, hint = message.info, "Check the node that publishes the map."
    if message.header.frame_id != frame:
        raise argument_error("map", f"the frame {frame!r}", message.header.frame_id, "Set the parameter map_frame.")
    resolution = check_float("map.info.resolution", info.resolution, hint, above=0.0, at_most=COARSEST)
    size = check_int("map.info.height", info.height, 0, hint), check_int("map.info.width", info.width, 0, hint)
    values = np.asarray(message.data, np.int8)
    if values.shape != (size[0] * size[1],):
        raise argument_error("map.data", f"{size[0]} x {size[1]} cells", f"shape {values.shape}", hint)
    values = values.reshape(size)
    start_from_cells = compose(
        start_from_map, planar_pose(info.origin.position, info.origin.orientation, "map.info.origin")
    )
    pieces = math.ceil(resolution / (0.5 * CELL))  # points of a coarse cell along each axis, so that none is left out
    inner = (np.stack(np.meshgrid(*[np.arange(pieces)] * 2), axis=-1).reshape(-1, 2) + 0.5) / pieces

    def places(cells: NDArray[np.bool_]) -> FloatArray:
        corners = np.argwhere(cells)[:, None, ::-1]
        return transform_points(start_from_cells, resolution * (corners + inner).reshape(-1, 2))

    grid = OccupancyGrid()
    grid.enter(places((values >= 0) & (values <= FREE_UP_TO)), places(values >= OCCUPIED_FROM))
    return grid


def scan_in(grid: OccupancyGrid, pose: FloatArray, angles: FloatArray, scan_range: float) -> FloatArray:
    """Return the ranges (R,) [m] of rays at angles (R,) [rad] to walls of a grid, `scan_range` where there is none."""
    cells, along = grid.cells, np.arange(0.0, scan_range, 0.5 * CELL)
    rays = along[None, :, None] * np.stack([np.cos(angles), np.sin(angles)], axis=-1)[:, None]
    where = cell_of(transform_points(pose, rays.reshape(-1, 2)), len(cells)).reshape(rays.shape)
    inside = ((where >= 0) & (where < len(cells))).all(axis=-1)
    states = np.where(inside, cells[tuple(np.moveaxis(where.clip(0, len(cells) - 1), -1, 0))], UNKNOWN)
    first = (states != FREE).argmax(axis=1)  # 0 if all are free
    return np.where(states[np.arange(len(states)), first] == OCCUPIED, along[first], scan_range)


@lru_cache(maxsize=10_000)
def descriptor_of(identity: str) -> NDArray[np.float32]:
    """Return a unit vector (64,) that is the same on all machines, and far from those of other identities."""
    seed = int.from_bytes(hashlib.blake2b(identity.encode(), digest_size=8).digest(), "big")
    vector = np.random.default_rng(seed).normal(size=SIZE)
    return np.asarray(vector / np.linalg.norm(vector), np.float32)


def landmarks_of_markers(message: Any, camera: StereoCamera, sigma: float) -> tuple[float, Measurements] | None:
    """Return stamp [s] and measurements of a `visualization_msgs/MarkerArray`; None if no marker is added.

    Namespace and id of a marker are the identity of a landmark, its position is where the robot sees it.

    Raises:
        ValueError: If stamps, frames or identities do not fit, or a position is not finite.
    """
    markers = [marker for marker in message.markers if marker.action == 0]
    if not markers:
        return None
    stamp, frame = seconds(markers[0].header.stamp), markers[0].header.frame_id
    if any((seconds(each.header.stamp), each.header.frame_id) != (stamp, frame) for each in markers):
        raise argument_error("landmarks", "markers of one stamp and frame", "a second one", "Publish them apart.")
    names = [f"{marker.ns}/{marker.id}" for marker in markers]
    if len(set(names)) < len(names):
        raise argument_error("landmarks", "each landmark once", "a repeated id", "Give each landmark an id of its own.")
    points = [[p.x, p.y, p.z] for p in (marker.pose.position for marker in markers)]
    descriptors = [descriptor_of(name) for name in names]
    return stamp, measured(np.array(points), np.array(descriptors), frame, camera, sigma)


def landmarks_of_cloud(message: Any, camera: StereoCamera, sigma: float) -> tuple[float, Measurements]:
    """Return stamp [s] and measurements of a `sensor_msgs/PointCloud2` with fields x, y, z and `descriptor`.

    Raises:
        ValueError: If a field is missing or of another type, sizes do not fit, or a number is not finite.
    """
    given, hint = {field.name: field for field in message.fields}, "Publish FLOAT32 fields x, y, z and descriptor."
    chosen = [given.get(name) for name in ("x", "y", "z", "descriptor")]
    if any(field is None or field.datatype != FLOAT32 or field.count < 1 for field in chosen):
        raise argument_error("landmark_points.fields", "x, y, z and descriptor", sorted(given), hint)
    number = message.width * message.height
    if any(field.offset + 4 * field.count > message.point_step for field in chosen):
        raise argument_error("landmark_points.point_step", "all fields in a point", message.point_step, hint)
    if len(message.data) != number * message.point_step or message.row_step != message.width * message.point_step:
        got = f"a message of {len(message.data)} bytes"
        raise argument_error("landmark_points.data", f"{number} points without padding", got, hint)
    kind = ">f4" if message.is_bigendian else "<f4"
    rows = np.frombuffer(bytes(message.data), np.dtype({
        "names": [field.name for field in chosen], "formats": [(kind, (field.count,)) for field in chosen],
        "offsets": [field.offset for field in chosen], "itemsize": message.point_step,
    }))  # fmt: skip
    points = np.concatenate([rows[name][:, :1] for name in ("x", "y", "z")], axis=1).astype(np.float64)
    frame = message.header.frame_id
    return seconds(message.header.stamp), measured(points, rows["descriptor"], frame, camera, sigma)


def measured(
    points: FloatArray, descriptors: NDArray[Any], frame: str, camera: StereoCamera, sigma: float
) -> Measurements:
    """Return measurements of points in a frame of the body, or in an optical one (REP 103), which has such a name.

    Args:
        points: (n, 3) float64 [m].
        descriptors: (n, d) float32.
        frame: Name of the frame.
        camera: Mount of the camera.
        sigma: Standard deviation of a position [m]; 0: that of the camera model.
    """
    if len(points) > MOST_POINTS:
        hint = "Publish the best ones."
        raise argument_error("landmarks", f"at most {MOST_POINTS} points", f"a frame of {len(points)}", hint)
    seen = points if "optical" in frame else camera.camera_from_robot(points)
    return Measurements(seen, descriptors, np.tile(sigma**2 * np.eye(3), (len(points), 1, 1)) if sigma else None)


def write_cloud(points: FloatArray, descriptors: NDArray[np.float32], message: Any, field: Callable[[], Any]) -> None:
    """Fill a `sensor_msgs/PointCloud2` as `landmarks_of_cloud` reads it; `field` makes a `PointField`."""
    length = descriptors.shape[1]
    message.fields = []
    for name, offset, count in (("x", 0, 1), ("y", 4, 1), ("z", 8, 1), ("descriptor", 12, length)):
        part = field()
        part.name, part.offset, part.datatype, part.count = name, offset, FLOAT32, count
        message.fields.append(part)
    message.height, message.width, message.point_step = 1, len(points), 12 + 4 * length
    message.row_step, message.is_bigendian, message.is_dense = message.width * message.point_step, False, True
    message.data = array("B", np.hstack([points, descriptors]).astype("<f4").tobytes())


def write_arrows(
    arrows: Iterable[tuple[str, int, FloatArray]], message: Any, marker: Callable[[], Any], header: Any
) -> None:
    """Fill a `visualization_msgs/MarkerArray` with poses (3,) by namespace and id, all others deleted."""
    first = marker()
    first.header, first.action = header, DELETE_ALL
    message.markers = [first]
    for space, number, pose in arrows:
        arrow = marker()
        arrow.header, arrow.ns, arrow.id, arrow.type = header, space, number, ARROW
        write_pose(pose, arrow.pose)
        arrow.scale.x, arrow.scale.y, arrow.scale.z = 0.5, 0.1, 0.1
        arrow.color.g = arrow.color.a = 1.0
        message.markers.append(arrow)


class Steps:
    """Steps of a filter from stamped odometry and landmarks: each frame at its own time, odometry interpolated.

    Args:
        wait: Time for which a step without landmarks waits for late ones [s].

    Attributes:
        last: Stamp [s] and odometry pose (3,) of the last step; None: there was none.
    """

    def __init__(self, wait: float) -> None:
        self._wait = check_float("wait", wait, "Give seconds.", above=0.0, at_most=10.0)
        self._poses: list[tuple[float, FloatArray]] = []  # since the last step
        self._frames: deque[tuple[float, Measurements]] = deque()
        self.last: tuple[float, FloatArray] | None = None

    def resume(self, stamp: float, pose: FloatArray) -> None:
        """Continue after an earlier step."""
        self.last = stamp, pose
        self._poses = [self.last]

    def add_frame(self, stamp: float, frame: Measurements) -> None:
        """Add landmarks, which wait for odometry.

        Raises:
            ValueError: If they come too late, or too long before the odometry of their time.
        """
        before = self._frames[-1][0] if self._frames else -math.inf if self.last is None else self.last[0]
        if stamp <= before:
            hint = "Set the parameter wait above their delay, and one clock on all machines."
            raise argument_error(
                "landmarks", "stamps after the last step", f"a stamp {before - stamp:.3f} s older", hint
            )
        if len(self._frames) >= MOST_WAITING:
            got, hint = f"no such odometry for {MOST_WAITING} messages", "Check the topic odom, and the clocks."
            raise argument_error("landmarks", "odometry of their time", got, hint)
        self._frames.append((stamp, frame))

    def add_pose(self, stamp: float, pose: FloatArray) -> Iterator[tuple[FloatArray | None, Measurements | None]]:
        """Add a pose (3,) of the odometry; yield motion since the step before and landmarks of each step now due.

        Raises:
            ValueError: If its stamp does not follow that of the pose before.
        """
        if self._poses and stamp <= self._poses[-1][0]:
            hint = "If the clock was set back, restart the node."
            raise argument_error("odom", "stamps that rise", f"a stamp {self._poses[-1][0] - stamp:.3f} s older", hint)
        self._poses.append((stamp, pose))
        while self._frames and self._frames[0][0] <= stamp:
            when, frame = self._frames.popleft()
            if when >= self._poses[0][0]:  # else before all odometry
                yield self._advance(when), frame
        if stamp - self._poses[0][0] >= 2.0 * self._wait:
            yield self._advance(stamp - self._wait), None

    def _advance(self, when: float) -> FloatArray | None:
        """Make a step at a time up to the newest pose, and return its motion."""
        k = max(1, bisect_left(self._poses, when, key=lambda each: each[0]))
        if k < len(self._poses):
            (begin, one), (end, other) = self._poses[k - 1 : k + 1]
            pose = compose(one, (when - begin) / (end - begin) * between(one, other))
        else:
            pose = self._poses[0][1]  # the only one
        before, self.last = self.last, (when, pose)
        self._poses = [self.last, *(each for each in self._poses[k:] if each[0] > when)]
        return None if before is None else between(before[1], pose)


def filter_options(mount: list[float], particles: int) -> FilterOptions:
    """Return the options of a filter, with the mount of the camera on the robot [m]."""
    options = default_filter_options()
    return replace(options, num_particles=particles, camera=replace(options.camera, mount=tuple(mount)))


def parameters(node: Any, **defaults: Any) -> Any:
    """Declare parameters of a node, and return their values in the order of the defaults."""
    return tuple(node.declare_parameter(name, default).value for name, default in defaults.items())


def warner(node: Any) -> Callable[[str], None]:
    """Return a function that logs warnings of a node, each kind of them once."""
    said: set[str] = set()

    def warn(text: str) -> None:
        kind = text.partition(", got ")[0]
        if kind not in said and len(said) < MOST_SAID:
            said.add(kind)
            node.get_logger().warning(text)

    return warn


def guarded(warn: Callable[[str], None], callback: Callable[..., None]) -> Callable[..., None]:
    """Return a callback that refuses a bad message in one line, in place of an end of the node."""

    def checked(*message: Any) -> None:
        try:
            callback(*message)
        except ValueError as error:
            warn(str(error))

    return checked


def listen(
    node: Any, step: Callable[[FloatArray | None, Measurements | None], Any], warn: Callable[[str], None],
    wait: float, sigma: float, camera: StereoCamera,
) -> Steps:  # fmt: skip
    """Subscribe to odometry and landmarks, make the steps of a filter from them, and return these."""
    from nav_msgs.msg import Odometry
    from rclpy.qos import QoSProfile, ReliabilityPolicy
    from sensor_msgs.msg import PointCloud2
    from visualization_msgs.msg import MarkerArray

    check_float("sigma", sigma, "Give metres; 0 for the noise of a stereo camera.", at_least=0.0)
    steps = Steps(wait)

    def on_odometry(message: Any) -> None:
        pose = planar_pose(message.pose.pose.position, message.pose.pose.orientation, "odom.pose")
        for motion, frame in steps.add_pose(seconds(message.header.stamp), pose):
            try:
                step(motion, frame)
            except ValueError as error:  # of the landmarks, as a rule: the motion still counts
                warn(str(error))
                step(motion, None)

    def on_markers(message: Any) -> None:
        found = landmarks_of_markers(message, camera, sigma)
        if found is not None:
            steps.add_frame(*found)

    def on_cloud(message: Any) -> None:
        steps.add_frame(*landmarks_of_cloud(message, camera, sigma))

    any_sender = QoSProfile(depth=50, reliability=ReliabilityPolicy.BEST_EFFORT)  # reliable or not
    node.create_subscription(Odometry, "odom", guarded(warn, on_odometry), any_sender)
    node.create_subscription(MarkerArray, "landmarks", guarded(warn, on_markers), any_sender)
    node.create_subscription(PointCloud2, "landmark_points", guarded(warn, on_cloud), any_sender)
    return steps


def run(make: Callable[[], Any]) -> None:
    """Make a node and let it work until it is stopped; parameters that do not fit end it with one line."""
    import rclpy
    from rclpy.exceptions import ParameterException
    from rclpy.executors import ExternalShutdownException

    rclpy.init()
    try:
        node = make()
    except (ValueError, ParameterException) as error:
        rclpy.try_shutdown()
        sys.exit(f"error {error}")
    try:
        rclpy.spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    finally:
        node.destroy_node()
        rclpy.try_shutdown()
