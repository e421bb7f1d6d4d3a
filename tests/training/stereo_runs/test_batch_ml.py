"""Batch maximum likelihood and the ideal online estimate: laws, statistics, and an independent implementation."""

from dataclasses import replace

import numpy as np
import pytest
from gtsam_problem import solve_with_gtsam
from scipy import stats

from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between, inverse, transform_points, wrap_angle
from slam_backend.models.measurements import Measurements
from studies.bounds.online import ideal_online
from training.stereo_runs.batch_ml import BatchEstimate, batch_ml, most_likely
from training.stereo_runs.batch_problem import BatchProblem, Estimate
from training.stereo_runs.runs import FALSE_POINT, PRESETS, NoisePreset, RunSpec, StereoRun, simulate_run

FALSE_ALARM = 1e-3
SPEC = RunSpec(robots=2, length=12.0, measurements=9, landmarks=170)


@pytest.fixture(scope="module")
def run() -> StereoRun:
    """Two robots for 12 m."""
    return simulate_run(SPEC, seed=4)


@pytest.fixture(scope="module")
def problem(run: StereoRun) -> BatchProblem:
    """Least-squares problem of the run."""
    return BatchProblem.of_run(run)


@pytest.fixture(scope="module")
def batch(problem: BatchProblem) -> BatchEstimate:
    """Batch estimate of the problem."""
    return batch_ml(problem)


def noiseless(run: StereoRun) -> StereoRun:
    """Return the same run with exact readings."""
    camera = run.spec.noise.camera
    frames = []
    for step, (seen, names) in enumerate(zip(run.frames, run.names, strict=True)):
        exact = []
        for robot, (frame, name) in enumerate(zip(seen, names, strict=True)):
            local = transform_points(inverse(run.true_paths[robot, step]), run.landmarks[name])
            exact.append(Measurements(camera.camera_from_robot(local), frame.descriptors))
        frames.append(tuple(exact))
    odometry = run.odometry.copy()
    odometry[1:] = between(run.true_paths[:, :-1], run.true_paths[:, 1:]).transpose(1, 0, 2)
    return replace(run, frames=tuple(frames), odometry=odometry)


def pose_errors(paths: FloatArray, run: StereoRun) -> FloatArray:
    """Return estimate minus truth (K, T, 3)."""
    errors = paths - run.true_paths
    errors[..., 2] = wrap_angle(errors[..., 2])
    return errors


