"""A way for tests to call kernels that only other kernels call."""

from collections.abc import Callable
from functools import cache
from typing import Any

import numba

from slam_backend.core.jit import DeviceKernel


@cache
def python_entry(kernel: Callable[..., Any]) -> Callable[..., Any]:
    """Return a kernel compiled as it is, but with the wrapper that Python needs to call it."""
    if not isinstance(kernel, DeviceKernel):
        return kernel
    return numba.jit(**kernel.targetoptions | {"no_cpython_wrapper": False})(kernel.py_func)
