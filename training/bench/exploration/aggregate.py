"""Aggregates over worlds of several families: interquartile means, profiles and probabilities of improvement.

Definitions and intervals follow Agarwal, Schwarzer, Castro, Courville, Bellemare: Deep reinforcement learning at the
edge of the statistical precipice, NeurIPS 2021 (the library rliable): families are their tasks, worlds their runs, and
intervals come from the stratified bootstrap, which draws worlds within each family.
"""

from collections.abc import Callable, Mapping, Sequence

import numpy as np
from scipy import stats

from slam_backend.core.validation import FloatArray
from training.experiments.statistics import CONFIDENCE

RESAMPLES = 2000
Strata = Sequence[FloatArray]  # values (n,) of the worlds of each family


def iqm(values: FloatArray) -> FloatArray:
    """Return the interquartile means (...,) of values (..., n): the mean of the middle half.

    >>> float(iqm(np.array([0.0, 1.0, 3.0, 100.0])))
    2.0
    """
    return np.asarray(stats.trim_mean(values, 0.25, axis=-1))


def pooled(statistic: Callable[[FloatArray], FloatArray]) -> Callable[[Sequence[FloatArray]], FloatArray]:
    """Return a statistic of strata (..., n) that is computed on all worlds of all families together."""
    return lambda strata: statistic(np.concatenate(list(strata), axis=-1))


def stratified_ci(
    strata: Strata, statistic: Callable[[Sequence[FloatArray]], FloatArray], resamples: int = RESAMPLES
) -> tuple[float, float, float]:
    """Return a statistic of strata with its 95 % interval by the stratified bootstrap.

    Args:
        strata: Values (n,) of the worlds of each family.
        statistic: Function of arrays (..., n), one for each family, that returns (...,).

    Returns:
        Value, lower and upper end; the ends are NaN if no family has two worlds.
    """
    value = float(statistic(strata))
    if max(map(len, strata)) < 2:
        return value, float("nan"), float("nan")
    rng = np.random.default_rng(0)
    drawn = [own[rng.integers(len(own), size=(resamples, len(own)))] for own in strata]
    low, high = np.quantile(statistic(drawn), [0.5 - 0.5 * CONFIDENCE, 0.5 + 0.5 * CONFIDENCE])
    return value, float(low), float(high)


def probability_of_improvement(own: Strata, other: Strata, resamples: int = RESAMPLES) -> tuple[float, float, float]:
    """Return P(X > Y) + P(X = Y) / 2 of a random world of each side, the mean over families, with its 95 % interval.

    Args:
        own, other: Values (n,) and (m,) of the worlds of each family, larger is better.
    """

    def share(xs: FloatArray, ys: FloatArray) -> FloatArray:
        above, equal = xs[..., :, None] > ys[..., None, :], xs[..., :, None] == ys[..., None, :]
        return np.asarray((above + 0.5 * equal).mean(axis=(-2, -1)))

    def mean_share(strata: Sequence[FloatArray]) -> FloatArray:
        half = len(strata) // 2
        return np.asarray(np.mean([share(*pair) for pair in zip(strata[:half], strata[half:], strict=True)], axis=0))

    return stratified_ci([*own, *other], mean_share, resamples)


def performance_profile(strata: Strata, thresholds: FloatArray) -> FloatArray:
    """Return the share (k,) of worlds, the mean over families, whose value exceeds each threshold (k,)."""
    return np.asarray(np.mean([(own[:, None] > thresholds).mean(axis=0) for own in strata], axis=0))


def by_family(values: Mapping[tuple[str, int], float], wanted: Sequence[tuple[str, int]] | None = None) -> Strata:
    """Return the values of (family, seed) as strata, families in order of first occurrence.

    Args:
        wanted: Worlds to include, which must be known; None: all.
    """
    families: dict[str, list[float]] = {}
    for world in values if wanted is None else wanted:
        families.setdefault(world[0], []).append(values[world])
    return [np.array(own) for own in families.values()]
