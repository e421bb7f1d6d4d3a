"""Nodes of `examples/ros2` on a stub of rclpy: driven by the readings of simulated robots, and by bad messages."""

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders import ros_stub as msg
from builders.environments import small_env
from builders.full_disk import files_up_to
from builders.refusals import refused
from builders.teams import SimulatedTeam

from slam_backend import LandmarkMap, Measurements
from slam_backend.core.validation import FloatArray
from slam_backend.distributed.messages import messages_of
from slam_backend.geometry import between, compose, inverse
from slam_backend.models.camera import StereoCamera
from vslam_env.navigation import CELL, FREE, OCCUPIED, CandidateKind, cell_of, centre_of

TICK = 0.1


@pytest.fixture
def stub() -> Iterator[tuple[msg.Ros, SimpleNamespace]]:
    """World and scripts of a test."""
    with msg.ros_stub() as made:
        yield made


def odometry_at(time: float, pose: FloatArray, tilt: float = 0.0) -> Any:
    """Return an odometry message of a pose (3,), tilted about its x axis."""
    found = msg.Odometry(header=msg.Header(stamp=msg.stamp_of(time), frame_id="odom"))
    c, s, ct, st = np.cos(0.5 * pose[2]), np.sin(0.5 * pose[2]), np.cos(0.5 * tilt), np.sin(0.5 * tilt)
    found.pose.pose.position = msg.Point(x=float(pose[0]), y=float(pose[1]))
    found.pose.pose.orientation = msg.Quaternion(x=c * st, y=s * st, z=s * ct, w=c * ct)
    return found


def cloud_at(conversions: Any, time: float, frame: Measurements, name: str = "camera_optical_frame") -> Any:
    """Return a message of landmarks with descriptors."""
    found = msg.PointCloud2(header=msg.Header(stamp=msg.stamp_of(time), frame_id=name))
    conversions.write_cloud(frame.points, frame.descriptors, found, msg.PointField)
    return found


def map_of(grid: Any, resolution: float = CELL, frame: str = "map") -> Any:
    """Return the known part of a grid as a message, each cell split into cells of a resolution."""
    top, left, bottom, right = grid.bounds.tolist()
    values = np.choose(grid.cells[top:bottom, left:right], [-1, 0, 100])
    pieces = round(CELL / resolution)
    values = np.kron(values, np.ones((pieces, pieces), int))
    corner = centre_of([top, left], len(grid.cells)) - 0.5 * CELL
    info = msg.MapInfo(resolution=resolution, width=values.shape[1], height=values.shape[0])
    info.origin.position = msg.Point(x=float(corner[0]), y=float(corner[1]))
    return msg.OccupancyGrid(header=msg.Header(frame_id=frame), info=info, data=values.ravel().tolist())


@pytest.fixture(scope="module")
def drive() -> Any:
    """Readings of a robot that has turned and driven in a room for three seconds, and its last belief."""
    env, ticks = small_env(num_robots=1, action_type="continuous"), list[Any]()
    env.recorder = lambda readings: ticks.append(readings[0])
    env.reset(seed=3)
    for k in range(30):
        env.step({"robot_0": np.array([0.5, 0.6 if k < 20 else -0.4], np.float32)})
    return ticks, env.belief("robot_0").materialise()


def play(world: msg.Ros, conversions: Any, ticks: list[Any], space: str = "") -> FloatArray:
    """Publish readings as odometry and landmarks, and return the last pose of the odometry."""
    pose = np.zeros(3)
    for k, readings in enumerate(ticks):
        pose = pose if readings.odometry is None else compose(pose, readings.odometry)
        world.now = 10.0 + TICK * k
        world.publish(f"{space}/landmark_points", cloud_at(conversions, world.now, readings.measurements))
        world.publish(f"{space}/odom", odometry_at(world.now, pose))
    return pose


EXPLORER = {"particles": 10, "sigma": 0.0}


