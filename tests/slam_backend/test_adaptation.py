"""The number of particles follows the spread of the poses as KLD-sampling says."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from slam_backend.adaptation import AdaptiveParticles, kld_bound, next_num_particles, occupied_bins
from slam_backend.errors import FloatArray
from slam_backend.geometry import wrap_angle
from slam_backend.resampling import effective_sample_size


def cloud(rng: np.random.Generator, num: int, spread: float, robots: int = 1) -> FloatArray:
    """Return poses (K, M, 3) scattered about a place, headings about the seam of the circle."""
    poses = rng.normal([3.0, -2.0, np.pi], [spread, spread, 0.5 * spread], (robots, num, 3))
    poses[..., 2] = wrap_angle(poses[..., 2])
    return poses


def equal(num: int) -> FloatArray:
    """Return equal weights."""
    return np.full(num, 1.0 / num)


@pytest.mark.parametrize("quantile", [0.5, 0.9, 0.99, 0.999])
@pytest.mark.parametrize("bins", [2, 3, 5, 20, 50, 1000])
def test_the_bound_is_a_chi_square_quantile(bins: int, quantile: float) -> None:
    """Fox's bound is chi^2_{k-1} / (2 error), approximated within 4 %, and 0.3 % from 19 degrees of freedom on."""
    exact = stats.chi2.ppf(quantile, bins - 1) / (2.0 * 0.05)
    assert kld_bound(bins, 0.05, quantile) == pytest.approx(exact, rel=0.04 if bins < 20 else 0.003)


def test_the_bound_as_printed() -> None:
    """Fox's formula, written out with his parameters, error 0.05 and 1 - delta = 0.99; one bin asks for nothing."""
    for k in (2, 7, 50):
        printed = (k - 1) / 0.1 * (1.0 - 2.0 / (9.0 * (k - 1)) + np.sqrt(2.0 / (9.0 * (k - 1))) * 2.3263478740) ** 3
        assert kld_bound(k, 0.05, 0.99) == pytest.approx(printed, rel=1e-9)
    assert kld_bound(1, 0.05, 0.99) == 0.0


def test_the_bound_keeps_its_promise() -> None:
    """So many samples stay below the admitted divergence in 99 % of the cases; false alarm 1e-3.

    The likelihood ratio is chi-square only in the limit, hence 0.3 % on top.
    """
    rng = np.random.default_rng(100)
    error, runs = 0.05, 4000
    true = rng.uniform(0.5, 1.5, 20)
    true /= true.sum()
    num = int(np.ceil(kld_bound(20, error, 0.99)))
    shares = rng.multinomial(num, true, runs) / num
    divergences = np.sum(np.where(shares > 0.0, shares * np.log(np.maximum(shares, 1e-300) / true), 0.0), axis=1)
    failures = int(np.count_nonzero(divergences > error))
    assert failures <= stats.binom.isf(1e-3, runs, 0.013)
    assert failures >= stats.binom.ppf(1e-3, runs, 0.005), "nor are more samples drawn than needed"


@given(seed=st.integers(0, 2**32 - 1), num=st.integers(1, 60), spread=st.sampled_from([0.001, 0.1, 1.0, 30.0]))
def test_bins_are_counted_as_a_set_of_cells(seed: int, num: int, spread: float) -> None:
    """The count is that of a plain set of tuples, heading taken on the circle, whatever the weights."""
    rng = np.random.default_rng(seed)
    poses = cloud(rng, num, spread)[0]
    weights = rng.dirichlet(np.ones(num))
    mean = weights @ poses[:, :2]
    heading = np.angle(weights @ np.exp(1j * poses[:, 2]))
    cells: dict[tuple[int, ...], float] = {}
    for (x, y, theta), weight in zip(poses, weights, strict=True):
        turn = (theta - heading + np.pi) % (2.0 * np.pi) - np.pi
        cell = tuple(int(np.floor(v + 0.5)) for v in ((x - mean[0]) / 0.1, (y - mean[1]) / 0.1, turn / 0.05))
        cells[cell] = cells.get(cell, 0.0) + weight
    assert occupied_bins(poses, weights, 0.1, 0.05) == len(cells)
    least = float(np.median(list(cells.values()))) * (1.0 + 1e-6)
    assert occupied_bins(poses, weights, 0.1, 0.05, least) == max(1, sum(w >= least for w in cells.values()))


def test_a_tight_cloud_fills_one_bin_wherever_it_lies() -> None:
    """Poses within half a bin of their mean ask for the least number, at the seam of the heading as well."""
    rng = np.random.default_rng(0)
    options = AdaptiveParticles(min_particles=17)
    for _ in range(20):
        centre = rng.uniform([-50.0, -50.0, -np.pi], [50.0, 50.0, np.pi])
        poses = centre + rng.uniform(-0.02, 0.02, (1, 200, 3))
        poses[..., 2] = wrap_angle(poses[..., 2])
        assert occupied_bins(poses[0], equal(200), 0.1, 0.05) == 1
        assert next_num_particles(options, poses, equal(200)) == 17


