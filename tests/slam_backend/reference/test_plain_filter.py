"""Laws of the plain filter that need no other filter to be checked."""

import numpy as np
import pytest
from builders.worlds import StereoWorld
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import compose, wrap_angle
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.reference import ReferenceFastSlam
from slam_backend.reference.fastslam2 import pose_given, refine
from slam_backend.reference.measurement_model import Frame, Landmark
from slam_backend.reference.pose_gaussian import GaussianPose, WhitenedPose, lower_root, turn_about_vertical

CAMERA = StereoCamera(mount=(0.3, -0.2, 0.5))
MOVE = np.array([0.25, 0.02, 0.3])
HOW = pytest.mark.parametrize("is_given", [False, True], ids=["camera model", "given covariances"])
factors = st.integers(0, 3).flatmap(lambda rank: arrays(np.float64, (3, rank), elements=st.integers(-3, 3)))
poses = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.1, 3.1)).map(np.array)


def random_scene(seed: int, is_given: bool, num: int = 4) -> tuple[WhitenedPose, dict[int, Landmark], Frame]:
    """Return a doubtful pose, landmarks, and a frame in which measurement b is of landmark b."""
    rng = np.random.default_rng(seed)
    start = rng.uniform([-2.0, -2.0, -3.0], [2.0, 2.0, 3.0])
    root = np.tril(rng.normal(0.0, 0.02, (3, 3)))
    points = rng.uniform([-1.5, -0.5, 1.5], [1.5, 0.5, 5.0], (num, 3))
    landmarks = {}
    for b, point in enumerate(points):
        factor = rng.normal(0.0, 0.02, (3, 3))
        mean = turn_about_vertical(start[2]) @ CAMERA.robot_from_camera(point) + [start[0], start[1], 0.0]
        landmarks[b] = Landmark(mean, factor @ factor.T)
    noise = rng.normal(0.0, 0.02, (num, 3)) if is_given else rng.normal(0.0, 0.3, (num, 3))
    measured = points + noise if is_given else CAMERA.triangulate(CAMERA.project(points) + noise)
    covariances = np.array([np.diag(row) for row in rng.uniform(1e-4, 1e-3, (num, 3))]) if is_given else None
    frame = Frame(Measurements(measured, np.eye(num), covariances), range(num), None, CAMERA)
    return WhitenedPose.before_measurements(start, root), landmarks, frame


@given(factor=factors)
def test_root_of_a_covariance_of_any_rank(factor: FloatArray) -> None:
    """C C^T is the covariance, C is lower triangular, and a direction without doubt has a column of zeros."""
    covariance = 0.01 * factor @ factor.T  # in decimals, so that pivots that should vanish are rounding errors
    root = lower_root(covariance)
    np.testing.assert_allclose(root @ root.T, covariance, atol=1e-9)
    assert np.count_nonzero(np.abs(root).sum(axis=0)) == np.linalg.matrix_rank(factor)
    np.testing.assert_array_equal(root, np.tril(root))
    np.testing.assert_array_equal(lower_root(np.zeros((3, 3))), np.zeros((3, 3)))
    np.testing.assert_array_equal(lower_root(np.diag([4.0, 0.0, 9.0])), np.diag([2.0, 0.0, 3.0]))


@given(pose=poses, move=poses, factor=factors)
def test_motion_is_predicted_to_first_order(pose: FloatArray, move: FloatArray, factor: FloatArray) -> None:
    """Mean and covariance of a moved pose are those of the linearised motion, by finite differences."""
    covariance, sigmas = factor @ factor.T, np.array([0.3, 0.2, 0.1])
    moved = GaussianPose(pose, covariance).moved(move, sigmas)

    def difference(a: FloatArray, b: FloatArray) -> FloatArray:
        return np.array([*(a - b)[:2], wrap_angle((a - b)[2])])

    np.testing.assert_allclose(difference(moved.mean, compose(pose, move)), 0.0, atol=1e-9)
    step = 1e-6 * np.eye(3)
    f = np.column_stack([difference(compose(pose + d, move), compose(pose - d, move)) for d in step]) / 2e-6
    g = np.column_stack([difference(compose(pose, move + d), compose(pose, move - d)) for d in step]) / 2e-6
    expected = f @ covariance @ f.T + g @ np.diag(sigmas**2) @ g.T
    np.testing.assert_allclose(moved.covariance, expected, rtol=1e-6, atol=1e-6)


