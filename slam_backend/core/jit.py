"""The few ways in which this project compiles a kernel: serial, cached on disk, without the interpreter lock."""

from collections.abc import Callable
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
import numpy as np
from llvmlite import ir
from numba.core import cgutils, types
from numba.core.cpu import CPUTargetOptions
from numba.core.registry import CPUDispatcher
from numba.extending import intrinsic
from numba.np import arrayobj
from numpy.typing import NDArray

from slam_backend.core.kernel_cache import KernelCache
from slam_backend.core.validation import FloatArray

P = ParamSpec("P")
T = TypeVar("T")
Scalar = TypeVar("Scalar", bound=np.generic)

LINE = 64  # bytes of a line of the cache
KERNELS = "_kernels"  # ends the name of a folder whose modules hold kernels that call each other
SIMD_MATH = Path(__file__).with_name("simd_math.py")  # which those of other folders call, too


# numba counts the references to each array: it makes a counter for each one that Python hands over, and each slice in a
# kernel costs two atomic instructions. A kernel that only works in arrays which it is given can do without. numba
# refuses to make an array in one of those, but not to call a kernel that returns some, which nobody would free: a test
# looks for that. The option is numba's own; in a version that does not know it references are counted everywhere.
HAS_NRT_OPTION = hasattr(CPUTargetOptions, "_nrt")

# A kernel inherits `fastmath`, `error_model`, `forceinline` and `_nrt` from the kernel whose compilation first
# asked for it, where it does not set them: results would depend on the order. Each kind of kernel sets all four.
_STRICT: dict[str, Any] = {"fastmath": False, "error_model": "python"}

# Lane kernels run the same arithmetic over a fixed number of particles, so that the compiler turns it into vector
# instructions. Two things it needs: a product and a sum may be fused into one instruction (`contract`; sums are not
# reordered, so the same machine gives the same bytes), and a division by zero gives inf instead of an exception.
_LANES: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy"}
_ANY_ORDER: dict[str, Any] = {"fastmath": {"contract", "reassoc", "nsz"}, "error_model": "numpy"}


class DeviceKernel(CPUDispatcher):
    """Kernel that has no wrapper for Python: only other kernels can call it."""

    def __call__(self, *args: Any, **kwargs: Any) -> Any:
        """Refuse a call from Python, which would end in a segmentation fault.

        Raises:
            TypeError: Always.
        """
        raise TypeError(f"{self.py_func.__qualname__} can be called by kernels only: remove @device to call it here")


