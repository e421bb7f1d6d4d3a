"""The landmark sensor sees what a camera would see, with the errors it is said to have."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam_backend import FastSlam
from slam_backend.fastslam._kernels import MIN_DEPTH
from slam_backend.geometry import compose
from slam_backend.models.camera import StereoCamera
from vslam_env.sensors import LandmarkSensor, LandmarkSensorConfig
from vslam_env.sensors._landmark_kernels import NEAREST, measure
from vslam_env.sensors.landmark_sensor import false_points, shuffle_clutter
from vslam_env.world import FreeSpace, Landmarks, World, make_world, place_landmarks
from vslam_env.world._kernels import detect
from vslam_env.world.visibility import group_bounds, landmark_geometry, view_limits, visible_landmarks

SHARP = StereoCamera(sigma_px=1e-9, sigma_disparity_px=1e-9)
PERFECT = LandmarkSensorConfig(
    camera=SHARP, detection_probability=1.0, false_points=0.0, descriptor_noise=0.0, max_measurements=1000
)
WALL = np.array([[4.0, -3.0, 4.0, 3.0]])


def on_wall(rows: list[list[float]], size: int = 11) -> Landmarks:
    """Landmarks at (4, y, z) on WALL, which faces -x."""
    positions = [[4.0, y, z] for y, z in rows]
    return Landmarks(positions, [[-1, 0]] * len(rows), [0] * len(rows), np.eye(len(rows), size))


def office(seed: int) -> tuple[World, FreeSpace, Landmarks]:
    """An office with landmarks."""
    rng = np.random.default_rng(seed)
    world = make_world("office", rng)
    free = FreeSpace(world)
    return world, free, place_landmarks(world, rng, None, free)


def test_a_perfect_sensor_reports_the_truth() -> None:
    """Without noise, points moved to the world are the visible landmarks, all of them, each once."""
    world, free, marks = office(1)
    camera = replace(SHARP, mount=(0.1, 0.05, 0.2))
    sensor = LandmarkSensor(replace(PERFECT, camera=camera), world.walls, marks)
    rng = np.random.default_rng(0)
    for _ in range(10):
        poses = free.draw_starts(3, rng, 1.0)
        visible = sensor.visible(poses)
        for pose, seen, frame in zip(poses, visible, sensor.measure(poses, rng).per_robot(), strict=True):
            assert sorted(frame.true_ids.tolist()) == np.flatnonzero(seen).tolist()
            local = camera.robot_from_camera(frame.measurements.points)
            c, s = np.cos(pose[2]), np.sin(pose[2])
            x, y = pose[0] + c * local[:, 0] - s * local[:, 1], pose[1] + s * local[:, 0] + c * local[:, 1]
            measured = np.stack([x, y, local[:, 2]], axis=1)
            np.testing.assert_allclose(measured, marks.positions[frame.true_ids], atol=1e-6)
            np.testing.assert_allclose(frame.measurements.descriptors, marks.descriptors[frame.true_ids], atol=1e-6)
            assert frame.measurements.covariances is None


def test_visibility_is_the_plain_definition() -> None:
    """Compiled visibility equals: in the image and range, face not too oblique, no other wall across the sight line."""
    world, free, marks = office(4)
    camera = StereoCamera(mount=(0.05, -0.03, 0.1))
    sensor = LandmarkSensor(replace(PERFECT, camera=camera), world.walls, marks)
    a, b = world.walls[:, :2], world.walls[:, 2:]
    for pose in free.draw_starts(12, np.random.default_rng(2), 0.5):
        c, s = np.cos(pose[2]), np.sin(pose[2])
        robot_from_world = np.array([[c, s], [-s, c]])
        local = np.column_stack([(marks.positions[:, :2] - pose[:2]) @ robot_from_world.T, marks.positions[:, 2]])
        eye = pose[:2] + np.array(camera.mount[:2]) @ robot_from_world
        expected = camera.sees(camera.camera_from_robot(local))
        for n in np.flatnonzero(expected):
            point = marks.positions[n]
            back = np.array([*(eye - point[:2]), camera.mount[2] - point[2]])
            expected[n] = back[:2] @ marks.normals[n] > 0.5 * np.linalg.norm(back)
            for wall in range(len(world.walls)):
                system = np.column_stack([point[:2] - eye, a[wall] - b[wall]])
                if wall != marks.walls[n] and abs(np.linalg.det(system)) > 1e-12:
                    t, u = np.linalg.solve(system, a[wall] - eye)
                    expected[n] &= not (0.0 < t < 1.0 and 0.0 <= u <= 1.0)
        np.testing.assert_array_equal(sensor.visible(pose[None])[0], expected)


def test_walls_and_robots_hide_landmarks() -> None:
    """A wall in between hides a landmark, and so does a robot; the landmark's own wall does not."""
    marks = on_wall([[0.0, 0.0], [1.0, 0.0]])
    behind = LandmarkSensor(PERFECT, np.vstack([WALL, [[2.0, -1.0, 2.0, 0.3]]]), marks)
    assert behind.visible(np.zeros((1, 3))).tolist() == [[False, True]]
    free = LandmarkSensor(PERFECT, WALL, marks, robot_radius=0.2)
    assert free.visible(np.zeros((1, 3))).tolist() == [[True, True]]
    assert free.visible(np.array([[0.0, 0.0, 0.0], [2.0, 0.1, 0.0]]))[0].tolist() == [False, True]
    assert free.visible(np.array([[0.0, 0.0, 0.0], [2.0, -0.3, 0.0]]))[0].tolist() == [True, True]


