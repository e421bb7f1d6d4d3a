"""Whether errors are as large as the filter says: chi-square tests with fixed seeds.

Each test states its false-alarm rate: how often a right filter would fail it if the seed were drawn anew.
"""

from typing import Any

import numpy as np
import pytest
from linear_world import CAMERA, LANDMARKS, turn
from scipy import stats
from stereo_world import EXACT_MOTION, StereoWorld

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose, transform_points, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.metrics import nees
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel

PROPOSALS = pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
FALSE_ALARM = 1e-3


def assert_chi_square(values: Any, dimension: int) -> None:
    """The sum of independent squares is chi-square; two-sided, false alarm 1e-3."""
    values = np.asarray(values)
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, dimension * values.size)
    assert low < values.sum() < high, f"mean {values.mean():.3f} of {values.size}, ideal {dimension}"


def map_errors(world: StereoWorld, result: LandmarkMap) -> FloatArray:
    """Return estimate minus truth (N, 3) of each landmark, recognised by its look."""
    return result.means - world.landmarks[np.argmax(result.descriptors @ world.descriptors.T, axis=1)]


@PROPOSALS
def test_innovations_and_map_at_known_poses(proposal: Any) -> None:
    """With exact poses NIS and landmark NEES are chi-square with 3 degrees of freedom; false alarm 1e-3 each."""
    total, matched = 0.0, 0
    for seed in range(8):
        world = StereoWorld(np.random.default_rng(seed))
        slam = FastSlam(1, 2, world.camera, proposal=proposal)
        for step in range(60):
            pose = np.array([0.5 * np.cos(0.1 * step), 0.5 * np.sin(0.1 * step), 0.4 * step])
            names = world.visible(pose)
            report = slam.step([None], [world.measure(pose, names)], identities=[names], poses=[pose])
            old = len(names) - report.num_new
            total += report.nis * old if old else 0.0
            matched += old
        result = slam.map()
        assert_chi_square(nees(map_errors(world, result), result.covariances), 3)
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, 3 * matched)
    assert low < total < high


def test_information_in_place_of_a_covariance_is_seen_at_once() -> None:
    """Algorithm 1, l. 31 *: G^-1 R G^-T is an honest covariance of a new landmark, the printed G^T R^-1 G is not.

    NEES of 400 new landmarks, ideal 3; false alarm 1e-3.
    """
    rng = np.random.default_rng(0)
    camera = StereoCamera()
    pose = np.array([1.0, -2.0, 0.8])
    points = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], (400, 3))
    noise = np.array([np.diag(row) for row in rng.uniform(0.001, 0.01, (400, 3))])
    measured = points + rng.standard_normal((400, 3)) * np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    slam = FastSlam(1, 1, camera, initial_poses=[pose])
    slam.step([None], [Measurements(measured, rng.normal(size=(400, 5)), noise)], identities=[range(400)])
    true = transform_points(pose, camera.robot_from_camera(points))
    result = slam.map()
    assert_chi_square(nees(result.means - true, result.covariances), 3)
    printed = np.linalg.inv(result.covariances)  # G is a rotation: G^T R^-1 G is the inverse of ours
    assert nees(result.means - true, printed).mean() < 0.01


def test_a_pose_refined_by_one_landmark() -> None:
    """One look back at a landmark after a noisy motion: pose NEES and NIS are chi-square; false alarm 1e-3 each.

    All particles share the start and the map, so that N(x^, P^) is the whole posterior. Motion and noise are small
    enough for the linearisation to hold.
    """
    motion = OdometryModel(sigma_along=0.05, sigma_across=0.05, sigma_heading=0.02, sigma_turn=0.0)
    move = np.array([0.5, 0.0, 0.1])
    world = StereoWorld(np.random.default_rng(12))
    names = world.visible(move)[:1]
    pose_squares, innovation_squares = [], []
    for run in range(250):
        slam = FastSlam(1, 3, world.camera, motion, seed=run)
        slam.step([None], [world.measure(np.zeros(3), names)], identities=[names])
        odometry = move + world.rng.standard_normal(3) * motion.sigmas(move)
        report = slam.step([odometry], [world.measure(move, names)], identities=[names])
        estimate = slam.pose()
        error = estimate.mean - move
        error[2] = wrap_angle(error[2])
        pose_squares.append(error @ np.linalg.solve(estimate.covariance, error))
        innovation_squares.append(report.nis)
    assert_chi_square(innovation_squares, 3)
    assert_chi_square(pose_squares, 3)


