"""How long calls take: one by one, the garbage collector off, summarised by quantiles."""

import gc
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray


@dataclass(frozen=True, slots=True)
class Timing:
    """Of calls that were timed one by one [ms].

    Attributes:
        median_ms: Half of the calls took longer.
        low_ms: 10 % took less.
        high_ms: 10 % took longer.
        min_ms: The shortest.
        calls: How many.
    """

    median_ms: float
    low_ms: float
    high_ms: float
    min_ms: float
    calls: int

    @classmethod
    def of(cls, seconds: FloatArray) -> "Timing":
        """Summarise durations (n,) [s]."""
        low, median, high = (float(q) for q in np.quantile(1e3 * seconds, (0.1, 0.5, 0.9)))
        return cls(median, low, high, float(1e3 * seconds.min()), len(seconds))


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect once, then not again until the block ends: a collection falls on one call and belongs to many."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def time_calls(call: Callable[[Any], Any], arguments: Sequence[Any], warm_up: int = 0) -> tuple[FloatArray, list[Any]]:
    """Time `call(argument)` for each argument in turn.

    Args:
        call: What is timed.
        arguments: Made beforehand.
        warm_up: So many first calls are not counted.

    Returns:
        Durations (n - warm_up,) [s], and what these calls returned.
    """
    durations = np.empty(len(arguments), np.int64)
    results: list[Any] = [None] * len(arguments)
    with no_garbage_collection():
        for i, argument in enumerate(arguments):
            begin = time.perf_counter_ns()
            results[i] = call(argument)
            durations[i] = time.perf_counter_ns() - begin
    seconds: FloatArray = durations[warm_up:] / 1e9
    return seconds, results[warm_up:]
