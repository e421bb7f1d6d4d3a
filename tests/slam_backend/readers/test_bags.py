"""Bags of ROS 1 and ROS 2, written by rosbags: what is read of them, and what is refused."""

from collections.abc import Callable
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders import bags
from builders.bags import FORMATS, OPTICAL, odometry, path_of, views_of, write_circle, write_odometry, written, yaw

from slam_backend.geometry import between
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.readers.bag_files import open_bag
from slam_backend.readers.bags import BagSteps, bag_topics, load_bag
from slam_backend.readers.mrclam import SightingNoise

pytest.importorskip("rosbags", reason="rosbags is not installed: pip install .[ros]")

SECONDS = 6.0
VIEWS = views_of(seconds=SECONDS)


def load(path: Path, **named: Any) -> BagSteps:
    """Read a bag of `write_circle`."""
    return load_bag(path, **{"odometry": ["/odom"], "landmarks": ["/tags"], **named})


def points_of(steps: BagSteps, robot: int = 0) -> list[Any]:
    """Return the points of each step in the robot's axes; None without any."""
    frames = steps.robots[robot].measurements
    return [None if frame is None else frame.points @ ROBOT_FROM_CAMERA.T for frame in frames]


def assert_same_steps(first: BagSteps, second: BagSteps, tolerance: float = 0.0) -> None:
    """Compare times, odometry, points, covariances and descriptors."""
    np.testing.assert_array_equal(first.times, second.times)
    for one, other in zip(first.robots, second.robots, strict=True):
        np.testing.assert_array_equal(one.odometry, other.odometry)
        for a, b in zip(one.measurements, other.measurements, strict=True):
            assert (a is None) == (b is None)
            if a is not None and b is not None:
                np.testing.assert_allclose(a.points, b.points, atol=tolerance, rtol=0.0)
                np.testing.assert_allclose(a.covariances, b.covariances, atol=tolerance, rtol=0.0)
                np.testing.assert_array_equal(a.descriptors, b.descriptors)


def test_all_formats_give_the_same_steps(tmp_path: Path) -> None:
    """The same messages in ROS 1, a database of ROS 2 and MCAP give the same bits, with the true motion and points."""
    read = [load(write_circle(tmp_path / name, seconds=SECONDS), truth=["/gt"]) for name in FORMATS]
    for other in read[1:]:
        assert_same_steps(read[0], other)
    steps = read[0]
    (robot,) = steps.robots
    true = path_of(steps.times - bags.EPOCH)
    np.testing.assert_allclose(robot.odometry[1:-1], between(true[:-2], true[1:-1]), atol=2e-3)
    assert robot.truth is not None
    np.testing.assert_allclose(robot.truth.at(steps.times[:-1]), true[:-1], atol=2e-3)
    assert steps.kind == "identities"
    for view, frame, points in zip(VIEWS, robot.measurements, points_of(steps), strict=False):
        assert frame is not None
        np.testing.assert_allclose(points, view.points, atol=1e-6)  # stamps in float64 are 2e-7 s apart
        assert [int(steps.names[row]) for row in frame.descriptors.argmax(axis=1)] == view.ids.tolist()


def test_stamps_are_those_of_headers(tmp_path: Path) -> None:
    """Messages that arrive late and in another order give the same steps, with a note about the order."""
    at_once, late = (tmp_path / name / "circle.mcap" for name in ("at_once", "late"))
    for path, delays in ((at_once, [0.0]), (late, [0.7, 0.0, 0.3])):
        path.parent.mkdir()
        with written(path) as bag:
            write_odometry(bag, seconds=SECONDS)
            for number, view in enumerate(VIEWS):
                arrival = bags.ARRIVAL + delays[number % len(delays)]
                bag.write("/tags", view.time, bags.tags(bag, view), arrival)
    assert_same_steps(load(at_once), load(late))
    assert load(late).times[0] == bags.EPOCH
    assert any(note.startswith("Sorted by time: /tags (") for note in load(late).notes)


LOOKS = {
    "alvar": bags.alvar, "fiducials": bags.fiducials, "detections": bags.detections, "markers": bags.markers,
    "boxes": partial(bags.detections, in_box=True), "frames": bags.frames,
    "cloud": lambda bag, view: bags.cloud(bag, view, extra={"id": np.asarray(view.ids)}),
}  # fmt: skip