def test_noise_is_the_cameras() -> None:
    """Image coordinates and disparity scatter by the camera's sigmas (within 4 %, 5 sigma), without bias."""
    camera = StereoCamera(sigma_px=0.3, sigma_disparity_px=0.15)
    sensor = LandmarkSensor(replace(PERFECT, camera=camera), WALL, on_wall([[0.7, 0.4]]))
    rng = np.random.default_rng(3)
    frames = [sensor.measure(np.zeros((1, 3)), rng).per_robot()[0] for _ in range(8000)]
    pixels = np.array([camera.project(frame.measurements.points[0]) for frame in frames])
    true = camera.project(np.array([-0.7, -0.4, 4.0]))
    np.testing.assert_allclose(pixels.std(axis=0), [0.3, 0.3, 0.15], rtol=0.04)
    np.testing.assert_array_less(np.abs(pixels.mean(axis=0) - true), 5 * np.array([0.3, 0.3, 0.15]) / np.sqrt(8000))


def test_a_frame_is_the_plain_definition() -> None:
    """Points are disturbed in the image and triangulated, descriptors disturbed and normalised, false ones as well.

    What lies beyond infinity or before the lens by its disparity is left out.
    """
    rng = np.random.default_rng(8)
    camera = StereoCamera(mount=(0.1, -0.2, 0.3))
    ids, counts = np.array([2, -1, 4, 0, -2, 3]), np.array([3, 0, 3])
    in_rows = np.array([[2, -1, 4, 7], [7, 7, 7, 7], [0, -2, 3, 7]])
    robots = np.repeat(np.arange(3), counts)
    poses = rng.uniform(-1.0, 1.0, (3, 3))
    seen = rng.uniform([-1.0, -1.0, 2.0], [1.0, 1.0, 6.0], (6, 3))
    false, (looks, false_looks) = rng.uniform(1.0, 3.0, (2, 3)), rng.standard_normal((2, 5, 4))
    positions = np.empty((5, 3))
    for row in np.flatnonzero(ids >= 0):
        name, robot = ids[row], robots[row]
        x, y, z = camera.robot_from_camera(seen[row])
        positions[name, 2] = z
        positions[name, :2] = compose(poses[robot], [x, y, 0.0])[:2]
    noise = rng.standard_normal((6, 7))
    noise[0, 2], noise[4, 2] = -1000.0, 1e6
    sharp = [1, 2, 3, 5]
    is_true, made_up = ids[sharp, None] >= 0, (-1 - ids[sharp]) % 2
    true = np.where(is_true, seen[sharp], false[made_up])
    sigmas = camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px
    pixels = camera.project(true) + sigmas * noise[sharp, :3]
    disturbed = np.where(is_true, looks[ids[sharp]], false_looks[made_up]) + 0.15 * noise[sharp, 3:]

    lens = camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px
    optics = np.array([*camera.mount, *lens, 1e3, 0.3])
    made_of = np.hstack([positions, looks]), np.hstack([false, false_looks[:2]])
    got_points, got_looks = np.empty((6, 3)), np.empty((6, 4), np.float32)
    assert measure(in_rows, counts, poses, *made_of, noise, optics, got_points, got_looks) == 4
    assert counts.tolist() == [2, 2, 4]  # where those that are written end
    assert [in_rows[0, :2].tolist(), in_rows[2, :2].tolist()] == [[-1, 4], [0, 3]]
    np.testing.assert_allclose(got_points[:4], camera.triangulate(pixels), rtol=1e-9)
    np.testing.assert_allclose(got_looks[:4], disturbed / np.linalg.norm(disturbed, axis=1, keepdims=True), rtol=1e-6)