@given(pose=poses, factor=factors, normals=poses)
def test_samples_do_not_depend_on_how_the_map_is_turned(
    pose: FloatArray, factor: FloatArray, normals: FloatArray
) -> None:
    """In a rotated and shifted map the same uncertainty and random numbers give the same sample."""
    start = np.array([3.0, -7.0, 2.5])
    turn = turn_about_vertical(start[2])
    covariance = factor @ factor.T + 0.1 * np.eye(3)
    here, information = WhitenedPose.of(GaussianPose(pose, covariance)), covariance
    there = WhitenedPose.of(GaussianPose(compose(start, pose), turn @ covariance @ turn.T))
    xi = np.array([0.3, -0.2, 0.1])
    np.testing.assert_allclose(here.covariance, covariance, atol=1e-9)
    a, b = here.at(xi, information).sample(normals), there.at(xi, information).sample(normals)
    np.testing.assert_allclose(compose(start, a)[:2], b[:2], atol=1e-9)
    np.testing.assert_allclose(wrap_angle(compose(start, a)[2] - b[2]), 0.0, atol=1e-9)


@HOW
@pytest.mark.parametrize("seed", range(100, 105))
def test_gate_is_that_of_the_information_form(seed: int, is_given: bool) -> None:
    """D and log|S| with the doubt about the pose are d - g^T (L + J)^-1 g and log|S| + log|L + J| - log|L|."""
    predicted, landmarks, frame = random_scene(seed, is_given)
    factor = np.random.default_rng(seed).normal(0.0, 3.0, (3, 3))
    here = predicted.at(np.array([0.4, -0.2, 0.1]), np.eye(3) + factor @ factor.T)
    for b, landmark in landmarks.items():
        term = frame.compare(here.pose, landmark, b)
        assert term is not None
        gate = term.widened(here.covariance)
        told, slope = term.in_terms_of(here.root)
        both = here.information + told
        assert gate.distance == pytest.approx(term.distance - slope @ np.linalg.solve(both, slope), rel=1e-9)
        log_dets = np.linalg.slogdet(both)[1] - np.linalg.slogdet(here.information)[1]
        assert gate.log_det == pytest.approx(term.log_det + log_dets, rel=1e-9)


@HOW
@pytest.mark.parametrize("seed", range(100, 105))
def test_posterior_and_evidence_are_those_of_the_linear_model(seed: int, is_given: bool) -> None:
    """Conditioning all measurements at once, with one large covariance, gives the same pose and the same evidence."""
    predicted, landmarks, frame = random_scene(seed, is_given)
    here = predicted.at(np.array([0.4, -0.2, 0.1]), np.eye(3))
    posterior, log_evidence = pose_given(here, landmarks, frame, {b: b for b in landmarks})
    n = 3 * len(landmarks)
    innovation, a, s = np.zeros(n), np.zeros((n, 3)), np.zeros((n, n))
    for b, landmark in landmarks.items():
        term = frame.compare(here.pose, landmark, b)
        assert term is not None
        rows = slice(3 * b, 3 * b + 3)
        innovation[rows], a[rows] = term.innovation, term.by_pose @ here.root
        s[rows, rows] = term.covariance
    joint = s + a @ a.T
    surprise = innovation + a @ here.xi  # against what xi = 0 predicts
    expected = stats.multivariate_normal(np.zeros(n), joint).logpdf(surprise) + len(landmarks) * frame.log_unit
    assert log_evidence == pytest.approx(expected, rel=1e-9)
    gain = np.linalg.solve(joint, a).T
    np.testing.assert_allclose(posterior.xi, gain @ surprise, rtol=1e-6)
    np.testing.assert_allclose(posterior.spread, np.eye(3) - gain @ a, rtol=1e-6, atol=1e-9)


