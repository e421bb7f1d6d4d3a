"""Whether a merged filter knows how uncertain it is, by Monte Carlo with known noise."""

import numpy as np
import pytest
from builders.filters import (
    A_FROM_B,
    LANDMARKS,
    NAMES_A,
    NAMES_B,
    PAIRS,
    common_landmarks,
    known_alignment,
    map_once,
    names_of,
    starts_of,
)
from scipy import integrate, optimize, stats

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import rotate_covariances, transform_points, wrap_angle
from slam_backend.maps.alignment import Alignment
from slam_backend.maps.fusion import alignment_jacobian, fuse_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team.filter_merging.merging import merge_filters

SIGMA = 0.05
OWN_OF_B = [7, 8]  # names of the landmarks that b alone has seen


def nees(error: FloatArray, covariance: FloatArray) -> float:
    """Return the normalised estimation error squared."""
    return float(error @ np.linalg.solve(covariance, error))


def motion_error(motions: FloatArray) -> FloatArray:
    """Return the errors (..., 3) of motions a_from_b."""
    error = motions - A_FROM_B
    error[..., 2] = wrap_angle(error[..., 2])
    return error


def mean_nees(landmarks: LandmarkMap, rows: list[int]) -> float:
    """Return the mean NEES of b's own landmarks, which stand in these rows of a map in a's frame."""
    errors = landmarks.means[rows] - LANDMARKS[OWN_OF_B]
    return float(np.mean([nees(e, s) for e, s in zip(errors, landmarks.covariances[rows], strict=True)]))


def merged_nees(a: FastSlam, b: FastSlam, rng: np.random.Generator) -> tuple[float, float]:
    """Return the NEES of b's start in a's frame, and that of b's own landmarks, after a particle-level merge."""
    joint, _ = merge_filters(a, b, known_alignment(), common_landmarks(a, b), rng)
    offsets = motion_error(starts_of(joint, 1))
    merged, names = joint.map("mixture"), names_of(joint)
    held = [names[landmark] for landmark in merged.ids.tolist()]
    return nees(offsets.mean(axis=0), np.cov(offsets.T)), mean_nees(merged, [held.index(name) for name in OWN_OF_B])


def naive_nees(a: FastSlam, b: FastSlam) -> tuple[float, float]:
    """Return the same two figures for the best particles' maps, aligned by least squares and fused (Sec. 3.2)."""
    map_a, map_b = a.map(), b.map()
    pairs: IntArray = common_landmarks(a, b)  # ids count from 0 without gaps, so they are rows
    motion = A_FROM_B.copy()
    for _ in range(5):
        means, moved = map_a.means[pairs[:, 0]], transform_points(motion, map_b.means[pairs[:, 1]])
        total = map_a.covariances[pairs[:, 0]] + rotate_covariances(motion[2], map_b.covariances[pairs[:, 1]])
        jacobian = alignment_jacobian(motion[2], map_b.means[pairs[:, 1]])
        weighted = np.linalg.solve(total, jacobian)
        information = np.einsum("kij,kil->jl", jacobian, weighted)
        motion += np.linalg.solve(information, np.einsum("kij,ki->j", weighted, means - moved))
    covariance = np.linalg.inv(information)
    fused = fuse_maps(map_a, map_b, Alignment(True, "", *motion, covariance, pairs, 0.0))
    names = names_of(b)
    added = [names[row] for row in range(len(map_b)) if row not in pairs[:, 1]]  # appended in b's order
    rows = [len(map_a) + added.index(name) for name in OWN_OF_B]
    return nees(motion_error(motion), covariance), mean_nees(fused, rows)


def filters(seed: int, num_particles: int, moves: int) -> tuple[FastSlam, FastSlam, np.random.Generator]:
    """Return two filters that are draws from their exact posteriors, and the stream they came from."""
    rng = np.random.default_rng([seed, 7])
    a = map_once(NAMES_A, np.zeros(3), SIGMA, rng, num_particles, moves)
    return a, map_once(NAMES_B, A_FROM_B, SIGMA, rng, num_particles, moves), rng


def contradicting(sigma: float, claimed: float, rng: np.random.Generator) -> tuple[FastSlam, FastSlam]:
    """Return two filters that stand at their starts and claim another noise than they have."""
    a = map_once(NAMES_A, np.zeros(3), sigma, rng, claimed_sigma=claimed)
    return a, map_once(NAMES_B, A_FROM_B, sigma, rng, claimed_sigma=claimed)