@pytest.mark.parametrize("look", LOOKS)
@pytest.mark.parametrize("name", ["circle.bag", "circle.mcap"])
def test_every_type_of_landmarks_gives_the_same_points(look: str, name: str, tmp_path: Path) -> None:
    """Each type of message gives the points and identities of apriltag_ros; clouds have single precision."""
    (tmp_path / "tags").mkdir()
    tags = load(write_circle(tmp_path / "tags" / name, seconds=SECONDS))
    steps = load(write_circle(tmp_path / name, LOOKS[look], seconds=SECONDS))
    assert_same_steps(tags, steps, 1e-6)
    assert steps.kind == "identities"
    assert [each.removeprefix("tag36h11:") for each in sorted(steps.names)] == sorted(tags.names)


def test_a_chain_of_static_frames_is_the_place_of_the_sensor(tmp_path: Path) -> None:
    """Points of a tilted camera, by two static transforms and six numbers each, are those seen by the robot."""
    direct = load(write_circle(tmp_path / "direct.mcap", seconds=SECONDS))
    with written(tmp_path / "optical.mcap") as bag:
        write_odometry(bag, seconds=SECONDS)
        half = np.sin(0.35), np.cos(0.35)  # a mast turned by 0.7 rad about y
        bags.write_static(bag, "mast", "base_link", ((0.1, -0.2, 0.4), (0.0, half[0], 0.0, half[1])))
        bags.write_static(bag, "optical", "mast", OPTICAL)
        turn = np.array([[np.cos(0.7), 0.0, np.sin(0.7)], [0.0, 1.0, 0.0], [-np.sin(0.7), 0.0, np.cos(0.7)]])
        for view in VIEWS:
            local = bags.to_optical((view.points - [0.1, -0.2, 0.4]) @ turn)
            bag.write("/tags", view.time, bags.tags(bag, view._replace(points=local), "optical"))
    seen = load(tmp_path / "optical.mcap")
    for one, other in zip(points_of(direct), points_of(seen), strict=True):
        assert (one is None) == (other is None)
        if one is not None:
            np.testing.assert_allclose(one, other, atol=1e-12)
    assert not seen.notes


