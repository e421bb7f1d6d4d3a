"""Checks of state passed in by a caller: kinds, shapes, index ranges and sizes, in one pass over each array.

Kernels do not check the indices that they receive. A state is therefore checked before use, whether it comes from a
file or from a program.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any, NoReturn

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import in_place
from slam_backend.core.validation import argument_error

HINT = "Pass it unchanged."
LARGEST = 1e12  # limit of plain numbers [m, rad, 1]; squares and products of a few of them are finite
MAX_DISTANCE = 1e7  # limit of poses and landmarks [m, rad]
MAX_INT = 1 << 62  # limit of counts and steps: sums of two of them fit int64
MAX_LANDMARKS = 1 << 30  # limit of landmark names: tables are as long as the largest name
LANDMARK = (0, MAX_LANDMARKS)

BOOL, INT8, UINT8 = np.dtype(np.bool_), np.dtype(np.int8), np.dtype(np.uint8)
INT32, INT64 = np.dtype(np.int32), np.dtype(np.int64)
FLOAT32, FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)
STREAMS: dict[str, dict[str, tuple[np.dtype[Any], tuple[int, ...]]]] = {  # arrays in the states of numpy's generators
    "PCG64": {},
    "PCG64DXSM": {},
    "MT19937": {"key": (np.dtype(np.uint32), (624,))},
    "Philox": {"counter": (np.dtype(np.uint64), (4,)), "key": (np.dtype(np.uint64), (2,))},
    "SFC64": {"state": (np.dtype(np.uint64), (4,))},
}


@in_place
def count_outside(values: Any, columns: int, low: Any, high: Any) -> int:
    """Return how many values in the first columns of values (n, P) are out of bounds; NaN is out of bounds."""
    outside = 0
    for i in range(len(values)):
        for j in range(columns):
            outside += not low <= values[i, j] <= high
    return outside


@in_place
def count_falls(values: Any) -> int:
    """Return how many of the values (n,) do not exceed the previous one."""
    falls = 0
    for i in range(1, len(values)):
        falls += values[i] <= values[i - 1]
    return falls


def refuse(name: str, expected: str, got: object) -> NoReturn:
    """Raise the error for a part of a state."""
    raise argument_error(name, expected, got, HINT)


@contextmanager
def refuse_malformed(name: str) -> Iterator[None]:
    """Turn any error that a check meets in a malformed state into a refusal."""
    try:
        yield
    except ValueError:
        raise
    except Exception as error:
        got = f"'{type(error).__name__}: {error}' while checking it"
        raise argument_error(name, "what get_state returned", got, HINT) from error


def instance(name: str, value: Any, *kinds: type) -> None:
    """Refuse a value that is of none of the types; subclasses count as other types."""
    if type(value) not in kinds:
        refuse(name, f"a {' or '.join(kind.__name__ for kind in kinds)}", f"a {type(value).__name__}")


def keys(name: str, value: Any, keys: Iterable[str]) -> None:
    """Refuse a value that is not a dict, or lacks a key."""
    if not isinstance(value, Mapping):
        refuse(name, "a dict from get_state", f"a {type(value).__name__}")
    for key in keys:
        if key not in value:
            refuse(name, "a dict from get_state", f"no {key!r}")


def sequence(name: str, value: Any, length: int | None = None) -> None:
    """Refuse a value that is neither a tuple nor a list, or has another length."""
    instance(name, value, tuple, list)
    if length is not None and len(value) != length:
        refuse(name, f"{length} of them", len(value))


def integer(name: str, value: Any, low: int = 0, high: int = MAX_INT) -> None:
    """Refuse a value that is not an int, or out of bounds."""
    if type(value) is not int or not low <= value <= high:
        refuse(name, f"an int from {low} to {high}", value)


def number(name: str, value: Any, low: float = -LARGEST, high: float = LARGEST) -> None:
    """Refuse a value that is not a float, or out of bounds."""
    if not isinstance(value, float) or not low <= value <= high:
        refuse(name, f"a float from {low:g} to {high:g}", value)


def boolean(name: str, value: Any) -> None:
    """Refuse a value that is not a bool."""
    instance(name, value, bool)


def integers(name: str, values: Any, low: int = 0, high: int = MAX_INT, kind: type = tuple) -> None:
    """Refuse a value that is not a collection of one type with ints within bounds."""
    instance(name, values, kind)
    for value in values:
        if type(value) is not int or not low <= value <= high:
            refuse(name, f"ints from {low} to {high}", value)


def int_dict(name: str, value: Any, of_keys: tuple[int, int], of_values: tuple[int, int] = (0, MAX_INT)) -> None:
    """Refuse a value that is not a dict whose keys and values are ints within bounds."""
    instance(name, value, dict)
    integers(name, tuple(value), *of_keys)
    integers(name, tuple(value.values()), *of_values)


def robots(name: str, robots: Any, count: int) -> None:
    """Refuse a value that is not a tuple of at least one of `count` robots in ascending order."""
    integers(name, robots, 0, count - 1)
    if not robots or list(robots) != sorted(set(robots)):
        refuse(name, "robots in ascending order", robots)


def array(
    name: str, value: Any, dtype: np.dtype[Any], shape: tuple[int | None, ...], low: Any = None, high: Any = None,
    columns: int | None = None,
) -> int:  # fmt: skip
    """Return the length of an array, or refuse a wrong type or shape or a number out of bounds.

    Args:
        name: Name of the part.
        value: The value to check.
        dtype: Type of the array.
        shape: Expected shape, None for a free axis.
        low, high: The bounds; NaN is out of bounds. None: values are not checked.
        columns: Number of entries of the last axis that are in use; None: all.
    """
    if type(value) is not np.ndarray or value.dtype != dtype:
        got = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
        refuse(name, f"an array of {dtype}", got)
    found = value.shape
    if found != shape and (
        len(found) != len(shape) or found != tuple([m if n is None else n for n, m in zip(shape, found, strict=True)])
    ):
        wanted = tuple("n" if n is None else n for n in shape)
        refuse(name, f"an array of shape {wanted}".replace("'", ""), f"shape {found}")
    if low is not None and value.size:
        wide = value.reshape(-1, value.size if columns is None else found[-1])
        if count_outside(wide, wide.shape[1] if columns is None else columns, low, high):
            kind = "numbers from {:g} to {:g}" if dtype.kind == "f" else "integers from {} to {}"
            refuse(name, kind.format(low, high), "a value out of range" + " or NaN" * (dtype.kind == "f"))
    return len(value)


def floats(
    name: str, value: Any, shape: tuple[int | None, ...], low: float = -LARGEST, high: float = LARGEST,
    columns: int | None = None, dtype: np.dtype[Any] = FLOAT64,
) -> int:  # fmt: skip
    """Return the length of an array of floats within bounds, as `array`."""
    return array(name, value, dtype, shape, float(low), float(high), columns)


def positions(name: str, value: Any, shape: tuple[int | None, ...], columns: int | None = None) -> int:
    """Return the length of an array of poses or points, as `array`."""
    return array(name, value, FLOAT64, shape, -MAX_DISTANCE, MAX_DISTANCE, columns)


def indices(
    name: str, value: Any, shape: tuple[int | None, ...], low: int = 0, high: int = MAX_INT, columns: int | None = None,
    dtype: np.dtype[Any] = INT64,
) -> int:  # fmt: skip
    """Return the length of an array of integers within bounds, as `array`."""
    return array(name, value, dtype, shape, low, high, columns)


def ascending(name: str, values: NDArray[Any]) -> None:
    """Refuse values (n,) that are not strictly ascending."""
    if count_falls(values):
        refuse(name, "distinct numbers in ascending order", "a number that is out of order or repeated")


def unique(name: str, values: NDArray[Any]) -> None:
    """Refuse values (n,) with a duplicate."""
    if len(np.unique(values)) < len(values):
        refuse(name, "distinct numbers", "a repeated number")


def options(name: str, options: Any, kind: type, known: Iterable[Any] = ()) -> None:
    """Refuse a value that is not an options object of a type, or whose constructor refuses its fields.

    Args:
        name: Name of the part.
        options: The value to check.
        kind: A frozen dataclass.
        known: Options that are known to be valid.
    """
    instance(name, options, kind)
    try:
        if not any(options is other or options == other for other in known):
            _rebuilt(options)
    except Exception as error:  # of any kind: unchecked options may hold anything
        raise argument_error(name, f"{kind.__name__} that can be built", f"'{error}'", HINT) from error


def _rebuilt(options: Any) -> Any:
    """Return options rebuilt by their constructors, nested ones included."""
    parts = {field.name: getattr(options, field.name) for field in fields(options)}
    return type(options)(**{name: _rebuilt(part) if is_dataclass(part) else part for name, part in parts.items()})


def generator(name: str, state: Any) -> None:
    """Refuse a value that is not the state of a numpy bit generator; numpy itself would read beyond its buffers."""
    keys(name, state, ("bit_generator", "state"))
    kind = state["bit_generator"]
    if type(kind) is not str or kind not in STREAMS:
        refuse(f"{name}['bit_generator']", "one of " + ", ".join(STREAMS), kind)
    inner = state["state"]
    keys(f"{name}['state']", inner, STREAMS[kind])
    for part, (dtype, shape) in STREAMS[kind].items():
        array(f"{name}['state'][{part!r}]", inner[part], dtype, shape)
    if kind == "MT19937":
        integer(f"{name}['state']['pos']", inner.get("pos"), 0, 624)
        return
    integer(f"{name}['has_uint32']", state.get("has_uint32"), 0, 1)
    integer(f"{name}['uinteger']", state.get("uinteger"), 0, 2**32 - 1)
    if kind in ("PCG64", "PCG64DXSM"):
        for part in ("state", "inc"):
            integer(f"{name}['state'][{part!r}]", inner.get(part), 0, 2**128 - 1)
    elif kind == "Philox":
        integer(f"{name}['buffer_pos']", state.get("buffer_pos"), 0, 4)
        array(f"{name}['buffer']", state.get("buffer"), np.dtype(np.uint64), (4,))


def restore_generator(state: Mapping[str, Any]) -> np.random.Generator:
    """Return a random generator that continues from a state that `generator` accepted."""
    kinds: dict[str, Any] = {name: getattr(np.random, name) for name in STREAMS}
    stream = np.random.Generator(kinds[state["bit_generator"]](0))
    stream.bit_generator.state = state
    return stream


def named_items(name: str, values: Sequence[Any], length: int | None = None) -> Iterable[tuple[str, Any]]:
    """Return each of the parts with its name, or refuse a value that is not a tuple or list of `length` parts."""
    sequence(name, values, length)
    return [(f"{name}[{i}]", value) for i, value in enumerate(values)]


def compile_checks() -> None:
    """Compile all versions of the kernels that states need."""
    for is_open in (True, False):
        for dtype in (FLOAT64, FLOAT32, INT64, INT32):
            values = np.zeros((1, 1), dtype)
            values.setflags(write=is_open)
            check = floats if dtype.kind == "f" else indices
            check("warm", values, (1, 1), 0, 1, dtype=dtype)
        names = np.zeros(1, np.int64)
        names.setflags(write=is_open)
        ascending("warm", names)