@pytest.mark.parametrize("policy", ["frontier", "next_best_view", "learned"])
def test_goals_are_known_free_places_and_frontiers_those_of_the_belief(stub: Any, drive: Any, policy: str) -> None:
    """A goal is a candidate on a free cell of the map; the published frontiers are those of the belief on that map."""
    (world, scripts), (ticks, belief) = stub, drive
    world.parameters = EXPLORER | {"policy": policy}
    node = scripts.explore_node.ExploreNode()
    world.publish("/map", map_of(belief.grid))
    play(world, scripts.conversions, ticks)
    node.timers[0]()
    assert node.lines == []
    goal = world.last("/goal_pose")
    place = np.array([goal.pose.position.x, goal.pose.position.y])
    assert belief.grid.cells[tuple(cell_of(place, len(belief.grid.cells)))] == FREE
    shown = [(m.ns, m.id, m.pose.position.x, m.pose.position.y) for m in world.last("/candidates").markers[1:]]
    assert place.tolist() in [[x, y] for _, _, x, y in shown]
    candidates = node.team.belief(0).candidates
    slots = candidates.of_kind(CandidateKind.FRONTIER)
    assert [each for each in shown if each[0] == "frontier"] == [
        ("frontier", slot, *candidates.goals[slot].tolist()) for slot in slots.tolist()
    ]
    assert len(slots)
    assert goal.header.frame_id == "map"


def test_the_belief_of_the_node_is_that_of_the_readings(stub: Any, drive: Any) -> None:
    """The grid has the cells of the map but for those under the robot, and the pose is near that of the odometry."""
    (world, scripts), (ticks, belief) = stub, drive
    world.parameters = EXPLORER
    node = scripts.explore_node.ExploreNode()
    world.publish("/map", map_of(belief.grid))
    pose = play(world, scripts.conversions, ticks)
    assert node.team.belief(0).tick == len(ticks) - 1
    differs = node.team.grid(0).cells != belief.grid.cells
    assert np.linalg.norm(centre_of(np.argwhere(differs), len(differs)) - pose[:2], axis=1).max(initial=0.0) < 0.4
    np.testing.assert_allclose(node.team.poses[0], pose, atol=0.1)
    assert len(node.team.group_map(0)) > 3


def test_a_goal_is_published_once_until_it_is_old(stub: Any, drive: Any) -> None:
    """The same goal is published again only after the time of the parameter repeat."""
    (world, scripts), (ticks, belief) = stub, drive
    world.parameters = EXPLORER | {"policy": "frontier"}
    node = scripts.explore_node.ExploreNode()
    world.publish("/map", map_of(belief.grid))
    play(world, scripts.conversions, ticks)
    for later, count in ((0.0, 1), (2.0, 1), (31.0, 2)):
        world.now = 20.0 + later
        node.timers[0]()
        assert len(world.published["/goal_pose"]) == count


def test_goals_follow_the_frame_of_the_map(stub: Any, drive: Any) -> None:
    """If the transform from map to odometry is another one, the map and all goals move by it, and by nothing else."""
    (world, scripts), (ticks, belief) = stub, drive
    places = []
    for turn in (0.0, 0.5 * np.pi):
        moved = np.array([4.0, -2.0, turn])
        rotation = odometry_at(0.0, moved).pose.pose.orientation
        world.transform = msg.TransformStamped()
        world.transform.transform.translation, world.transform.transform.rotation = msg.Point(x=4.0, y=-2.0), rotation
        world.callbacks.clear()
        world.parameters = EXPLORER | {"policy": "frontier", "odom_frame": "odom"}
        node, message = scripts.explore_node.ExploreNode(), map_of(belief.grid)
        corner = compose(moved, [message.info.origin.position.x, message.info.origin.position.y, 0.0])
        message.info.origin = odometry_at(0.0, corner).pose.pose
        world.publish("/map", message)
        play(world, scripts.conversions, ticks)
        node.timers[0]()
        goal = world.last("/goal_pose").pose.position
        places.append(compose(inverse(moved), [goal.x, goal.y, 0.0])[:2])
        assert node.lines == []
    np.testing.assert_allclose(places[0], places[1], atol=1e-6)