def test_false_points_are_the_plain_definition() -> None:
    """They are spread over the image and in depth, none nearer than 0.5 m; descriptors have a part in common."""
    rng = np.random.default_rng(10)
    camera = StereoCamera(max_range=6.0)
    places, own = rng.random((3, 20)), rng.standard_normal((20, 8))
    places[2, :3] = 0.0
    common = 0.1 * rng.standard_normal(8)
    right, down = np.array([[np.tan(camera.half_fov)], [np.tan(camera.half_vertical_fov)]]) * (2.0 * places[:2] - 1.0)
    rays = np.stack([right, down, np.ones(20)], axis=1)
    ahead = np.maximum(places[2] * 6.0 / np.linalg.norm(rays, axis=1), 0.5)
    looks = common + 0.8 * own / np.linalg.norm(own, axis=1, keepdims=True)
    points = false_points(places, own, common, 0.8, view_limits(camera, 1.0))
    np.testing.assert_allclose(points[:, :3], rays * ahead[:, None], rtol=1e-12)
    np.testing.assert_allclose(points[:, 3:], looks / np.linalg.norm(looks, axis=1, keepdims=True), rtol=1e-12)


def test_false_points_are_mixed_in_by_their_keys() -> None:
    """Each robot's points, landmarks before false ones, are sorted by its share of the keys."""
    rng = np.random.default_rng(11)
    num_true, num_false = np.array([2, 0, 3, 0, 1]), np.array([1, 2, 0, 0, 4])
    ids, keys = rng.permutation(40)[:30].reshape(5, 6), rng.random(13)
    false = np.split(-1 - np.arange(7), np.cumsum(num_false)[:-1])
    shares = np.split(keys, np.cumsum(num_true + num_false)[:-1])
    own = [np.concatenate([row[:n], made_up]) for row, n, made_up in zip(ids, num_true, false, strict=True)]
    expected = [points[np.argsort(share)].tolist() for points, share in zip(own, shares, strict=True)]
    counts, mixed = num_true.copy(), ids.copy()
    shuffle_clutter(num_false, keys.copy(), mixed, counts)
    assert counts.tolist() == [3, 2, 3, 0, 5]
    assert [row[:n].tolist() for row, n in zip(mixed, counts, strict=True)] == expected


