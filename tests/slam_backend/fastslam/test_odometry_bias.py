"""Odometry biases that particles estimate with their paths."""

import numpy as np
import pytest
from builders.worlds import StereoWorld
from scipy.stats import chi2

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import between, compose, wrap_angle
from slam_backend.models.odometry import OdometryModel

MOTION = OdometryModel(bias_scale=0.08, bias_heading=0.1, bias_turn=0.05)
CAMERA = StereoWorld(np.random.default_rng(0)).camera


def drive(
    slam: FastSlam, steps: int, bias: FloatArray, blind: tuple[int, ...] = (), seed: int = 0
) -> tuple[FloatArray, FloatArray]:
    """Drive a robot in loops with biased odometry; return readings (T, 3) and particles' poses (T + 1, M, 3)."""
    world = StereoWorld(np.random.default_rng(seed))
    pose, readings, paths = np.zeros(3), [], [slam.particles()[0]]
    slam.step([None], [world.measure(pose, world.visible(pose))])
    for step in range(steps):
        motion = np.array([world.rng.uniform(0.05, 0.2), 0.01, world.rng.uniform(-0.1, 0.6)])
        pose = compose(pose, motion)
        reading = motion
        for _ in range(20):  # until reading - J(reading) bias is the motion
            reading = motion + MOTION.bias_jacobians(reading[None])[0] @ bias
        reading = reading + world.rng.standard_normal(3) * MOTION.sigmas(motion)
        names = world.visible(pose)
        seen = None if step in blind else world.measure(pose, names)
        slam.step([reading], [seen], None if seen is None else [names])
        readings.append(reading)
        paths.append(slam.particles()[0])
    return np.array(readings), np.array(paths)


def regression(readings: FloatArray, path: FloatArray, chains: list[list[int]]) -> tuple[FloatArray, FloatArray]:
    """Return the Gaussian of the bias given a path (T + 1, 3), with one motion for each chain of readings."""
    information, vector = np.linalg.inv(MOTION.bias_covariance), np.zeros(3)
    for chain in chains:
        motion, jacobian, covariance = np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3))
        for step in chain:
            u = readings[step]
            c, s = np.cos(motion[2]), np.sin(motion[2])
            turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
            x, y, _ = turn @ u
            carried = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
            jacobian = carried @ jacobian + turn @ MOTION.bias_jacobians(u[None])[0]
            covariance = carried @ covariance @ carried.T + turn @ np.diag(MOTION.sigmas(u) ** 2) @ turn.T
            motion = compose(motion, u)
        off = motion - between(path[chain[0]], path[chain[-1] + 1])
        off[2] = wrap_angle(off[2])
        weighed = jacobian.T @ np.linalg.inv(covariance)
        information, vector = information + weighed @ jacobian, vector + weighed @ off
    return np.linalg.solve(information, vector), np.linalg.inv(information)


@pytest.mark.parametrize("proposal", ["fastslam2", "fastslam1"])
def test_the_bias_of_a_particle_is_its_gaussian_given_the_path(proposal):
    """After steps with measurements mean and covariance are those of the regression of readings on the sampled path."""
    slam = FastSlam(num_particles=7, motion=MOTION, proposal=proposal, resample_threshold=0.0, seed=3)
    readings, paths = drive(slam, 9, np.array([0.05, -0.08, 0.04]))
    for m in (0, 6):
        mean, covariance = regression(readings, paths[:, m], [[step] for step in range(9)])
        np.testing.assert_allclose(slam.biases[0, :, m], mean, atol=5e-4)  # second order in the bias
        np.testing.assert_allclose(slam.bias_covariances[0, 0], covariance, rtol=0.01, atol=1e-6)


