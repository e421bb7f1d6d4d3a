"""Which arrays of a state are arrays of something else, too, and could be written to."""

from collections.abc import Iterator, Mapping
from types import BuiltinFunctionType, FunctionType, MethodType, ModuleType
from typing import Any
from weakref import ref

import numpy as np

OPAQUE = (str, bytes, np.generic, np.dtype, type, ModuleType, FunctionType, MethodType, BuiltinFunctionType, ref)


def arrays_in(root: Any) -> Iterator[tuple[str, np.ndarray]]:
    """Yield each array that can be reached from an object, once, with the way to it."""
    seen: dict[int, Any] = {}  # by `id`; holding the objects keeps their ids from being used again
    waiting = [("", root)]
    while waiting:
        way, value = waiting.pop()
        if isinstance(value, OPAQUE) or id(value) in seen:
            continue
        seen[id(value)] = value
        if isinstance(value, np.ndarray):
            yield way, value
        else:
            waiting += [(way + step, part) for step, part in _parts(value)]


def _parts(value: Any) -> Iterator[tuple[str, Any]]:
    """Yield the parts of a value: entries, and attributes from `__dict__` and `__slots__`."""
    if isinstance(value, Mapping):
        yield from ((f"[{key!r}]", part) for key, part in value.items())
    elif isinstance(value, (tuple, list, set, frozenset)) or hasattr(value, "popleft"):
        yield from ((f"[{place}]", part) for place, part in enumerate(value))
    names = dict.fromkeys(getattr(value, "__dict__", ()))
    for cls in type(value).__mro__:
        slots = cls.__dict__.get("__slots__", ())
        names |= dict.fromkeys((slots,) if isinstance(slots, str) else slots)
    yield from (
        (f".{name}", getattr(value, name)) for name in names if not name.startswith("__") and hasattr(value, name)
    )


def can_be_written(array: np.ndarray) -> bool:
    """Tell whether numpy lets its holder write to an array, or make it writable."""
    was = array.flags.writeable
    try:
        array.flags.writeable = True
    except ValueError:
        return False
    array.flags.writeable = was
    return True


def shared(state: Any, other: Any) -> dict[str, np.ndarray]:
    """Return the arrays in a state, by the way to them, that share memory with some in another object."""
    theirs = sorted(((*np.lib.array_utils.byte_bounds(array), array) for _, array in arrays_in(other) if array.size),
                    key=lambda entry: entry[:2])  # fmt: skip
    ends = np.maximum.accumulate([end for _, end, _ in theirs])
    found = {}
    for way, array in arrays_in(state):
        low, high = np.lib.array_utils.byte_bounds(array)
        first = int(np.searchsorted(ends, low, side="right"))
        for begin, _, candidate in theirs[first:] if array.size else ():
            if begin >= high:
                break
            if np.shares_memory(array, candidate):
                found[way] = array
                break
    return found


def shared_and_writable(state: Any, other: Any) -> list[str]:
    """Return the ways to those of `shared` that can be written."""
    return [way for way, array in shared(state, other).items() if can_be_written(array)]


def scribble(state: Any) -> int:
    """Write what is out of place into all arrays of a state that can be written; return how many there are."""
    count = 0
    for _, array in arrays_in(state):
        if array.size and can_be_written(array):
            array.flags.writeable = True
            array.fill(
                np.nan if array.dtype.kind == "f" else 1 if array.dtype.kind == "b" else np.iinfo(array.dtype).max
            )
            count += 1
    return count