def test_maps_of_other_resolutions_show_the_same_floor(stub: Any, drive: Any) -> None:
    """A finer map gives the same grid; a coarser one leaves no holes; walls are kept over floor in a cell of both."""
    (_, scripts), (_, belief) = stub, drive
    read, start = scripts.conversions.grid_of_map, np.zeros(3)
    for resolution in (0.2, 0.1, 0.05):
        np.testing.assert_array_equal(read(map_of(belief.grid, resolution), "map", start).cells, belief.grid.cells)
    info = msg.MapInfo(resolution=0.5, width=4, height=2)
    coarse = msg.OccupancyGrid(header=msg.Header(frame_id="map"), info=info, data=[0, 0, 0, 100, 10, 20, -1, 50])
    cells = read(coarse, "map", start).cells
    origin = cell_of([0.05, 0.05], len(cells))
    floor = cells[origin[0] : origin[0] + 5, origin[1] : origin[1] + 10]
    assert (floor[:, :5] == FREE).all()
    assert (floor[:2, 8:] == OCCUPIED).all()
    assert (floor[3:, 5:] == 0).all()  # unknown, and neither free nor a wall


def test_steps_take_landmarks_at_their_own_time(stub: Any) -> None:
    """Odometry is interpolated to the stamp of late landmarks; without any, steps are wait behind; the sum is exact."""
    steps = stub[1].conversions.Steps(0.5)
    frame, moved = Measurements.empty(4), []
    poses = {k: np.array([0.1 * k, 0.0, 0.02 * k]) for k in range(40)}
    for k, pose in poses.items():
        if k == 6:
            steps.add_frame(0.43, frame)  # 0.17 s late
        moved += list(steps.add_pose(TICK * k, pose))
    frames = [given is not None for _, given in moved]
    assert frames == [True, False, False, False, False, False]
    assert moved[0][0] is None
    begin = compose(poses[4], 0.3 * between(poses[4], poses[5]))
    total = np.zeros(3)
    for motion, _ in moved[1:]:
        total = compose(total, motion)
    np.testing.assert_allclose(compose(begin, total), steps.last[1], atol=1e-12)
    refused(lambda: steps.add_frame(0.5, frame), "landmarks: expected stamps after the last step, got a stamp ")
    refused(lambda: list(steps.add_pose(1.0, poses[0])), "odom: expected stamps that rise, got a stamp ")
    for k in range(64):
        steps.add_frame(100.0 + k, frame)
    refused(lambda: steps.add_frame(200.0, frame), "landmarks: expected odometry of their time, got no such")


def test_markers_and_clouds_are_measurements(stub: Any) -> None:
    """Optical frames are taken as they are, those of the body turned; ids are descriptors, the same on all machines."""
    conversions, camera = stub[1].conversions, StereoCamera(mount=(0.1, 0.0, 0.4))
    points = np.array([[2.0, 0.5, 0.3], [-3.0, 1.0, 0.2]])  # the second is behind
    markers = [
        msg.Marker(header=msg.Header(frame_id="base_link", stamp=msg.stamp_of(2.5)), ns="tag", id=7 + k)
        for k in range(2)
    ]
    for marker, (x, y, z) in zip(markers, points.tolist(), strict=True):
        marker.pose.position = msg.Point(x=x, y=y, z=z)
    stamp, found = conversions.landmarks_of_markers(msg.MarkerArray(markers=markers), camera, 0.1)
    assert stamp == 2.5
    np.testing.assert_allclose(camera.robot_from_camera(found.points), points)
    np.testing.assert_allclose(found.covariances, np.tile(0.01 * np.eye(3), (2, 1, 1)))
    assert found.descriptors[0] @ found.descriptors[1] < 0.5
    np.testing.assert_allclose(found.descriptors[0, :3], [0.1068, -0.1830, -0.0645], atol=1e-4)
    frame = Measurements(points[:, [1, 2, 0]] + [0.0, 0.0, 4.0], found.descriptors[:, :5])
    _, again = conversions.landmarks_of_cloud(cloud_at(conversions, 1.0, frame), camera, 0.0)
    np.testing.assert_allclose(again.points, frame.points, atol=1e-6)
    np.testing.assert_array_equal(again.descriptors, frame.descriptors)
    assert again.covariances is None
    assert conversions.landmarks_of_markers(msg.MarkerArray(), camera, 0.1) is None


