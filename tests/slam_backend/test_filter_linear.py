"""Where everything is linear and Gaussian the filter is measured against the exact posterior.

Each test states its false-alarm rate: how often a right filter would fail it if the seeds were drawn anew.
"""

from typing import Any

import numpy as np
import pytest
from linear_world import CAMERA, LANDMARKS, MOTION, LinearRun, kalman_filter, measure, simulate, turn
from scipy import stats

from slam_backend.fastslam.filter import FastSlam
from slam_backend.metrics import nees

PROPOSALS = pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
FALSE_ALARM = 1e-3


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
        slam = FastSlam(1, 2, CAMERA, proposal=proposal)
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
        slam = FastSlam(num_robots, 3, CAMERA, MOTION, seed=seed)
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
    slam = FastSlam(1, 500, CAMERA, MOTION, proposal, seed=seed, resample_threshold=0.7)
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


@PROPOSALS
def test_whole_runs_are_chi_square_where_nothing_is_linearised(proposal: Any) -> None:
    """NEES of the position and of a landmark over 150 runs of 8 steps; false alarm 1e-3 each.

    500 particles leave an excess of a few per cent, hence 5 % above the interval.
    """
    position_squares, landmark_squares = [], []
    for seed in range(150):
        run = simulate(1000 + seed, 8, 0.12)
        slam = drive(run, proposal, seed)
        estimate = slam.pose()
        error = estimate.mean[:2] - run.poses[-1, :2]
        position_squares.append(error @ np.linalg.solve(estimate.covariance[:2, :2], error))
        result = slam.map("mixture")
        first = int(np.argmax(result.descriptors[:, 0]))
        landmark_squares.append(float(nees([result.means[first] - LANDMARKS[0]], result.covariances[[first]])[0]))
    for squares, dimension in ((position_squares, 2), (landmark_squares, 3)):
        low, high = stats.chi2.interval(1.0 - FALSE_ALARM, dimension * len(squares))
        assert low < np.sum(squares) < 1.05 * high


@PROPOSALS
def test_a_known_path_makes_it_independent_kalman_filters(proposal: Any) -> None:
    """Two robots on known paths: each landmark is a Kalman filter of its own, to 1e-9, whatever else is seen."""
    rng = np.random.default_rng(6)
    landmarks = rng.uniform([-5.0, -5.0, -1.0], [5.0, 5.0, 1.0], (5, 3))
    slam = FastSlam(2, 3, CAMERA, proposal=proposal)
    means: dict[int, Any] = {}
    covariances: dict[int, Any] = {}
    for _ in range(40):
        poses = rng.uniform([-2.0, -2.0, -3.0], [2.0, 2.0, 3.0], (2, 3))
        names = [rng.permutation(5)[: rng.integers(0, 6)] for _ in range(2)]
        seen = [measure(rng, pose, landmarks[some], 0.1) for pose, some in zip(poses, names, strict=True)]
        slam.step([None, None], [frame for frame, _ in seen], identities=names, poses=list(poses))
        for pose, some, (frame, noises) in zip(poses, names, seen, strict=True):
            for name, point, noise in zip(some.tolist(), frame.points, noises, strict=True):
                z = turn(pose[2]) @ CAMERA.robot_from_camera(point) + [pose[0], pose[1], 0.0]
                r = turn(pose[2]) @ noise @ turn(pose[2]).T
                if name not in means:
                    means[name], covariances[name] = z, r
                    continue
                gain = covariances[name] @ np.linalg.inv(covariances[name] + r)
                means[name] = means[name] + gain @ (z - means[name])
                covariances[name] = (np.eye(3) - gain) @ covariances[name]
    result = slam.map()
    assert len(result) == 5
    for mean, covariance in zip(result.means, result.covariances, strict=True):
        name = int(np.argmin(np.linalg.norm(landmarks - mean, axis=1)))
        np.testing.assert_allclose(mean, means[name], atol=1e-9)
        np.testing.assert_allclose(covariance, covariances[name], atol=1e-9 * covariances[name].max())
