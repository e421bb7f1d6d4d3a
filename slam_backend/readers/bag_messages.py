"""Messages of ROS as poses, velocities and landmarks: a table of functions by type for each use."""

from collections.abc import Callable, Iterable, Iterator
from fnmatch import fnmatchcase
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.validation import Float32Array, FloatArray, argument_error

TAG_FRAMES = "tag*"  # child frames of /tf that are landmarks
MOST_IN_CLOUD = 5000  # points of a message: landmarks, not a scan
# Types of fields of PointCloud2, by number; numpy names
NUMBERS = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
FLOATS = (7, 8)


class PoseReading(NamedTuple):
    """Pose of a message."""

    stamp: int  # Time stamp of the header [ns]
    frame: str  # Frame in which the pose is
    child: str  # Frame whose pose it is; empty: not said
    position: tuple[float, float, float]  # [m]
    quaternion: tuple[float, float, float, float]  # x, y, z, w


class TwistReading(NamedTuple):
    """Velocity of a message."""

    stamp: int  # Time stamp of the header [ns]
    frame: str  # Frame in which it is
    forward: float  # [m/s]
    sideways: float  # [m/s]
    turn: float  # [rad/s]


class Sighting(NamedTuple):
    """Landmarks seen at one time."""

    stamp: int  # Time stamp of the header [ns]
    frame: str  # Frame of the sensor
    names: list[str] | None  # (n,) Identities; None: not known
    points: Any  # (n, 3) [m], frame of the sensor
    covariances: Any = None  # (n, 3, 3) [m^2], frame of the sensor; None: not known
    descriptors: Float32Array | None = None  # (n, d); None: none


def _stamp(header: Any) -> int:
    return int(header.stamp.sec) * 10**9 + int(header.stamp.nanosec)


def _frame(name: str) -> str:
    """Return a frame without the leading slash that ROS 1 allowed."""
    return name.strip().lstrip("/")


def _xyz(vector: Any) -> tuple[float, float, float]:
    return float(vector.x), float(vector.y), float(vector.z)


def _pose(header: Any, child: str, position: Any, rotation: Any) -> PoseReading:
    quaternion = (float(rotation.x), float(rotation.y), float(rotation.z), float(rotation.w))
    return PoseReading(_stamp(header), _frame(header.frame_id), _frame(child), _xyz(position), quaternion)


def _of_pose(header: Any, child: str, pose: Any) -> PoseReading:
    return _pose(header, child, pose.position, pose.orientation)


def _of_transform(message: Any) -> PoseReading:
    moved = message.transform
    return _pose(message.header, message.child_frame_id, moved.translation, moved.rotation)


def _of_twist(message: Any) -> TwistReading:
    linear, angular = message.twist.linear, message.twist.angular
    return TwistReading(
        _stamp(message.header), _frame(message.header.frame_id), float(linear.x), float(linear.y), float(angular.z)
    )


def transforms(message: Any) -> list[PoseReading]:
    """Return the poses of the child frames of a `tf2_msgs/TFMessage`."""
    return [_of_transform(each) for each in message.transforms]


def _position_covariance(values: Any) -> FloatArray | None:
    """Return the part (3, 3) of the position of a covariance (36,) of a pose; None if it is zero."""
    covariance = np.asarray(values, np.float64).reshape(6, 6)[:3, :3]
    return covariance if covariance.any() else None


def _sighting(header: Any, name: str, position: Any, covariance: FloatArray | None = None) -> Sighting:
    covariances = None if covariance is None else [covariance]
    return Sighting(_stamp(header), _frame(header.frame_id), [name], [_xyz(position)], covariances)


def _apriltags(message: Any, pattern: str) -> Iterator[Sighting]:
    """Yield tags and bundles of apriltag_ros, whose name is of all their numbers."""
    for each in message.detections:
        posed = each.pose
        header = posed.header if posed.header.frame_id else message.header
        name = "-".join(str(int(number)) for number in each.id)
        yield _sighting(header, name, posed.pose.pose.position, _position_covariance(posed.pose.covariance))


def _alvar(message: Any, pattern: str) -> Iterator[Sighting]:
    for each in message.markers:
        header = each.header if each.header.frame_id else message.header
        yield _sighting(header, str(int(each.id)), each.pose.pose.position)


def _fiducials(message: Any, pattern: str) -> Iterator[Sighting]:
    for each in message.transforms:
        yield _sighting(message.header, str(int(each.fiducial_id)), each.transform.translation)


def _score(result: Any) -> float:
    """Return what sorts results of a detection, the best first."""
    hypothesis: Any = getattr(result, "hypothesis", result)
    return -float(hypothesis.score)


def _detections(message: Any, pattern: str) -> Iterator[Sighting]:
    """Yield detections of ROS 1 and ROS 2, named by their own identity or that of their best class."""
    for each in message.detections:
        results = sorted(each.results, key=_score)
        header = each.header if each.header.frame_id else message.header
        name, position, covariance = str(getattr(each, "id", "")), each.bbox.center.position, None
        if results:
            best = getattr(results[0], "hypothesis", results[0])
            name = name or str(best.class_id if hasattr(best, "class_id") else best.id)
            if any(_xyz(results[0].pose.pose.position)):  # many detectors fill the box alone
                position = results[0].pose.pose.position
                covariance = _position_covariance(results[0].pose.covariance)
        yield _sighting(header, name, position, covariance)


