"""Timing of single calls without garbage collection, and common parts of the timing benchmarks."""

import gc
import os
import platform
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray

BUSY = 1.2  # one-minute load above which another process was running


def timing_ms(seconds: FloatArray) -> dict[str, float]:
    """Summarise durations (n,) [s] of `calls`: median, minimum, and the ends of the middle 80 % [ms]."""
    low, median, high = (float(q) for q in np.quantile(1e3 * seconds, (0.1, 0.5, 0.9)))
    least = float(1e3 * seconds.min())
    return {"median_ms": median, "low_ms": low, "high_ms": high, "min_ms": least, "calls": len(seconds)}


@contextmanager
def no_garbage_collection() -> Iterator[None]:
    """Collect garbage once, then not until the block ends: a collection would be charged to a single call."""
    was_on = gc.isenabled()
    gc.collect()
    gc.disable()
    try:
        yield
    finally:
        if was_on:
            gc.enable()


def time_calls(call: Callable[[Any], Any], arguments: Sequence[Any], warm_up: int = 0) -> tuple[FloatArray, list[Any]]:
    """Time `call(argument)` for each argument in order, not counting the first `warm_up` calls.

    Returns:
        Durations (n - warm_up,) [s] and results of the timed calls.
    """
    results: list[Any] = [None] * len(arguments)

    def keep(i: int) -> None:
        results[i] = call(arguments[i])

    with no_garbage_collection():
        seconds = clock(keep, range(len(arguments)))
    return seconds[warm_up:], results[warm_up:]


def clock(call: Callable[[Any], Any], arguments: Sequence[Any]) -> FloatArray:
    """Return the duration of each call (n,) [s]; results are discarded."""
    durations = np.empty(len(arguments), np.int64)
    for i, argument in enumerate(arguments):
        begin = time.perf_counter_ns()
        call(argument)
        durations[i] = time.perf_counter_ns() - begin
    return durations / 1e9


def describe_machine() -> dict[str, Any]:
    """Return the processor, its number of cores, and the one-minute load."""
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
    return {"processor": processor(), "cores": os.cpu_count(), "load_before": load}


def processor() -> str:
    """Return the name of the processor, if the system reports it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def busy_note(machine: Mapping[str, Any]) -> str:
    """Return a warning if the machine was busy, else nothing."""
    load = machine["load_before"]
    return "" if load is None or load <= BUSY else f"The machine was busy (load {load:.1f}): times may be too long."