def squares(errors: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return e^T P^-1 e over the last axes."""
    return np.einsum("...i,...i->...", errors, np.linalg.solve(covariances, errors[..., None])[..., 0])


@pytest.mark.parametrize("metric", [False, True])
def test_jacobians_of_measurements_match_central_differences(problem: BatchProblem, metric: bool) -> None:
    """Moving one pose or landmark changes its residuals as the Jacobians predict (central differences)."""
    at = problem.dead_reckoning()
    sights = problem.sights(at, metric)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = 1e-6
        ahead, behind = (problem.sights(Estimate(at.paths + s, at.landmarks), metric).residuals for s in (step, -step))
        np.testing.assert_allclose((ahead - behind) / 2e-6, sights.by_pose[..., axis], rtol=1e-4, atol=1e-3)
        ahead, behind = (problem.sights(Estimate(at.paths, at.landmarks + s), metric).residuals for s in (step, -step))
        np.testing.assert_allclose((ahead - behind) / 2e-6, sights.by_landmark[..., axis], rtol=1e-4, atol=1e-3)


def test_jacobians_of_odometry_match_central_differences(problem: BatchProblem) -> None:
    """Moving every second pose changes the residuals before and after it as the Jacobians predict."""
    at = problem.dead_reckoning()
    moves = problem.moves(at)
    for axis in range(3):
        step = np.zeros_like(at.paths)
        step[:, 1::2, axis] = 1e-6
        ahead, behind = (problem.moves(Estimate(at.paths + s, at.landmarks)).residuals for s in (step, -step))
        expected = np.where(
            (np.arange(problem.num_steps - 1) % 2 == 0)[None, :, None], moves.by_second[..., axis],
            moves.by_first[..., axis],
        )  # fmt: skip
        np.testing.assert_allclose((ahead - behind) / 2e-6, expected, rtol=1e-5, atol=1e-3)


def test_residuals_are_standard_normal_at_the_truth(run: StereoRun, problem: BatchProblem) -> None:
    """The squares of all residuals at the true paths and landmarks are chi-square; false alarm 1e-3 each."""
    truth = Estimate(run.true_paths, run.landmarks[problem.names])
    for residuals in (problem.sights(truth).residuals, problem.moves(truth).residuals):
        low, high = stats.chi2.interval(1.0 - FALSE_ALARM, residuals.size)
        assert low < (residuals**2).sum() < high


def test_exact_readings_give_the_truth(run: StereoRun) -> None:
    """Without noise the estimate equals the truth, even from a distant start, with zero residuals."""
    problem = BatchProblem.of_run(noiseless(run))
    rng = np.random.default_rng(0)
    away = problem.dead_reckoning()
    away.paths[:, 1:] += rng.normal(scale=[0.1, 0.1, 0.02], size=away.paths[:, 1:].shape)
    for start in (None, away):
        estimate = batch_ml(problem, start)
        np.testing.assert_allclose(pose_errors(estimate.paths, run), 0.0, atol=1e-8)
        np.testing.assert_allclose(estimate.landmarks, run.landmarks[problem.names], atol=1e-7)
        assert estimate.cost < 1e-9


def test_the_estimate_is_the_local_minimum(run: StereoRun, problem: BatchProblem, batch: BatchEstimate) -> None:
    """The gradient is zero; descent from the truth ends at the same point; the cost there is chi-square (1e-3)."""
    assert batch.gradient < 1e-5
    again = batch_ml(problem, Estimate(run.true_paths, run.landmarks[problem.names]))
    np.testing.assert_allclose(again.paths, batch.paths, atol=1e-7)
    np.testing.assert_allclose(again.landmarks, batch.landmarks, atol=1e-6)
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, batch.freedom)
    assert low < batch.cost < high
    np.testing.assert_array_equal(batch.paths[:, 0], run.true_paths[:, 0])


def test_covariances_match_the_dense_inverse(problem: BatchProblem, batch: BatchEstimate) -> None:
    """The blocks by elimination equal those of the dense inverse of J^T J over all unknowns."""
    at = Estimate(batch.paths, batch.landmarks)
    sights, moves = problem.sights(at), problem.moves(at)
    robots, steps, _ = batch.paths.shape
    poses = robots * steps
    jacobian = np.zeros((len(problem.points) + robots * (steps - 1), 3, poses + len(batch.landmarks), 3))
    each = np.arange(len(problem.points))
    jacobian[each, :, problem.robots * steps + problem.steps] = sights.by_pose
    jacobian[each, :, poses + problem.landmarks] = sights.by_landmark
    row = len(each)
    for robot in range(robots):
        for step in range(steps - 1):
            jacobian[row, :, robot * steps + step] = moves.by_first[robot, step]
            jacobian[row, :, robot * steps + step + 1] = moves.by_second[robot, step]
            row += 1
    jacobian = np.delete(jacobian, [robot * steps for robot in range(robots)], axis=2)
    flat = jacobian.reshape(3 * row, -1)
    inverted = np.linalg.inv(flat.T @ flat)
    blocks = np.array([inverted[i : i + 3, i : i + 3] for i in range(0, len(inverted), 3)])
    split = poses - robots
    np.testing.assert_allclose(batch.path_covariances[:, 1:].reshape(-1, 3, 3), blocks[:split], rtol=1e-5, atol=1e-12)
    np.testing.assert_allclose(batch.landmark_covariances, blocks[split:], rtol=1e-5, atol=1e-12)


def test_errors_agree_with_the_covariances() -> None:
    """Over 50 independent runs the last pose and a landmark have chi-square errors, batch and online; 1e-3 each."""
    spec = RunSpec(length=3.0, measurements=7, landmarks=170)
    found: dict[str, list[float]] = {"pose": [], "landmark": [], "online": []}
    for seed in range(50):
        run = simulate_run(spec, seed)
        problem = BatchProblem.of_run(run)
        batch = batch_ml(problem)
        online = ideal_online(problem, batch)
        found["pose"].append(squares(pose_errors(batch.paths, run)[0, -1], batch.path_covariances[0, -1]))
        error = batch.landmarks[-1] - run.landmarks[batch.names[-1]]
        found["landmark"].append(squares(error, batch.landmark_covariances[-1]))
        found["online"].append(squares(pose_errors(online.paths, run)[0, 6], online.covariances[0, 6]))
    low, high = stats.chi2.interval(1.0 - FALSE_ALARM, 3 * 50)
    for name, values in found.items():
        assert low < sum(values) < high, name


def test_after_the_last_step_online_and_batch_agree(problem: BatchProblem, batch: BatchEstimate) -> None:
    """The Kalman filter ends with the map, the last poses and the covariances of the elimination."""
    online = ideal_online(problem, batch)
    np.testing.assert_allclose(online.landmarks, batch.landmarks, atol=1e-6)
    np.testing.assert_allclose(online.landmark_covariances, batch.landmark_covariances, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(online.paths[:, -1], batch.paths[:, -1], atol=1e-7)
    np.testing.assert_allclose(online.covariances[:, -1], batch.path_covariances[:, -1], rtol=1e-6, atol=1e-12)


def test_later_readings_reduce_covariances(problem: BatchProblem, batch: BatchEstimate) -> None:
    """At every step the online covariance minus the batch covariance is positive semi-definite."""
    online = ideal_online(problem, batch)
    difference = online.covariances - batch.path_covariances
    assert np.linalg.eigvalsh(difference).min() > -1e-11
    assert np.trace(difference[:, 5], axis1=1, axis2=2).min() > 1e-6


def test_a_robust_kernel_withstands_false_points(run: StereoRun) -> None:
    """With 3 % of the points metres off, the kernel keeps the path within 3 sigmas of the clean one; squares do not."""
    clean = BatchProblem.of_run(run)
    rng = np.random.default_rng(1)
    points = clean.points.copy()
    wrong = rng.random(len(points)) < 0.03
    points[wrong] *= rng.uniform(0.4, 0.7, (int(wrong.sum()), 1))
    spoilt = replace(clean, points=points)
    reference = batch_ml(clean)
    spread = np.sqrt(np.trace(reference.path_covariances[:, -1, :2, :2], axis1=1, axis2=2))
    robust, plain = (batch_ml(spoilt, robust=scale) for scale in (3.0, None))
    apart = [np.linalg.norm((e.paths - reference.paths)[:, -1, :2], axis=1) for e in (robust, plain)]
    assert (apart[0] < 3.0 * spread).all()
    assert (apart[1] > 5.0 * spread).all()


def test_measured_landmarks_are_estimated_once(run: StereoRun, problem: BatchProblem, batch: BatchEstimate) -> None:
    """Every measured landmark is estimated once, under its own index; false points are left out."""
    np.testing.assert_array_equal(np.sort(batch.names), run.measured_landmarks())
    np.testing.assert_allclose(batch.landmarks, run.landmarks[batch.names], atol=0.5)
    hidden = simulate_run(SPEC.replace(association="unknown", outliers=0.2), seed=4)
    named = np.concatenate([names for step in hidden.names for names in step])
    kept = BatchProblem.of_run(hidden)
    assert len(kept.points) == np.count_nonzero(named != FALSE_POINT) < len(named)
    assert kept.names.min() >= 0


def test_nothing_to_estimate_is_refused(problem: BatchProblem) -> None:
    """A run without measurements and a scale that is not positive are refused."""
    none = np.zeros(0, dtype=np.int64)
    empty = replace(problem, points=np.zeros((0, 3)), robots=none, steps=none, landmarks=none, names=none)
    with pytest.raises(ValueError, match="problem: expected two steps and a measurement, got a run without them"):
        batch_ml(empty)
    with pytest.raises(ValueError, match="robust: expected a finite number > 0, got 0"):
        batch_ml(problem, robust=0.0)


@pytest.mark.slow
@pytest.mark.parametrize("preset", sorted(PRESETS))
def test_gtsam_gives_the_same_estimate(preset: str) -> None:
    """An independent library with its own factors gives the same paths, landmarks and covariances."""
    gtsam = pytest.importorskip("gtsam", reason="gtsam, an optional peer, is not installed: pip install gtsam")
    noise: NoisePreset = PRESETS[preset]
    run = simulate_run(RunSpec(robots=2, length=5.0, measurements=8, preset=noise), seed=6)
    problem = BatchProblem.of_run(run)
    batch = batch_ml(problem)
    start = Estimate(run.true_paths, run.landmarks[problem.names])
    peer, covariances = solve_with_gtsam(gtsam, problem, start)
    sigmas = np.sqrt(np.diagonal(batch.path_covariances[:, 1:], axis1=2, axis2=3))
    difference = peer.paths - batch.paths
    difference[..., 2] = wrap_angle(difference[..., 2])
    assert (np.abs(difference[:, 1:]) < 1e-3 * sigmas).all()
    spread = np.sqrt(np.diagonal(batch.landmark_covariances, axis1=1, axis2=2))
    assert (np.abs(peer.landmarks - batch.landmarks) < 1e-3 * spread).all()
    for robot in range(2):
        scale = np.outer(*[np.sqrt(np.diag(covariances[robot]))] * 2)
        assert np.abs(covariances[robot] - batch.path_covariances[robot, -1]).max() < 1e-3 * scale.max()
        assert (np.abs(covariances[robot] - batch.path_covariances[robot, -1]) < 1e-3 * scale).all()


def test_wrong_associations_behind_a_camera_do_not_stop_the_descent(run: StereoRun, problem: BatchProblem) -> None:
    """From the truth, at which such landmarks are behind the robot, and from dead reckoning, one minimum is found."""
    at = Estimate(run.true_paths, run.landmarks[problem.names])
    camera, wrong = run.spec.noise.camera, problem.landmarks.copy()
    often = np.bincount(problem.landmarks)[problem.landmarks] > 5
    late = np.flatnonzero((problem.steps > 30) & often)[::20]
    assert len(late) > 3
    for row in late:
        pose = run.true_paths[problem.robots[row], problem.steps[row]]
        local = camera.camera_from_robot(transform_points(inverse(pose), at.landmarks))
        wrong[row] = np.argmin(local[:, 2])
        assert local[wrong[row], 2] < 0.0
    changed = replace(problem, landmarks=wrong)
    found = [batch_ml(changed, start, robust=3.0) for start in (at, None)]
    for estimate in found:
        assert estimate.gradient < 1e-3
        assert np.abs(pose_errors(estimate.paths, run)[:, 1:]).max() > 1e-3
    np.testing.assert_allclose(found[0].paths, found[1].paths, atol=1e-5)
    assert found[0].cost == pytest.approx(found[1].cost)


def test_a_wrong_first_measurement_does_not_lose_a_landmark(run: StereoRun, problem: BatchProblem) -> None:
    """A landmark whose first measurement is another's stays with its later ones, and the descent converges."""
    _, counts = np.unique(problem.landmarks, return_counts=True)
    often = int(np.argmax(counts))
    first = int(np.flatnonzero(problem.landmarks == often)[0])
    far = int(np.argmax(np.linalg.norm(run.landmarks - run.landmarks[problem.names[often]], axis=1)))
    points = problem.points.copy()
    pose = run.true_paths[problem.robots[first], problem.steps[first]]
    points[first] = run.spec.noise.camera.camera_from_robot(transform_points(inverse(pose), run.landmarks[[far]]))[0]
    points[first, 2] = abs(points[first, 2])
    changed, truth = replace(problem, points=points), Estimate(run.true_paths, run.landmarks[problem.names])
    found, from_sights = (batch_ml(changed, start, robust=3.0) for start in (truth, None))
    np.testing.assert_allclose(from_sights.landmarks[often], found.landmarks[often], atol=1e-6)
    assert np.linalg.norm(found.landmarks[often] - run.landmarks[problem.names[often]]) < 0.5


def test_landmarks_of_outliers_alone_leave_an_estimate(run: StereoRun, problem: BatchProblem) -> None:
    """A landmark that the robust kernel leaves without information makes no step fail, nor is any other lost."""
    at = Estimate(run.true_paths, run.landmarks[problem.names].copy())
    at.landmarks[0] = 1e15, 1e15, 0.0
    found = most_likely(problem, at, robust=3.0)
    assert np.isfinite(found.paths).all()
    assert np.abs(pose_errors(found.paths, run)[..., :2]).max() < 0.5