@pytest.mark.parametrize("size", [4, 6, 30])
def test_each_robot_detects_what_it_sees_as_false_points_leave_places(size: int) -> None:
    """Of what is visible and detected the smallest keys are taken, in their order, as many as there are places."""
    marks, view = on_wall([[0.2 * i - 2.8, 0.0] for i in range(29)], 29), view_limits(StereoCamera(), 1.0)
    poses, rng = np.array([[0.0, y, 0.0] for y in (-1.5, -0.5, 0.5, 1.5)]), np.random.default_rng(12)
    sight = landmark_geometry(marks), group_bounds(marks), marks.walls, WALL.T.copy(), 0.2, view
    visible = visible_landmarks(poses, marks, WALL, 0.2, view)
    assert 8 < visible.sum(axis=1).min() < 29
    for _ in range(5):
        keys, num_false = rng.random((4, len(marks))), np.array([0, 2, size, 9])
        chosen, counts = np.empty((4, size), np.int64), np.empty(4, np.int64)
        total, extra = detect(poses, sight, keys, 0.8, num_false, chosen, counts)
        assert num_false.tolist() == [0, 2, size, min(9, size)]
        assert (total, extra) == (counts.sum(), num_false.sum())
        for seen, own, left, names, count in zip(visible, keys, size - num_false, chosen, counts, strict=True):
            detected = np.flatnonzero(seen & (own < 0.8))
            expected = detected[np.argsort(own[detected])][:left]
            assert names[:count].tolist() == expected.tolist()


def test_descriptor_noise_has_the_stated_length() -> None:
    """Descriptors stay unit vectors; they are off by about the stated length."""
    sensor = LandmarkSensor(replace(PERFECT, descriptor_noise=0.17), WALL, on_wall([[0.0, 0.0]], size=64))
    rng = np.random.default_rng(4)
    vectors = np.array([sensor.measure(np.zeros((1, 3)), rng).measurements.descriptors[0] for _ in range(500)])
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=1), 1.0, atol=1e-5)
    assert np.linalg.norm(vectors - np.eye(1, 64), axis=1).mean() == pytest.approx(0.17, rel=0.03)


def test_detection_and_choice_are_uniform() -> None:
    """Of 7 visible landmarks, detected with 0.6, at most 3 are reported, each equally often, in each place equally.

    Chi-square with 6 degrees of freedom below 22.5: false alarm rate 0.001 for each of the four.
    """
    rows = [[0.2 * i - 0.6, 0.0] for i in range(7)]
    config = replace(PERFECT, detection_probability=0.6, max_measurements=3)
    sensor = LandmarkSensor(config, WALL, on_wall(rows))
    rng = np.random.default_rng(5)
    frames = [sensor.measure(np.zeros((1, 3)), rng).per_robot()[0].true_ids for _ in range(6000)]
    sizes = np.bincount([len(ids) for ids in frames], minlength=4) / 6000
    few = [(1 - 0.6) ** 7, 7 * 0.6 * 0.4**6, 21 * 0.36 * 0.4**5]
    np.testing.assert_allclose(sizes[:3], few, atol=0.016)
    full = np.array([ids for ids in frames if len(ids) == 3])
    for counts in (np.bincount(full.ravel(), minlength=7), *(np.bincount(full[:, i], minlength=7) for i in range(3))):
        expected = counts.sum() / 7
        assert ((counts - expected) ** 2 / expected).sum() < 22.5