def test_more_spread_asks_for_more_particles_within_the_limits() -> None:
    """The number grows with the spread, from the least to the largest admitted."""
    offsets = cloud(np.random.default_rng(2), 300, 1.0) - [3.0, -2.0, 0.0]
    offsets[..., 2] = wrap_angle(offsets[..., 2] - np.pi)
    options = AdaptiveParticles(min_particles=20, max_particles=900)
    numbers = [next_num_particles(options, s * offsets, equal(300)) for s in (0.0, 0.03, 0.06, 0.12, 0.25, 0.5, 1.0)]
    assert numbers == sorted(numbers)
    assert (numbers[0], numbers[-1]) == (20, 900)
    assert len(set(numbers)) >= 4


def test_the_number_is_fox_s_bound_on_the_occupied_bins() -> None:
    """Between the limits and at equal weights it is the bound, rounded up; smaller bins and errors ask for more."""
    poses = cloud(np.random.default_rng(3), 200, 0.1)
    wide = AdaptiveParticles(min_particles=1, max_particles=10**6)
    bins = occupied_bins(poses[0], equal(200), 0.1, 0.05)
    assert bins > 5
    assert next_num_particles(wide, poses, equal(200)) == int(np.ceil(kld_bound(bins, 0.05, 0.99)))
    for finer in ({"bin_position": 0.03}, {"bin_heading": 0.01}, {"error": 0.02}, {"quantile": 0.999}):
        finer_options = AdaptiveParticles(min_particles=1, max_particles=10**6, **finer)
        assert next_num_particles(finer_options, poses, equal(200)) > next_num_particles(wide, poses, equal(200))


def test_weighted_particles_count_by_their_effective_number() -> None:
    """Unequal weights ask for M / ESS times as many, unless that is switched off."""
    rng = np.random.default_rng(4)
    poses = cloud(rng, 200, 0.1)
    weights = rng.uniform(0.2, 1.8, 200)
    weights /= weights.sum()
    plain, effective = (
        next_num_particles(
            AdaptiveParticles(min_particles=1, max_particles=10**6, effective=on), poses, weights
        )
        for on in (False, True)
    )  # fmt: skip
    assert effective == pytest.approx(plain * 200 / effective_sample_size(weights), abs=2)
    assert effective > 1.1 * plain


def test_particles_that_will_not_survive_do_not_count() -> None:
    """One particle with nearly all the weight asks for the least number, however far the others lie."""
    poses = cloud(np.random.default_rng(5), 100, 5.0)
    weights = np.full(100, 1e-9)
    weights[3] = 1.0 - 99e-9
    assert next_num_particles(AdaptiveParticles(min_particles=30), poses, weights) == 30


def test_the_robot_that_asks_for_most_decides() -> None:
    """The number for K robots is the largest of those for each alone, in any order."""
    rng = np.random.default_rng(6)
    options = AdaptiveParticles(min_particles=1, max_particles=10**6)
    robots = [cloud(rng, 150, spread)[0] for spread in (0.02, 0.2, 0.08)]
    alone = [next_num_particles(options, robot[None], equal(150)) for robot in robots]
    assert len(set(alone)) == 3
    assert next_num_particles(options, np.array(robots), equal(150)) == max(alone)
    assert next_num_particles(options, np.array(robots[::-1]), equal(150)) == max(alone)


def test_poses_beyond_all_bins_do_no_harm() -> None:
    """Two clouds at any distance are two bins, however small the bins are."""
    poses = np.zeros((1, 10, 3))
    poses[0, 5:, 0] = 1e9
    assert occupied_bins(poses[0], equal(10), 1e-3, 0.05) == 2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"min_particles": 0}, r"adaptive\.min_particles: expected an int >= 1, got 0"),
        ({"max_particles": 10**9}, r"adaptive\.max_particles: expected an int <= 1000000, got 1000000000"),
        ({"max_particles": 49}, r"adaptive\.max_particles: expected an int >= 50, got 49"),
        ({"error": 0.0}, r"adaptive\.error: expected a finite number > 0, got 0\.0"),
        ({"quantile": 1.0}, r"adaptive\.quantile: expected a finite number >= 0\.5 and <= 1, got 1\.0"),
        ({"bin_position": -1.0}, r"adaptive\.bin_position: expected a finite number > 0, got -1\.0"),
        ({"bin_heading": np.nan}, r"adaptive\.bin_heading: expected a finite number > 0, got nan"),
        ({"effective": 1}, r"adaptive\.effective: expected a bool, got 1"),
    ],
)
def test_options_out_of_range_are_refused(change: dict[str, Any], message: str) -> None:
    """The error names the option, its range and what came."""
    with pytest.raises(ValueError, match="^" + message):
        AdaptiveParticles(**change)


def test_poses_must_fit_the_weights() -> None:
    """One pose for each robot and particle."""
    for shape in ((5, 3), (1, 4, 3), (1, 5, 2)):
        with pytest.raises(ValueError, match=r"^poses: expected an array of shape \(n, 5, 3\), got shape"):
            next_num_particles(AdaptiveParticles(), np.zeros(shape), equal(5))