@HOW
@pytest.mark.parametrize("seed", range(100, 104))
def test_evidence_is_the_integral_over_all_poses(seed: int, is_given: bool) -> None:
    """Laplace's formula at the refined pose agrees to 3 % with the integral of prior times likelihood by quadrature."""
    predicted, landmarks, frame = random_scene(seed, is_given)
    matches = {b: b for b in landmarks}
    refined = refine(predicted, landmarks, frame, matches, iterations=4, scale=11.34)
    posterior, log_evidence = pose_given(refined, landmarks, frame, matches)
    nodes, weights = np.polynomial.hermite_e.hermegauss(9)
    weights = weights / weights.sum()
    root = lower_root(posterior.spread)
    log_values, shares = [], []
    for i, j, k in np.ndindex(9, 9, 9):
        n = nodes[[i, j, k]]
        xi = posterior.xi + root @ n
        terms = [frame.compare(predicted.start + predicted.root @ xi, landmark, b) for b, landmark in landmarks.items()]
        log_likelihood = sum(term.log_density for term in terms if term is not None)
        log_values.append(log_likelihood - 0.5 * (xi @ xi) + 0.5 * (n @ n) + np.linalg.slogdet(root)[1])
        shares.append(weights[i] * weights[j] * weights[k])
    largest = max(log_values)
    log_integral = largest + np.log(np.dot(shares, np.exp(np.array(log_values) - largest)))
    assert log_evidence == pytest.approx(log_integral, abs=0.03)


@pytest.mark.parametrize("seed", range(100, 105))
def test_one_false_match_hardly_moves_the_refined_pose(seed: int) -> None:
    """Beside seven right matches, one with an error of metres moves the refined pose by less than its uncertainty."""
    predicted, landmarks, frame = random_scene(seed, is_given=True, num=8)
    matches = {b: b for b in landmarks}
    right = refine(predicted, landmarks, frame, {b: b for b in range(7)}, 4, 11.34)
    landmarks[7].mean = landmarks[7].mean + np.array([3.0, -2.0, 0.5])
    bent = refine(predicted, landmarks, frame, matches, 4, 11.34)
    shift = bent.xi - right.xi
    assert shift @ right.information @ shift < 1.0
    believed, _ = pose_given(right, landmarks, frame, matches)  # which a filter that took all at face value would go to
    far = believed.xi - right.xi
    assert far @ right.information @ far > 100.0 * (shift @ right.information @ shift)


@HOW
def test_an_update_adds_the_information_of_the_measurement(is_given: bool) -> None:
    """Sigma^-1 grows by G^T R^-1 G, the mean moves by Sigma G^T R^-1 (z - z^); what cannot be seen is counted only."""
    predicted, landmarks, frame = random_scene(100, is_given)
    pose, landmark = predicted.start, landmarks[1]
    prior = Landmark(landmark.mean.copy(), landmark.covariance.copy())
    frame.update(pose, landmark, 1)
    prediction = frame.predict(pose, prior.mean)
    assert prediction is not None
    z_hat, g, _ = prediction
    weighted = g.T @ np.linalg.inv(frame.noises[1])
    np.testing.assert_allclose(
        np.linalg.inv(landmark.covariance), np.linalg.inv(prior.covariance) + weighted @ g, rtol=1e-6
    )
    np.testing.assert_allclose(landmark.mean - prior.mean, landmark.covariance @ weighted @ (frame.z[1] - z_hat))
    assert landmark.count == 2
    if not is_given:
        mean = landmark.mean.copy()
        frame.update(pose + np.array([0.0, 0.0, np.pi]), landmark, 1)
        np.testing.assert_array_equal(landmark.mean, mean)
        assert landmark.count == 3