def test_bad_messages_are_refused_in_one_line_and_change_nothing(stub: Any, drive: Any) -> None:
    """Tilted, non-finite, stale, ragged or foreign messages are logged once each, and the node goes on as without."""
    (world, scripts), (ticks, belief) = stub, drive
    world.parameters = EXPLORER | {"policy": "frontier"}
    node = scripts.explore_node.ExploreNode()
    node.timers[0]()  # nothing known yet
    good = map_of(belief.grid)
    world.publish("/map", good)
    pose = play(world, scripts.conversions, ticks)
    before = node.team.poses[0], node.team.grid(0).cells.copy()
    cloud = cloud_at(scripts.conversions, 20.0, ticks[0].measurements)
    broken = Measurements(np.ones((1, 3)), np.ones((1, 3)))  # descriptors of another length
    nan = cloud_at(scripts.conversions, 20.0, broken)
    nan.data = np.full(6, np.nan, "<f4").tobytes()
    short, bare = cloud_at(scripts.conversions, 20.0, broken), cloud_at(scripts.conversions, 20.0, broken)
    short.data, bare.fields = short.data[:-1], bare.fields[:3]
    marker = msg.Marker(header=msg.Header(stamp=msg.stamp_of(30.0)))
    marker.pose.position = msg.Point(x=float("nan"))
    ragged, far, coarse, turned = (map_of(belief.grid) for _ in range(4))
    ragged.data, far.header, coarse.info.resolution = ragged.data[1:], msg.Header(frame_id="earth"), 2.0
    turned.info.origin = odometry_at(0.0, pose, tilt=0.5).pose.pose
    nothing = msg.Odometry(header=msg.Header(stamp=msg.stamp_of(50.0)))
    nothing.pose.pose.orientation.w = 0.0
    bad = [
        (
            "/odom",
            odometry_at(20.0, pose, tilt=0.3),
            "odom.pose: expected a tilt of at most 0.2 rad, got a tilt of 0.30",
        ),
        ("/odom", odometry_at(20.0, np.array([np.nan, 0.0, 0.0])), "odom.pose: expected finite numbers, got NaN"),
        (
            "/odom",
            odometry_at(20.0, np.array([1e200, 0.0, 0.0])),
            "odom.pose: expected numbers within +-1e+08, got 1e+200",
        ),
        ("/odom", nothing, "odom.pose: expected a unit quaternion, got a length of 0."),
        ("/odom", odometry_at(1.0, pose), "odom: expected stamps that rise, got a stamp 12.000 s older"),
        ("/landmark_points", nan, "points: expected finite numbers, got NaN"),
        ("/landmark_points", short, "landmark_points.data: expected 1 points without padding, got a message of 23"),
        ("/landmark_points", bare, "landmark_points.fields: expected x, y, z and descriptor, got ['x', 'y', 'z']"),
        ("/landmark_points", cloud_at(scripts.conversions, 2.0, broken), "landmarks: expected stamps after the last"),
        ("/landmarks", msg.MarkerArray(markers=[marker]), "points: expected finite numbers, got NaN"),
        ("/landmarks", msg.MarkerArray(markers=[marker, marker]), "landmarks: expected each landmark once, got"),
        ("/map", ragged, "map.data: expected "),
        ("/map", far, "map: expected the frame 'map', got 'earth'"),
        ("/map", coarse, "map.info.resolution: expected a finite number > 0 and <= 1, got 2.0"),
        ("/map", turned, "map.info.origin: expected a tilt of at most 0.2 rad, got a tilt of 0.50"),
    ]
    for topic, message, text in bad:
        count = len(node.lines)
        for _ in range(2):
            world.publish(topic, message)
        repeated = topic == "/landmarks" and text.startswith("points")
        assert len(node.lines) == count + (not repeated), (text, node.lines[count:])
        assert repeated or node.lines[-1].startswith(text), node.lines[-1]
        assert "\n" not in node.lines[-1]
    np.testing.assert_array_equal(node.team.poses[0], before[0])
    np.testing.assert_array_equal(node.team.grid(0).cells, before[1])
    world.publish("/landmark_points", cloud_at(scripts.conversions, 13.1, broken))
    world.publish("/odom", odometry_at(13.2, compose(pose, [0.3, 0.0, 0.0])))
    assert "descriptors" in node.lines[-1]
    assert node.team.belief(0).tick == len(ticks)  # the motion counts, without these landmarks
    world.publish("/landmark_points", cloud)
    node.timers[0]()
    assert len(world.published["/goal_pose"]) == 1