@pytest.mark.slow
def test_a_particle_level_merge_keeps_the_path_uncertainty_and_a_naive_one_loses_it() -> None:
    """NEES of b's start and of b's landmarks in a's frame is near its dimension; fusing best particles' maps is not.

    Erratum Sec. 3.2 *. Mean over 120 trials with 3 degrees of freedom: 3 +- 3.3 sqrt(6 / 120) is the 99.9 % interval,
    plus 5 % because the covariance is that of 80 draws. Landmarks of one trial share the error of the motion; their
    mean is no wider.
    """
    figures = []
    for seed in range(120):
        a, b, rng = filters(seed, 80, moves=1)
        figures.append((*merged_nees(a, b, rng), *naive_nees(a, b)))
    start, landmarks, naive_start, naive_landmarks = np.mean(figures, axis=0)
    low, high = 3.0 - 3.3 * np.sqrt(6 / 120), 1.05 * (3.0 + 3.3 * np.sqrt(6 / 120))
    assert low < start < high
    assert low < landmarks < high
    assert naive_start > 50.0
    assert naive_landmarks > 15.0


@pytest.mark.slow
def test_path_uncertainty_does_not_make_a_merge_overconfident() -> None:
    """Where paths between frames are uncertain too, NEES stays below its dimension (and above a third of it).

    Mean over 60 trials, one-sided 99.9 % bound 3 + 3.1 sqrt(6 / 60), plus 5 % for the 150 draws.
    """
    figures = []
    for seed in range(60):
        a, b, rng = filters(seed, 150, moves=2)
        figures.append(merged_nees(a, b, rng))
    for figure in np.mean(figures, axis=0):
        assert 1.0 < figure < 1.05 * (3.0 + 3.1 * np.sqrt(6 / 60))


@pytest.mark.parametrize("understated", [1.0, 2.0])
def test_contradicting_maps_are_widened_by_what_their_covariances_do_not_explain(understated: float) -> None:
    """Where all noise is claimed alike, covariances grow by max(1, chi^2 / 12): what is added makes chi^2 its freedom.

    Five common landmarks and three unknowns leave 12 degrees of freedom. The mean over 80 merges lies within four
    standard errors of the expected one; false alarm below 1e-4.
    """
    rng = np.random.default_rng(3)
    scales = []
    for _ in range(80):
        a, b = contradicting(0.02, 0.02 / understated, rng)
        joint, _ = merge_filters(a, b, known_alignment(), PAIRS, rng)
        scales.append(joint.map().covariances[5, 2, 2] / a.map().covariances[5, 2, 2])  # of a landmark of a alone

    def moment(power: int) -> float:
        density = stats.chi2(12).pdf
        return float(
            integrate.quad(lambda x: max(1.0, understated**2 * x / 12.0) ** power * density(x), 0.0, 80.0, limit=200)[0]
        )

    deviation = np.sqrt((moment(2) - moment(1) ** 2) / len(scales))
    assert min(scales) >= 1.0 - 1e-12
    assert abs(np.mean(scales) - moment(1)) < 4.0 * deviation


@pytest.mark.parametrize(("sigma", "claimed"), [(0.02, 0.004), (0.3, 0.01)])
def test_contradictions_add_variance_up_to_a_bound_and_scale_beyond(sigma: float, claimed: float) -> None:
    """A landmark known thirty times worse is widened by the same variance, up to 2 x (5 cm / 2)^2, and not by its own.

    The added variance solves chi^2(tau^2) = 12, found here by bracketing with the motion fitted again by a general
    optimiser; where tau^2 would exceed (5 cm)^2, chi^2 / 12 at that value scales all covariances.
    """
    rng = np.random.default_rng(5)
    a, b = contradicting(sigma, claimed, rng)
    a.maps.blocks[a.maps.row_of[5], :, 3:] *= 900.0  # a's own landmark 5
    map_a, map_b = a.map(), b.map()
    joint, _ = merge_filters(a, b, known_alignment(), PAIRS, rng)
    rows_a, rows_b = PAIRS.T

    def least(extra: float) -> float:
        def chi2(motion: FloatArray) -> float:
            away = map_a.means[rows_a] - transform_points(motion, map_b.means[rows_b])
            spread = map_a.covariances[rows_a] + rotate_covariances(motion[2], map_b.covariances[rows_b])
            spread = spread + extra * np.eye(3)
            return float(np.einsum("ki,ki->", away, np.linalg.solve(spread, away[..., None])[..., 0]))

        return float(optimize.minimize(chi2, A_FROM_B, tol=1e-10).fun)

    beyond = least(0.05**2) > 12.0
    assert beyond == (sigma > 0.1)
    extra = 0.05**2 if beyond else optimize.brentq(lambda value: least(value) - 12.0, 0.0, 0.05**2, xtol=1e-12)
    expected = (map_a.covariances[[5, 6]] + 0.5 * extra * np.eye(3)) * (least(extra) / 12.0 if beyond else 1.0)
    np.testing.assert_allclose(joint.map().covariances[[5, 6]], expected, rtol=2e-3, atol=1e-9)
