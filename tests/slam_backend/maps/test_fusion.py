from typing import Any

import numpy as np
import pytest
from builders.maps import covariances
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import compose, inverse, rotation, transform_points
from slam_backend.maps import fusion
from slam_backend.maps.alignment import Alignment, align_maps
from slam_backend.maps.landmark_map import FIELDS, LandmarkMap
from slam_backend.metrics import anees, nees

RUNS = 20_000


def errors(rng: np.random.Generator, covariance: np.ndarray, n: int) -> np.ndarray:
    """Draw n errors (n, 3) with one covariance (3, 3)."""
    return rng.standard_normal((n, 3)) @ np.linalg.cholesky(covariance).T


def alignment(pose: Any, inliers: Any, sigma: float = 0.0) -> Alignment:
    """Build a successful alignment with the same standard deviation in all three parameters."""
    return Alignment(True, "", pose[0], pose[1], pose[2], sigma**2 * np.eye(3), inliers, 0.0)


def some_map(rng: np.random.Generator, n: int, ids: Any = None) -> LandmarkMap:
    """Draw n landmarks with unit descriptors of size seven."""
    d = rng.standard_normal((n, 7))
    d /= np.linalg.norm(d, axis=1, keepdims=True)
    return LandmarkMap(rng.uniform(-9, 9, (n, 3)), covariances(rng, n), d, rng.integers(1, 9, n), ids)


def test_fused_covariances_are_the_sum_of_informations() -> None:
    """Eq. 15 with Sigma_1 equals (Sigma_1^-1 + Sigma_2^-1)^-1; the printed mu_1 would not even be a matrix."""
    rng = np.random.default_rng(0)
    one, two = covariances(rng, 11), covariances(rng, 11)
    mean1, mean2 = rng.normal(size=(2, 11, 3))
    _, fused = fusion.fuse_landmarks(mean1, one, mean2, two)
    np.testing.assert_allclose(fused, np.linalg.inv(np.linalg.inv(one) + np.linalg.inv(two)), atol=1e-12)
    gain = one @ np.linalg.inv(one + two)
    printed = ((np.eye(3) - gain) @ mean1[..., None])[..., 0]  # Eq. 15 as printed
    assert printed.shape != fused.shape


def test_the_fused_mean_lies_between_and_the_printed_one_does_not() -> None:
    """Eq. 14 with mu_2 - mu_1 is unbiased and best; with the printed sign the error is several times larger."""
    rng = np.random.default_rng(1)
    sigma1, sigma2 = np.diag([0.04, 0.01, 0.02]), np.diag([0.01, 0.04, 0.02])
    truth = np.array([3.0, -2.0, 1.0])
    mean1, mean2 = truth + errors(rng, sigma1, RUNS), truth + errors(rng, sigma2, RUNS)
    fused, sigma = fusion.fuse_landmarks(mean1, np.tile(sigma1, (RUNS, 1, 1)), mean2, np.tile(sigma2, (RUNS, 1, 1)))
    gain = sigma1 @ np.linalg.inv(sigma1 + sigma2)
    printed = mean1 + (mean1 - mean2) @ gain.T  # Eq. 14 as printed

    def rms(mean: np.ndarray) -> float:
        return float(np.sqrt(((mean - truth) ** 2).sum(axis=1).mean()))

    assert rms(fused) == pytest.approx(np.sqrt(np.trace(sigma[0])), rel=0.02)  # 6 sigma
    assert rms(fused) < min(rms(mean1), rms(mean2))
    assert rms(printed) > 2.5 * rms(fused)
    assert anees(fused - truth, sigma) == pytest.approx(1.0, abs=5.0 * np.sqrt(2.0 / (3.0 * RUNS)))


@given(seed=st.integers(0, 10_000))
def test_fusion_is_commutative_and_never_adds_uncertainty(seed: int) -> None:
    """The order of the two estimates does not matter, and Sigma_1 - Sigma stays positive semi-definite."""
    rng = np.random.default_rng(seed)
    one, two = covariances(rng, 3, 1e-4, 10.0), covariances(rng, 3, 1e-4, 10.0)
    mean1, mean2 = rng.normal(size=(2, 3, 3))
    mean, sigma = fusion.fuse_landmarks(mean1, one, mean2, two)
    swapped, sigma_swapped = fusion.fuse_landmarks(mean2, two, mean1, one)
    np.testing.assert_allclose(mean, swapped, atol=1e-6)
    np.testing.assert_allclose(sigma, sigma_swapped, atol=1e-8)
    np.testing.assert_array_equal(sigma, sigma.swapaxes(-1, -2))
    assert np.linalg.eigvalsh(sigma).min() > 0.0
    assert np.linalg.eigvalsh(one - sigma).min() > -1e-8
    assert np.linalg.eigvalsh(two - sigma).min() > -1e-8


