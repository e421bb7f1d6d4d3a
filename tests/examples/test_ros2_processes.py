"""Nodes of `examples/ros2` as processes on rclpy and DDS: skipped where there is no rclpy.

Other machines hear nothing if the tests run in a network namespace whose only interface is lo.
"""

import os
import signal
import subprocess
import sys
import time
from array import array
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.environments import small_env
from builders.teams import SimulatedTeam

from slam_backend import LandmarkMap
from slam_backend.core.validation import FloatArray
from slam_backend.geometry import compose, inverse
from vslam_env.navigation import CELL, centre_of

rclpy = pytest.importorskip("rclpy")
from geometry_msgs.msg import Point, PoseStamped, Quaternion  # noqa: E402
from nav_msgs.msg import OccupancyGrid, Odometry  # noqa: E402
from rclpy.qos import DurabilityPolicy, QoSProfile  # noqa: E402
from sensor_msgs.msg import PointCloud2, PointField  # noqa: E402
from std_msgs.msg import Header, UInt8MultiArray  # noqa: E402
from std_srvs.srv import Trigger  # noqa: E402
from visualization_msgs.msg import MarkerArray  # noqa: E402

pytestmark = pytest.mark.slow
NODES = Path(__file__).parents[2] / "examples" / "ros2"
TICK = 0.1  # time between two steps [s]
BEGIN = 100.0  # stamp of the first step [s]


class Bench:
    """A node of the test, and processes of nodes.

    Attributes:
        heard: Messages by topic.
    """

    def __init__(self, folder: Path) -> None:
        self.node, self.folder = rclpy.create_node("bench"), folder
        self.heard: dict[str, list[Any]] = {}
        self.running: dict[str, subprocess.Popen[str]] = {}
        self._publishers: dict[str, Any] = {}

    def start(self, name: str, script: str, /, *arguments: str, **parameters: Any) -> None:
        """Start a node with arguments and parameters of the command line."""
        for key, value in parameters.items():
            arguments += "-p", f"{key}:={value}"
        with (self.folder / f"{name}.log").open("a") as log:
            self.running[name] = subprocess.Popen(
                [sys.executable, str(NODES / script), "--ros-args", *arguments], stdout=log, stderr=log, text=True
            )

    def log(self, name: str) -> str:
        """Return what a node has said."""
        return (self.folder / f"{name}.log").read_text()

    def end(self, name: str, number: int = signal.SIGINT) -> int:
        """Send a signal to a node, and return its status."""
        self.running[name].send_signal(number)
        return self.running[name].wait(60)

    def publish(self, topic: str, message: Any) -> None:
        """Publish a message; maps are latched."""
        if topic not in self._publishers:
            profile = QoSProfile(depth=50)
            if isinstance(message, OccupancyGrid):
                profile = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
            self._publishers[topic] = self.node.create_publisher(type(message), topic, profile)
        self._publishers[topic].publish(message)

    def listen(self, kind: Any, topic: str) -> None:
        """Keep the messages of a topic."""
        self.heard[topic] = []
        self.node.create_subscription(kind, topic, self.heard[topic].append, 50)

    def spin(self, seconds: float) -> None:
        """Hear for a while."""
        end = time.monotonic() + seconds
        while (rest := end - time.monotonic()) > 0.0:
            rclpy.spin_once(self.node, timeout_sec=rest)

    def wait(self, is_there: Callable[[], Any], what: str) -> None:
        """Hear until something holds."""
        end = time.monotonic() + 90.0
        while not is_there():
            assert time.monotonic() < end, what
            self.spin(0.1)

    def wait_for_readers(self, *topics: str, count: int = 1) -> None:
        """Wait until nodes have subscribed to topics."""
        for topic in topics:
            self.wait(lambda topic=topic: self.node.count_subscribers(topic) >= count, f"no reader of {topic}")


@pytest.fixture
def bench(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    """A node, and processes that are killed afterwards; all on this machine alone."""
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "logs"))
    root = str(Path(__file__).parents[2])
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])]))
    rclpy.init()
    made = Bench(tmp_path)
    yield made
    for process in made.running.values():
        process.kill()
        process.wait()
    made.node.destroy_node()
    rclpy.try_shutdown()


def odometry_at(when: float, pose: FloatArray) -> Any:
    """Return an odometry message of a pose (3,)."""
    found = Odometry(header=header_at(when, "odom"))
    found.pose.pose.position = Point(x=float(pose[0]), y=float(pose[1]))
    found.pose.pose.orientation = Quaternion(z=float(np.sin(0.5 * pose[2])), w=float(np.cos(0.5 * pose[2])))
    return found


