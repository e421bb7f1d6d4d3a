"""Aggregates over worlds of several strata: means with intervals, and performance profiles.

Intervals and profiles follow Agarwal, Schwarzer, Castro, Courville, Bellemare: Deep reinforcement learning at the edge
of the statistical precipice, NeurIPS 2021 (the library rliable): tracks, families and team sizes are their tasks,
worlds their runs, and intervals come from the stratified bootstrap, which draws worlds within each stratum.
"""

from collections.abc import Hashable, Mapping, Sequence

import numpy as np

from slam_backend.core.validation import FloatArray
from training.experiments.statistics import CONFIDENCE

RESAMPLES = 2000
Strata = Sequence[FloatArray]  # values (n,) of the worlds of each stratum


def strata_of(values: Mapping[tuple[Hashable, ...], float]) -> Strata:
    """Return values by stratum and seed, the seed last, as strata in the order of first occurrence.

    >>> [own.tolist() for own in strata_of({("hall", 0): 1.0, ("maze", 0): 2.0, ("hall", 1): 3.0})]
    [[1.0, 3.0], [2.0]]
    """
    found: dict[tuple[Hashable, ...], list[float]] = {}
    for (*stratum, _), value in values.items():
        found.setdefault(tuple(stratum), []).append(value)
    return [np.array(own) for own in found.values()]


def mean_with_interval(strata: Strata, resamples: int = RESAMPLES) -> tuple[float, float, float]:
    """Return the mean of the means of strata, with its 95 % interval by the stratified bootstrap.

    Returns:
        Mean, lower and upper end; the ends are NaN if no stratum has two worlds.
    """
    value = float(np.mean([own.mean() for own in strata]))
    if max(map(len, strata)) < 2:
        return value, float("nan"), float("nan")
    rng = np.random.default_rng(0)
    drawn = [own[rng.integers(len(own), size=(resamples, len(own)))].mean(axis=-1) for own in strata]
    low, high = np.quantile(np.mean(drawn, axis=0), [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
    return value, float(low), float(high)


def performance_profile(strata: Strata, thresholds: FloatArray) -> FloatArray:
    """Return the share (k,) of worlds, the mean over strata, whose value is below each threshold (k,)."""
    return np.asarray(np.mean([(own[:, None] < thresholds).mean(axis=0) for own in strata], axis=0))