def test_moved_errors_have_the_rotated_covariance() -> None:
    """Cov(R p) = R Sigma R^T (Eq. 16): the printed R^T Sigma R turns the ellipse the wrong way."""
    rng = np.random.default_rng(2)
    theta, sigma = 0.6, np.array([[0.9, 0.2, 0.1], [0.2, 0.2, 0.0], [0.1, 0.0, 0.3]])
    moved = transform_points([0.0, 0.0, theta], errors(rng, sigma, RUNS))
    exact = alignment([4.0, -1.0, theta], np.empty((0, 2)))
    ours = fusion.move_covariances(exact, np.zeros((1, 3)), sigma[None])
    full = np.eye(3)
    full[:2, :2] = rotation(theta)
    printed = full.T @ sigma @ full
    np.testing.assert_allclose(np.cov(moved.T), ours[0], atol=0.05)  # 5 sigma of the largest entry
    assert np.abs(np.cov(moved.T) - printed).max() > 0.4


@given(theta=st.floats(-3.2, 3.2), seed=st.integers(0, 999))
def test_the_alignment_jacobian_is_the_finite_difference(theta: float, seed: int) -> None:
    """J = [e_x, e_y, dR/dtheta p_b] is the derivative of R p_b + t."""
    pose = np.array([1.0, 2.0, theta])
    points = np.random.default_rng(seed).uniform(-9.0, 9.0, (4, 3))
    step = 1e-6
    for axis in range(3):
        ahead, behind = (transform_points(pose + sign * step * np.eye(3)[axis], points) for sign in (1.0, -1.0))
        expected = (ahead - behind) / (2.0 * step)
        np.testing.assert_allclose(fusion.alignment_jacobian(theta, points)[..., axis], expected, atol=1e-8)


def test_an_uncertain_alignment_makes_moved_landmarks_uncertain() -> None:
    """With J Sigma_align J^T the NEES of moved landmarks is 3; without it, as printed, far more."""
    rng = np.random.default_rng(3)
    pose, sigma = np.array([2.0, -3.0, 0.8]), np.diag([0.02, 0.01, 0.01])
    sigma_align = np.diag([0.05, 0.05, 0.02]) ** 2
    truth_b = np.array([6.0, 3.0, 0.5])
    estimates_b = truth_b + errors(rng, sigma, RUNS)
    poses = pose + errors(rng, sigma_align, RUNS)
    e = compose(poses, np.column_stack([estimates_b[:, :2], np.zeros(RUNS)]))[:, :2]
    e = np.column_stack([e, estimates_b[:, 2]]) - transform_points(pose, truth_b)
    estimated = Alignment(True, "", pose[0], pose[1], pose[2], sigma_align, np.empty((0, 2)), 0.0)
    ours = fusion.move_covariances(estimated, truth_b[None], sigma[None])
    printed = fusion.move_covariances(alignment(pose, np.empty((0, 2))), truth_b[None], sigma[None])
    # 2 % for the curvature of the rotation, and 5 sigma of the sampling.
    assert nees(e, np.tile(ours, (RUNS, 1, 1))).mean() == pytest.approx(3.0, abs=0.06 + 5.0 * np.sqrt(6.0 / RUNS))
    assert nees(e, np.tile(printed, (RUNS, 1, 1))).mean() > 5.0


def test_covariances_conditioned_on_one_path_are_over_confident() -> None:
    """Sec. 3.2 fuses Sigma^[m] of the best particle: only the mixture over particles has a NEES of 3."""
    rng = np.random.default_rng(4)
    runs, particles = 2000, 100
    conditional, path = np.diag([0.01, 0.01, 0.01]), np.diag([0.2, 0.1, 0.05])
    means = errors(rng, path, runs * particles).reshape(runs, particles, 3)  # of the landmark, one per particle
    truth = errors(rng, path, runs) + errors(rng, conditional, runs)
    mixture = means.mean(axis=1)
    spread = means - mixture[:, None]
    covariance = conditional + np.einsum("rmi,rmj->rij", spread, spread) / particles
    best = nees(means[:, 0] - truth, np.tile(conditional, (runs, 1, 1))).mean()
    whole = nees(mixture - truth, covariance).mean()
    assert best > 30.0
    assert whole == pytest.approx(3.0, abs=0.2 + 5.0 * np.sqrt(6.0 / runs))  # 0.2 for the finite number of particles