def blind_walk(seed: int, num_particles: int) -> tuple[ReferenceFastSlam, StereoWorld, FloatArray]:
    """Return a filter whose robot saw landmarks at the start and then walked a full circle blind; its true pose."""
    world = StereoWorld(np.random.default_rng(100))
    motion = OdometryModel(floor_position=0.01, floor_heading=0.005)
    options = FilterOptions(num_particles=num_particles, camera=world.camera, motion=motion, rejuvenate_every=None)
    slam, pose = ReferenceFastSlam(1, options, seed), np.zeros(3)
    slam.step([None], [world.measure(pose, world.visible(pose))])
    for _ in range(21):
        pose = compose(pose, MOVE)
        slam.step([MOVE], [None])
    return slam, world, pose


def test_motion_without_measurements_is_predicted_and_not_sampled() -> None:
    """Without sight the estimate is one propagated Gaussian, the same for all seeds; the particles scatter as it says.

    The sum of the particles' squared distances is chi-square; false alarm 1e-3.
    """
    slam, _, _ = blind_walk(100, 200)
    belief = GaussianPose.known(np.zeros(3))
    for _ in range(21):
        belief = belief.moved(MOVE, slam.options.motion.sigmas(MOVE))
    assert slam.is_blind == [True]
    np.testing.assert_allclose(slam.pose().mean, compose(belief.mean, np.zeros(3)), atol=1e-12)
    np.testing.assert_allclose(slam.pose().covariance, belief.covariance, rtol=1e-9, atol=1e-15)
    offsets = np.array([particle.poses[0] for particle in slam.particles]) - slam.pose().mean
    offsets[:, 2] = wrap_angle(offsets[:, 2])
    squares = np.sum(offsets * np.linalg.solve(belief.covariance, offsets.T).T)
    low, high = stats.chi2.interval(1.0 - 1e-3, 3 * len(offsets))
    assert low < squares < high


def test_a_measurement_corrects_unsampled_motion_as_one_gaussian() -> None:
    """The first measurement corrects all particles equally, for any seed; only then do they differ."""
    estimates = []
    for seed in (100, 101):
        slam, world, pose = blind_walk(seed, 3)
        predicted = slam.pose()
        world.rng = np.random.default_rng(7)
        report = slam.step([None], [world.measure(pose, world.visible(pose))])
        assert report.num_matched == 2
        assert slam.is_blind == [False]
        for particle in slam.particles:
            np.testing.assert_allclose(particle.posteriors[0].mean, slam.particles[0].posteriors[0].mean, atol=1e-12)
        assert len({tuple(particle.poses[0]) for particle in slam.particles}) == 3
        ahead = np.linalg.eigvalsh(predicted.covariance - slam.pose().covariance)
        assert ahead.min() > 0.0, "in every direction more is known"
        estimates.append(slam.pose())
    np.testing.assert_allclose(estimates[0].mean, estimates[1].mean, atol=1e-12)
    np.testing.assert_allclose(estimates[0].covariance, estimates[1].covariance, rtol=1e-9, atol=1e-15)


def test_a_given_pose_ends_unsampled_motion() -> None:
    """A pose that the caller gives is known exactly, whatever was walked blind before, and so is what follows it."""
    slam, _, pose = blind_walk(100, 3)
    slam.step([None], [None], poses=[pose])
    assert slam.is_blind == [False]
    np.testing.assert_allclose(slam.pose().covariance, 0.0, atol=1e-30)
    np.testing.assert_allclose(slam.pose().mean, pose, atol=1e-12)
    slam.step([MOVE], [None])
    expected = GaussianPose.known(pose).moved(MOVE, slam.options.motion.sigmas(MOVE))
    np.testing.assert_allclose(slam.pose().covariance, expected.covariance, rtol=1e-9, atol=1e-15)
