"""What one core of this machine can do at best, measured: how fast it moves bytes, how fast it multiplies and adds."""

import os
import platform
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

SMALLEST, LARGEST = 2**16, 2**27  # [bytes] of a copy
MATRIX = 384  # rows of the matrices whose product is timed
# The best of many short timings counts: each fits between two interruptions, should the machine be busy.
AT_LEAST_S = 0.001
TRIALS = 40


def best_seconds(call: Callable[[], Any]) -> float:
    """Return the shortest duration of a call [s]; short calls are repeated within a timing."""
    call()
    begin = time.perf_counter()
    call()
    repeats = 1 + int(AT_LEAST_S / max(time.perf_counter() - begin, 1e-7))
    best = np.inf
    for _ in range(TRIALS):
        begin = time.perf_counter()
        for _ in range(repeats):
            call()
        best = min(best, (time.perf_counter() - begin) / repeats)
    return float(best)


def copy_rate(working_set: int) -> float:
    """Return how many bytes per second numpy's copy moves (read and written ones together).

    Args:
        working_set: Bytes of source and target together; what fits a cache is moved faster.
    """
    return _copy_rate(2 ** round(np.log2(min(max(working_set, SMALLEST), LARGEST))))


@cache
def _copy_rate(working_set: int) -> float:
    source, target = np.ones(working_set // 16), np.zeros(working_set // 16)
    return working_set / best_seconds(lambda: np.copyto(target, source))


@cache
def multiply_add_rate(dtype: str) -> float:
    """Return how many multiply-adds per second the matrix product of numpy's BLAS does, for `"float64"` or `"float32"`.

    It uses as many threads as BLAS is allowed to: limit them to one beforehand.
    """
    a, out = np.ones((MATRIX, MATRIX), dtype), np.empty((MATRIX, MATRIX), dtype)
    return MATRIX**3 / best_seconds(lambda: np.matmul(a, a, out=out))


def describe_machine() -> dict[str, Any]:
    """Return processor, cores, the load of the last minute, and the rates of one core."""
    return {
        "processor": processor(),
        "cores": os.cpu_count(),
        "load_before": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "copy_bytes_per_s": copy_rate(LARGEST),
        "copy_in_cache_bytes_per_s": copy_rate(2**19),
        "multiply_adds_per_s_float64": multiply_add_rate("float64"),
        "multiply_adds_per_s_float32": multiply_add_rate("float32"),
    }


def processor() -> str:
    """Return the processor's name, as far as the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