def _markers(message: Any, pattern: str) -> Iterator[Sighting]:
    """Yield markers, without those that are deleted; names have the name space, if there is one."""
    for each in message.markers:
        if int(each.action) == 0:
            name = f"{each.ns}:{int(each.id)}" if each.ns else str(int(each.id))
            yield _sighting(each.header, name, each.pose.position)


def _tag_frames(message: Any, pattern: str) -> Iterator[Sighting]:
    """Yield child frames of /tf whose name matches the pattern."""
    for each in message.transforms:
        name = _frame(each.child_frame_id)
        if fnmatchcase(name, pattern):
            yield _sighting(each.header, name, each.transform.translation)


def _cloud(message: Any, pattern: str) -> Iterator[Sighting]:
    """Yield the points of a cloud with their field `id`, or else all other fields of floats as descriptors."""
    count = int(message.width) * int(message.height)
    if count > MOST_IN_CLOUD:
        hint = "Landmarks are points with an identity or descriptor, not a scan."
        raise argument_error("landmarks", f"at most {MOST_IN_CLOUD:,} points in a message", count, hint)
    fields = {each.name: each for each in message.fields}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        hint = f"It has {', '.join(fields) or 'none'}."
        raise argument_error("landmarks", "fields x, y, z of a PointCloud2", f"no {missing[0]}", hint)
    step, row = int(message.point_step), int(message.row_step)
    data = np.asarray(message.data, np.uint8)
    if step < 1 or row < step * int(message.width) or len(data) < row * int(message.height):
        hint = "Check what publishes it."
        raise argument_error("landmarks", f"{count} points in a PointCloud2", f"a message of {len(data)} bytes", hint)
    rows = data[: row * int(message.height)].reshape(int(message.height), row)[:, : step * int(message.width)]
    cells = np.ascontiguousarray(rows).reshape(count, step)

    def column(field: Any) -> Any:
        kind, number = NUMBERS.get(int(field.datatype)), max(1, int(field.count))
        size = np.dtype(kind).itemsize * number if kind else 0
        if kind is None or int(field.offset) + size > step:
            got = f"a field {field.name!r} of type {field.datatype} at {field.offset}"
            raise argument_error("landmarks", "fields within a point", got, "Check what publishes it.")
        part = np.ascontiguousarray(cells[:, int(field.offset) : int(field.offset) + size])
        return part.view(np.dtype(kind).newbyteorder(">" if message.is_bigendian else "<"))

    points = np.concatenate([column(fields[name])[:, :1] for name in "xyz"], axis=1).astype(np.float64)
    names, described = None, None
    if "id" in fields:
        names = [str(int(value)) for value in column(fields["id"])[:, 0]]
    else:
        others = [each for name, each in fields.items() if name not in "xyz" and int(each.datatype) in FLOATS]
        described = np.concatenate(
            [np.zeros((count, 0), np.float32), *(column(each).astype(np.float32) for each in others)], axis=1
        )
    header = message.header
    yield Sighting(_stamp(header), _frame(header.frame_id), names, points, None, described)


POSES: dict[str, Callable[[Any], PoseReading]] = {
    "nav_msgs/Odometry": lambda m: _of_pose(m.header, m.child_frame_id, m.pose.pose),
    "geometry_msgs/PoseStamped": lambda m: _of_pose(m.header, "", m.pose),
    "geometry_msgs/PoseWithCovarianceStamped": lambda m: _of_pose(m.header, "", m.pose.pose),
    "geometry_msgs/TransformStamped": _of_transform,
}
TWISTS: dict[str, Callable[[Any], TwistReading]] = {"geometry_msgs/TwistStamped": _of_twist}
LANDMARKS: dict[str, Callable[[Any, str], Iterable[Sighting]]] = {
    "apriltag_ros/AprilTagDetectionArray": _apriltags,
    "ar_track_alvar_msgs/AlvarMarkers": _alvar,
    "fiducial_msgs/FiducialTransformArray": _fiducials,
    "vision_msgs/Detection3DArray": _detections,
    "visualization_msgs/MarkerArray": _markers,
    "sensor_msgs/PointCloud2": _cloud,
    "tf2_msgs/TFMessage": _tag_frames,
}
CAMERAS = ("sensor_msgs/CameraInfo",)
# Types that lack what they seem to have, and the cure
LACKING = {
    "apriltag_msgs/AprilTagDetectionArray": "It has no poses: they are in /tf, so give /tf and --tag-frames.",
    "nav_msgs/Path": "Give the topic of the single poses.",
    "geometry_msgs/Pose": "It has no time stamp: record PoseStamped.",
    "geometry_msgs/Twist": "It has no time stamp: record TwistStamped or Odometry.",
    "vision_msgs/Detection2DArray": "It has no positions in space: give a Detection3DArray.",
}


def uses(kind: str) -> list[str]:
    """Return what a topic of a type can be.

    >>> uses("nav_msgs/Odometry"), uses("sensor_msgs/Image")
    (['odometry', 'truth'], [])
    """
    tables = (("odometry", {*POSES, *TWISTS}), ("landmarks", LANDMARKS), ("truth", POSES), ("camera", CAMERAS))
    return [name for name, known in tables if kind in known]


def check_type(argument: str, topic: str, kind: str, known: Iterable[str]) -> str:
    """Return the type of a topic if it can be read.

    Raises:
        ValueError: If it is not one of the known types; the message names them.
    """
    if kind in known:
        return kind
    hint = LACKING.get(kind, f"Give a topic of {', '.join(known)}.")
    raise argument_error(argument, f"a type of {topic} that can be read", kind, hint)
