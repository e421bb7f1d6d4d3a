"""Recordings for ROS 2, Foxglove and rerun (extra `ros`): an episode as an .mcap file."""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.files import move_file, os_errors_as_argument_errors, resolved
from training.report.recording import Recording, check_export, part_of
from vslam_env.navigation.occupancy_grid import CELL, FREE, OCCUPIED

WIDTH = 0.04  # of walls [m]
WORLD = "world"
LINE_LIST = 5  # type of markers
DEBUG, INFO = 10, 20  # levels of log messages
Array = NDArray[Any]
Message = tuple[float, str, Any]  # time [s], topic, message


def check_mcap(file: Path) -> None:
    """Check that an .mcap file can be written, see `check_export`."""
    check_export(file, "mcap", "rosbags", "rosbags", ".mcap")


def write_mcap(recording: Recording, file: Path) -> Path:
    """Write an episode as an MCAP file of ROS 2 with the definitions of its messages.

    Stamps are seconds of the episode. Frames: `world`; `robot<k>`, the estimated pose; `robot<k>/start`, in which the
    grid lies. Topics: `/tf`, `/tf_static`, `/walls` and `/landmarks` (true ones, once), `/events` (merges and
    attempts), and `/robot<k>/estimate`, `truth`, `map` and `grid`. What robots share is with the first of them; the
    others have an empty map and a grid of one unknown cell.

    Raises:
        ValueError: If rosbags is not installed or the file cannot be written.
    """
    check_mcap(file)
    from rosbags import rosbag2
    from rosbags.interfaces import Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    forever = QosTime(2147483647, 4294967295)
    kept = Qos(  # late subscribers get the last message
        QosHistory.KEEP_LAST, 1, QosReliability.RELIABLE, QosDurability.TRANSIENT_LOCAL, forever, forever,
        QosLiveliness.AUTOMATIC, forever, False,
    )  # fmt: skip
    topics: dict[str, Any] = {}
    with os_errors_as_argument_errors(file, "mcap"), TemporaryDirectory(dir=resolved(file).parent) as folder:
        parts = Path(folder) / "bag"
        writer = rosbag2.Writer(parts, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
        writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
        with writer:
            for time, topic, message in sorted(_messages(recording, store.types), key=lambda each: each[0]):
                kind = message.__msgtype__
                if topic not in topics:
                    profiles = [kept] if topic in ("/tf_static", "/walls", "/landmarks") else []
                    topics[topic] = writer.add_connection(topic, kind, typestore=store, offered_qos_profiles=profiles)
                writer.write(topics[topic], round(time * 1e9), store.serialize_cdr(message, kind))
        move_file(next(parts.glob("*.mcap")), file, "mcap")
    return file


def _messages(recording: Recording, types: Any) -> Iterator[Message]:
    """Yield all messages, by topic."""
    robots = range(recording.estimate.shape[1])
    first = float(recording.times[0])
    starts = [
        _transform(types, first, WORLD, f"robot{robot}/start", start) for robot, start in enumerate(recording.starts)
    ]
    if starts:
        yield first, "/tf_static", types["tf2_msgs/msg/TFMessage"](starts)
    if len(recording.walls):
        yield first, "/walls", types["visualization_msgs/msg/MarkerArray"]([_walls(types, first, recording.walls)])
    if len(recording.landmarks):
        yield first, "/landmarks", _cloud(types, first, recording.landmarks)
    for step, moment in enumerate(recording.times):
        time = float(moment)
        placed = [robot for robot in robots if np.isfinite(recording.estimate[step, robot]).all()]
        moved = [_transform(types, time, WORLD, f"robot{k}", recording.estimate[step, k]) for k in placed]
        yield time, "/tf", types["tf2_msgs/msg/TFMessage"](moved)
        for robot in robots:
            yield from _poses(recording, types, step, time, robot)
    for key, step in enumerate(recording.keyframes.astype(np.int64)):
        for robot in robots:
            yield from _maps(recording, types, key, float(recording.times[step]), robot)
    for event in recording.about["events"]:
        time, level = float(event["time"]), INFO if event["success"] else DEBUG
        yield (
            time,
            "/events",
            types["rcl_interfaces/msg/Log"](
                _stamp(types, time), level, str(event["kind"]), str(event["text"]), "", "", 0
            ),
        )


def _poses(recording: Recording, types: Any, step: int, time: float, robot: int) -> Iterator[Message]:
    """Yield estimate and truth of a robot at a step, if they are known."""
    estimate, truth = recording.estimate[step, robot], recording.truth[step, robot]
    if np.isfinite(estimate).all():
        posed = types["geometry_msgs/msg/PoseStamped"](_header(types, time, WORLD), _pose(types, estimate))
        yield time, f"/robot{robot}/estimate", posed
    if np.isfinite(truth).all():
        zero = types["geometry_msgs/msg/Vector3"](0.0, 0.0, 0.0)
        still = types["geometry_msgs/msg/Twist"](zero, zero)
        yield time, f"/robot{robot}/truth", types["nav_msgs/msg/Odometry"](
            _header(types, time, WORLD), f"robot{robot}/truth",
            types["geometry_msgs/msg/PoseWithCovariance"](_pose(types, truth), np.zeros(36)),
            types["geometry_msgs/msg/TwistWithCovariance"](still, np.zeros(36)),
        )  # fmt: skip


def _maps(recording: Recording, types: Any, key: int, time: float, robot: int) -> Iterator[Message]:
    """Yield map and grid of a robot at a step that has them."""
    if recording.map_ends.size:
        points = recording.map_points[part_of(recording.map_ends, key, robot), :2]
        yield time, f"/robot{robot}/map", _cloud(types, time, points)
    if recording.grid_ends.size:
        x, y, rows, columns = recording.grid_boxes[key, robot]
        runs = part_of(recording.grid_ends, key, robot)
        cells = np.repeat(recording.grid_values[runs], recording.grid_runs[runs].astype(np.int64))
        data = np.full(len(cells), -1, np.int8)
        data[cells == FREE], data[cells == OCCUPIED] = 0, 100
        size = int(columns), int(rows)
        if not len(cells):
            data, size = np.array([-1], np.int8), (1, 1)
        about = types["nav_msgs/msg/MapMetaData"](_stamp(types, time), CELL, *size, _pose(types, np.array([x, y, 0.0])))
        yield (
            time,
            f"/robot{robot}/grid",
            types["nav_msgs/msg/OccupancyGrid"](_header(types, time, f"robot{robot}/start"), about, data),
        )


def _stamp(types: Any, time: float) -> Any:
    nanoseconds = round(time * 1e9)
    return types["builtin_interfaces/msg/Time"](nanoseconds // 10**9, nanoseconds % 10**9)


def _header(types: Any, time: float, frame: str) -> Any:
    return types["std_msgs/msg/Header"](_stamp(types, time), frame)


def _turned(types: Any, heading: float) -> Any:
    """Return the quaternion of a heading [rad]."""
    return types["geometry_msgs/msg/Quaternion"](0.0, 0.0, float(np.sin(0.5 * heading)), float(np.cos(0.5 * heading)))


def _pose(types: Any, pose: Array) -> Any:
    x, y, heading = map(float, pose)
    return types["geometry_msgs/msg/Pose"](types["geometry_msgs/msg/Point"](x, y, 0.0), _turned(types, heading))


def _transform(types: Any, time: float, frame: str, child: str, pose: Array) -> Any:
    x, y, heading = map(float, pose)
    moved = types["geometry_msgs/msg/Transform"](types["geometry_msgs/msg/Vector3"](x, y, 0.0), _turned(types, heading))
    return types["geometry_msgs/msg/TransformStamped"](_header(types, time, frame), child, moved)


def _cloud(types: Any, time: float, points: Array) -> Any:
    """Return a cloud of points (n, 2) [m], world frame."""
    field, count = types["sensor_msgs/msg/PointField"], len(points)
    fields = [field(name, 4 * number, 7, 1) for number, name in enumerate("xyz")]  # float32
    data = np.column_stack([points, np.zeros(count)]).astype("<f4").view(np.uint8).ravel()
    header = _header(types, time, WORLD)
    return types["sensor_msgs/msg/PointCloud2"](header, 1, count, fields, False, 12, 12 * count, data, True)


def _walls(types: Any, time: float, walls: Array) -> Any:
    """Return a marker of lines (s, 4) x1, y1, x2, y2 [m], world frame."""
    nothing = np.zeros(0, np.uint8)
    point = types["geometry_msgs/msg/Point"]
    return types["visualization_msgs/msg/Marker"](
        header=_header(types, time, WORLD), ns="", id=0, type=LINE_LIST, action=0, pose=_pose(types, np.zeros(3)),
        scale=types["geometry_msgs/msg/Vector3"](WIDTH, WIDTH, WIDTH),
        color=types["std_msgs/msg/ColorRGBA"](0.6, 0.6, 0.6, 1.0),
        lifetime=types["builtin_interfaces/msg/Duration"](0, 0), frame_locked=False,
        points=[point(float(x), float(y), 0.0) for x, y in walls.reshape(-1, 2)], colors=[], texture_resource="",
        texture=types["sensor_msgs/msg/CompressedImage"](_header(types, 0.0, ""), "", nothing), uv_coordinates=[],
        text="", mesh_resource="", mesh_file=types["visualization_msgs/msg/MeshFile"]("", nothing),
        mesh_use_embedded_materials=False,
    )  # fmt: skip