def jit(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel that may make arrays, and keep its signature for the type checker.

    numba's disk cache notices edits of the file that holds `function`, not of other files whose kernels it calls:
    kernels that call each other therefore live in one module, or in one folder whose name ends in `_kernels`, of which
    an edit of any file is noticed, as is one of `SIMD_MATH`. `parallel=True` is left out on purpose, because it breaks
    forked workers.
    """
    return _compiled(function, counted=True, forceinline=False, **_STRICT)


def jit_fma(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel that may make arrays and does little but add products: each is rounded once, as by `lanes`."""
    return _compiled(function, counted=True, forceinline=False, **_LANES)


def in_place(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel that works in the arrays it is given: references to them are not counted.

    It makes no arrays, returns none, and calls none that returns some. So do all kernels compiled by the following.
    """
    return _compiled(function, counted=False, forceinline=False, **_STRICT)


def inline(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a small building block into each kernel that calls it: passing arrays costs more than its arithmetic."""
    return device(_compiled(function, counted=False, forceinline=True, **_STRICT))


def simd(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel whose loops over lanes are to become vector instructions, or one as of `fused` in place."""
    return _compiled(function, counted=False, forceinline=False, **_LANES)


def simd_inline(function: Callable[P, T]) -> Callable[P, T]:
    """Compile the arithmetic of one lane into the loops that call it."""
    return device(_compiled(function, counted=False, forceinline=True, **_LANES))


def simd_sum(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a sum over an array that may be taken in any order, the same one each time, so that it is vectorised."""
    return device(_compiled(function, counted=False, forceinline=True, **_ANY_ORDER))


def device(kernel: Callable[P, T]) -> Callable[P, T]:
    """Leave out the Python wrapper of a kernel that only other kernels call; stands above the kernel's own decorator.

    The wrapper takes as long to compile as a small kernel. A call from Python raises TypeError.
    """
    if isinstance(kernel, CPUDispatcher):  # a plain function where NUMBA_DISABLE_JIT is set
        kernel.targetoptions["no_cpython_wrapper"] = True
        kernel.__class__ = DeviceKernel
        _stamp(kernel)
    return kernel


def _compiled(function: Callable[P, T], counted: bool, **options: Any) -> Callable[P, T]:
    """Compile without the interpreter lock and with the cache on disk, if there is a place for it."""
    if HAS_NRT_OPTION:
        options["_nrt"] = counted
    options |= {"nogil": True, "no_cfunc_wrapper": True}  # no C code calls a kernel
    try:
        kernel = numba.njit(cache=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's can be written: each process compiles anew
        kernel = numba.njit(**options)(function)
    _stamp(kernel)
    return cast(Callable[P, T], kernel)


def _stamp(kernel: Any) -> None:
    """Let entries of the disk cache be stale once the options or the files that a kernel was compiled from change."""
    cache: Any = getattr(kernel, "_cache", None)
    if not hasattr(cache, "_impl"):  # compilation, or its cache, is switched off
        return
    folder = Path(kernel.py_func.__code__.co_filename).parent
    callees = _contents(folder) if folder.name.endswith(KERNELS) else b""
    options = sorted((name, sorted(x) if isinstance(x, set) else x) for name, x in kernel.targetoptions.items())
    kernel._cache = KernelCache(cache, (cache._impl.locator.get_source_stamp(), callees, options))


@lru_cache
def _contents(folder: Path) -> bytes:
    """Return a digest of all modules of a folder, and of those which any folder's may call."""
    digest = sha256()
    for file in sorted({*folder.glob("*.py"), SIMD_MATH}):
        digest.update(file.read_bytes())
    return digest.digest()


def _float_bits(typing_context: Any, x: Any) -> Any:
    """Return the 64 bits of a float64 as an int64 (inside kernels only)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.IntType(64))

    return types.int64(types.float64), code


def _bits_float(typing_context: Any, x: Any) -> Any:
    """Return the float64 that an int64's bits stand for (inside kernels only)."""

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return builder.bitcast(args[0], ir.DoubleType())

    return types.float64(types.int64), code


float_bits = cast(Callable[[float], int], intrinsic(_float_bits))
bits_float = cast(Callable[[int], float], intrinsic(_bits_float))


# numba declares no types for these.
alloca_once: Callable[..., Any] = cgutils.alloca_once
populate_array: Callable[..., Any] = arrayobj.populate_array


def _unset(number: Any, size: Any, *others: Any) -> Any:
    """Return type and code of a function of a constant size, and perhaps more, that returns an array on the stack."""
    if not isinstance(size, types.IntegerLiteral):
        return None
    row = types.Array(number, 1, "C")

    def code(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        data = alloca_once(builder, context.get_data_type(number), size=size.literal_value)
        data.align = LINE
        array = context.make_array(row)(context, builder)
        item, length = (context.get_constant(types.intp, n) for n in (number.bitwidth // 8, size.literal_value))
        populate_array(array, data=data, shape=[length], strides=[item], itemsize=item, meminfo=None)
        return array._getvalue()

    return row(size, *others), code


def _room(typing_context: Any, size: Any) -> Any:
    """Return an array (size,) of float64, unset, on the stack (inside kernels only)."""
    return _unset(types.float64, size)


def _room_of(typing_context: Any, size: Any, dtype: Any) -> Any:
    """Return an array (size,) of numbers of a type, unset, on the stack (inside kernels only)."""
    return _unset(dtype.dtype, size, dtype)


# An array of as many numbers as a constant says, unset, that lives as long as the call of a kernel: it costs nothing,
# and even a kernel that works `in_place` may have it, but not return it.
stack_array = cast(Callable[[int], FloatArray], intrinsic(prefer_literal=True)(_room))
stack_array_of = cast(Callable[[int, type[Scalar]], NDArray[Scalar]], intrinsic(prefer_literal=True)(_room_of))