def test_false_points_come_at_the_stated_rate_and_look_like_the_rest() -> None:
    """False points appear 0.5 times a frame (within 5 sigma), within B, in the view and at no special place."""
    world, free, marks = office(2)
    config = LandmarkSensorConfig(false_points=0.5, max_measurements=5)
    sensor = LandmarkSensor(config, world.walls, marks)
    rng = np.random.default_rng(6)
    poses = free.draw_starts(3, rng, 2.0)
    frames = [frame for _ in range(1000) for frame in sensor.measure(poses, rng).per_robot()]
    ids = [frame.true_ids for frame in frames]
    assert max(map(len, ids)) <= 5
    false = np.array([(i < 0).sum() for i in ids])
    assert false.mean() == pytest.approx(0.5, abs=5 * np.sqrt(0.5 / 3000))
    mixed = [i for i, n in zip(ids, false, strict=True) if 0 < n < len(i)]
    places = np.array([np.flatnonzero(i < 0).mean() / (len(i) - 1) for i in mixed])
    assert places.mean() == pytest.approx(0.5, abs=5 * 0.5 / np.sqrt(len(places)))
    points = np.vstack([f.measurements.points[f.true_ids < 0] for f in frames])
    assert replace(StereoCamera(), max_range=12.0, width=330, height=250).sees(points).all()
    vectors = np.vstack([f.measurements.descriptors[f.true_ids < 0] for f in frames])
    nearest = np.sqrt(np.maximum(0.0, 2 - 2 * vectors @ marks.descriptors.T)).min(axis=1)
    assert 0.5 < np.median(nearest) < 0.8  # as far from all landmarks as these are from each other


def test_an_empty_view_gives_an_empty_frame() -> None:
    """A robot that looks away reports no points, with descriptors of the usual size."""
    sensor = LandmarkSensor(PERFECT, WALL, on_wall([[0.0, 0.0]]))
    frame = sensor.measure(np.array([[0, 0, 3.0]]), np.random.default_rng(0)).per_robot()[0]
    assert frame.measurements.points.shape == (0, 3)
    assert frame.measurements.descriptors.shape == (0, 11)


def test_all_measurements_are_accepted_by_a_filter() -> None:
    """Filters take no depth below theirs, none is measured there; nor are there points at the end of the world."""
    assert NEAREST == MIN_DEPTH
    camera = StereoCamera(sigma_px=10.0, sigma_disparity_px=200.0, max_range=4.5)
    close = LandmarkSensor(replace(PERFECT, camera=camera), WALL, on_wall([[0.0, 0.0], [0.01, 0.0]]))
    slam, rng, told = FastSlam(num_particles=2, camera=camera, seed=0), np.random.default_rng(9), []
    for x in np.linspace(0.0, 3.99, 400):
        (frame,) = close.measure(np.array([[x, 0.0, 0.0]]), rng).per_robot()
        slam.step([(0.0, 0.0, 0.0)], [frame.measurements])
        told.append(len(frame.true_ids))
    assert min(told) == 0
    assert max(told) == 2


@settings(max_examples=40)
@given(
    camera=st.builds(
        StereoCamera,
        focal_px=st.floats(20.0, 2000.0),
        baseline=st.floats(0.01, 1.0),
        max_range=st.floats(0.1, 60.0),
        sigma_px=st.floats(1e-3, 50.0),
        sigma_disparity_px=st.floats(1e-3, 50.0),
    ),
    false_points=st.floats(0.0, 5.0),
    seed=st.integers(0, 2**32),
)
def test_no_camera_reports_what_a_filter_cannot_use(camera: StereoCamera, false_points: float, seed: int) -> None:
    """Whatever the camera and its noise: points are ahead, and no farther than 1.2 times its range."""
    rng = np.random.default_rng(seed)
    config = LandmarkSensorConfig(camera=camera, false_points=false_points, max_measurements=20)
    sensor = LandmarkSensor(config, WALL, on_wall([[0.2 * i - 0.6, 0.3 - 0.1 * i] for i in range(7)]))
    for x in (0.0, 2.0, 3.5):
        for _ in range(10):
            (frame,) = sensor.measure(np.array([[x, 0.0, 0.0]]), rng).per_robot()
            points = frame.measurements.points
            assert frame.measurements.extent == (points[:, 2].min(initial=np.inf), np.abs(points).max(initial=0.0))
            assert np.all(points[:, 2] >= NEAREST)
            assert np.all(np.linalg.norm(points, axis=1) <= 1.2 * camera.max_range * (1.0 + 1e-9))
