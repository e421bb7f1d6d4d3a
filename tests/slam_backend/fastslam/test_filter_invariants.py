"""Properties of the filter that hold exactly for any noise, and extreme inputs."""

from typing import Any

import numpy as np
import pytest
from builders.filters import plain_filter
from builders.linear_world import measure
from builders.worlds import EXACT_MOTION, StereoWorld
from scipy import stats

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import StepReport
from slam_backend.geometry import compose, transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements

PROPOSALS = pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
LOOK = np.eye(1, 3, dtype=np.float32)
MOVE = np.array([0.25, 0.02, 0.3])


def drive(slam: FastSlam, world: StereoWorld, steps: int, noise: float = 1.0) -> tuple[FloatArray, list[StepReport]]:
    """Drive one robot in circles from the world's origin; return its true pose, own start frame, and the reports."""
    pose = np.zeros(3)
    reports = [slam.step([None], [world.measure(pose, world.visible(pose), noise)])]
    for _ in range(steps):
        odometry = MOVE + noise * world.rng.standard_normal(3) * slam.options.motion.sigmas(MOVE)
        pose = compose(pose, MOVE)
        reports.append(slam.step([odometry], [world.measure(pose, world.visible(pose), noise)]))
    return pose, reports


@PROPOSALS
def test_moving_the_start_moves_path_and_map(proposal: Any) -> None:
    """A start pose turned and shifted turns and shifts path and map, covariances included; decisions stay."""
    start = np.array([3.0, -7.0, 2.5])
    results = []
    for initial in ([0.0, 0.0, 0.0], start):
        world = StereoWorld(np.random.default_rng(4))
        slam = plain_filter(num_particles=7, camera=world.camera, proposal=proposal, seed=2, initial_poses=[initial])
        _, reports = drive(slam, world, 25)
        results.append((slam, reports))
    (a, reports_a), (b, reports_b) = results
    for x, y in zip(reports_a, reports_b, strict=True):
        np.testing.assert_array_equal(x.associations[0], y.associations[0])
    moved = a.map().moved(start)
    np.testing.assert_allclose(b.map().means, moved.means, atol=1e-9)
    np.testing.assert_allclose(b.map().covariances, moved.covariances, atol=1e-9)
    np.testing.assert_allclose(b.pose().mean[:2], compose(start, a.pose().mean)[:2], atol=1e-9)
    np.testing.assert_allclose(b.start_pose(), start)


@PROPOSALS
@pytest.mark.parametrize("num_robots", [1, 2])
@pytest.mark.parametrize("sigma", [None, 1e-6, 0.1])
def test_no_noise_means_no_error(proposal: Any, num_robots: int, sigma: float | None) -> None:
    """Exact odometry and exact measurements give exact poses and an exact map, associations unknown.

    However large the noise is said to be, by the camera or by covariances of the size `sigma` [m].
    """
    world = StereoWorld(np.random.default_rng(1))

    def seen(pose: FloatArray) -> Measurements:
        exact = world.measure(pose, world.visible(pose), 0.0)
        if sigma is None:
            return exact
        claimed, _ = measure(world.rng, pose, np.zeros((len(exact), 3)), sigma)
        return Measurements(exact.points, exact.descriptors, claimed.covariances)

    starts = np.array([[0.0, 0.0, 0.0], [0.4, -0.3, 2.0]])[:num_robots]
    slam = plain_filter(
        num_robots, 5, world.camera, EXACT_MOTION, proposal, seed=0, initial_poses=starts, new_landmark_gate=11.34
    )
    poses = starts.copy()
    for _ in range(60):
        poses = compose(poses, MOVE)
        report = slam.step([MOVE] * num_robots, [seen(pose) for pose in poses])
        assert report.ess == pytest.approx(5.0)
    result = slam.map()
    assert len(result) == len(world.landmarks)
    true = world.landmarks[np.argmax(result.descriptors @ world.descriptors.T, axis=1)]
    np.testing.assert_allclose(result.means, true, atol=1e-9)
    for robot in range(num_robots):
        np.testing.assert_allclose(slam.pose(robot).mean, poses[robot], atol=1e-9)
        assert np.abs(slam.pose(robot).covariance).max() < 1e-12


