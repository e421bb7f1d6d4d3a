"""Decorators that compile kernels: serial, cached on disk, without the interpreter lock."""

import logging
from collections.abc import Callable
from inspect import signature
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.cpu import CPUTargetOptions
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic
from numpy.typing import NDArray

from slam_backend.core.compilation.cache import KernelCache
from slam_backend.core.compilation.device import DeviceCompiler
from slam_backend.core.compilation.shipped import CONFIG
from slam_backend.core.validation import FloatArray

LOGGER = logging.getLogger("slam_backend")
P = ParamSpec("P")
T = TypeVar("T")
Scalar = TypeVar("Scalar", bound=np.generic)

IS_PLAIN = bool(CONFIG.DISABLE_JIT)  # whether kernels are plain functions
LINE = 64  # size of a cache line [bytes]

# numba counts the references to each array: it makes a counter for each array passed from Python, and each slice in a
# kernel costs two atomic instructions. A kernel that only works in arrays passed to it needs no counts. numba rejects
# such a kernel if it makes an array, but not if it calls a kernel that returns one, whose memory would leak: a test
# detects this. The option belongs to numba; a version without it counts references everywhere.
HAS_NRT_OPTION = hasattr(CPUTargetOptions, "_nrt")

# A kernel inherits those of `fastmath`, `error_model`, `forceinline` and `_nrt` that it does not set from the kernel
# whose compilation first calls it: results would depend on the order. Each kind of kernel sets all four.
_STRICT: dict[str, Any] = {"fastmath": False, "error_model": "python"}

# Lane kernels run the same arithmetic over a fixed number of particles, so that the compiler emits vector instructions.
# This needs two settings: a product and a sum may be fused into one instruction (`contract`), and a division by zero
# gives inf instead of an exception. Sums are never reordered: their last bits would depend on the width of the
# processor's vectors, and kernels compiled for another processor would give other bytes.
_LANES: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy"}


class DeviceKernel(CPUDispatcher):
    """Kernel without a wrapper for Python, which only other kernels can call."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Refuse a call from Python, which would cause a segmentation fault.

        Raises:
            TypeError: Always.
        """
        raise TypeError(f"{self.py_func.__qualname__} can be called by kernels only: remove @device to call it here")


def jit(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel that may make arrays; the type checker sees the signature of `function`.

    `parallel=True` is left out on purpose, because it breaks forked workers.
    """
    return _compiled(function, counted=True, forceinline=False, **_STRICT)


def jit_fma(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel that may make arrays and mainly sums products: products and sums are fused, as by `simd`."""
    return _compiled(function, counted=True, forceinline=False, **_LANES)


def in_place(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel that works in the arrays passed to it, without reference counts.

    It makes no arrays, returns none, and calls no kernel that returns one. This holds for all decorators below, too.
    """
    return _compiled(function, counted=False, forceinline=False, **_STRICT)


def inline(function: Callable[P, T]) -> Callable[P, T]:
    """Inline a small kernel into each caller: passing arrays costs more than its arithmetic."""
    return device(_compiled(function, counted=False, forceinline=True, **_STRICT))


def simd(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel whose loops over lanes become vector instructions, or an in-place kernel of `jit_fma`'s kind."""
    return _compiled(function, counted=False, forceinline=False, **_LANES)


def simd_inline(function: Callable[P, T]) -> Callable[P, T]:
    """Inline the arithmetic of one lane into the loops that call it."""
    return device(_compiled(function, counted=False, forceinline=True, **_LANES))


def device(kernel: Callable[P, T]) -> Callable[P, T]:
    """Omit the Python wrapper of a kernel that only other kernels call; goes above the kernel's own decorator.

    The wrapper takes as long to compile as a small kernel, and only the calling kernels are optimised and become
    machine code. A call from Python raises TypeError.
    """
    if isinstance(kernel, CPUDispatcher):
        kernel.targetoptions["no_cpython_wrapper"] = True
        compiler: Any = kernel._compiler  # type: ignore[attr-defined]
        compiler.pipeline_class = DeviceCompiler
        kernel.__class__ = DeviceKernel
    return kernel


def _compiled(function: Callable[P, T], counted: bool, **options: Any) -> Callable[P, T]:
    """Compile without the interpreter lock and with the cache on disk."""
    if IS_PLAIN:  # compiled arithmetic overflows and divides by zero without a warning
        return np.errstate(all="ignore")(function)
    if HAS_NRT_OPTION:
        options["_nrt"] = counted
    options |= {"nogil": True, "no_cfunc_wrapper": True}  # no C code calls a kernel
    python: Any = function
    python.__signature__ = signature(function)  # numba asks for it twice, which takes a tenth of this package's import
    kernel: Any = numba.njit(**options)(function)
    kernel._cache = KernelCache(kernel)
    return cast(Callable[P, T], kernel)


def _float_bits(typing_context: Any, x: Any) -> Any:
    """Return the 64 bits of a float64 as an int64 (inside kernels only)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), code


def _bits_float(typing_context: Any, x: Any) -> Any:
    """Return the float64 with the bits of an int64 (inside kernels only)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), code


# numba declares no types for this.
alloca_once: Callable[..., Any] = cgutils.alloca_once


def _unset(number: Any, size: Any, *others: Any) -> Any:
    """Return type and code of a function that returns an array of constant size on the stack."""
    if not isinstance(size, types.IntegerLiteral):
        return None
    row = types.Array(number, 1, "C")

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        from numba.np import arrayobj  # a slow import

        data = alloca_once(builder, context.get_data_type(number), size=size.literal_value)
        data.align = LINE
        array = context.make_array(row)(context, builder)
        item, length = (context.get_constant(types.intp, n) for n in (number.bitwidth // 8, size.literal_value))
        populate_array: Any = arrayobj.populate_array
        populate_array(array, data=data, shape=[length], strides=[item], itemsize=item, meminfo=None)
        return array._getvalue()

    return row(size, *others), code


def _room(typing_context: Any, size: Any) -> Any:
    """Return an array (size,) of float64, unset, on the stack (inside kernels only)."""
    return _unset(types.float64, size)


def _room_of(typing_context: Any, size: Any, dtype: Any) -> Any:
    """Return an array (size,) of numbers of a type, unset, on the stack (inside kernels only)."""
    return _unset(dtype.dtype, size, dtype)


# numba refuses calls of intrinsics from Python, as happen with compilation switched off.
if IS_PLAIN:
    LOGGER.warning("NUMBA_DISABLE_JIT is set: kernels run as plain Python, some hundred times as slow.")
float_bits = cast(
    Callable[[float], int], (lambda x: np.float64(x).view(np.int64)) if IS_PLAIN else intrinsic(_float_bits)
)
bits_float = cast(
    Callable[[int], float], (lambda x: np.int64(x).view(np.float64)) if IS_PLAIN else intrinsic(_bits_float)
)
# Uninitialised array of a constant size that lives as long as the call of a kernel. It costs nothing, and a kernel
# compiled by `in_place` may use it, but not return it.
stack_array = cast(Callable[[int], FloatArray], np.empty if IS_PLAIN else intrinsic(prefer_literal=True)(_room))
stack_array_of = cast(
    Callable[[int, type[Scalar]], NDArray[Scalar]],
    np.empty if IS_PLAIN else intrinsic(prefer_literal=True)(_room_of),
)
