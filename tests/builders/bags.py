"""Small bags of ROS 1 and ROS 2 of a circle world, written by rosbags."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.readers.conversions import integrate_commands

SPEED, TURN = 0.5, 0.25  # [m/s, rad/s]
EPOCH = 1_700_000_000  # [s]
ARRIVAL = 977  # [s] of arrival after the stamp: a clock of its own
LANDMARKS = np.column_stack([
    2.0 + np.array([1.5, 2.8, 4.1]).repeat(5) * np.cos(np.arange(15) * 1.9),
    2.0 + np.array([1.5, 2.8, 4.1]).repeat(5) * np.sin(np.arange(15) * 1.9),
    np.linspace(-0.4, 0.9, 15),
])  # fmt: skip
STARTS = np.array([[0.0, 0.0, 0.0], [3.0, 3.5, 2.0]])
# A camera 0.3 m ahead and 0.1 m to the left, 0.5 m up: optical axes, right, down, ahead
OPTICAL = (0.3, 0.1, 0.5), (-0.5, 0.5, -0.5, 0.5)
ROBOT_FROM_OPTICAL = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
FORMATS = ("circle.bag", "circle", "circle.mcap")
# Types of packages that ROS itself lacks, as their definitions in ROS 1 or ROS 2.
EXTRA = {
    "tf2_msgs/msg/TFMessage": "geometry_msgs/TransformStamped[] transforms\n",
    "apriltag_ros/msg/AprilTagDetection": (
        "int32[] id\nfloat64[] size\ngeometry_msgs/PoseWithCovarianceStamped pose\n"
    ),
    "apriltag_ros/msg/AprilTagDetectionArray": "std_msgs/Header header\napriltag_ros/AprilTagDetection[] detections\n",
    "ar_track_alvar_msgs/msg/AlvarMarker": (
        "std_msgs/Header header\nuint32 id\nuint32 confidence\ngeometry_msgs/PoseStamped pose\n"
    ),
    "ar_track_alvar_msgs/msg/AlvarMarkers": "std_msgs/Header header\nar_track_alvar_msgs/AlvarMarker[] markers\n",
    "fiducial_msgs/msg/FiducialTransform": (
        "int32 fiducial_id\ngeometry_msgs/Transform transform\nfloat64 image_error\nfloat64 object_error\n"
        "float64 fiducial_area\n"
    ),
    "fiducial_msgs/msg/FiducialTransformArray": (
        "std_msgs/Header header\nint32 image_seq\nfiducial_msgs/FiducialTransform[] transforms\n"
    ),
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size\n",
    "apriltag_msgs/msg/AprilTagDetectionArray": "std_msgs/Header header\nint32[] ids\n",
}
VISION = {
    1: {
        "vision_msgs/msg/ObjectHypothesisWithPose": (
            "int64 id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose\n"
        ),
        "vision_msgs/msg/Detection3D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
        ),
    },
    2: {
        "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score\n",
        "vision_msgs/msg/ObjectHypothesisWithPose": (
            "vision_msgs/ObjectHypothesis hypothesis\ngeometry_msgs/PoseWithCovariance pose\n"
        ),
        "vision_msgs/msg/Detection3D": (
            "std_msgs/Header header\nvision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
            "string id\n"
        ),
    },
}


class Views(NamedTuple):
    """What a robot sees at one time: numbers (n,) of landmarks, and points (n, 3) [m] in the robot's frame."""

    time: float
    ids: Any
    points: Any


def path_of(times: Any, robot: int = 0) -> Any:
    """Return the true poses (T, 3) of a robot on its circle at times (T,) [s] since the start."""
    return compose(STARTS[robot], integrate_commands([[0.0, SPEED, TURN]], times, hold=1e6))


def views_of(robot: int = 0, seconds: float = 30.0, every: float = 0.25, noise: float = 0.0) -> list[Views]:
    """Return what a robot sees ahead of it, over time."""
    rng, views = np.random.default_rng(7 + robot), []
    for time in np.arange(0.0, seconds, every):
        back = inverse(path_of(np.array([time]), robot)[0])
        points = np.column_stack([transform_points(back, LANDMARKS[:, :2]), LANDMARKS[:, 2]])
        ids = np.flatnonzero((points[:, 0] > 0.2) & (np.abs(points[:, 1]) < points[:, 0]))
        views.append(Views(float(time), ids, points[ids] + noise * rng.normal(size=(len(ids), 3))))
    return views