def test_fused_descriptors_keep_their_length() -> None:
    """The mean of two unit vectors is shorter than one, so that the gate E0 would change its meaning."""
    rng = np.random.default_rng(5)
    one, two = rng.standard_normal((2, 4, 7))
    one /= np.linalg.norm(one, axis=1, keepdims=True)
    two /= np.linalg.norm(two, axis=1, keepdims=True)
    fused = fusion.fuse_descriptors(one, [1, 2, 3, 4], two, [4, 3, 2, 1])
    np.testing.assert_allclose(np.linalg.norm(fused, axis=1), 1.0, atol=1e-6)
    assert np.linalg.norm(0.5 * (one + two), axis=1).max() < 0.95  # as printed
    np.testing.assert_allclose(fusion.fuse_descriptors(one, [3] * 4, one, [1] * 4), one, atol=1e-6)


def test_descriptors_are_weighted_by_their_counts() -> None:
    """A descriptor made of 99 measurements hardly moves when one more arrives; opposite ones leave the first."""
    one, two = np.array([[1.0, 0.0]], np.float32), np.array([[0.0, 1.0]], np.float32)
    np.testing.assert_allclose(fusion.fuse_descriptors(one, [99], two, [1]), [[0.99995, 0.0101005]], rtol=1e-4)
    np.testing.assert_array_equal(fusion.fuse_descriptors(one, [2], -one, [2]), one)


def test_fused_maps_keep_a_and_append_what_is_new_in_b() -> None:
    """Rows, ids and counts of a merge: a's stay, fused ones add up, b's others follow with ids that are not in use."""
    rng = np.random.default_rng(6)
    map_a, map_b = some_map(rng, 4, ids=[3, 8, 0, 5]), some_map(rng, 5, ids=[8, 21, 5, 2, 3])
    pose = [1.0, -2.0, 2.1]
    fused = fusion.fuse_maps(map_a, map_b, alignment(pose, [[1, 3], [0, 0]]))
    assert fused.ids.tolist() == [3, 8, 0, 5, 21, 22, 23]
    assert fused.counts[:2].tolist() == [map_a.counts[0] + map_b.counts[0], map_a.counts[1] + map_b.counts[3]]
    assert fused.counts[2:].tolist() == [*map_a.counts[2:], *map_b.counts[[1, 2, 4]]]
    for name in FIELDS[:3]:
        np.testing.assert_array_equal(getattr(fused, name)[2:4], getattr(map_a, name)[2:4])
    moved = map_b.moved(pose)
    for name in ("means", "covariances"):
        np.testing.assert_allclose(getattr(fused, name)[4:], getattr(moved, name)[[1, 2, 4]], atol=1e-12)
    expected = fusion.fuse_landmarks(map_a.means[1], map_a.covariances[1], moved.means[3], moved.covariances[3])
    np.testing.assert_allclose(fused.means[1], expected[0], atol=1e-12)
    np.testing.assert_allclose(fused.covariances[1], expected[1], atol=1e-12)


def test_maps_that_were_aligned_and_fused_are_as_certain_as_they_claim() -> None:
    """With the motion's own covariance, a's landmarks, the fused ones and b's moved ones all have an ANEES of 1."""
    squares = []
    for seed in range(40):
        rng = np.random.default_rng([9, seed])
        truth = rng.uniform(0.0, [30.0, 30.0, 1.5], (120, 3))
        looks = rng.standard_normal((120, 32))
        looks /= np.linalg.norm(looks, axis=1, keepdims=True)
        pose = np.array([*rng.uniform(-9.0, 9.0, 2), rng.uniform(-3.0, 3.0)])
        sigma = np.tile(0.05**2 * np.eye(3), (70, 1, 1))
        a, b = (
            LandmarkMap(points + 0.05 * rng.standard_normal(points.shape), sigma, looks[rows])
            for rows, points in ((slice(70), truth[:70]), (slice(50, 120), transform_points(inverse(pose), truth[50:])))
        )
        fused = fusion.fuse_maps(a, b, align_maps(a, b))
        assert len(fused) == 120
        squares.append(nees(fused.means - truth, fused.covariances) / 3.0)
    parts = np.array(squares)
    # Sampling: 4 sigma; what b's landmarks share, the error of one motion in each run, makes theirs spread more.
    for rows, width in ((slice(50), 0.08), (slice(50, 70), 0.12), (slice(70, 120), 0.25)):
        assert parts[:, rows].mean() == pytest.approx(1.0, abs=width)


def test_fusing_with_an_empty_map_changes_nothing() -> None:
    """A map without landmarks adds none."""
    map_a = some_map(np.random.default_rng(7), 3)
    fused = fusion.fuse_maps(map_a, LandmarkMap.empty(7), alignment([1.0, 1.0, 1.0], np.empty((0, 2))))
    for name in FIELDS:
        np.testing.assert_array_equal(getattr(fused, name), getattr(map_a, name))