def seen_from(rng: np.random.Generator, landmark: FloatArray, pose: FloatArray, camera: StereoCamera) -> Measurements:
    """Measure one point with a covariance that comes with the measurement."""
    root = rng.normal(0.0, 0.1, (3, 3)) + 0.1 * np.eye(3)
    c, s = np.cos(pose[2]), np.sin(pose[2])
    offset = landmark - [pose[0], pose[1], 0.0]
    in_robot = np.array([c * offset[0] + s * offset[1], -s * offset[0] + c * offset[1], offset[2]])
    point = camera.camera_from_robot(in_robot) + root @ rng.standard_normal(3)
    return Measurements(point[None], LOOK, (root @ root.T)[None])


def weighted_mean(frames: list[tuple[FloatArray, Measurements]], camera: StereoCamera) -> tuple[FloatArray, FloatArray]:
    """Return mean and covariance of a point from independent measurements at known poses, in closed form."""
    information, vector = np.zeros((3, 3)), np.zeros(3)
    for pose, frame in frames:
        assert frame.covariances is not None
        turn = np.eye(3)
        turn[:2, :2] = [[np.cos(pose[2]), -np.sin(pose[2])], [np.sin(pose[2]), np.cos(pose[2])]]
        weight = np.linalg.inv(turn @ ROBOT_FROM_CAMERA @ frame.covariances[0] @ ROBOT_FROM_CAMERA.T @ turn.T)
        information += weight
        vector += weight @ transform_points(pose, camera.robot_from_camera(frame.points[0]))
    covariance = np.linalg.inv(information)
    return covariance @ vector, covariance


@PROPOSALS
def test_known_poses_make_it_independent_least_squares(proposal: Any) -> None:
    """With exact poses and linear measurements a landmark is the information-weighted mean of what was measured."""
    rng = np.random.default_rng(8)
    camera = StereoCamera(mount=(0.2, 0.1, 0.4))
    slam = plain_filter(1, 3, camera, proposal=proposal)
    landmark = np.array([4.0, 1.0, 0.7])
    frames = []
    for _ in range(30):
        pose = rng.uniform([-1.0, -1.0, -3.0], [1.0, 1.0, 3.0])
        frames.append((pose, seen_from(rng, landmark, pose, camera)))
        slam.step([None], [frames[-1][1]], identities=[[5]], poses=[pose])
    mean, covariance = weighted_mean(frames, camera)
    result = slam.map()
    np.testing.assert_allclose(result.means[0], mean, rtol=1e-9)
    np.testing.assert_allclose(result.covariances[0], covariance, rtol=1e-7, atol=1e-12)
    assert result.counts is not None
    assert result.counts[0] == 30


@PROPOSALS
def test_a_second_robot_corrects_what_the_first_has_just_updated(proposal: Any) -> None:
    """Algorithm 1, l. 16-18: current values, not those of t-1. Three looks in two steps weigh as three looks."""
    rng = np.random.default_rng(3)
    camera = StereoCamera()
    slam = plain_filter(2, 3, camera, proposal=proposal)
    landmark = np.array([3.0, 0.5, 0.2])
    poses = rng.uniform([-1.0, -1.0, -1.0], [1.0, 1.0, 1.0], (3, 3))
    frames = [(pose, seen_from(rng, landmark, pose, camera)) for pose in poses]
    slam.step([None, None], [frames[0][1], None], identities=[[1], None], poses=[poses[0], None])
    slam.step([None, None], [frames[1][1], frames[2][1]], identities=[[1], [1]], poses=[poses[1], poses[2]])
    mean, covariance = weighted_mean(frames, camera)
    np.testing.assert_allclose(slam.map().means[0], mean, rtol=1e-9)
    np.testing.assert_allclose(slam.map().covariances[0], covariance, rtol=1e-9, atol=1e-15)


