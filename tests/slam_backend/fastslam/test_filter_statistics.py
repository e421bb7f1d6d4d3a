"""Whether errors are as large as the filter says.

Each test states its false-alarm rate: how often a right filter would fail it with other seeds.
Particle filters grow over-confident; where no closed form gives a bound, it was measured on other seeds, as stated.
"""

from typing import Any

import numpy as np
import pytest
from builders.filters import plain_filter
from builders.linear_world import CAMERA, LANDMARKS, MOTION, LinearRun, kalman_filter, measure, simulate, turn
from builders.worlds import StereoWorld
from scipy import stats

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
        slam = plain_filter(1, num_particles=2, camera=world.camera, proposal=proposal)
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


def test_information_in_place_of_a_covariance_is_detected() -> None:
    """Algorithm 1, l. 31 *: G^-1 R G^-T is an honest covariance of a new landmark, the printed G^T R^-1 G is not.

    NEES of 400 new landmarks, ideal 3; false alarm 1e-3.
    """
    rng = np.random.default_rng(0)
    camera = StereoCamera()
    pose = np.array([1.0, -2.0, 0.8])
    points = rng.uniform([-1.0, -0.8, 2.0], [1.0, 0.8, 4.0], (400, 3))
    noise = np.array([np.diag(row) for row in rng.uniform(0.001, 0.01, (400, 3))])
    measured = points + rng.standard_normal((400, 3)) * np.sqrt(np.diagonal(noise, axis1=1, axis2=2))
    slam = plain_filter(1, num_particles=1, camera=camera, initial_poses=[pose])
    slam.step([None], [Measurements(measured, rng.normal(size=(400, 5)), noise)], identities=[range(400)])
    true = transform_points(pose, camera.robot_from_camera(points))
    result = slam.map()
    assert_chi_square(nees(result.means - true, result.covariances), 3)
    printed = np.linalg.inv(result.covariances)  # G is a rotation: G^T R^-1 G is the inverse of ours
    assert nees(result.means - true, printed).mean() < 0.01


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
        slam = plain_filter(1, num_particles=3, camera=CAMERA, motion=motion, seed=seed)
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


def test_mixture_covariances_include_the_path_uncertainty() -> None:
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
        slam = plain_filter(1, num_particles=300, camera=world.camera, motion=motion, proposal="fastslam1", seed=run)
        odometry = np.array([1.5, 0.0, 0.3])
        pose = compose(np.zeros(3), odometry + rng.standard_normal(3) * motion.sigmas(odometry))
        slam.step([odometry], [world.measure(pose, world.visible(pose)[:1])])
        for estimate, values in (("best", best), ("mixture", mixture)):
            result = slam.map(estimate)  # type: ignore[arg-type]
            values.append(nees(map_errors(world, result), result.covariances)[0])
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, 3 * len(mixture))
    assert 0.95 * low < sum(mixture) < 1.05 * high
    assert np.mean(best) > 30.0


def assert_distributed_as_chi_square(values: Any, dimension: int) -> None:
    """Kolmogorov and Smirnov's test of the whole distribution, and the two-sided test of its sum; 1e-3 each."""
    values = np.asarray(values)
    assert stats.kstest(values, stats.chi2(dimension).cdf).pvalue > FALSE_ALARM
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, dimension * values.size)
    assert low < values.sum() < high, f"mean {values.mean():.3f} of {values.size}, ideal {dimension}"


@PROPOSALS
def test_one_landmark_seen_from_a_known_path(proposal: Any) -> None:
    """Innovations are white and chi-square with 3 degrees of freedom, and so is the error in the end; 5e-3 in all.

    The correlation of an innovation's square with that of the step before is zero for a right gain.
    """
    rng = np.random.default_rng(0)
    squares, errors, covariances = [], [], []
    for _ in range(60):
        slam = plain_filter(1, num_particles=2, camera=CAMERA, proposal=proposal)
        run = []
        for step in range(25):
            pose = rng.uniform([-1.0, -1.0, -3.0], [1.0, 1.0, 3.0])
            frame, _ = measure(rng, pose, LANDMARKS[:1], 0.1)
            report = slam.step([None], [frame], identities=[[4]], poses=[pose])
            if step:
                run.append(report.nis)
        squares.append(run)
        errors.append(slam.map().means[0] - LANDMARKS[0])
        covariances.append(slam.map().covariances[0])
    assert_distributed_as_chi_square(np.ravel(squares), 3)
    assert_distributed_as_chi_square(nees(errors, covariances), 3)
    now, before = np.array(squares)[:, 1:].ravel(), np.array(squares)[:, :-1].ravel()
    assert stats.pearsonr(now, before).pvalue > FALSE_ALARM


