"""The one way in which this project compiles a kernel: serial, cached on disk, without the interpreter lock."""

from collections.abc import Callable
from typing import ParamSpec, TypeVar, cast

import numba

P = ParamSpec("P")
T = TypeVar("T")


def jit(function: Callable[P, T]) -> Callable[P, T]:
    """Compile `function` with numba and keep its signature for the type checker.

    numba's disk cache notices edits of the file that holds `function`, not of other files whose kernels it calls:
    kernels that call each other therefore live in one module. `parallel=True` is left out on purpose, because it
    breaks forked workers.
    """
    return cast(Callable[P, T], numba.njit(cache=True, nogil=True)(function))


def inlined(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a small building block into each kernel that calls it: passing arrays costs more than its arithmetic."""
    return cast(Callable[P, T], numba.njit(cache=True, nogil=True, forceinline=True)(function))