@PROPOSALS
def test_weights_multiply_over_the_measurements_of_a_frame(proposal: Any) -> None:
    """Eqs. 3 and 11: log w grows by the sum of log N(v; v^, Z) over the B measurements, each Z from before."""
    camera = StereoCamera()
    rng = np.random.default_rng(6)
    points = np.array([[0.0, 0.0, 2.0], [1.0, 0.2, 3.0], [-1.0, 0.1, 4.0]])
    noise = np.array([np.diag(row) for row in rng.uniform(0.01, 0.04, (3, 3))])
    slam = plain_filter(1, 2, camera, proposal=proposal, resample_threshold=0.0, new_landmark_density=0.3)
    slam.step([None], [Measurements(points, np.eye(3), noise)], identities=[[1, 2, 3]], poses=[np.zeros(3)])
    np.testing.assert_allclose(slam.path_log_weights, 3.0 * np.log(0.3))  # l. 32: p0 for each new landmark
    again = points + rng.normal(0.0, 0.1, (3, 3))
    slam.step([None], [Measurements(again, np.eye(3), noise)], identities=[[1, 2, 3]], poses=[np.zeros(3)])
    expected = [stats.multivariate_normal(v, 2.0 * r).logpdf(w) for v, w, r in zip(points, again, noise, strict=True)]
    np.testing.assert_allclose(slam.path_log_weights - 3.0 * np.log(0.3), np.sum(expected))


@PROPOSALS
def test_k_robots_make_the_map_of_one_robot_with_their_measurements(proposal: Any) -> None:
    """At equal total measurements and known poses, three robots make exactly the map of one."""
    world = StereoWorld(np.random.default_rng(2))
    together, alone = (
        plain_filter(3, 2, world.camera, proposal=proposal),
        plain_filter(1, 2, world.camera, proposal=proposal),
    )
    for turn in np.linspace(0.0, 6.0, 13):
        pose = np.array([0.1, 0.2, turn])
        frame = world.measure(pose, world.visible(pose))
        parts = [Measurements(frame.points[i::3], frame.descriptors[i::3]) for i in range(3)]
        alone.step([None], [frame], poses=[pose])
        together.step([None] * 3, parts, poses=[pose] * 3)
    a, b = together.map(), alone.map()
    order_a, order_b = (np.argmax(m.descriptors @ world.descriptors.T, axis=1).argsort() for m in (a, b))
    np.testing.assert_allclose(a.means[order_a], b.means[order_b], atol=1e-12)
    np.testing.assert_allclose(a.covariances[order_a], b.covariances[order_b], atol=1e-12)


@PROPOSALS
def test_points_without_appearance_are_matched_by_names_or_by_place_alone(proposal: Any) -> None:
    """Descriptors of length 0 all look alike: a filter maps each point once, in bounded memory."""
    camera = StereoCamera()
    points = np.array([[0.0, 0.0, 2.0], [1.5, 0.2, 3.0]])
    frame = Measurements(points, np.empty((2, 0), dtype=np.float32))
    for names in (None, [[4, 5]]):
        slam = plain_filter(1, 5, camera, proposal=proposal)
        slam.step([None], [frame], names)
        start = slam.nbytes
        for _ in range(20):
            report = slam.step([None], [frame], names)
            np.testing.assert_array_equal(report.associations[0], [0, 1])
        assert slam.num_landmarks == 2
        assert slam.map().counts.tolist() == [21, 21]
        assert slam.nbytes < 2 * start


def least_eigenvalue(matrices: FloatArray) -> float:
    """Return the smallest eigenvalue of symmetric matrices (n, 3, 3)."""
    return float(np.linalg.eigvalsh(matrices).min())


@PROPOSALS
def test_covariances_stay_symmetric_and_positive_and_never_grow(proposal: Any) -> None:
    """Hundreds of updates leave them positive definite, and none adds uncertainty."""
    camera = StereoCamera()
    rng = np.random.default_rng(5)
    slam = plain_filter(1, 1, camera, proposal=proposal)
    landmark = np.array([[4.0, 1.0, 0.5], [2.0, -0.5, -0.1]])
    before: LandmarkMap | None = None
    for step in range(400):
        pose = np.array([0.4 * np.sin(0.1 * step), 0.4 * np.cos(0.07 * step), 0.2 * np.sin(0.03 * step)])
        c, s = np.cos(pose[2]), np.sin(pose[2])
        offsets = landmark - [pose[0], pose[1], 0.0]
        in_robot = np.column_stack([offsets[:, :2] @ np.array([[c, -s], [s, c]]), offsets[:, 2]])
        pixels = camera.project(camera.camera_from_robot(in_robot)) + rng.normal(0.0, 0.1, (2, 3))
        slam.step([None], [Measurements(camera.triangulate(pixels), np.eye(2))], identities=[[0, 1]], poses=[pose])
        now = slam.map()
        np.testing.assert_array_equal(now.covariances, now.covariances.transpose(0, 2, 1))
        assert least_eigenvalue(now.covariances) > 0.0
        if before is not None:
            assert least_eigenvalue(before.covariances - now.covariances) > -1e-15
        before = now
    assert before is not None
    np.testing.assert_allclose(before.means, landmark, atol=0.01)