def test_a_map_without_floor_has_no_goals(stub: Any, drive: Any) -> None:
    """An empty or unknown map, as SLAM nodes publish it at first, is awaited in silence, without a goal."""
    (world, scripts), (ticks, _) = stub, drive
    world.parameters = EXPLORER | {"policy": "frontier"}
    node = scripts.explore_node.ExploreNode()
    play(world, scripts.conversions, ticks[:3])
    for width in (0, 6):
        info = msg.MapInfo(resolution=0.05, width=width, height=width)
        empty = msg.OccupancyGrid(header=msg.Header(frame_id="map"), info=info, data=[-1] * width**2)
        world.publish("/map", empty)
        node.timers[0]()
    assert "/goal_pose" not in world.published
    assert node.lines == []


def test_a_policy_of_ones_own_that_fails_is_a_warning(
    stub: Any, drive: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A policy from a module is found in the current folder; if it raises or chooses no candidate, the node goes on."""
    (world, scripts), (ticks, belief) = stub, drive
    lines = ("class Wrong:", "    def reset(self): pass", "    def act(self, observation, belief, rng):")
    faults = {"raises_here": "raise KeyError('no plan')", "chooses_none": "return 99", "stays": "return 0"}
    monkeypatch.chdir(tmp_path)
    said = []
    for name, fault in faults.items():
        (tmp_path / f"{name}.py").write_text("\n".join([*lines, f"        {fault}"]), encoding="utf-8")
        world.callbacks.clear()
        world.parameters = EXPLORER | {"policy": f"{name}:Wrong"}
        node = scripts.explore_node.ExploreNode()
        world.publish("/map", map_of(belief.grid))
        play(world, scripts.conversions, ticks[:4])
        for _ in range(2):
            node.timers[0]()
        monkeypatch.delitem(sys.modules, name)
        said += node.lines
    assert "/goal_pose" not in world.published
    assert [line.partition(", got")[0] for line in said] == [
        "policy 'raises_here:Wrong': expected it to be imported and made",
        "policy: expected 0 or 1 + the slot of a candidate",
        "nothing left to go to",
    ]
    assert "KeyError: 'no plan' (raises_here.py, line 4)" in said[0]


def test_bad_parameters_end_a_node_with_one_line(stub: Any, tmp_path: Path) -> None:
    """Unknown policies, numbers out of range and damaged files end the program with a line that names the parameter."""
    world, scripts = stub
    damaged = tmp_path / "damaged"
    damaged.write_bytes(b"vslam robot state 1\nnonsense\n")
    for node, given, text in (
        (scripts.explore_node.ExploreNode, {"policy": "frontie"}, "error policy: expected one of "),
        (scripts.explore_node.ExploreNode, {"policy": "no_such_module:Policy"}, "error policy: expected MODULE:NAME"),
        (scripts.explore_node.ExploreNode, {"period": 2}, "error Trying to set parameter 'period' to 2, expecting"),
        (scripts.explore_node.ExploreNode, {"period": 0.0}, "error period: expected a finite number > 0"),
        (scripts.explore_node.ExploreNode, {"wait": -1.0}, "error wait: expected a finite number > 0"),
        (scripts.explore_node.ExploreNode, {"sigma": -1.0}, "error sigma: expected a finite number >= 0"),
        (scripts.team_node.TeamNode, {}, "error name: expected a name of 1 to 64 bytes"),
        (scripts.team_node.TeamNode, {"name": "ada", "state": str(damaged)}, "error .*expected "),
    ):
        world.parameters = given
        with pytest.raises(SystemExit, match=f"^{text}") as caught:
            scripts.conversions.run(node)
        assert "\n" not in str(caught.value)


def test_without_a_transform_the_node_waits_for_it(stub: Any, drive: Any) -> None:
    """A robot whose map is not connected to its odometry says so once, and starts when it is."""
    (world, scripts), (ticks, belief) = stub, drive
    world.parameters = EXPLORER | {"odom_frame": "odom"}
    node = scripts.explore_node.ExploreNode()
    world.publish("/map", map_of(belief.grid))
    play(world, scripts.conversions, ticks[:5])
    node.timers[0]()
    assert [line.partition(",")[0] for line in node.lines] == ["odom_frame: expected its transform to the map"]
    world.transform = msg.TransformStamped()
    for later in (20.0, 20.1):
        world.publish("/odom", odometry_at(later, np.zeros(3)))
    node.timers[0]()
    assert len(world.published["/goal_pose"]) == 1


ROBOT = {"particles": 10, "sigma": 0.0, "share_every": 10, "attempt_every": 5}


def drive_team(
    world: msg.Ros, conversions: Any, simulation: SimulatedTeam, poses: list[FloatArray], steps: int
) -> None:
    """Drive two robots, whose odometry has `poses`, and publish what they read."""
    for _ in range(steps):
        world.now += TICK
        for k, (name, odometry, frame) in enumerate(zip(("ada", "bo"), *simulation.read(), strict=True)):
            poses[k] = poses[k] if odometry is None else compose(poses[k], odometry)
            world.publish(f"/{name}/landmark_points", cloud_at(conversions, world.now, frame))
            world.publish(f"/{name}/odom", odometry_at(world.now, poses[k]))


def test_robots_on_one_topic_end_in_one_group_with_maps_that_agree(stub: Any, tmp_path: Path) -> None:
    """Two nodes find each other, publish one map in two frames, refuse strangers, and one comes back from its file."""
    (world, scripts), simulation = stub, SimulatedTeam(2, seed=5)
    file = tmp_path / "bo.state"
    world.parameters = ROBOT | {"name": "ada", "ns": "/ada"}
    ada = scripts.team_node.TeamNode()
    world.parameters = ROBOT | {"name": "bo", "ns": "/bo", "state": str(file)}
    bo = scripts.team_node.TeamNode()
    poses = [np.array([1.0, 2.0, 0.5]), np.zeros(3)]  # odometry may start anywhere
    drive_team(world, scripts.conversions, simulation, poses, 60)
    bo.destroy_node()  # stopped: saves
    before, step = bo.robot.poses()["bo"].mean, bo.robot.filter.next_step
    for topic in ("/bo/odom", "/bo/landmark_points", "/bo/landmarks"):
        world.callbacks[topic].clear()
    world.callbacks[scripts.team_node.SHARED].pop()
    drive_team(world, scripts.conversions, simulation, poses, 3)  # while bo's process is dead
    bo = scripts.team_node.TeamNode()
    assert bo.robot.filter.next_step == step
    np.testing.assert_array_equal(bo.robot.poses()["bo"].mean, before)
    drive_team(world, scripts.conversions, simulation, poses, 60)
    assert ada.robot.group == bo.robot.group == ("ada", "bo")
    assert any(line.startswith("linked: ") for line in ada.lines + bo.lines)
    clouds = []
    for name, node in (("ada", ada), ("bo", bo)):
        node.timers[0]()
        assert [each.ns for each in world.last(f"/{name}/group_poses").markers[1:]] == (
            ["ada", "bo"] if name == "ada" else ["bo", "ada"]
        )
        _, found = scripts.conversions.landmarks_of_cloud(world.last(f"/{name}/group_map"), StereoCamera(), 0.0)
        points = found.points @ np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]).T  # body axes
        start = simulation.starts[0 if name == "ada" else 1]
        c, s = np.cos(start[2]), np.sin(start[2])
        clouds.append(start[:2] + points[:, :2] @ np.array([[c, s], [-s, c]]))
    gaps = np.linalg.norm(clouds[0][:, None] - clouds[1][None], axis=-1).min(axis=1)
    assert np.median(gaps) < 0.25
    own = bo.robot.poses()["bo"].mean
    off = between(simulation.true_motion(1, 1), own)
    true = compose(inverse(simulation.starts[1]), simulation.poses[1])
    assert np.hypot(*(off - true)[:2]) < 0.3
    count = len(ada.lines)
    world.parameters = ROBOT | {"name": "eve", "ns": "/eve", "team": "another"}
    eve = scripts.team_node.TeamNode()
    forged = messages_of(ada.robot._own, eve.robot._key)[:1]
    for message in [*forged, b"nonsense", b""]:
        world.publish(scripts.team_node.SHARED, msg.UInt8MultiArray(data=list(message)))
    assert sorted(ada.lines[count:]) == [
        "message refused: expected a message of a robot, got other bytes",
        "message refused: expected a message with the key of this team, got one of a stranger, or a damaged one",
    ]


def test_faults_of_files_do_not_stop_a_robot(stub: Any, tmp_path: Path) -> None:
    """A state that cannot be written is a warning; an odometry that is not of the state, too; another's is refused."""
    (world, scripts), simulation = stub, SimulatedTeam(2, seed=1)
    world.parameters = ROBOT | {"name": "ada", "ns": "/ada", "state": str(tmp_path / "none" / "ada.state")}
    ada = scripts.team_node.TeamNode()
    drive_team(world, scripts.conversions, simulation, [np.zeros(3)] * 2, 3)
    for _ in range(2):
        ada.timers[1]()
    assert len(ada.lines) == 1
    assert ": expected " in ada.lines[0]
    file = tmp_path / "ada.state"
    ada.robot.save(file)
    (tmp_path / "ada.state.odom").write_text("1 2 nonsense")
    world.parameters = ROBOT | {"name": "ada", "state": str(file)}
    again = scripts.team_node.TeamNode()
    assert again.lines[0].startswith("back from ")
    assert "must stand where it was saved" in again.lines[1]
    world.parameters = ROBOT | {"name": "bo", "state": str(file)}
    refused(scripts.team_node.TeamNode, "state: expected the file of 'bo', got a file of 'ada'")


@pytest.mark.parametrize("room", [0, 1000])
def test_a_full_disk_costs_neither_state_nor_odometry(stub: Any, tmp_path: Path, room: int) -> None:
    """Whether there is room for no file or for the first alone, the robot comes back where it was saved before."""
    (world, scripts), simulation, poses = stub, SimulatedTeam(2, seed=1), [np.zeros(3), np.zeros(3)]
    world.parameters = ROBOT | {"name": "ada", "ns": "/ada", "state": str(tmp_path / "ada.state")}
    ada = scripts.team_node.TeamNode()
    drive_team(world, scripts.conversions, simulation, poses, 4)
    ada.save()
    step, (stamp, pose) = ada.robot.filter.next_step, ada._steps.last
    for _ in range(2):
        drive_team(world, scripts.conversions, simulation, poses, 4)
        with files_up_to(room):
            ada.timers[1]()
    assert [line.partition(", got")[0] for line in ada.lines] == ["path: expected a file that can be written"]
    again = scripts.team_node.TeamNode()
    assert again.lines == [f"back from {tmp_path / 'ada.state'}, at step {step}"]
    assert again._steps.last[0] == stamp
    np.testing.assert_array_equal(again._steps.last[1], pose)
    ada.save()  # after some room was made
    assert scripts.team_node.TeamNode().lines == [f"back from {tmp_path / 'ada.state'}, at step {step + 8}"]


def test_the_merge_service_answers_with_a_motion_or_a_reason(stub: Any, tmp_path: Path) -> None:
    """Overlapping maps are merged into a file; maps of two rooms, and files that are none, get their reason."""
    (world, scripts), rng = stub, np.random.default_rng(0)
    means, looks = rng.uniform(-5.0, 5.0, (40, 3)), rng.normal(size=(80, 16))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    small = np.tile(1e-4 * np.eye(3), (40, 1, 1))
    first = LandmarkMap(means, small, looks[:40])
    files = {name: str(tmp_path / f"{name}.npz") for name in ("first", "moved", "other", "out")}
    first.save(files["first"])
    first.moved(inverse([2.0, -1.0, 0.3])).save(files["moved"])
    LandmarkMap(rng.uniform(-5.0, 5.0, (40, 3)), small, looks[40:]).save(files["other"])
    world.parameters = {"map_a": files["first"], "map_b": files["moved"], "out": files["out"]}
    node = scripts.merge_node.MergeNode()

    def call(**values: Any) -> Any:
        node.values.update(values)
        return node.services["merge_maps"](msg.Trigger.Request(), msg.Trigger.Response())

    answer = call(map_b=files["other"])
    assert not answer.success
    assert "not aligned. Reason: " in answer.message
    assert not Path(files["out"]).exists()
    answer = call(map_b=files["moved"])
    assert answer.success
    assert "x 2.000 +- 0.0" in answer.message
    assert len(LandmarkMap.load(files["out"])) == 40
    for wrong in ({"map_a": str(tmp_path / "none.npz")}, {"out": "merged.txt"}, {"min_inliers": 0}):
        answer = call(**wrong)
        assert not answer.success
        assert ": expected " in answer.message
