"""Whole runs: how honest the filter's uncertainty is in the long run, and whether resampling inside it is unbiased.

Particle filters grow over-confident; where no closed form gives a bound, it was measured on other seeds, as stated.
"""

import numpy as np
import pytest
from scipy import stats
from stereo_world import StereoWorld

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose, wrap_angle
from slam_backend.metrics import nees
from slam_backend.models.measurements import Measurements
from slam_backend.resampling import RESAMPLING

MOVE = np.array([0.25, 0.02, 0.3])  # 21 steps are one turn


def run(seed: int, num_particles: int, steps: int) -> tuple[FloatArray, float]:
    """Drive in circles, associations unknown; return NEES / 3 of the pose at each step, and the mean NIS / 3."""
    world = StereoWorld(np.random.default_rng(seed))
    slam = FastSlam(1, num_particles, world.camera, seed=seed)
    pose = np.zeros(3)
    slam.step([None], [world.measure(pose, world.visible(pose))])
    errors, covariances, innovations = [], [], []
    for _ in range(steps):
        odometry = MOVE + world.rng.standard_normal(3) * slam.options.motion.sigmas(MOVE)
        pose = compose(pose, MOVE)
        report = slam.step([odometry], [world.measure(pose, world.visible(pose))])
        estimate = slam.pose()
        errors.append(estimate.mean - pose)
        errors[-1][2] = wrap_angle(errors[-1][2])
        covariances.append(estimate.covariance)
        innovations.append(report.nis)
    return nees(errors, covariances) / 3.0, float(np.nanmean(innovations)) / 3.0


@pytest.mark.parametrize(("steps", "lowest", "highest"), [(20, 0.5, 1.45), (60, 0.5, 6.3)])
def test_uncertainty_of_whole_runs(steps: int, lowest: float, highest: float) -> None:
    """The median of NEES / 3 is near its ideal (0.79) in a first turn, and bounded after three; NIS / 3 is near 1.

    100 particles, 20 runs. Bounds: 99.9 % of 3000 draws of 20 among 400 (three turns: 240) runs with seeds from 100 on
    lie between 0.51 and 1.42 (1.8 and 6.23: over-confident), their NIS between 0.85 and 1.08.
    """
    runs = [run(seed, 100, steps) for seed in range(20)]
    assert lowest < np.median([squares for squares, _ in runs]) < highest
    assert 0.85 < np.mean([innovations for _, innovations in runs]) < 1.1


def test_more_particles_are_less_overconfident() -> None:
    """Over three turns, 200 particles claim less certainty than 10 in the same runs; Wilcoxon's test, p < 1e-3."""
    few, many = ([np.log(run(seed, num_particles, 60)[0]).mean() for seed in range(20)] for num_particles in (10, 200))
    assert stats.wilcoxon(few, many, alternative="greater").pvalue < 1e-3


def weights_and_counts(scheme: str, seed: int) -> tuple[FloatArray, FloatArray]:
    """Return the weights of 9 particles before a step's resampling, and how many offspring each has.

    Twins with the same seed live the same life, but only one of them resamples. Its particles are recognised by their
    poses, which `fastslam1` leaves alone.
    """
    twins = [
        FastSlam(num_particles=9, proposal="fastslam1", resampling=scheme, resample_threshold=threshold, seed=seed)
        for threshold in (0.0, 0.999)
    ]
    look, noise = np.eye(1, 5), 0.01 * np.eye(3)[None]
    for slam in twins:
        slam.step([None], [Measurements([[0.5, 0.0, 4.0]], look, noise)], identities=[[3]])
    seen = Measurements([[0.4, 0.1, 3.1]], look, noise)
    reports = [slam.step([[1.0, 0.0, 0.0]], [seen], identities=[[3]]) for slam in twins]
    assert [report.resampled for report in reports] == [False, True]
    poses, offspring = twins[0].particles()[0], twins[1].particles()[0]
    counts = np.array([np.count_nonzero((offspring == pose).all(axis=1)) for pose in poses], dtype=np.float64)
    assert counts.sum() == 9
    return twins[0].weights, counts


@pytest.mark.parametrize("scheme", list(RESAMPLING))
def test_resampling_inside_the_filter_is_unbiased(scheme: str) -> None:
    """A particle has M w offspring on average, whatever its weight, rank and index; false alarm 1e-3 per scheme.

    800 filters with weights of their own; the excess over M w is a sum of independent numbers of mean zero. z-tests of
    9 ranks, of 9 indices, and of the excess along the weight.
    """
    lives = [weights_and_counts(scheme, seed) for seed in range(800)]
    weights, counts = (np.array(column) for column in zip(*lives, strict=True))
    order = np.argsort(weights, axis=1)
    ranked = np.take_along_axis(weights, order, axis=1)
    assert 0.01 < np.median(ranked[:, 0]) < 0.1 < np.median(ranked[:, -1]) < 0.5, "weights are far from equal"
    excess = counts - 9.0 * weights
    along = np.sum(excess * (weights - 1.0 / 9.0), axis=1, keepdims=True)
    numbers = np.concatenate([excess, np.take_along_axis(excess, order, axis=1), along], axis=1)
    z = numbers.mean(axis=0) / (numbers.std(axis=0, ddof=1) / np.sqrt(len(numbers)))
    assert np.all(np.abs(z) < stats.norm.isf(0.5e-3 / 19)), z.round(2)
