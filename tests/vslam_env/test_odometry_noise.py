"""Odometry readings have the errors they are said to have, and no others."""

import numpy as np
import pytest

from slam_backend.geometry import between, compose, wrap_angle
from vslam_env.world import OdometryNoise, draw_bias, read_odometry

QUIET = OdometryNoise(sigma_distance=0.0, sigma_heading_per_metre=0.0, bias_distance=0.0, bias_heading_per_metre=0.0)


def test_without_noise_the_reading_is_the_motion() -> None:
    """All sigmas zero: the reading equals the true motion."""
    rng = np.random.default_rng(0)
    before, after = rng.uniform(-3, 3, (5, 3)), rng.uniform(-3, 3, (5, 3))
    reading = read_odometry(before, after, draw_bias(QUIET, 5, rng), QUIET, rng)
    np.testing.assert_allclose(reading, between(before, after), atol=1e-12)


def test_a_robot_at_rest_reads_zero() -> None:
    """No motion, no reading, whatever the noise."""
    rng = np.random.default_rng(1)
    poses = rng.uniform(-3, 3, (4, 3))
    bias = draw_bias(OdometryNoise(), 4, rng)
    np.testing.assert_array_equal(read_odometry(poses, poses, bias, OdometryNoise(), rng), 0.0)


def test_noise_has_the_stated_size() -> None:
    """Over 20,000 readings the spread of distance and turn is the stated one within 3 % (6 sigma)."""
    rng = np.random.default_rng(2)
    n, motion = 20_000, np.array([0.08, 0.0, 0.1])
    before = rng.uniform(-np.pi, np.pi, (n, 3))
    reading = read_odometry(before, compose(before, motion), np.zeros((n, 2)), OdometryNoise(), rng)
    distance = np.hypot(reading[:, 0], reading[:, 1])
    assert np.std(distance) == pytest.approx(0.05 * 0.08, rel=0.03)
    assert np.std(reading[:, 2]) == pytest.approx(np.radians(2.0) * 0.08, rel=0.03)
    assert np.mean(distance) == pytest.approx(0.08, abs=6 * 0.004 / np.sqrt(n))
    assert np.mean(reading[:, 2]) == pytest.approx(0.1, abs=6 * np.radians(2.0) * 0.08 / np.sqrt(n))


def test_bias_lasts() -> None:
    """A bias of 2 % and 0.5 degrees per metre turns and stretches a straight drive of 10 m by just that."""
    step = np.array([[0.1, 0.0, 0.0]])
    bias = np.array([[0.02, np.radians(0.5)]])
    rng = np.random.default_rng(3)
    readings = [read_odometry(np.zeros((1, 3)), step, bias, QUIET, rng)[0] for _ in range(100)]
    np.testing.assert_allclose(np.sum([np.hypot(r[0], r[1]) for r in readings]), 10.2, rtol=1e-9)
    np.testing.assert_allclose(np.sum([r[2] for r in readings]), np.radians(5.0), rtol=1e-9)


def test_bias_has_the_stated_size() -> None:
    """Over 20,000 robots the spread of both biases is the stated one within 3 % (6 sigma)."""
    bias = draw_bias(OdometryNoise(), 20_000, np.random.default_rng(4))
    np.testing.assert_allclose(bias.std(axis=0), [0.02, np.radians(0.5)], rtol=0.03)


def test_draws_do_not_depend_on_the_motion() -> None:
    """A moving and a resting robot leave the random stream at the same place."""
    ends = []
    for scale in (0.0, 1.0):
        rng = np.random.default_rng(5)
        read_odometry(np.zeros((3, 3)), scale * np.ones((3, 3)), np.zeros((3, 2)), OdometryNoise(), rng)
        ends.append(rng.random())
    assert ends[0] == ends[1]


def test_negative_sigmas_are_refused() -> None:
    """A negative standard deviation is refused by name."""
    with pytest.raises(ValueError, match=r"odometry\.bias_distance: expected a finite number >= 0 and <= .*, got -1"):
        OdometryNoise(bias_distance=-1)


def test_readings_are_the_noisy_motions() -> None:
    """The compiled reading is the formula on arrays: stretched and turned motion in the previous frame; ways add up."""
    rng = np.random.default_rng(5)
    before, after = rng.uniform(-3.0, 3.0, (2, 40, 3))
    bias, noise = rng.normal(0.0, 0.02, (40, 2)), OdometryNoise()
    travelled = np.ones(40)
    read = read_odometry(before, after, bias, noise, np.random.default_rng(8), travelled)
    draws = np.random.default_rng(8).standard_normal((40, 2))
    moved = after - before
    distance = np.hypot(moved[:, 0], moved[:, 1])
    stretch = 1.0 + bias[:, 0] + noise.sigma_distance * draws[:, 0]
    turn = distance * (bias[:, 1] + noise.sigma_heading_per_metre * draws[:, 1])
    angle = 0.5 * turn - before[:, 2]
    x, y = moved[:, 0], moved[:, 1]
    expected = np.stack([np.cos(angle) * x - np.sin(angle) * y, np.sin(angle) * x + np.cos(angle) * y], axis=1)
    np.testing.assert_allclose(read[:, :2], stretch[:, None] * expected, atol=1e-12)
    np.testing.assert_allclose(read[:, 2], wrap_angle(moved[:, 2] + turn), atol=1e-12)
    np.testing.assert_allclose(travelled, 1.0 + distance, atol=1e-12)
