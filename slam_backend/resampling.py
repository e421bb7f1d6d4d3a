"""Resampling schemes, from normalised weights to ancestor indices.

Every scheme takes weights (M,) float64 that sum to 1, a source of draws and the number of draws (None: M), and returns
ancestors (count,) int64 in [0, M). All are unbiased: particle m is drawn count w_m times on average. They differ in
variance.
"""

from collections.abc import Callable

import numpy as np

from slam_backend.core.jit import in_place
from slam_backend.core.validation import FloatArray, IntArray


def effective_sample_size(weights: FloatArray) -> float:
    """Return 1 / sum w^2 of weights (M,) that sum to 1, in [1, M].

    >>> effective_sample_size(np.array([0.5, 0.5, 0.0]))
    2.0
    """
    return float(1.0 / np.sum(weights * weights))


def _invert(weights: FloatArray, uniforms: FloatArray) -> IntArray:
    """Return the ancestors of `uniforms` in [0, 1), in any order, by the inverse of the weights' cumulative sum."""
    edges = np.cumsum(weights)
    edges /= edges[-1]
    return np.minimum(np.searchsorted(edges, uniforms, side="right"), len(weights) - 1).astype(np.int64)


@in_place
def _write_strata(weights: FloatArray, offsets: FloatArray, ancestors: IntArray) -> None:
    """Write the ancestors of (i + offset) / count, i = 0 .. count - 1, with one offset for all or one for each."""
    count = len(ancestors)
    total = 0.0
    for m in range(len(weights)):
        total += weights[m]
    m, edge = 0, weights[0]
    for i in range(count):
        u = (i + offsets[i if len(offsets) > 1 else 0]) / count * total
        while u >= edge and m < len(weights) - 1:
            m += 1
            edge += weights[m]
        ancestors[i] = m


def _strata(weights: FloatArray, offsets: FloatArray, count: int) -> IntArray:
    """Return the ancestors that `_write_strata` writes."""
    ancestors = np.empty(count, dtype=np.int64)
    _write_strata(weights, offsets, ancestors)
    return ancestors


def systematic(weights: FloatArray, rng: np.random.Generator, count: int | None = None) -> IntArray:
    """Draw with one uniform shared by all strata."""
    count = len(weights) if count is None else count
    return _strata(weights, rng.random(1), count)


def stratified(weights: FloatArray, rng: np.random.Generator, count: int | None = None) -> IntArray:
    """Draw with one uniform per stratum."""
    count = len(weights) if count is None else count
    return _strata(weights, rng.random(count), count)


def multinomial(weights: FloatArray, rng: np.random.Generator, count: int | None = None) -> IntArray:
    """Draw independently."""
    return _invert(weights, rng.random(len(weights) if count is None else count))


def residual(weights: FloatArray, rng: np.random.Generator, count: int | None = None) -> IntArray:
    """Keep floor(count w) copies of each particle, and draw the rest from the residual weights."""
    count = len(weights) if count is None else count
    scaled = count * weights / weights.sum()
    copies = np.floor(scaled + 1e-9).astype(np.int64)  # a weight of 1/M gives one copy despite rounding
    kept = np.repeat(np.arange(len(weights)), copies)
    missing = count - len(kept)
    if missing == 0:
        return kept.astype(np.int64)
    return np.concatenate([kept, multinomial(np.maximum(scaled - copies, 0.0), rng, missing)]).astype(np.int64)


RESAMPLING: dict[str, Callable[..., IntArray]] = {
    "systematic": systematic,
    "stratified": stratified,
    "multinomial": multinomial,
    "residual": residual,
}