@PROPOSALS
def test_covariances_stay_positive_definite_where_depth_is_all_but_unknown(proposal: Any) -> None:
    """Landmarks seen from all sides by a very poor camera, and predicted far beyond its range, stay definite."""
    camera = StereoCamera(sigma_px=0.4, sigma_disparity_px=50.0)
    rng = np.random.default_rng(5)
    slam = plain_filter(1, 1, camera, proposal=proposal, position_gate=1e12, new_landmark_gate=1e12)
    for step in range(200):
        bearing, away = rng.uniform(-np.pi, np.pi), 10.0 ** rng.uniform(0.0, 2.7) if step else 3.0
        pose = np.array([-away * np.cos(bearing), -away * np.sin(bearing), bearing + rng.uniform(-0.3, 0.3)])
        seen = min(away, 9.0) * np.array([np.sin(pose[2] - bearing), -0.1, np.cos(pose[2] - bearing)])
        slam.step([None], [Measurements(seen[None], LOOK)], identities=[[0]], poses=[pose])
        assert least_eigenvalue(slam.map().covariances) > 0.0
    assert slam.map().counts[0] > 100


@PROPOSALS
def test_weights_never_underflow(proposal: Any) -> None:
    """After a thousand steps without resampling the weights are finite and sum to one."""
    world = StereoWorld(np.random.default_rng(0), 9)
    slam = plain_filter(1, 5, world.camera, proposal=proposal, resample_threshold=0.0, seed=1)
    drive(slam, world, 1000)
    assert np.isfinite(slam.log_weights).all()
    assert np.isfinite(slam.path_log_weights).all()
    assert slam.weights.sum() == pytest.approx(1.0, abs=1e-12)
    assert 1.0 <= slam.step([None], [None]).ess <= 5.0


FRAME = Measurements([[0.0, 0.0, 2.0], [0.5, 0.1, 3.0]], np.eye(2, 5))
DRIVEN = [0.1, 0.0, 0.02]


def assert_sound(slam: FastSlam) -> None:
    """All that a filter tells is finite, weights sum to one, and covariances are positive definite."""
    assert slam.weights.sum() == pytest.approx(1.0, abs=1e-9)
    for robot in range(slam.num_robots):
        assert np.isfinite(slam.particles(robot)[0]).all()
        assert np.isfinite(slam.pose(robot).covariance).all()
    for estimate in ("best", "mixture"):
        result = slam.map(estimate)  # type: ignore[arg-type]
        assert np.isfinite(result.means).all()
        np.linalg.cholesky(result.covariances)  # raises where one is not positive definite


@PROPOSALS
@pytest.mark.parametrize("given", [False, True])
def test_thousands_of_measurements_in_a_step(proposal: Any, given: bool) -> None:
    """A frame of 3,000 points makes 3,000 landmarks, and the same frame again finds each of them."""
    rng = np.random.default_rng(2)
    looks = rng.normal(size=(3000, 64))
    looks /= np.linalg.norm(looks, axis=1, keepdims=True)
    points = rng.uniform([-4.0, -3.0, 1.0], [4.0, 3.0, 8.0], (3000, 3))
    frame = Measurements(points, looks, np.array([1e-4 * np.eye(3)] * 3000) if given else None)
    slam = plain_filter(2, 3, proposal=proposal)
    first = slam.step([None, None], [frame, None], poses=[np.zeros(3), None])
    assert (first.num_new, slam.map_size) == (3000, 3000)
    again = slam.step([None, DRIVEN], [frame, frame], poses=[np.zeros(3), np.zeros(3)])
    for found in again.associations:
        np.testing.assert_array_equal(found, first.associations[0])
    assert (again.num_new, slam.map_size) == (0, 3000)
    assert_sound(slam)


