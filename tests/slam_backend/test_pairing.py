"""The compiled fit of many pairs of particles agrees with the plain one."""

import math

import numpy as np
import pytest

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.team.filter_merging._kernels.pairing import MIN_PAIRS, WIDTH, fit, unexplained

UPPER = np.triu_indices(3)
UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
START = np.array([1.05, 1.95, 0.69])
Common = tuple[FloatArray, BoolArray, FloatArray, BoolArray, IntArray, IntArray]


def common_landmarks(seed: int, count: int, pairs: int) -> Common:
    """Return the landmarks that two filters share, which of their particles hold them, and pairs of these."""
    rng = np.random.default_rng(seed)
    c, s = math.cos(0.7), math.sin(0.7)
    turn, shift = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.array([1.0, 2.0, 0.0])
    truth = rng.uniform(-9.0, 9.0, (count, 3)) * [1.0, 1.0, 0.1]
    sides = []
    for points, particles in ((truth, 11), ((truth - shift) @ turn, 7)):
        roots = 0.03 * rng.standard_normal((count, particles, 3, 3))
        spread = roots @ roots.transpose(0, 1, 3, 2) + 1e-4 * np.eye(3)
        values = np.empty((count, 9, particles))
        values[:, :3] = points[:, :, None] + rng.normal(0.0, 0.04, (count, 3, particles))
        values[:, 3:] = spread[..., *UPPER].transpose(0, 2, 1)
        sides += [values, rng.random((count, particles)) < 0.8]
    return sides[0], sides[1], sides[2], sides[3], rng.integers(0, 11, pairs), rng.integers(0, 7, pairs)


def plain_fit(
    common: Common, pair: int, motion: FloatArray, extra: float, iterations: int
) -> tuple[FloatArray, FloatArray, float, float, int, float]:
    """Return what `fit` says of one pair of particles, and how fast chi^2 falls with tau^2, by matrices."""
    a, held_a, b, held_b, from_a, from_b = common
    m, n = from_a[pair], from_b[pair]
    both = held_a[:, m] & held_b[:, n]
    ours, theirs = a[both, :, m], b[both, :, n]
    motion = motion.copy()
    for iteration in range(iterations + 1):
        c, s = math.cos(motion[2]), math.sin(motion[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        turned = theirs[:, :3] @ turn.T
        spread = ours[:, 3:][:, UNPACK] + turn @ theirs[:, 3:][:, UNPACK] @ turn.T + extra * np.eye(3)
        information = np.linalg.inv(spread)
        residuals = ours[:, :3] - turned - [motion[0], motion[1], 0.0]
        jacobian = np.zeros((len(ours), 3, 3))
        jacobian[:, 0, 0] = jacobian[:, 1, 1] = 1.0
        jacobian[:, 0, 2], jacobian[:, 1, 2] = -turned[:, 1], turned[:, 0]
        normal = np.einsum("kia,kij,kjb->ab", jacobian, information, jacobian)
        weighted = np.einsum("kij,kj->ki", information, residuals)
        if iteration < iterations and both.sum() >= MIN_PAIRS:
            motion += np.linalg.solve(normal, np.einsum("kia,ki->a", jacobian, weighted))
    log_det = float(np.linalg.slogdet(2.0 * np.pi * spread)[1].sum())
    return motion, normal, float((weighted * residuals).sum()), log_det, int(both.sum()), float((weighted**2).sum())


@pytest.mark.parametrize(("count", "pairs"), [(20, 1), (12, WIDTH), (4, WIDTH + 3), (0, 2)])
def test_the_fit_agrees_with_matrices(count: int, pairs: int) -> None:
    """Of each pair of particles, whatever it shares: motion, information, chi^2, log-determinants, how many."""
    common = common_landmarks(count, count, pairs)
    for extra in (0.0, 0.02):
        found = fit(*common, START, extra, 3)
        for pair in range(pairs):
            plain = plain_fit(common, pair, START, extra, 3)
            for one, other in zip(found, plain, strict=False):
                np.testing.assert_allclose(one[pair], other, rtol=1e-9, atol=1e-9)
    if count == 4:  # there are pairs on either side of what is enough
        assert found[4].min() < MIN_PAIRS <= found[4].max()


def test_what_is_unexplained_agrees_with_newtons_method() -> None:
    """tau^2 of each pair is what the plain rounds come to; where it is not 0, chi^2 is its degrees of freedom then."""
    common = common_landmarks(3, 15, WIDTH + 5)
    extra, shared = unexplained(*common, START, 8)
    for pair in range(WIDTH + 5):
        motion, plain = START, 0.0
        for _ in range(8):
            motion, _, chi2, _, k, slope = plain_fit(common, pair, motion, plain, 1)
            freedom = 3.0 * k - 3.0
            plain = max(plain + chi2 * (chi2 - freedom) / (freedom * slope), 0.0)
        assert shared[pair] == k
        assert extra[pair] == pytest.approx(plain, rel=1e-9)
        chi2 = plain_fit(common, pair, motion, plain, 5)[2]
        assert chi2 == pytest.approx(freedom, rel=1e-4) if plain > 0.0 else chi2 <= freedom
    assert np.count_nonzero(extra) > WIDTH / 2
    exact = (common[0], common[1], common[0], common[1], common[4], common[4])
    assert not unexplained(*exact, np.zeros(3), 8)[0].any()  # a map agrees with itself


def test_landmarks_at_one_place_turn_nothing() -> None:
    """Where all that is shared lies at one place the rotation stays as it began, and nothing is infinite."""
    values, held = np.zeros((5, 9, 1)), np.ones((5, 1), np.bool_)
    values[:, [3, 6, 8]] = 0.01
    none = np.zeros(2, np.int64)
    motions = fit(values, held, values, held, none, none, np.array([0.3, 0.2, 0.1]), 0.0, 3)[0]
    np.testing.assert_allclose(motions, [[0.0, 0.0, 0.1]] * 2, atol=1e-12)