def test_a_stretch_without_measurements_counts_as_one_motion():
    """While nothing is seen pose and bias correlate; the next sampled pose corrects the bias by the whole stretch."""
    slam = FastSlam(num_particles=7, motion=MOTION, resample_threshold=0.0, seed=3)
    blind = (3, 4, 5, 6)
    readings, paths = drive(slam, 9, np.array([0.02, -0.03, 0.01]), blind)
    chains = [[0], [1], [2], [3, 4, 5, 6, 7], [8]]
    for m in (0, 6):
        mean, covariance = regression(readings, paths[:, m], chains)
        np.testing.assert_allclose(slam.biases[0, :, m], mean, atol=3e-3)  # second order in the bias
        np.testing.assert_allclose(slam.bias_covariances[0, 0], covariance, rtol=0.05, atol=3e-6)
    assert not slam.bias_covariances[1].any()


def test_uncertainty_without_measurements_grows_with_the_bias():
    """A straight blind run of n steps: variances of the bias grow as n squared, those of the noise as n."""
    motion = OdometryModel(bias_scale=0.05, bias_heading=0.02)
    slam = FastSlam(num_particles=3, motion=motion, seed=1)
    for _ in range(50):
        slam.step([np.array([0.1, 0.0, 0.0])], [None])
    sigmas = motion.sigmas(np.array([0.1, 0.0, 0.0]))
    covariance = slam.pose().covariance
    assert covariance[0, 0] == pytest.approx((5.0 * 0.05) ** 2 + 50 * sigmas[0] ** 2, rel=1e-9)
    assert covariance[2, 2] == pytest.approx((5.0 * 0.02) ** 2 + 50 * sigmas[2] ** 2, rel=1e-9)


def test_a_model_without_biases_leaves_the_filter_as_it_was():
    """Zero standard deviations change no bit, and no bias is ever learnt."""
    slam = FastSlam(num_particles=5, motion=OdometryModel(), seed=3)
    drive(slam, 5, np.zeros(3))
    assert not slam.biases.any()
    assert not slam.bias_covariances.any()


def test_biases_are_found_with_honest_uncertainty():
    """Over 24 runs the squared Mahalanobis distance of the bias is chi-square of 3 degrees; false alarm rate 1 %.

    Motions must vary by more than their noise, or the noise in the derivatives looks like information.
    Rejuvenated particles together have the posterior of smoothed paths, and each its own bias given its path.
    """
    squares, rng = [], np.random.default_rng(11)
    for seed in range(24):
        bias = rng.standard_normal(3) * np.sqrt(np.diag(MOTION.bias_covariance))
        slam = FastSlam(num_particles=60, motion=MOTION, camera=CAMERA, rejuvenate_every=10, seed=seed)
        drive(slam, 60, bias, seed=seed)
        estimate = slam.odometry_bias()
        off = estimate.mean - bias
        squares.append(off @ np.linalg.solve(estimate.covariance, off))
        assert (np.diag(estimate.covariance) < np.diag(MOTION.bias_covariance)).all()
    assert np.sum(squares) < chi2.ppf(0.99, 3 * 24)


def test_a_run_with_biases_continues_bit_exactly():
    """A restored state goes on with the same biases, covariances and graph."""

    def run(half: int) -> FastSlam:
        slam = FastSlam(num_particles=9, motion=MOTION, rejuvenate_every=6, seed=5)
        world = StereoWorld(np.random.default_rng(2))
        pose = np.zeros(3)
        for step in range(20):
            names = world.visible(pose)
            slam.step([np.array([0.1, 0.0, 0.2])], [world.measure(pose, names) if step % 5 else None])
            pose = compose(pose, np.array([0.1, 0.0, 0.2]))
            if step == half:
                other = FastSlam(num_particles=9, motion=MOTION, rejuvenate_every=6, seed=77)
                other.set_state(slam.get_state())
                slam = other
        return slam

    whole, halves = run(-1), run(9)
    for name in ("poses", "biases", "bias_covariances", "weights"):
        np.testing.assert_array_equal(getattr(whole, name), getattr(halves, name))
    assert whole.biases.any()
