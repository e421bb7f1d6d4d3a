from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from slam_backend.geometry3d import fit_rigid, ransac_rigid, rotation_angle


def _motion(seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return Rotation.random(rng=rng).as_matrix(), rng.normal(size=3)


@pytest.mark.parametrize("seed", range(5))
def test_exact_pairs_give_the_exact_motion(seed: int) -> None:
    """Without noise the motion is found whatever the weights, also from points of a plane; it is never a reflection."""
    rng = np.random.default_rng(seed)
    turn, shift = _motion(seed)
    for flat in (1.0, 0.0):
        b = rng.normal(size=(7, 3)) * [1.0, 2.0, flat]
        found_turn, found_shift = fit_rigid(b @ turn.T + shift, b, rng.uniform(0.5, 2.0, 7))
        np.testing.assert_allclose(found_turn, turn, atol=1e-12)
        np.testing.assert_allclose(found_shift, shift, atol=1e-12)
        assert np.linalg.det(found_turn) == pytest.approx(1.0)


def test_it_agrees_with_scipy_on_noisy_points() -> None:
    """About their weighted means, the rotation is that of scipy's `Rotation.align_vectors`."""
    rng = np.random.default_rng(6)
    turn, shift = _motion(6)
    b, weights = rng.normal(size=(20, 3)), rng.uniform(0.2, 3.0, 20)
    a = b @ turn.T + shift + 0.1 * rng.normal(size=(20, 3))
    found, _ = fit_rigid(a, b, weights)
    means = [np.average(points, axis=0, weights=weights) for points in (a, b)]
    oracle = Rotation.align_vectors(a - means[0], b - means[1], weights)[0].as_matrix()
    np.testing.assert_allclose(found, oracle, atol=1e-9)


@pytest.mark.parametrize("seed", range(3))
def test_the_consensus_leaves_wrong_pairs_out(seed: int) -> None:
    """With six of ten pairs wrong, the right ones are found, and the motion to their noise."""
    rng = np.random.default_rng(seed)
    turn, shift = _motion(seed)
    b = rng.uniform(-5.0, 5.0, (100, 3))
    a = b @ turn.T + shift + 0.01 * rng.normal(size=(100, 3))
    a[40:] = rng.uniform(-5.0, 5.0, (60, 3))
    fit = ransac_rigid(a, b, 0.06, rng)
    assert fit is not None
    assert fit.inliers[:40].sum() >= 39
    assert fit.inliers[40:].sum() <= 1
    assert np.linalg.norm(fit.translation - shift) < 0.01
    assert rotation_angle(fit.rotation.T @ turn) < 0.003
    assert 0.01 < fit.rms < 0.025
    again = ransac_rigid(a, b, np.full(100, 0.06), np.random.default_rng(9))
    assert again is not None
    np.testing.assert_array_equal(again.inliers, fit.inliers)


def test_unrelated_and_too_few_points_have_no_motion() -> None:
    """Two pairs fix nothing, nor do triangles of different sides."""
    rng = np.random.default_rng(1)
    assert ransac_rigid(np.zeros((2, 3)), np.zeros((2, 3)), 0.1, rng) is None
    a = np.diag([1.0, 2.0, 3.0])
    assert ransac_rigid(a, 4.0 * a, 0.1, rng, iterations=5) is None


def test_angles_of_rotations() -> None:
    """The angle is exact where the trace alone would lose it."""
    for angle in (0.0, 1e-9, 0.3, 3.1):
        turn = Rotation.from_rotvec([0.0, 0.6 * angle, 0.8 * angle]).as_matrix()
        assert rotation_angle(turn) == pytest.approx(angle, rel=1e-9, abs=1e-15)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((2, 3)), np.zeros((2, 3))), r"points_a: expected at least 3 points, got shape \(2, 3\)"),
        ((np.zeros((4, 3)), np.zeros((5, 3))), r"points_b: expected an array of shape \(4, 3\)"),
        ((np.zeros((4, 3)), np.zeros((4, 3)), [1, 1, 0, 1]), "weights: expected numbers > 0, got 0.0"),
    ],
)
def test_bad_input_is_named(arguments: Any, message: str) -> None:
    """Too few points, unpaired points and weights of zero are refused by name."""
    with pytest.raises(ValueError, match=message):
        fit_rigid(*arguments)
