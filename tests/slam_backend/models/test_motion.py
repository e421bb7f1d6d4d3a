from dataclasses import astuple

import numpy as np
from builders.kernels import python_entry
from builders.linear_world import turn
from builders.worlds import EXACT_MOTION
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels.motion import odometry_bias
from slam_backend.geometry import compose, wrap_angle
from slam_backend.models.odometry import OdometryModel

MODEL = OdometryModel(
    sigma_along=0.1, sigma_across=0.03, sigma_heading=0.05, sigma_turn=0.2, floor_position=0.01, floor_heading=0.02
)
MOVE = np.array([0.6, 0.8, -0.5])


def test_standard_deviations_add_in_squares() -> None:
    """Each part grows with distance or turn and is added to its floor in squares."""
    expected = [np.hypot(0.1, 0.01), np.hypot(0.03, 0.01), np.sqrt(0.05**2 + (0.2 * 0.5) ** 2 + 0.02**2)]
    np.testing.assert_allclose(MODEL.sigmas(MOVE), expected)
    np.testing.assert_allclose(MODEL.sigmas(np.zeros(3)), [0.01, 0.01, 0.02])


@given(st.lists(st.floats(0.0, 1.0), min_size=9, max_size=9), st.lists(st.floats(-10.0, 10.0), min_size=3, max_size=3))
def test_kernels_assume_the_same_standard_deviations(sigmas: list[float], move: list[float]) -> None:
    """The compiled form of the model is the model."""
    model = OdometryModel(**dict(zip(OdometryModel.__slots__, sigmas, strict=True)))
    compiled = np.empty(3)
    python_entry(_kernels.write_sigmas)(np.array(astuple(model)), np.array(move), compiled)
    np.testing.assert_allclose(compiled, model.sigmas(np.array(move)), rtol=1e-14)


def test_samples_have_the_stated_moments() -> None:
    """In the robot's frame the samples are N(u, diag(sigmas^2)); chi-square and t, false alarm 1e-4 each."""
    start = np.array([1.0, -2.0, 2.4])
    n = 20_000
    samples = MODEL.sample(np.tile(start, (n, 1)), MOVE, np.random.default_rng(5))
    motion = (samples - start) @ turn(start[2])
    motion[:, 2] = wrap_angle(motion[:, 2])
    scaled = (motion - MOVE) / MODEL.sigmas(MOVE)
    assert np.all(np.abs(scaled.mean(axis=0)) * np.sqrt(n) < stats.norm.isf(0.5e-4))
    low, high = stats.chi2.interval(1.0 - 1e-4, n)
    assert np.all((low < (scaled**2).sum(axis=0)) & ((scaled**2).sum(axis=0) < high))
    correlations = np.corrcoef(scaled.T)[np.triu_indices(3, 1)]
    assert np.all(np.abs(correlations) * np.sqrt(n) < stats.norm.isf(0.5e-4))


def test_each_particle_moves_from_its_own_pose() -> None:
    """Eq. 4 conditions on the particle's own pose: without noise, particle m ends at x^[m] composed with u."""
    poses = np.random.default_rng(0).normal(size=(7, 3))
    np.testing.assert_array_equal(EXACT_MOTION.sample(poses, MOVE, np.random.default_rng(1)), compose(poses, MOVE))


def test_the_pose_is_linear_in_the_noise_of_the_odometry() -> None:
    """Noise e of the odometry moves the pose by diag(R(theta), 1) e, exactly: the Jacobian leaves no remainder."""
    start, noise = np.array([0.3, 0.4, 1.1]), np.array([0.2, -0.3, 0.4])
    jacobian = turn(start[2])
    np.testing.assert_allclose(compose(start, MOVE + noise), compose(start, MOVE) + jacobian @ noise, atol=1e-14)


def test_a_reading_under_a_bias_measures_the_motion_to_first_order() -> None:
    """A stretched reading whose turn has a constant error per metre and per radian is the motion plus J b."""
    bias, off = np.array([0.3, -0.2, 0.4]), 1e-6
    distance = np.hypot(*MOVE[:2])
    turned = off * (bias[1] * distance + bias[2] * MOVE[2])
    reading = MOVE + np.array([0.0, 0.0, turned])
    reading[:2] = (1.0 + off * bias[0]) * (turn(0.5 * turned)[:2, :2] @ MOVE[:2])
    np.testing.assert_allclose(MODEL.bias_jacobians(MOVE[None])[0] @ bias, (reading - MOVE) / off, atol=1e-5)


def test_kernels_have_the_same_derivative_by_the_bias() -> None:
    """The compiled derivative is that of the model, and turns with nothing but the reading."""
    found = np.empty((3, 3))
    for move in np.random.default_rng(4).normal(size=(5, 3)):
        python_entry(odometry_bias.write_bias_jacobian)(move, found)
        np.testing.assert_allclose(found, MODEL.bias_jacobians(move[None])[0], rtol=1e-14)


def test_a_model_without_a_bias_says_so() -> None:
    """Only a positive standard deviation makes a bias; its prior covariance is the squares of all three."""
    assert not MODEL.is_biased
    assert not MODEL.bias_covariance.any()
    for name in ("bias_scale", "bias_heading", "bias_turn"):
        assert OdometryModel(**{name: 0.1}).is_biased
    biased = OdometryModel(bias_scale=0.1, bias_heading=0.2, bias_turn=0.3)
    np.testing.assert_allclose(biased.bias_covariance, np.diag([0.01, 0.04, 0.09]))
