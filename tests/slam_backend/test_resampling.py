import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from slam_backend.resampling import RESAMPLING, effective_sample_size, systematic

SCHEMES = pytest.mark.parametrize("scheme", list(RESAMPLING))
weights_of_particles = st.lists(st.floats(1e-6, 1.0), min_size=1, max_size=13).map(
    lambda raw: np.array(raw) / np.sum(raw)
)


@SCHEMES
def test_counts_are_unbiased(scheme: str) -> None:
    """Particle m is drawn M w_m times on average; z-test of each mean count, false alarm 1e-4 per scheme."""
    weights = np.array([0.4, 0.02, 0.13, 0.2, 0.05, 0.17, 0.03])
    rng = np.random.default_rng(11)
    runs = 4000
    counts = np.array([np.bincount(RESAMPLING[scheme](weights, rng), minlength=7) for _ in range(runs)])
    spread = counts.std(axis=0, ddof=1) / np.sqrt(runs)
    z = (counts.mean(axis=0) - 7 * weights) / spread
    assert np.all(np.abs(z) < stats.norm.isf(0.5e-4 / 7))


def test_multinomial_counts_are_multinomial() -> None:
    """Pooled counts pass the chi-square test against M w; false alarm 1e-4."""
    weights = np.array([0.4, 0.1, 0.3, 0.2])
    rng = np.random.default_rng(2)
    pooled = sum(np.bincount(RESAMPLING["multinomial"](weights, rng, 9), minlength=4) for _ in range(500))
    assert stats.chisquare(pooled, 4500 * weights).pvalue > 1e-4


@given(weights=weights_of_particles, seed=st.integers(0, 2**32 - 1))
def test_systematic_counts_are_within_one_of_their_mean(weights: np.ndarray, seed: int) -> None:
    """Systematic resampling draws particle m floor(M w_m) or ceil(M w_m) times."""
    counts = np.bincount(systematic(weights, np.random.default_rng(seed)), minlength=len(weights))
    assert np.all(np.abs(counts - len(weights) * weights) < 1.0 + 1e-9)


@given(weights=weights_of_particles, seed=st.integers(0, 2**32 - 1))
def test_residual_keeps_the_whole_copies(weights: np.ndarray, seed: int) -> None:
    """Residual resampling draws particle m at least floor(M w_m) times."""
    counts = np.bincount(RESAMPLING["residual"](weights, np.random.default_rng(seed)), minlength=len(weights))
    assert np.all(counts >= np.floor(len(weights) * weights - 1e-12))


@SCHEMES
@given(weights=weights_of_particles, count=st.integers(1, 20), seed=st.integers(0, 2**32 - 1))
def test_ancestors_are_indices_of_particles(scheme: str, weights: np.ndarray, count: int, seed: int) -> None:
    """The result is int64 indices in range, as many as asked for."""
    ancestors = RESAMPLING[scheme](weights, np.random.default_rng(seed), count)
    assert ancestors.dtype == np.int64
    assert ancestors.shape == (count,)
    assert np.all((ancestors >= 0) & (ancestors < len(weights)))


@SCHEMES
def test_particles_of_no_weight_die(scheme: str) -> None:
    """Weight 0 is never drawn, at the ends neither, and weight 1 always."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        assert set(RESAMPLING[scheme](np.array([0.0, 0.6, 0.0, 0.4, 0.0]), rng)) <= {1, 3}
        assert set(RESAMPLING[scheme](np.array([0.0, 0.0, 1.0]), rng)) == {2}


@pytest.mark.parametrize("scheme", ["systematic", "stratified", "residual"])
@pytest.mark.parametrize("size", [1, 3, 6, 49, 100])
def test_equal_weights_change_nothing(scheme: str, size: int) -> None:
    """With weights 1/M each particle survives once, however 1/M is rounded."""
    for seed in range(20):
        ancestors = RESAMPLING[scheme](np.full(size, 1.0 / size), np.random.default_rng(seed))
        np.testing.assert_array_equal(ancestors, np.arange(size))


@given(weights=weights_of_particles)
def test_effective_sample_size_lies_between_one_and_all(weights: np.ndarray) -> None:
    """1 <= ESS <= M; equal weights give M, a single survivor 1."""
    assert 1.0 - 1e-12 <= effective_sample_size(weights) <= len(weights) * (1.0 + 1e-12)
    assert effective_sample_size(np.full(9, 1.0 / 9.0)) == pytest.approx(9.0)
    assert effective_sample_size(np.array([0.0, 1.0, 0.0])) == 1.0