@PROPOSALS
@pytest.mark.parametrize("named", [False, True])
def test_a_landmark_at_the_camera_centre_is_one_like_others_with_given_covariances(proposal: Any, named: bool) -> None:
    """Seen from ahead, from its very place and from beyond, it is the mean of what was measured."""
    camera = StereoCamera(mount=(0.2, -0.1, 0.3))
    rng = np.random.default_rng(3)
    slam = plain_filter(1, 4, camera, proposal=proposal)
    seen = []
    for ahead in (2.0, 1.0, 0.0, 0.0, -0.5, -2.0):
        point = np.array([0.0, 0.0, ahead]) + (0.05 * rng.standard_normal(3) if ahead else 0.0)
        frame = Measurements([point], np.eye(1, 5), 0.0025 * np.eye(3)[None])
        slam.step([None], [frame], identities=[[9]] if named else None, poses=[[-ahead, 0.0, 0.0]])
        seen.append(camera.robot_from_camera(point) - [ahead, 0.0, 0.0])
    result = slam.map()
    assert len(result) == 1
    np.testing.assert_allclose(result.means[0], np.mean(seen, axis=0), atol=1e-12)
    np.testing.assert_allclose(result.covariances[0], 0.0025 / 6.0 * np.eye(3), atol=1e-15)
    assert_sound(slam)


@PROPOSALS
def test_driving_through_a_landmark(proposal: Any) -> None:
    """A robot with noisy odometry that passes through a landmark holds one landmark, near where it is."""
    rng = np.random.default_rng(4)
    slam = plain_filter(1, 50, proposal=proposal, seed=2)
    for step in range(21):
        point = np.array([0.0, 0.0, 1.0 - 0.1 * step]) + 0.02 * rng.standard_normal(3)
        frame = Measurements([point], np.eye(1, 5), 4e-4 * np.eye(3)[None])
        slam.step([[0.1, 0.0, 0.0] if step else None], [frame])
        assert_sound(slam)
    assert len(slam.map()) == 1
    np.testing.assert_allclose(slam.map("mixture").means[0], [1.0, 0.0, 0.0], atol=0.1)


@PROPOSALS
def test_a_landmark_at_the_camera_centre_cannot_be_seen_by_the_camera(proposal: Any) -> None:
    """What the camera model says of it is undefined: a stereo frame leaves it alone, even if the caller names it."""
    slam = plain_filter(1, 4, proposal=proposal)
    noise = 0.0025 * np.eye(3)[None]
    slam.step([None], [Measurements(np.zeros((1, 3)), np.eye(1, 5), noise)], identities=[[9]])
    before = slam.map()
    for names in ([[9]], None):
        slam.step([None], [Measurements([[0.0, 0.0, 2.0]], np.eye(1, 5))], identities=names)
        assert_sound(slam)
    after = slam.map()
    at = int(np.flatnonzero(after.ids == before.ids[0])[0])  # type: ignore[index]
    np.testing.assert_array_equal(after.means[at], before.means[0])
    np.testing.assert_array_equal(after.covariances[at], before.covariances[0])


@PROPOSALS
@pytest.mark.parametrize(
    ("point", "noise", "move"),
    [
        ([0.0, 0.0, 0.05], None, DRIVEN),
        ([500.0, -300.0, 990.0], None, DRIVEN),
        ([9000.0, 9000.0, 9000.0], 1e12, DRIVEN),
        ([0.1, 0.2, 3.0], 1.1e-14, DRIVEN),
        ([0.1, 0.2, 3.0], None, [100.0, -100.0, 0.0]),
        ([0.1, 0.2, 3.0], None, [0.0, 0.0, 3000.0]),
        ([0.1, 0.2, 3.0], 0.01, [100.0, -100.0, 3000.0]),
    ],
)
def test_extreme_readings_leave_the_filter_valid(proposal: Any, point: Any, noise: float | None, move: Any) -> None:
    """Far points, tiny and huge covariances and long jumps, among ordinary readings, leave the filter sound."""
    covariances = None if noise is None else noise * np.eye(3)[None]
    extreme = Measurements([point], np.eye(1, 5), covariances)
    slam = plain_filter(2, 6, proposal=proposal, seed=3)
    for step in range(40):
        odd = step % 4 == 3
        slam.step([move if odd else DRIVEN, DRIVEN], [extreme if odd else FRAME, FRAME if odd else extreme])
        assert_sound(slam)