def header_at(when: float, frame: str) -> Any:
    """Return a header."""
    header = Header(frame_id=frame)
    header.stamp.sec, header.stamp.nanosec = int(when), round(1e9 * (when % 1.0))
    return header


def cloud_at(when: float, frame: Any) -> Any:
    """Return a message of landmarks with descriptors, in the optical frame."""
    size, found = frame.descriptors.shape[1], PointCloud2(header=header_at(when, "camera_optical_frame"))
    for name, offset, count in (("x", 0, 1), ("y", 4, 1), ("z", 8, 1), ("descriptor", 12, size)):
        found.fields.append(PointField(name=name, offset=offset, datatype=PointField.FLOAT32, count=count))
    found.height, found.width, found.point_step = 1, len(frame.points), 12 + 4 * size
    found.row_step = found.width * found.point_step
    found.data = array("B", np.hstack([frame.points, frame.descriptors]).astype("<f4").tobytes())
    return found


def drive(bench: Bench, simulation: SimulatedTeam, poses: list[FloatArray], steps: range) -> list[FloatArray]:
    """Drive two robots, publish what they read, and return their true poses at each step."""
    path = []
    for step in steps:
        when = BEGIN + TICK * step
        for k, (name, odometry, frame) in enumerate(zip(("ada", "bo"), *simulation.read(), strict=True)):
            poses[k] = poses[k] if odometry is None else compose(poses[k], odometry)
            bench.publish(f"/{name}/landmark_points", cloud_at(when, frame))
            bench.publish(f"/{name}/odom", odometry_at(when, poses[k]))
        path.append(simulation.poses.copy())
        bench.spin(TICK)
    return path


def test_two_robots_find_each_other_and_one_comes_back_after_kill_9(bench: Bench) -> None:
    """Two nodes on one topic become a group with one map; a killed one resumes from its file, and both still agree."""
    simulation, poses = SimulatedTeam(2, seed=5), [np.array([1.0, 2.0, 0.5]), np.zeros(3)]

    def start(name: str) -> None:
        given = {"name": name, "state": bench.folder / f"{name}.state", "particles": 50, "sigma": 0.0,
                 "share_every": 10, "attempt_every": 5, "save_every": 1.0}  # fmt: skip
        bench.start(name, "team_node.py", "-r", f"__ns:=/{name}", **given)
        bench.wait_for_readers(f"/{name}/odom", f"/{name}/landmark_points")

    for name in ("ada", "bo"):
        bench.listen(PointCloud2, f"/{name}/group_map")
        bench.listen(MarkerArray, f"/{name}/group_poses")
        start(name)
    drive(bench, simulation, poses, range(80))
    bench.spin(3.0)  # bo reads what is on the way, and saves
    assert bench.end("bo", signal.SIGKILL) == -signal.SIGKILL
    drive(bench, simulation, poses, range(80, 90))  # while bo's process is dead
    start("bo")
    bench.wait(lambda: "back from" in bench.log("bo"), "bo does not come back")
    path = drive(bench, simulation, poses, range(90, 160))
    bench.publish("/vslam/maps", UInt8MultiArray(data=array("B", b"nonsense")))
    bench.spin(5.0)  # longer than the period of maps
    places = {}
    for k, name in enumerate(("ada", "bo")):
        shown = {each.ns: each.pose.position for each in bench.heard[f"/{name}/group_poses"][-1].markers[1:]}
        assert set(shown) == {"ada", "bo"}, bench.log(name)
        for j, other in enumerate(("ada", "bo")):
            late = 10 if j == k else 30  # steps: the others' poses are those of their last map
            true = np.array([compose(inverse(simulation.starts[k]), at[j]) for at in path[-late:]])
            assert np.hypot(shown[other].x - true[:, 0], shown[other].y - true[:, 1]).min() < 0.6
        cloud = bench.heard[f"/{name}/group_map"][-1]
        assert cloud.header.frame_id == f"{name}/start"
        rows = np.frombuffer(bytes(cloud.data), "<f4").reshape(cloud.width, -1)
        places[name] = compose(simulation.starts[k], np.pad(rows[:, :2].astype(np.float64), ((0, 0), (0, 1))))[:, :2]
    gaps = np.linalg.norm(places["ada"][:, None] - places["bo"][None], axis=-1).min(axis=1)
    assert np.median(gaps) < 0.25
    assert "message refused: expected a message of a robot, got other bytes" in bench.log("ada")
    assert "must stand where it was saved" not in bench.log("bo")
    for name in ("ada", "bo"):
        assert bench.end(name) == 0
        assert "Traceback" not in bench.log(name)


