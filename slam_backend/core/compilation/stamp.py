"""Stamps of kernels: digests of the inputs of their compilation, apart from signature and processor.

A kernel is compiled together with all kernels that it calls, and the constants that these name become part of it. The
stamp therefore covers the code of the kernel and of all functions that it reaches, in any module, their options and
compilers, and the values of their constants. A change of any of these changes the stamp; a change of a comment in a
kernel does not.
"""

from collections.abc import Iterable, Iterator
from functools import cache
from hashlib import sha256
from inspect import getfile
from pathlib import Path
from types import BuiltinFunctionType, CodeType, EllipsisType, FunctionType, ModuleType, NoneType
from typing import Any

import llvmlite
import numba
import numpy as np
from numba.core import types
from numba.core.extending import _Intrinsic
from numba.core.registry import CPUDispatcher

LIBRARIES = ("numba", "llvmlite", "numpy", "math", "builtins")  # modules covered by their versions
# Settings of numba that change machine code, and that numba's own cache overlooks.
SETTINGS = ("OPT", "LOOP_VECTORIZE", "SLP_VECTORIZE", "BOUNDSCHECK", "DEBUGINFO_DEFAULT")
SCALARS = (int, float, complex, str, bytes, NoneType, EllipsisType, types.Type)


def stamp_of(kernel: CPUDispatcher) -> str:
    """Return a digest of all inputs of a kernel's compilation.

    Raises:
        TypeError: If a kernel names an object whose value has no digest.
    """
    seen: dict[Any, str] = {}
    todo: list[Any] = [kernel]
    while todo:
        function = todo.pop()
        if function not in seen:
            seen[function], callees = _described(function, _options(function))
            todo += callees
    return sha256(repr([_tools(), *sorted(seen.values())]).encode()).hexdigest()


def types_text(arguments: Iterable[Any]) -> str:
    """Return argument types as a text with the fields of records, which numba's own text leaves out."""
    parts = []
    for each in arguments:
        fields: Any = each
        inner = types_text(fields.types) if isinstance(each, types.BaseTuple) else ""
        parts.append((str(each), getattr(each, "fields", ()), inner))
    return repr(parts)


@cache
def _tools() -> str:
    """Return the versions and settings of the compiler, as a text."""
    settings = [str(getattr(numba.config, name, None)) for name in SETTINGS]
    return repr((numba.__version__, llvmlite.__version__, settings))


def _options(function: Any) -> str:
    """Return the options of a kernel and its compiler as a text, sorted; empty for other functions."""
    if not isinstance(function, CPUDispatcher):
        return ""
    options = sorted((name, sorted(x) if isinstance(x, set) else x) for name, x in function.targetoptions.items())
    return repr((options, _compiler_text(function._compiler.pipeline_class)))  # type: ignore[attr-defined]


@cache
def _compiler_text(kind: type) -> str:
    """Return the name of a compiler and, if it is the project's own, a digest of its module."""
    return _path(kind) + ("" if _is_library(kind) else sha256(Path(getfile(kind)).read_bytes()).hexdigest())


@cache
def _described(function: Any, options: str) -> tuple[str, tuple[Any, ...]]:
    """Return a digest of a function's own code, constants and options, and the functions that it names."""
    callees: list[Any] = []
    python: FunctionType = getattr(function, "py_func", None) or getattr(function, "_defn", function)
    scope = python.__globals__ | {
        name: cell.cell_contents
        for name, cell in zip(python.__code__.co_freevars, python.__closure__ or (), strict=True)
    }
    names = sorted(set(_names(python.__code__)))
    found = {name: scope[name] for name in names if name in scope}
    for module in [value for value in found.values() if isinstance(value, ModuleType) and not _is_library(value)]:
        del found[next(name for name in found if found[name] is module)]
        found |= {f"{module.__name__}.{name}": getattr(module, name) for name in names if hasattr(module, name)}
    values = [(name, _text(value, callees)) for name, value in found.items()]
    defaults = _text([python.__defaults__, sorted((python.__kwdefaults__ or {}).items())], callees)
    parts = (_path(python), options, _code(python.__code__), defaults, values)
    return sha256(repr(parts).encode()).hexdigest(), tuple(callees)


def _names(code: CodeType) -> Iterator[str]:
    """Yield the names that code looks up outside itself, including those in nested functions."""
    yield from (*code.co_names, *code.co_freevars)
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _names(constant)


def _code(code: CodeType) -> str:
    """Return code as a text, without line numbers and file names."""
    constants = [_code(x) if isinstance(x, CodeType) else _text(x, []) for x in code.co_consts]
    shape = code.co_argcount, code.co_posonlyargcount, code.co_kwonlyargcount, code.co_flags
    names = code.co_names, code.co_varnames, code.co_freevars, code.co_cellvars
    return repr((code.co_name, code.co_code.hex(), code.co_exceptiontable.hex(), constants, shape, names))


def _text(value: Any, callees: list[Any]) -> str:
    """Return a value as a complete text; functions are named and added to the callees."""
    if isinstance(value, (CPUDispatcher, _Intrinsic, FunctionType)):
        python: Any = getattr(value, "py_func", None) or getattr(value, "_defn", value)
        if not _is_library(python):
            callees.append(value)
        return _path(python)
    if isinstance(value, type):
        return f"{_path(value)} {getattr(value, '_fields', ())}"  # a kernel finds a record's fields by their order
    if isinstance(value, (BuiltinFunctionType, np.ufunc)):
        return _path(value)
    if isinstance(value, ModuleType) and _is_library(value):
        return value.__name__
    if isinstance(value, (np.generic, np.ndarray)):
        return f"{value.dtype.descr} {value.shape} {value.tobytes().hex()}"
    if isinstance(value, (tuple, list)):
        return f"{type(value).__name__} {[_text(x, callees) for x in value]}"
    if isinstance(value, frozenset):
        return f"set {sorted(_text(x, callees) for x in value)}"
    if isinstance(value, (*SCALARS, np.dtype)):
        return f"{type(value).__name__} {value!r}"
    raise TypeError(f"constant of a kernel: expected a number, text, array or tuple, got {type(value).__name__}.")


def _is_library(thing: Any) -> bool:
    """Return whether a module or function belongs to a library."""
    name = thing.__name__ if isinstance(thing, ModuleType) else thing.__module__
    return str(name).split(".")[0] in LIBRARIES


def _path(thing: Any) -> str:
    """Return the dotted name of a function or class."""
    return f"{getattr(thing, '__module__', '')}.{getattr(thing, '__qualname__', thing.__name__)}"