@pytest.mark.parametrize("num_robots", [1, 2])
def test_a_position_refined_by_one_landmark(num_robots: int) -> None:
    """One look back after a noisy motion: errors of the position are chi-square (2), innovations (3); 2e-3 each.

    All particles share the start and the map, so that N(x^, P^) is the whole posterior; no linearisation disturbs it.
    In a team the first robot stands, and the second looks.
    """
    pose_squares, innovation_squares = [], []
    for seed in range(500):
        run = simulate(seed, 1, 0.08, num_landmarks=1)
        slam = plain_filter(num_robots, num_particles=3, camera=CAMERA, motion=MOTION, seed=seed)
        idle: list[Any] = [None] * (num_robots - 1)
        slam.step([*idle, None], [*idle, run.frames[0]], identities=[*idle, [7]])
        report = slam.step([*idle, run.odometry[0]], [*idle, run.frames[1]], identities=[*idle, [7]])
        estimate = slam.pose(num_robots - 1)
        error = estimate.mean[:2] - run.poses[1, :2]
        pose_squares.append(error @ np.linalg.solve(estimate.covariance[:2, :2], error))
        innovation_squares.append(report.nis)
        assert estimate.mean[2] == pytest.approx(run.poses[1, 2], abs=1e-12)
    assert_distributed_as_chi_square(pose_squares, 2)
    assert_distributed_as_chi_square(innovation_squares, 3)


def drive(run: LinearRun, proposal: Any, seed: int) -> FastSlam:
    """Return a filter of 500 particles after a run, identities known."""
    slam = plain_filter(
        1, num_particles=500, camera=CAMERA, motion=MOTION, proposal=proposal, seed=seed, resample_threshold=0.7
    )
    names = [list(range(len(run.frames[0])))]
    slam.step([None], [run.frames[0]], identities=names)
    for odometry, frame in zip(run.odometry, run.frames[1:], strict=True):
        slam.step([odometry], [frame], identities=names)
    return slam


@PROPOSALS
def test_the_particles_stand_for_the_exact_posterior(proposal: Any) -> None:
    """Mean and covariance over many filters with the same readings are those of the Kalman filter.

    Position and all landmarks after 8 steps, with resampling in between: t-tests over 40 filters of 500 particles, 22
    means and variances, false alarm 1e-3 together; 1 % of a standard deviation, 2 % of a variance are allowed for what
    500 particles are biased.
    """
    run = simulate(3, 8, 0.12)
    mean, covariance = kalman_filter(run)
    sigmas = np.sqrt(np.diag(covariance))
    means, variances = [], []
    for seed in range(40):
        slam = drive(run, proposal, seed)
        result = slam.map("mixture")
        order = np.argmax(result.descriptors, axis=1).argsort()
        position = slam.pose()
        means.append(np.concatenate([position.mean[:2], result.means[order].ravel()]))
        blocks = np.diagonal(result.covariances[order], axis1=1, axis2=2)
        variances.append(np.concatenate([np.diag(position.covariance)[:2], blocks.ravel()]))
    limit = stats.t.isf(FALSE_ALARM / 44, 39)
    for values, ideal, scale, allowed in (
        (np.array(means), mean, sigmas, 0.01),
        (np.array(variances), sigmas**2, sigmas**2, 0.02),
    ):
        spread = values.std(axis=0, ddof=1) / np.sqrt(40)
        excess = np.abs(values.mean(axis=0) - ideal) - allowed * scale
        assert np.all(excess < limit * spread), (excess / spread).round(1)
        assert np.all(spread < 0.05 * scale), "the test is sharp"


MOVE = np.array([0.25, 0.02, 0.3])  # 21 steps are one turn


def run(seed: int, num_particles: int, steps: int) -> tuple[FloatArray, float]:
    """Drive in circles, associations unknown; return NEES / 3 of the pose at each step, and the mean NIS / 3."""
    world = StereoWorld(np.random.default_rng(seed))
    slam = plain_filter(1, num_particles=num_particles, camera=world.camera, seed=seed)
    pose = np.zeros(3)
    slam.step([None], [world.measure(pose, world.visible(pose))])
    errors, covariances, innovations = [], [], []
    for _ in range(steps):
        odometry = MOVE + world.rng.standard_normal(3) * slam.options.motion.sigmas(MOVE)
        pose = compose(pose, MOVE)
        report = slam.step([odometry], [world.measure(pose, world.visible(pose))])
        estimate = slam.pose()
        errors.append(estimate.mean - pose)
        errors[-1][2] = wrap_angle(errors[-1][2])
        covariances.append(estimate.covariance)
        innovations.append(report.nis)
    return nees(errors, covariances) / 3.0, float(np.nanmean(innovations)) / 3.0


@pytest.mark.parametrize(("steps", "lowest", "highest"), [(20, 0.5, 1.45), (60, 0.5, 6.3)])
def test_uncertainty_of_whole_runs(steps: int, lowest: float, highest: float) -> None:
    """The median of NEES / 3 is near its ideal (0.79) in a first turn, and bounded after three; NIS / 3 is near 1.

    100 particles, 20 runs. Bounds: 99.9 % of 3000 draws of 20 among 400 (three turns: 240) runs with seeds from 100 on
    lie between 0.51 and 1.42 (1.8 and 6.23: over-confident), their NIS between 0.85 and 1.08.
    """
    runs = [run(seed, 100, steps) for seed in range(20)]
    assert lowest < np.median([squares for squares, _ in runs]) < highest
    assert 0.85 < np.mean([innovations for _, innovations in runs]) < 1.1


def test_more_particles_are_less_overconfident() -> None:
    """Over three turns, 200 particles claim less certainty than 10 in the same runs; Wilcoxon's test, p < 1e-3."""
    few, many = ([np.log(run(seed, num_particles, 60)[0]).mean() for seed in range(20)] for num_particles in (10, 200))
    assert stats.wilcoxon(few, many, alternative="greater").pvalue < 1e-3