class Writer:
    """A bag being written; `types` makes messages."""

    def __init__(self, writer: Any, store: Any, is_ros1: bool) -> None:
        self._writer, self.store, self.is_ros1, self._topics = writer, store, is_ros1, {}

    def make(self, kind: str, *values: Any, **named: Any) -> Any:
        """Return a message of a type such as `geometry_msgs/Pose`."""
        return self.store.types[kind.replace("/", "/msg/")](*values, **named)

    def header(self, time: float, frame: str) -> Any:
        """Return a header; a negative time has the stamp zero."""
        nanoseconds = 0 if time < 0.0 else EPOCH * 10**9 + round(time * 1e9)
        stamp = self.make("builtin_interfaces/Time", nanoseconds // 10**9, nanoseconds % 10**9)
        return self.make("std_msgs/Header", *([0] if self.is_ros1 else []), stamp, frame)

    def pose(self, position: Sequence[float], quaternion: Sequence[float] = (0.0, 0.0, 0.0, 1.0)) -> Any:
        """Return a `geometry_msgs/Pose`."""
        return self.make(
            "geometry_msgs/Pose",
            self.make("geometry_msgs/Point", *map(float, position)),
            self.make("geometry_msgs/Quaternion", *map(float, quaternion)),
        )

    def with_covariance(self, pose: Any, covariance: Any = None) -> Any:
        """Return a `geometry_msgs/PoseWithCovariance`."""
        values = np.zeros(36) if covariance is None else np.asarray(covariance, np.float64)
        return self.make("geometry_msgs/PoseWithCovariance", pose, values)

    def transform(self, header: Any, child: str, position: Any, quaternion: Any = (0.0, 0.0, 0.0, 1.0)) -> Any:
        """Return a `geometry_msgs/TransformStamped`."""
        moved = self.make(
            "geometry_msgs/Transform",
            self.make("geometry_msgs/Vector3", *map(float, position)),
            self.make("geometry_msgs/Quaternion", *map(float, quaternion)),
        )
        return self.make("geometry_msgs/TransformStamped", header, child, moved)

    def write(self, topic: str, time: float, message: Any, arrival: float = ARRIVAL) -> None:
        """Write a message, which arrives later than its time."""
        kind = message.__msgtype__
        if topic not in self._topics:
            self._topics[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        data = (self.store.serialize_ros1 if self.is_ros1 else self.store.serialize_cdr)(message, kind)
        self._writer.write(self._topics[topic], round((EPOCH + arrival + time) * 1e9), data)

    def empty_topic(self, topic: str, kind: str) -> None:
        """Add a topic without messages."""
        self._topics[topic] = self._writer.add_connection(topic, kind.replace("/", "/msg/"), typestore=self.store)


@contextmanager
def written(path: Path) -> Iterator[Writer]:
    """Write a bag: `.bag` of ROS 1, `.mcap`, or a folder with a database of ROS 2."""
    from rosbags import rosbag1, rosbag2
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    is_ros1 = path.suffix == ".bag"
    store = get_typestore(Stores.ROS1_NOETIC if is_ros1 else Stores.LATEST)
    for kind, text in {
        **EXTRA, **VISION[1 if is_ros1 else 2],
        "vision_msgs/msg/Detection3DArray": "std_msgs/Header header\nvision_msgs/Detection3D[] detections\n",
    }.items():  # fmt: skip
        if kind not in store.fielddefs:
            store.register(get_types_from_msg(text, kind))
    if is_ros1:
        with rosbag1.Writer(path) as writer:
            yield Writer(writer, store, True)
        return
    plugin = rosbag2.StoragePlugin.MCAP if path.suffix == ".mcap" else rosbag2.StoragePlugin.SQLITE3
    folder = path.with_name(f"{path.stem}_parts") if path.suffix == ".mcap" else path
    with rosbag2.Writer(folder, version=9, storage_plugin=plugin) as writer:
        yield Writer(writer, store, False)
    if path.suffix == ".mcap":
        next(folder.glob("*.mcap")).rename(path)
        (folder / "metadata.yaml").unlink()
        folder.rmdir()


def yaw(angle: float) -> tuple[float, float, float, float]:
    """Return the quaternion x, y, z, w of a heading."""
    return 0.0, 0.0, float(np.sin(0.5 * angle)), float(np.cos(0.5 * angle))


def odometry(bag: Writer, time: float, pose: Any, child: str = "base_link", tilt: Any = None) -> Any:
    """Return a `nav_msgs/Odometry` with a planar pose, or with another quaternion."""
    zero = bag.make("geometry_msgs/Vector3", 0.0, 0.0, 0.0)
    twist = bag.make("geometry_msgs/TwistWithCovariance", bag.make("geometry_msgs/Twist", zero, zero), np.zeros(36))
    planar = bag.pose((*pose[:2], 0.0), yaw(pose[2]) if tilt is None else tilt)
    return bag.make("nav_msgs/Odometry", bag.header(time, "odom"), child, bag.with_covariance(planar), twist)


def write_odometry(
    bag: Writer, topic: str = "/odom", robot: int = 0, seconds: float = 30.0, scale: float = 1.0,
    child: str = "base_link",
) -> None:  # fmt: skip
    """Write odometry at 20 Hz in its own frame, whose turn rate is wrong by a factor."""
    times = np.arange(0.0, seconds, 0.05)
    poses = integrate_commands([[0.0, SPEED, TURN * scale]], times, hold=1e6)
    for time, pose in zip(times, poses, strict=True):
        bag.write(topic, time, odometry(bag, float(time), pose, child))


def write_static(
    bag: Writer, child: str = "optical", parent: str = "base_link", at: Any = OPTICAL, topic: str = "/tf_static"
) -> None:
    """Write the place of a sensor."""
    message = bag.make("tf2_msgs/TFMessage", [bag.transform(bag.header(0.0, parent), child, *at)])
    bag.write(topic, 0.0, message)


def to_optical(points: Any) -> Any:
    """Return points (n, 3) of the robot's frame in that of the camera `OPTICAL`."""
    return (points - np.array(OPTICAL[0])) @ ROBOT_FROM_OPTICAL


def _array(bag: Writer, view: Views, frame: str, kind: str, entry: Callable[..., Any], *between: Any) -> Any:
    """Return a message of a header, other fields, and an entry for each landmark: `entry(header, id, point)`."""
    header = bag.header(view.time, frame)
    found = [entry(header, int(number), point) for number, point in zip(view.ids, view.points, strict=True)]
    return bag.make(kind, header, *between, found)


def tags(bag: Writer, view: Views, frame: str = "base_link", covariance: Any = None) -> Any:
    """Return an `apriltag_ros/AprilTagDetectionArray`."""

    def entry(header: Any, number: int, point: Any) -> Any:
        pose = bag.with_covariance(bag.pose(point), covariance)
        posed = bag.make("geometry_msgs/PoseWithCovarianceStamped", header, pose)
        return bag.make("apriltag_ros/AprilTagDetection", np.array([number], np.int32), np.array([0.1]), posed)

    return _array(bag, view, frame, "apriltag_ros/AprilTagDetectionArray", entry)


def alvar(bag: Writer, view: Views, frame: str = "base_link") -> Any:
    """Return an `ar_track_alvar_msgs/AlvarMarkers`."""

    def entry(header: Any, number: int, point: Any) -> Any:
        posed = bag.make("geometry_msgs/PoseStamped", header, bag.pose(point))
        return bag.make("ar_track_alvar_msgs/AlvarMarker", header, number, 1, posed)

    return _array(bag, view, frame, "ar_track_alvar_msgs/AlvarMarkers", entry)


def fiducials(bag: Writer, view: Views, frame: str = "base_link") -> Any:
    """Return a `fiducial_msgs/FiducialTransformArray`."""

    def entry(header: Any, number: int, point: Any) -> Any:
        moved = bag.transform(header, "", point).transform
        return bag.make("fiducial_msgs/FiducialTransform", number, moved, 0.0, 0.0, 0.0)

    return _array(bag, view, frame, "fiducial_msgs/FiducialTransformArray", entry, 0)


def detections(bag: Writer, view: Views, frame: str = "base_link", in_box: bool = False) -> Any:
    """Return a `vision_msgs/Detection3DArray` of ROS 1 or ROS 2; positions are in the boxes alone, if asked."""
    header, found = bag.header(view.time, frame), []
    for number, point in zip(view.ids, view.points, strict=True):
        pose = bag.with_covariance(bag.pose((0.0, 0.0, 0.0) if in_box else point))
        if bag.is_ros1:
            results = [bag.make("vision_msgs/ObjectHypothesisWithPose", int(number), 0.9, pose)]
        else:
            best = bag.make("vision_msgs/ObjectHypothesis", str(number), 0.9)
            results = [bag.make("vision_msgs/ObjectHypothesisWithPose", best, pose)]
        box = bag.make("vision_msgs/BoundingBox3D", bag.pose(point), bag.make("geometry_msgs/Vector3", 1.0, 1.0, 1.0))
        found.append(bag.make("vision_msgs/Detection3D", header, results, box, *([] if bag.is_ros1 else [""])))
    return bag.make("vision_msgs/Detection3DArray", header, found)


def markers(bag: Writer, view: Views, frame: str = "base_link") -> Any:
    """Return a `visualization_msgs/MarkerArray`, whose first entry deletes all."""

    def marker(number: int, point: Any, action: int) -> Any:
        vector = bag.make("geometry_msgs/Vector3", 0.1, 0.1, 0.1)
        colour = bag.make("std_msgs/ColorRGBA", 1.0, 0.0, 0.0, 1.0)
        known: dict[str, Any] = {
            "header": bag.header(view.time, frame), "ns": "", "id": number, "type": 2, "action": action,
            "pose": bag.pose(point), "scale": vector, "color": colour, "points": [], "colors": [],
            "lifetime": bag.make("builtin_interfaces/Duration", 0, 0), "frame_locked": False, "text": "",
            "mesh_resource": "", "mesh_use_embedded_materials": False,
        }  # fmt: skip
        if not bag.is_ros1:
            image = bag.make("sensor_msgs/CompressedImage", bag.header(-1.0, ""), "", np.zeros(0, np.uint8))
            mesh = bag.make("visualization_msgs/MeshFile", "", np.zeros(0, np.uint8))
            known |= {"texture_resource": "", "texture": image, "uv_coordinates": [], "mesh_file": mesh}
        return bag.make("visualization_msgs/Marker", **known)

    found = [marker(int(n), point, 0) for n, point in zip(view.ids, view.points, strict=True)]
    return bag.make("visualization_msgs/MarkerArray", [marker(0, (0.0, 0.0, 0.0), 3), *found])


def frames(bag: Writer, view: Views, frame: str = "base_link") -> Any:
    """Return a `tf2_msgs/TFMessage` of tags, beside a frame that is none."""
    header = bag.header(view.time, frame)
    found = [bag.transform(header, f"tag36h11:{n}", p) for n, p in zip(view.ids, view.points, strict=True)]
    return bag.make("tf2_msgs/TFMessage", [bag.transform(header, "gripper", (9.0, 9.0, 9.0)), *found])


def cloud(
    bag: Writer, view: Views, frame: str = "base_link", extra: dict[str, Any] | None = None, number: int = 1
) -> Any:
    """Return a `sensor_msgs/PointCloud2` with x, y, z and further fields of float32 (n,) or (n, count), or int32."""
    columns: dict[str, Any] = {name: view.points[:, at] for at, name in enumerate("xyz")} | (extra or {})
    fields, parts, offset = [], [], 0
    for name, values in columns.items():
        whole = np.asarray(values).dtype.kind in "iu"
        part = np.ascontiguousarray(np.asarray(values, np.int32 if whole else np.float32).reshape(len(view.ids), -1))
        fields.append(bag.make("sensor_msgs/PointField", name, offset, 5 if whole else 7, part.shape[1]))
        parts.append(part.view(np.uint8).reshape(len(view.ids), part.shape[1] * 4))
        offset += part.shape[1] * 4
    data = np.concatenate(parts, axis=1).ravel() if len(view.ids) else np.zeros(0, np.uint8)
    return bag.make(
        "sensor_msgs/PointCloud2", bag.header(view.time, frame), 1, len(view.ids), fields, False, offset,
        offset * len(view.ids), data, True,
    )  # fmt: skip


def camera_info(bag: Writer, focal: float = 400.0, frame: str = "optical", baseline: float = 0.2) -> Any:
    """Return a `sensor_msgs/CameraInfo` of a right camera, whose centre is not in the middle."""
    k = np.array([focal, 0.0, 300.0, 0.0, focal, 250.0, 0.0, 0.0, 1.0])
    p = np.array([focal, 0.0, 300.0, -baseline * focal, 0.0, focal, 250.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    region = bag.make("sensor_msgs/RegionOfInterest", 0, 0, 0, 0, False)
    header, turned = bag.header(0.0, frame), np.eye(3).ravel()
    return bag.make("sensor_msgs/CameraInfo", header, 480, 640, "plumb_bob", np.zeros(5), k, turned, p, 0, 0, region)


def write_circle(
    path: Path, look: Callable[..., Any] = tags, seconds: float = 30.0, noise: float = 0.0, scale: float = 1.0,
    views: Iterable[Views] | None = None, truth: bool = True,
) -> Path:  # fmt: skip
    """Write a bag of one robot: `/odom`, `/tags` by a function of bag and view, and `/gt`."""
    with written(path) as bag:
        write_odometry(bag, seconds=seconds, scale=scale)
        for view in views_of(seconds=seconds, noise=noise) if views is None else views:
            bag.write("/tags", view.time, look(bag, view))
        if truth:
            for time in np.arange(0.0, seconds, 0.1):
                x, y, heading = path_of(np.array([time]))[0]
                pose = bag.pose((x, y, 0.0), yaw(heading))
                bag.write("/gt", time, bag.make("geometry_msgs/PoseStamped", bag.header(float(time), "world"), pose))
    return path