def test_base_names_another_frame_of_the_robot(tmp_path: Path) -> None:
    """With --base, poses of a frame 0.4 m behind the base become poses of the base."""
    with written(tmp_path / "rear.mcap") as bag:
        write_odometry(bag, seconds=SECONDS, child="rear")
        bags.write_static(bag, "base_link", "rear", ((0.4, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
        for view in VIEWS:
            bag.write("/tags", view.time, bags.tags(bag, view))
    behind, base = load(tmp_path / "rear.mcap"), load(tmp_path / "rear.mcap", base=["base_link"])
    for one, other in zip(points_of(behind), points_of(base), strict=True):
        if one is not None:
            np.testing.assert_allclose(one - other, np.tile([0.4, 0.0, 0.0], (len(one), 1)), atol=1e-12)
    path = path_of(base.times[:-1] - bags.EPOCH)
    ahead = path[:, :2] + 0.4 * np.column_stack([np.cos(path[:, 2]), np.sin(path[:, 2])])
    moved = np.linalg.norm(np.diff(ahead, axis=0), axis=1)
    np.testing.assert_allclose(np.linalg.norm(base.robots[0].odometry[1:-1, :2], axis=1), moved, atol=1e-3)


def test_sightings_between_steps_are_moved_by_the_odometry(tmp_path: Path) -> None:
    """A sighting at a time between steps is at its place as seen from the step, to the accuracy of interpolation."""
    views = views_of(seconds=SECONDS, every=0.35)
    steps = load(write_circle(tmp_path / "between.mcap", seconds=SECONDS, views=views))
    true = path_of(steps.times - bags.EPOCH)
    for pose, points, frame in list(zip(true, points_of(steps), steps.robots[0].measurements, strict=True))[:-1]:
        if points is None or frame is None:
            continue  # the last step is after the odometry
        c, s = np.cos(pose[2]), np.sin(pose[2])
        world = points[:, :2] @ np.array([[c, s], [-s, c]]) + pose[:2]
        ids = [int(steps.names[row]) for row in frame.descriptors.argmax(axis=1)]
        np.testing.assert_allclose(world, bags.LANDMARKS[ids, :2], atol=6e-3)


def test_covariances_of_messages_are_used_and_turned(tmp_path: Path) -> None:
    """A covariance of a message is turned to the robot; one that is not positive definite gives the assumed noise."""
    own = np.zeros((6, 6))
    own[:3, :3] = np.diag([0.01, 0.04, 0.09])
    for name, covariance in (("good", own), ("bad", -own)):
        with written(tmp_path / f"{name}.mcap") as bag:
            write_odometry(bag, seconds=SECONDS)
            bags.write_static(bag)
            for view in VIEWS:
                local = view._replace(points=bags.to_optical(view.points))
                bag.write("/tags", view.time, bags.tags(bag, local, "optical", covariance.ravel()))
    frame = load(tmp_path / "good.mcap").robots[0].measurements[0]
    assert frame is not None
    np.testing.assert_allclose(frame.covariances[0], np.diag([0.01, 0.04, 0.09]), atol=1e-12)  # the same optical axes
    noise = SightingNoise(range_floor=0.2, range_share=0.0)
    bad = load(tmp_path / "bad.mcap", noise=noise)
    assert any("covariances are not positive definite" in note for note in bad.notes)
    frame = bad.robots[0].measurements[0]
    assert frame is not None
    assert np.linalg.eigvalsh(frame.covariances[0]).max() == pytest.approx(0.04)
    assert frame.covariances[0, 1, 1] == pytest.approx(noise.height**2)


def test_other_fields_of_a_cloud_are_descriptors(tmp_path: Path) -> None:
    """Single fields and fields of several numbers become descriptors of unit length; one message counts per step."""
    rng = np.random.default_rng(3)
    table = rng.normal(size=(15, 6)).astype(np.float32)

    def look(bag: Any, view: Any) -> Any:
        rows = table[view.ids]
        return bags.cloud(bag, view, extra={"first": rows[:, 0], "rest": rows[:, 1:]})

    views = views_of(seconds=SECONDS, every=0.1)
    steps = load(write_circle(tmp_path / "cloud.bag", look, seconds=SECONDS, views=views))
    assert (steps.kind, len(steps.names)) == ("descriptors", 0)
    frame = steps.robots[0].measurements[1]
    view = views[2]  # the first of the nearest ones to 0.25 s
    assert frame is not None
    assert len(frame) == len(view.ids)
    unit = table / np.linalg.norm(table, axis=1, keepdims=True)
    np.testing.assert_allclose(frame.descriptors, unit[view.ids], atol=1e-6)


def test_a_cloud_of_bare_points_is_matched_by_position(tmp_path: Path) -> None:
    """Without identities and descriptors all descriptors are equal, which a note says; NaN points are dropped."""

    def look(bag: Any, view: Any) -> Any:
        return bags.cloud(
            bag, view._replace(points=np.where(np.arange(len(view.ids))[:, None] == 0, np.nan, view.points))
        )

    steps = load(write_circle(tmp_path / "cloud.mcap", look, seconds=SECONDS))
    assert steps.kind == "positions"
    assert any("positions alone" in note for note in steps.notes)
    assert any("that are not finite were dropped" in note for note in steps.notes)
    frame = steps.robots[0].measurements[0]
    assert frame is not None
    assert (frame.descriptors == 1.0).all()


def test_velocities_are_integrated(tmp_path: Path) -> None:
    """Twists give the motion of the circle, exactly but for the last step."""
    with written(tmp_path / "twist.bag") as bag:
        for time in np.arange(0.0, SECONDS, 0.1):
            velocity = bag.make("geometry_msgs/Vector3", bags.SPEED, 0.0, 0.0)
            turn = bag.make("geometry_msgs/Vector3", 0.0, 0.0, bags.TURN)
            twist = bag.make("geometry_msgs/Twist", velocity, turn)
            bag.write("/cmd", time, bag.make("geometry_msgs/TwistStamped", bag.header(float(time), "base_link"), twist))
        for view in VIEWS:
            bag.write("/tags", view.time, bags.tags(bag, view))
    steps = load(tmp_path / "twist.bag", odometry=["/cmd"])
    true = path_of(steps.times - bags.EPOCH)
    np.testing.assert_allclose(steps.robots[0].odometry[1:], between(true[:-1], true[1:]), atol=1e-7)


def test_a_camera_gives_field_of_view_and_place(tmp_path: Path) -> None:
    """Focal length, baseline and the image around the centre come from CameraInfo; points are relative to its place."""
    path = tmp_path / "camera.mcap"
    with written(path) as bag:
        write_odometry(bag, seconds=SECONDS)
        bags.write_static(bag)
        bag.write("/info", 0.0, bags.camera_info(bag))
        bag.write("/blank", 0.0, bags.camera_info(bag, focal=0.0))
        bag.write("/side", 0.0, bags.camera_info(bag, frame="base_link"))
        bags.write_static(bag, "side_optical", "base_link", ((0.0, 0.0, 0.0), (-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5))))
        bag.write("/left", 0.0, bags.camera_info(bag, frame="side_optical"))
        for view in VIEWS:
            bag.write("/tags", view.time, bags.tags(bag, view))
    steps, without = load(path, camera="/info"), load(path)
    assert steps.camera is not None
    lens = steps.camera
    assert (lens.focal_px, lens.width, lens.height, lens.mount) == (400.0, 600, 460, OPTICAL[0])
    assert lens.baseline == pytest.approx(0.2)
    for one, other in zip(points_of(steps), points_of(without), strict=True):
        if one is not None:
            np.testing.assert_allclose(one + OPTICAL[0], other, atol=1e-12)
    with pytest.raises(ValueError, match=r"camera: expected focal lengths > 0 in K or P of /blank, got \[0.0, 0.0\]"):
        load(path, camera="/blank")
    with pytest.raises(
        ValueError, match=r"camera: expected a camera that looks along x of 'base_link', to 0.2 rad, got"
    ):
        load(path, camera="/left")
    with pytest.raises(ValueError, match=r"camera: expected a type of /odom that can be read, got 'nav_msgs/Odometry'"):
        load(path, camera="/odom")


def test_several_topics_are_several_robots(tmp_path: Path) -> None:
    """Robots have common times and names, and their own frames below a name space."""
    path = tmp_path / "team.bag"
    with written(path) as bag:
        for robot in (0, 1):
            write_odometry(bag, f"/r{robot}/odom", robot, seconds=SECONDS + robot)
            place = ((0.1 + robot, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
            bags.write_static(bag, "eye", "base_link", place, f"/r{robot}/tf_static")
            for view in views_of(robot, seconds=SECONDS):
                local = view._replace(points=view.points - [0.1 + robot, 0.0, 0.0])
                bag.write(f"/r{robot}/tags", view.time, bags.tags(bag, local, "eye"))
    steps = load(path, odometry=["/r0/odom", "/r1/odom"], landmarks=["/r0/tags", "/r1/tags"])
    assert len(steps.robots) == 2
    for robot in (0, 1):
        views = views_of(robot, seconds=SECONDS)
        for view, points in zip(views, points_of(steps, robot), strict=False):
            if points is not None:
                np.testing.assert_allclose(points, view.points, atol=1e-6)


def test_topics_are_listed_with_their_use(tmp_path: Path) -> None:
    """The table has name, type, number and use of each topic."""
    path = tmp_path / "circle.mcap"
    with written(path) as bag:
        write_odometry(bag, seconds=1.0)
        bag.write("/tags", 0.0, bags.tags(bag, VIEWS[0]))
        bag.write("/words", 0.0, bag.make("std_msgs/String", "hello"))
    assert bag_topics(path) == [
        ("/odom", "nav_msgs/Odometry", 20, "odometry, truth"),
        ("/tags", "apriltag_ros/AprilTagDetectionArray", 1, "landmarks"),
        ("/words", "std_msgs/String", 1, ""),
    ]


def test_landmarks_are_listed_only_where_the_reader_would_accept_them(tmp_path: Path) -> None:
    """Not so: frames that are no tags, a map in the frame of the odometry, a scan, and a topic without a landmark."""
    path, nothing = tmp_path / "circle.mcap", VIEWS[0]._replace(ids=VIEWS[0].ids[:0], points=VIEWS[0].points[:0])
    with written(path) as bag:
        write_odometry(bag, seconds=1.0)
        bags.write_static(bag)
        for name, message in {
            "/tf": bags.frames(bag, VIEWS[0]),
            "/map": bags.cloud(bag, VIEWS[0], "odom"),
            "/empty": bags.tags(bag, nothing),
            "/scan": bags.cloud(bag, VIEWS[0]._replace(ids=np.arange(6000), points=np.zeros((6000, 3)))),
            "/late": bags.tags(bag, nothing),
        }.items():
            bag.write(name, 0.0, message)
        bag.write("/late", 0.5, bags.tags(bag, VIEWS[0]))
    uses = {name: use for name, _, _, use in bag_topics(path)}
    assert uses == {
        "/odom": "odometry, truth", "/tf": "landmarks", "/tf_static": "", "/map": "", "/empty": "", "/scan": "",
        "/late": "landmarks",
    }  # fmt: skip
    assert {name: use for name, _, _, use in bag_topics(path, "marker*")}["/tf"] == ""
    for name, use in uses.items():
        if name not in ("/odom", "/late"):
            with nullcontext() if use else pytest.raises(ValueError, match="landmarks: expected"):
                load(path, landmarks=[name])


def _write_refused(path: Path) -> None:
    """Write a bag of topics, each wrong in one way."""
    with written(path) as bag:
        write_odometry(bag, seconds=SECONDS)
        for view in VIEWS:
            bag.write("/tags", view.time, bags.tags(bag, view))
            bag.write("/unstamped", view.time, bags.tags(bag, view._replace(time=-1.0)))
            bag.write("/other_clock", view.time, bags.tags(bag, view._replace(time=view.time + 5000.0)))
            bag.write("/elsewhere", view.time, bags.tags(bag, view, "gripper"))
            bag.write("/mapped", view.time, bags.tags(bag, view, "odom"))
            bag.write("/frames", view.time, bags.frames(bag, view))
            bag.write("/odd", view.time, bags.cloud(bag, view, extra={"id": view.ids}))
            bag.write("/bare", view.time, bags.cloud(bag, view))
        bags.write_static(bag, "optical", "mast")
        jump = VIEWS[0]._replace(time=1.0)
        for number, time in enumerate((4.0, 1.0, 4.5)):
            bag.write("/back", time, bags.tags(bag, jump._replace(time=time)), arrival=900.0 + number - time)
        for number, quaternion in enumerate(((0.0, 0.0, 0.0, 2.0), (np.sin(0.15), 0.0, 0.0, np.cos(0.15)))):
            for time in (0.0, 1.0):
                bag.write(f"/pose{number}", time, odometry(bag, time, np.zeros(3), tilt=quaternion))
        bag.write("/single", 0.0, odometry(bag, 0.0, np.zeros(3)))
        bag.write(
            "/detected",
            0.0,
            bag.make("apriltag_msgs/AprilTagDetectionArray", bag.header(0.0, ""), np.ones(1, np.int32)),
        )
        bag.write("/words", 0.0, bag.make("std_msgs/String", "hello"))
        bag.empty_topic("/silent", "nav_msgs/Odometry")


REFUSED: dict[str, tuple[dict[str, Any], str]] = {
    "misspelt": ({"landmarks": ["/tag"]}, r"expected a topic of the bag, got '/tag'. Did you mean '/tags'\?"),
    "silent": ({"odometry": ["/silent"]}, r"odometry: expected messages of /silent, got no message"),
    "type": ({"odometry": ["/words"]}, r"odometry: expected a type of /words that can be read, got 'std_msgs/String'."
             r" Give a topic of nav_msgs/Odometry, "),
    "no poses": ({"landmarks": ["/detected"]}, r"got 'apriltag_msgs/AprilTagDetectionArray'. It has no poses: they"),
    "unstamped": ({"landmarks": ["/unstamped"]}, r"expected time stamps in the headers of /unstamped, got no stamp"),
    "two clocks": ({"landmarks": ["/other_clock"]}, r"expected stamps of /other_clock among those of the odometry, "),
    "back": ({"landmarks": ["/back"]}, r"stamps of /back that go back by at most 1 s, got a stamp 1700000001.0"),
    "no chain": ({"landmarks": ["/elsewhere"]}, r"expected static frames from 'gripper' of /elsewhere to 'base_link', "
                 r"got no such chain. /tf_static has mast, optical: name the robot's frame by --base."),
    "a map": ({"landmarks": ["/mapped"]}, r"expected landmarks of /mapped in a frame of the robot, got 'odom'"),
    "quaternion": ({"odometry": ["/pose0"]}, r"expected unit quaternions of /pose0, got \[0.0, 0.0, 0.0, 2.0\]"),
    "tilt": ({"odometry": ["/pose1"]}, r"/pose1 tilted by at most 0.2 rad, got a tilt of 0.30 rad at 17000000"),
    "single": ({"odometry": ["/single"]}, r"odometry: expected two poses of /single or more, got a single one"),
    "no such tags": ({"landmarks": ["/frames"], "tag_frames": "qr*"}, r"landmarks in /frames, got no landmark"),
    "numbers": ({"landmarks": ["/tags", "/odd"]}, r"expected 1 topic, as of odometry, got \['/tags', '/odd'\]"),
    "bases": ({"base": ["a", "b"]}, r"base: expected one frame or 1, got \['a', 'b'\]"),
    "kinds": ({"odometry": ["/odom", "/odom"], "landmarks": ["/tags", "/bare"]}, r"one kind of landmarks, got"),
    "truth": ({"truth": ["/words"]}, r"truth: expected a type of /words that can be read, got 'std_msgs/String'"),
    "dt": ({"dt": 0.0}, r"dt: expected a finite number > 0, got 0.0"),
    "steps": ({"dt": 1e-6}, r"dt: expected at most 1,000,000 steps, got"),
}  # fmt: skip


@pytest.fixture(scope="module")
def wrong(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a bag of topics, each wrong in one way."""
    path: Path = tmp_path_factory.mktemp("wrong") / "wrong.mcap"
    _write_refused(path)
    return path


@pytest.mark.parametrize("case", REFUSED)
def test_wrong_topics_are_refused_in_one_line(case: str, wrong: Path) -> None:
    """Each error names argument, expected, got and cure, without a line break."""
    named, says = REFUSED[case]
    with pytest.raises(ValueError, match=says) as refusal:
        load(wrong, **named)
    assert "\n" not in str(refusal.value)


def _cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size * 2 // 3])


def _scramble(path: Path) -> None:
    data = bytearray(path.read_bytes())
    rng = np.random.default_rng(5)
    for at in rng.integers(20, len(data) - 40, 400):
        data[at] ^= 0x55
    path.write_bytes(bytes(data))


@pytest.mark.parametrize("damage", [_cut, _scramble, lambda path: path.write_bytes(b"")], ids=["cut", "bits", "empty"])
@pytest.mark.parametrize("name", FORMATS)
def test_damaged_bags_are_one_line(damage: Callable[[Path], Any], name: str, tmp_path: Path) -> None:
    """A bag that is cut, has wrong bytes or is empty is refused, or read as it is; nothing else is raised."""
    path = write_circle(tmp_path / name, seconds=SECONDS)
    damage(next(path.glob("*.db3")) if path.is_dir() else path)
    error = None
    try:
        load(path)
    except ValueError as raised:
        error = str(raised)
    assert damage is _scramble if error is None else ": expected " in error and "\n" not in error


def test_definitions_of_a_bag_are_words_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Constants of a definition are not taken, and a type without a definition is one that rosbags knows."""
    path = write_circle(tmp_path / "circle", bags.detections, seconds=SECONDS)
    steps = load(path)
    from rosbags.interfaces import MessageDefinition, MessageDefinitionFormat
    from rosbags.typesys.store import Typestore

    registered: list[Any] = []
    register = Typestore.register
    monkeypatch.setattr(Typestore, "register", lambda self, types: registered.append(types) or register(self, types))
    load(path)
    assert registered
    assert not any(constants for types in registered for constants, _ in types.values())
    nothing = MessageDefinition(MessageDefinitionFormat.NONE, "")
    with open_bag(path) as bag:
        stripped = [each._replace(msgdef=nothing) for each in bag._reader.connections]
        kinds = {each.topic: bag._types(each).fielddefs[each.msgtype] for each in stripped}
        assert kinds.keys() == {"/odom", "/tags", "/gt"}
        with pytest.raises(ValueError, match="expected a bag with the definition of a/B, got no definition"):
            bag._types(stripped[0]._replace(msgtype="a/msg/B"))
    assert steps.kind == "identities"


def test_paths_that_are_no_bags_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Missing paths, other files and folders are refused, a folder with the name of a bag in it."""
    with pytest.raises(ValueError, match=r"path: expected a bag \(.bag, .mcap, .db3, or a folder .*, got no such file"):
        bag_topics(tmp_path / "none.bag")
    (tmp_path / "notes.txt").write_text("hello")
    with pytest.raises(ValueError, match=r"path: expected a bag .*notes.txt"):
        bag_topics(tmp_path / "notes.txt")
    write_circle(tmp_path / "circle.mcap", seconds=1.0, views=VIEWS[:3])
    with pytest.raises(ValueError, match=r"got a folder without it. Name a file in it: circle.mcap."):
        bag_topics(tmp_path)
    monkeypatch.setattr("slam_backend.readers.bag_files.find_spec", lambda name: None)
    with pytest.raises(ValueError, match=r"path: expected the package rosbags for bags, got no such package"):
        bag_topics(tmp_path / "circle.mcap")


def test_sizes_are_bounded(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Long topics, many points and scans are refused before they are read whole."""
    path = write_circle(tmp_path / "circle.mcap", seconds=SECONDS)
    monkeypatch.setattr("slam_backend.readers.bags.MOST_POINTS", 10)
    with pytest.raises(ValueError, match=r"landmarks: expected at most 10 points and .* in /tags, got a longer topic"):
        load(path)
    monkeypatch.setattr("slam_backend.readers.bag_files.MOST_MESSAGES", 10)
    with pytest.raises(ValueError, match=r"odometry: expected at most 10 messages of /odom, got 120"):
        load(path)
    monkeypatch.undo()
    monkeypatch.setattr("slam_backend.readers.bag_messages.MOST_IN_CLOUD", 2)
    path = write_circle(tmp_path / "scan.mcap", bags.cloud, seconds=SECONDS)
    with pytest.raises(ValueError, match=r"landmarks: expected at most 2 points in a message, got"):
        load(path)


def test_poses_without_a_child_frame_need_a_base_for_optical_points(tmp_path: Path) -> None:
    """PoseStamped names no frame of the robot: points of an optical frame need --base, others have a note."""
    path = tmp_path / "poses.bag"
    with written(path) as bag:
        for time in np.arange(0.0, SECONDS, 0.1):
            x, y, heading = path_of(np.array([time]))[0]
            pose = bag.pose((x, y, 0.0), yaw(heading))
            bag.write("/pose", time, bag.make("geometry_msgs/PoseStamped", bag.header(float(time), "odom"), pose))
        bags.write_static(bag, "camera_optical_frame", "base_link")
        for view in VIEWS:
            bag.write("/plain", view.time, bags.tags(bag, view, "eye"))
            local = view._replace(points=bags.to_optical(view.points))
            bag.write("/tags", view.time, bags.tags(bag, local, "camera_optical_frame"))
    with pytest.raises(ValueError, match="base: expected the frame of the robot, for /tags in 'camera_optical_frame'"):
        load(path, odometry=["/pose"])
    based = load(path, odometry=["/pose"], base=["base_link"])
    plain = load(path, odometry=["/pose"], landmarks=["/plain"])
    assert plain.notes == ("/plain: taken to be in the frame of the robot (x ahead, z up).",)
    for one, other in zip(points_of(based), points_of(plain), strict=True):
        if one is not None:
            np.testing.assert_allclose(one, other, atol=1e-12)
