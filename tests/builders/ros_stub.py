"""The few calls of rclpy, and the few messages, that `examples/ros2` uses: everything in one process, by hand.

Messages have exactly the fields of their ROS types that nodes use, and refuse others.
"""

import importlib
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

EXAMPLES = Path(__file__).parents[2] / "examples" / "ros2"
SCRIPTS = ("conversions", "explore_node", "team_node", "merge_node")


def _message(**fields: Callable[[], Any]) -> type:
    """Return the class of a message with defaults of fields."""

    class Message:
        __slots__ = tuple(fields)

        def __init__(self, **given: Any) -> None:
            for name, make in fields.items():
                setattr(self, name, given.pop(name) if name in given else make())
            assert not given, f"no such fields: {given}"

    return Message


Stamp = _message(sec=int, nanosec=int)
Header = _message(stamp=Stamp, frame_id=str)
Point = _message(x=float, y=float, z=float)
Quaternion = _message(x=float, y=float, z=float, w=lambda: 1.0)
Pose = _message(position=Point, orientation=Quaternion)
PoseStamped = _message(header=Header, pose=Pose)
Odometry = _message(header=Header, child_frame_id=str, pose=_message(pose=Pose))
MapInfo = _message(resolution=float, width=int, height=int, origin=Pose)
OccupancyGrid = _message(header=Header, info=MapInfo, data=list)
PointField = _message(name=str, offset=int, datatype=int, count=int)
PointCloud2 = _message(
    header=Header, height=int, width=int, fields=list, is_bigendian=bool, point_step=int, row_step=int, data=bytes,
    is_dense=bool,
)  # fmt: skip
Marker = _message(
    header=Header, ns=str, id=int, type=int, action=int, pose=Pose, scale=Point,
    color=_message(r=float, g=float, b=float, a=float),
)  # fmt: skip
MarkerArray = _message(markers=list)
UInt8MultiArray = _message(data=list)
Trigger = SimpleNamespace(Request=_message(), Response=_message(success=bool, message=str))
TransformStamped = _message(transform=_message(translation=Point, rotation=Quaternion))


class ParameterException(Exception):
    """Parameter of another type than its default."""


class TransformException(Exception):
    """Missing transform."""


class Ros:
    """All nodes and topics of a test.

    Attributes:
        parameters: Values that the next nodes get, as from the command line.
        now: Time [s].
        transform: Answer of TF; None: there is none.
        published: Messages by topic.
        callbacks: Subscribers by topic.
    """

    def __init__(self) -> None:
        self.parameters: dict[str, Any] = {}
        self.now = 0.0
        self.transform: Any = None
        self.published: dict[str, list[Any]] = {}
        self.callbacks: dict[str, list[Callable[[Any], None]]] = {}

    def publish(self, topic: str, message: Any) -> None:
        """Deliver a message at once."""
        self.published.setdefault(topic, []).append(message)
        for callback in self.callbacks.get(topic, []):
            callback(message)

    def last(self, topic: str) -> Any:
        """Return the last message of a topic."""
        return self.published[topic][-1]


def _node_class(world: Ros) -> type:
    class Node:
        def __init__(self, name: str) -> None:
            given = dict(world.parameters)
            self.space = given.pop("ns", "")  # topics with a leading slash are shared by all
            self.values: dict[str, Any] = {}
            self.given, self.lines, self.timers, self.services = given, [], [], {}

        def declare_parameter(self, name: str, default: Any) -> Any:
            value = self.given.get(name, default)
            if type(value) is not type(default):
                raise ParameterException(f"Trying to set parameter {name!r} to {value!r}, expecting another type")
            self.values[name] = value
            return SimpleNamespace(value=value)

        def get_parameter(self, name: str) -> Any:
            return SimpleNamespace(value=self.values[name])

        def topic(self, name: str) -> str:
            return name if name.startswith("/") else f"{self.space}/{name}"

        def create_subscription(self, kind: Any, topic: str, callback: Any, profile: Any) -> None:
            world.callbacks.setdefault(self.topic(topic), []).append(callback)

        def create_publisher(self, kind: Any, topic: str, profile: Any) -> Any:
            def publish(message: Any) -> None:
                assert isinstance(message, kind)
                world.publish(self.topic(topic), message)

            return SimpleNamespace(publish=publish)

        def create_timer(self, period: float, callback: Any) -> None:
            self.timers.append(callback)

        def create_service(self, kind: Any, name: str, callback: Any) -> None:
            self.services[name] = callback

        def get_logger(self) -> Any:
            return SimpleNamespace(info=self.lines.append, warning=self.lines.append)

        def get_clock(self) -> Any:
            time = SimpleNamespace(nanoseconds=int(1e9 * world.now), to_msg=lambda: stamp_of(world.now))
            return SimpleNamespace(now=lambda: time)

        def destroy_node(self) -> None:
            pass

    return Node


def stamp_of(time: float) -> Any:
    """Return a time [s] as a stamp."""
    return Stamp(sec=int(time), nanosec=round(1e9 * (time % 1.0)))


@contextmanager
def ros_stub() -> Iterator[tuple[Ros, SimpleNamespace]]:
    """Provide the modules that nodes import, and the nodes: the world of a test, and the scripts of the examples."""
    world = Ros()

    def lookup(self: Any, target: str, source: str, time: Any) -> Any:
        if world.transform is None:
            raise TransformException(f"{source} is not connected to {target}")
        return world.transform

    def profile(**options: Any) -> Any:
        return options

    def stopped(node: Any) -> None:
        raise KeyboardInterrupt

    modules = {
        "rclpy": {"init": lambda: None, "spin": stopped, "try_shutdown": lambda: None},
        "rclpy.exceptions": {"ParameterException": ParameterException},
        "rclpy.executors": {"ExternalShutdownException": type("ExternalShutdownException", (Exception,), {})},
        "rclpy.node": {"Node": _node_class(world)},
        "rclpy.qos": {
            "QoSProfile": profile, "DurabilityPolicy": SimpleNamespace(TRANSIENT_LOCAL=1),
            "ReliabilityPolicy": SimpleNamespace(BEST_EFFORT=2),
        },
        "rclpy.time": {"Time": object},
        "tf2_ros": {
            "Buffer": type("Buffer", (), {"lookup_transform": lookup}), "TransformException": TransformException,
            "TransformListener": lambda buffer, node: None,
        },
        "geometry_msgs.msg": {"PoseStamped": PoseStamped},
        "nav_msgs.msg": {"OccupancyGrid": OccupancyGrid, "Odometry": Odometry},
        "sensor_msgs.msg": {"PointCloud2": PointCloud2, "PointField": PointField},
        "std_msgs.msg": {"Header": Header, "UInt8MultiArray": UInt8MultiArray},
        "std_srvs.srv": {"Trigger": Trigger},
        "visualization_msgs.msg": {"Marker": Marker, "MarkerArray": MarkerArray},
    }  # fmt: skip
    names = [*modules, *{name.partition(".")[0] for name in modules} - {"rclpy", "tf2_ros"}, *SCRIPTS]
    real = {name: sys.modules.pop(name) for name in names if name in sys.modules}  # of an installed ROS
    try:
        for name in names:
            if name not in SCRIPTS:
                sys.modules[name] = ModuleType(name)
                vars(sys.modules[name]).update(modules.get(name, {}))
        sys.path.insert(0, str(EXAMPLES))
        yield world, SimpleNamespace(**{name: importlib.import_module(name) for name in SCRIPTS})
    finally:
        sys.path.remove(str(EXAMPLES))
        for name in names:
            sys.modules.pop(name, None)
        sys.modules.update(real)
