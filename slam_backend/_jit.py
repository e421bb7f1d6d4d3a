"""The few ways in which this project compiles a kernel: serial, cached on disk, without the interpreter lock."""

from collections.abc import Callable
from functools import lru_cache
from hashlib import sha256
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numba
from llvmlite import ir
from numba.core import types
from numba.extending import intrinsic

P = ParamSpec("P")
T = TypeVar("T")

KERNELS = "_kernels"  # ends the name of a folder whose modules hold kernels that call each other


def jit(function: Callable[P, T]) -> Callable[P, T]:
    """Compile `function` with numba and keep its signature for the type checker.

    numba's disk cache notices edits of the file that holds `function`, not of other files whose kernels it calls:
    kernels that call each other therefore live in one module, or in one folder whose name ends in `_kernels`, of which
    an edit of any file is noticed. `parallel=True` is left out on purpose, because it breaks forked workers.
    """
    return _compiled(function)


def inlined(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a small building block into each kernel that calls it: passing arrays costs more than its arithmetic."""
    return _compiled(function, forceinline=True)


# Lane kernels run the same arithmetic over a fixed number of particles, so that the compiler turns it into vector
# instructions. Two things it needs: a product and a sum may be fused into one instruction (`contract`; sums are not
# reordered, so the same machine gives the same bytes), and a division by zero gives inf instead of an exception.
_LANES: dict[str, Any] = {"fastmath": {"contract"}, "error_model": "numpy"}


def lanes(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel whose loops over lanes are to become vector instructions."""
    return _compiled(function, **_LANES)


def lanes_inlined(function: Callable[P, T]) -> Callable[P, T]:
    """Compile the arithmetic of one lane into the loops that call it."""
    return _compiled(function, forceinline=True, **_LANES)


def fused(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a kernel that does little but add products: each is one instruction, rounded once."""
    return _compiled(function, **_LANES)


def any_order(function: Callable[P, T]) -> Callable[P, T]:
    """Compile a sum over an array that may be taken in any order, the same one each time, so that it is vectorised."""
    return _compiled(function, forceinline=True, fastmath={"contract", "reassoc", "nsz"}, error_model="numpy")


def _compiled(function: Callable[P, T], **options: Any) -> Callable[P, T]:
    """Compile without the interpreter lock and with the cache on disk, if there is a place for it."""
    try:
        kernel = numba.njit(cache=True, nogil=True, **options)(function)
    except RuntimeError:  # neither the package's folder nor the user's can be written: each process compiles anew
        return cast(Callable[P, T], numba.njit(nogil=True, **options)(function))
    folder = Path(function.__code__.co_filename).parent
    if folder.name.endswith(KERNELS) and hasattr(kernel, "_cache"):  # it has none where NUMBA_DISABLE_JIT is set
        file = kernel._cache._cache_file
        file._source_stamp = (file._source_stamp, _contents(folder))
    return cast(Callable[P, T], kernel)


@lru_cache
def _contents(folder: Path) -> bytes:
    """Return a digest of all modules of a folder."""
    digest = sha256()
    for file in sorted(folder.glob("*.py")):
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