def test_a_robot_gets_a_goal_on_the_free_floor_of_a_latched_map(bench: Bench) -> None:
    """The node hears a map published before it started, and publishes candidates and a goal in the frame of the map."""
    env, ticks = small_env(num_robots=1, action_type="continuous"), list[Any]()
    env.recorder = lambda readings: ticks.append(readings[0])
    env.reset(seed=3)
    for k in range(30):
        env.step({"robot_0": np.array([0.5, 0.6 if k < 20 else -0.4], np.float32)})
    grid, pose = env.belief("robot_0").materialise().grid, np.zeros(3)
    top, left, bottom, right = grid.bounds.tolist()
    cells = np.choose(grid.cells[top:bottom, left:right], [-1, 0, 100])
    latched = OccupancyGrid(header=header_at(BEGIN, "map"))
    latched.info.resolution, (latched.info.height, latched.info.width) = CELL, cells.shape
    corner = centre_of([top, left], len(grid.cells)) - 0.5 * CELL
    latched.info.origin.position = Point(x=float(corner[0]), y=float(corner[1]))
    latched.data = array("b", cells.ravel().tolist())
    bench.publish("/map", latched)
    bench.listen(PoseStamped, "/goal_pose")
    bench.listen(MarkerArray, "/candidates")
    bench.start("explore", "explore_node.py", policy="next_best_view", particles=10, sigma=0.0, period=0.5)
    bench.wait_for_readers("/odom", "/landmark_points", "/map")
    for k, readings in enumerate(ticks):
        pose = pose if readings.odometry is None else compose(pose, readings.odometry)
        bench.publish("/landmark_points", cloud_at(BEGIN + TICK * k, readings.measurements))
        bench.publish("/odom", odometry_at(BEGIN + TICK * k, pose))
        bench.spin(TICK)
    bench.wait(lambda: bench.heard["/goal_pose"], f"no goal: {bench.log('explore')}")
    goal = bench.heard["/goal_pose"][-1]
    assert goal.header.frame_id == "map"
    row, column = ((np.array([goal.pose.position.y, goal.pose.position.x]) - corner[::-1]) // CELL).astype(int)
    assert cells[row, column] == 0
    assert "frontier" in {marker.ns for marker in bench.heard["/candidates"][-1].markers}
    assert bench.end("explore") == 0
    assert "Traceback" not in bench.log("explore")


def test_the_merge_service_answers_over_dds(bench: Bench) -> None:
    """The service merges two maps from files, and gives the reason where it does not."""
    rng = np.random.default_rng(0)
    means, looks = rng.uniform(-5.0, 5.0, (40, 3)), rng.normal(size=(40, 16))
    first = LandmarkMap(
        means, np.tile(1e-4 * np.eye(3), (40, 1, 1)), looks / np.linalg.norm(looks, axis=1, keepdims=True)
    )
    files = {name: str(bench.folder / f"{name}.npz") for name in ("first", "moved", "out")}
    first.save(files["first"])
    first.moved(inverse([2.0, -1.0, 0.3])).save(files["moved"])
    bench.start("merge", "merge_node.py", map_a=files["first"], map_b=files["moved"], out=files["out"])
    client = bench.node.create_client(Trigger, "merge_maps")
    bench.wait(client.service_is_ready, "no service")
    answers = []
    for _ in range(2):
        future = client.call_async(Trigger.Request())
        rclpy.spin_until_future_complete(bench.node, future, timeout_sec=60.0)
        answers.append(future.result())
        Path(files["moved"]).unlink(missing_ok=True)
    assert [answer.success for answer in answers] == [True, False]
    assert "x 2.000 +- 0.0" in answers[0].message
    assert answers[1].message.startswith("path: expected ")
    assert len(LandmarkMap.load(files["out"])) == 40


@pytest.mark.parametrize(
    ("script", "parameter", "words"),
    [
        ("explore_node.py", "period:=2", "error Trying to set parameter 'period' to '2'"),
        ("explore_node.py", "policy:=frontie", "error policy: expected one of "),
        ("team_node.py", "name:=''", "error name: expected a name of 1 to 64 bytes"),
    ],
)
def test_parameters_that_do_not_fit_end_a_process_with_one_line(
    bench: Bench, script: str, parameter: str, words: str
) -> None:
    """A wrong type or value is one line on the screen, and status 1."""
    bench.start("node", script, "-p", parameter)
    assert bench.running["node"].wait(60) == 1
    assert bench.log("node").startswith(words)
    assert bench.log("node").count("\n") == 1