@pytest.mark.parametrize(("sigma", "tolerance"), [(1e-2, 1e-9), (1e-3, 1e-5), (1e-4, 1e-2)])
@pytest.mark.parametrize("move", [np.array([0.5, 0.0, 0.1]), np.array([3.0, 0.0, 1.0])])
def test_the_reported_nis_is_the_innovation_under_its_whole_covariance(
    sigma: float, tolerance: float, move: FloatArray
) -> None:
    """r^T (Sigma + R + H P H^T)^-1 r, written out, for one look back after a noisy motion.

    The larger the motion's noise beside the measurement's (here up to 5,000 times), the more digits the compiled form
    loses; this is how many it may.
    """
    motion = OdometryModel()
    sigmas = motion.sigmas(move)
    for seed in range(30):
        rng = np.random.default_rng(seed)
        slam = FastSlam(1, 3, CAMERA, motion, seed=seed)
        pose = compose(np.zeros(3), move + rng.standard_normal(3) * sigmas)
        points = []
        for place in (np.zeros(3), pose):
            in_robot = turn(place[2]).T @ (LANDMARKS[0] - [place[0], place[1], 0.0])
            points.append(CAMERA.camera_from_robot(in_robot) + sigma * rng.standard_normal(3))
        frames = [Measurements([point], np.eye(1, 5), sigma**2 * np.eye(3)[None]) for point in points]
        slam.step([None], [frames[0]], identities=[[0]])
        report = slam.step([move], [frames[1]], identities=[[0]])
        mean = CAMERA.robot_from_camera(points[0])
        by_pose = np.array([[1.0, 0.0, move[1] - mean[1]], [0.0, 1.0, mean[0] - move[0]], [0.0, 0.0, 0.0]])
        innovation = turn(move[2]) @ CAMERA.robot_from_camera(points[1]) + [move[0], move[1], 0.0] - mean
        whole = 2.0 * sigma**2 * np.eye(3) + by_pose @ np.diag(sigmas**2) @ by_pose.T
        assert report.nis == pytest.approx(innovation @ np.linalg.solve(whole, innovation), abs=tolerance)


def test_mixture_covariances_hold_what_the_path_may_be() -> None:
    """Sec. 3.2 *: covariances of the best particle are conditioned on its path; those of the mixture are honest.

    Landmarks first seen after a long blind motion, 120 runs: mean NEES of "best" far above its dimension 3, that of
    "mixture" near it. M = 300 estimates a covariance to a few per cent, hence 5 % on either side of the interval; false
    alarm below 1e-3.
    """
    motion = OdometryModel(sigma_along=0.1, sigma_across=0.1, sigma_heading=0.005)
    world = StereoWorld(np.random.default_rng(0))
    best, mixture = [], []
    rng = np.random.default_rng(31)
    for run in range(120):
        slam = FastSlam(1, 300, world.camera, motion, "fastslam1", seed=run)
        odometry = np.array([1.5, 0.0, 0.3])
        pose = compose(np.zeros(3), odometry + rng.standard_normal(3) * motion.sigmas(odometry))
        slam.step([odometry], [world.measure(pose, world.visible(pose)[:1])])
        for estimate, values in (("best", best), ("mixture", mixture)):
            result = slam.map(estimate)  # type: ignore[arg-type]
            values.append(nees(map_errors(world, result), result.covariances)[0])
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, 3 * len(mixture))
    assert 0.95 * low < sum(mixture) < 1.05 * high
    assert np.mean(best) > 30.0


def test_the_first_robot_to_see_a_landmark_does_not_matter() -> None:
    """Two robots at exact poses that see the same landmarks in either order leave equally honest maps."""
    for order in ([0, 1], [1, 0]):
        world = StereoWorld(np.random.default_rng(5))
        starts = np.array([[0.3, 0.2, 0.1], [-0.4, 0.1, 0.5]])[order]
        slam = FastSlam(2, 3, world.camera, EXACT_MOTION, initial_poses=starts)
        for _ in range(40):
            frames = [world.measure(pose, world.visible(pose)) for pose in starts]
            slam.step([np.zeros(3)] * 2, frames)
        result = slam.map()
        assert_chi_square(nees(map_errors(world, result), result.covariances), 3)
