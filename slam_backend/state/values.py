"""Parts of states: numbers, texts, arrays and containers."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_constant, as_read_only, constant_copy
from slam_backend.state.declaration import Part, Sizes, Snapshot, refuse

LARGEST = 1e12  # limit of plain numbers [m, rad, 1]; squares and products of a few of them are finite
MAX_DISTANCE = 1e7  # limit of poses and landmarks [m, rad]
MAX_INT = 1 << 62  # limit of counts and steps: sums of two of them fit int64
MAX_LANDMARKS = 1 << 30  # limit of landmark ids: tables are as long as the largest id
MAX_DESCRIPTOR = 1e6  # limit of components of descriptors; squared distances do not overflow float32

BOOL, INT8, UINT8 = np.dtype(np.bool_), np.dtype(np.int8), np.dtype(np.uint8)
INT32, INT64 = np.dtype(np.int32), np.dtype(np.int64)
FLOAT32, FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)

Bound = int | float | str | None  # a number, or the name of a size: less than it


# ---------------------------------------------------------------------- numbers


def _limit(bound: Bound, sizes: Sizes, default: float) -> Any:
    """Return a bound as a number."""
    if isinstance(bound, str):
        return sizes[bound.removesuffix("+1")] - 1 + bound.endswith("+1")
    return default if bound is None else bound


@dataclass(frozen=True)
class Int(Part):
    """An int within bounds, both included; a name as upper bound stands for an index below that size.

    Attributes:
        low, high: The bounds.
        size: Name of the size that the int is; None: of no size.
    """

    low: int = 0
    high: int | str = MAX_INT
    size: str | None = None

    def check(self, name: str, value: Any, sizes: Sizes) -> int:
        high = _limit(self.high, sizes, MAX_INT)
        if type(value) is not int or not self.low <= value <= high:
            refuse(name, f"an int from {self.low} to {high}", value)
        if self.size is not None and sizes.setdefault(self.size, value) != value:
            refuse(name, f"{sizes[self.size]}", value)
        return value


@dataclass(frozen=True)
class Float(Part):
    """A float within bounds, or NaN if `nan` is set."""

    low: float = -LARGEST
    high: float = LARGEST
    nan: bool = False

    def check(self, name: str, value: Any, sizes: Sizes) -> float:
        if not isinstance(value, float) or not (self.low <= value <= self.high or (self.nan and value != value)):
            refuse(name, f"a float from {self.low:g} to {self.high:g}", value)
        return float(value)


@dataclass(frozen=True)
class Flag(Part):
    """A bool."""

    def check(self, name: str, value: Any, sizes: Sizes) -> bool:
        if type(value) is not bool:
            refuse(name, "a bool", value)
        return value


@dataclass(frozen=True)
class Text(Part):
    """A text; one of `choices` if there are any."""

    choices: tuple[str, ...] = ()

    def check(self, name: str, value: Any, sizes: Sizes) -> str:
        if type(value) is not str or (self.choices and value not in self.choices):
            refuse(name, f"one of {', '.join(self.choices)}" if self.choices else "a text", value)
        return value


@dataclass(frozen=True)
class Maybe(Part):
    """None, or a value of another type."""

    part: Part

    @property
    def is_constant(self) -> bool:  # type: ignore[override]
        """Whether values never change."""
        return self.part.is_constant

    def take(self, value: Any) -> Any:
        return None if value is None else self.part.take(value)

    def put(self, value: Any, kept: Any) -> Any:
        return None if kept is None else self.part.put(value, kept)

    def check(self, name: str, value: Any, sizes: Sizes) -> Any:
        return None if value is None else self.part.check(name, value, sizes)

    def inner(self) -> Iterable[Part | type]:
        return (self.part,)


# ---------------------------------------------------------------------- arrays


@dataclass(frozen=True)
class Array(Part):
    """An array with the bounds of its numbers, both included; a name as upper bound stands for indices below that size.

    Attributes:
        dtype: Type of the numbers.
        shape: Sizes of the axes: numbers, names, names with "+1", or "*" for any size, separated by spaces.
        low, high: The bounds. None: plain limits; integers then are at least 0.
        nan: Whether floats may be NaN.
        ascending: Whether the numbers ascend, none twice.
        used: Name of the size of the used part of the last axis; None: all of it.
        renewed: Whether the owner replaces the array and never writes to it. Snapshots then share it.
        constant: Whether it is read-only; it is then shared by objects as well.
    """

    dtype: np.dtype[Any]
    shape: str = ""
    low: float | None = None
    high: Bound = None
    nan: bool = False
    ascending: bool = False
    used: str | None = None
    renewed: bool = False
    constant: bool = False

    @property
    def is_constant(self) -> bool:  # type: ignore[override]
        """Whether values never change."""
        return self.constant

    def take(self, value: NDArray[Any]) -> NDArray[Any]:
        if self.constant:
            return value
        return as_read_only(value) if self.renewed else constant_copy(value)

    def put(self, value: Any, kept: NDArray[Any]) -> NDArray[Any]:
        if self.constant:
            return kept
        if self.renewed or type(value) is not np.ndarray or value.shape != kept.shape or not value.flags.writeable:
            return kept.copy()
        value[...] = kept
        return value

    def check(self, name: str, value: Any, sizes: Sizes) -> NDArray[Any]:
        if type(value) is not np.ndarray or value.dtype != self.dtype:
            got = f"an array of {value.dtype}" if isinstance(value, np.ndarray) else f"a {type(value).__name__}"
            refuse(name, f"an array of {self.dtype}", got)
        check_shape(name, value, self.shape, sizes)
        numbers = value if self.used is None else value[..., : sizes[self.used]]
        if numbers.size and self.dtype.kind != "b":
            is_float = self.dtype.kind == "f"
            low = _limit(self.low, sizes, -LARGEST if is_float else 0)
            high = _limit(self.high, sizes, LARGEST if is_float else min(MAX_INT, np.iinfo(self.dtype).max))
            if self.nan:
                numbers = numbers[~np.isnan(numbers)]
            if numbers.size and not (low <= numbers.min() and numbers.max() <= high):  # NaN: not
                kind = f"numbers from {low:g} to {high:g}" if is_float else f"integers from {low} to {high}"
                refuse(name, kind, "a value out of range" + " or NaN" * is_float)
        if self.ascending and (value[1:] <= value[:-1]).any():
            refuse(name, "distinct numbers in ascending order", "a number that is out of order or repeated")
        return as_constant(value)


def check_shape(name: str, value: NDArray[Any], shape: str, sizes: Sizes) -> None:
    """Raise unless an array has a shape, see `Array`; sizes with new names are added to `sizes`."""
    axes, found = _axes(shape), value.shape
    if len(found) == len(axes):
        for (word, number, more), size in zip(axes, found, strict=True):
            if word == "*":
                continue
            wanted = sizes.setdefault(word, size - more) if number is None else number
            if wanted + more != size:
                break
        else:
            return
    expected = ", ".join(str(sizes.get(axis, axis)) for axis in shape.split())
    refuse(name, f"an array of shape ({expected})", f"shape {found}")


@cache
def _axes(shape: str) -> tuple[tuple[str, int | None, bool], ...]:
    """Return word, number if it is one, and whether one more is meant, of each axis."""
    words = [(axis.removesuffix("+1"), axis.endswith("+1")) for axis in shape.split()]
    return tuple((word, int(word) if word.isdigit() else None, more) for word, more in words)


# ---------------------------------------------------------------------- containers


@dataclass(frozen=True)
class Each(Part):
    """A sequence of values of one type.

    Attributes:
        part: Type of the values.
        size: Name of their number, or the number in digits; None: any.
        kind: Class of the sequence in the object.
    """

    part: Part
    size: str | None = None
    kind: Callable[[Iterable[Any]], Any] = tuple

    @property
    def is_constant(self) -> bool:  # type: ignore[override]
        """Whether values never change."""
        return self.kind in (tuple, frozenset) and self.part.is_constant

    def take(self, value: Iterable[Any]) -> Any:
        made = frozenset if self.kind in (set, frozenset) else tuple
        return made(value) if self.part.is_constant else made(map(self.part.take, value))

    def put(self, value: Any, kept: Any) -> Any:
        if self.part.is_constant:
            return kept if self.kind in (tuple, frozenset) else self.kind(kept)
        before = [*(() if value is None else value)][: len(kept)]
        before += [None] * (len(kept) - len(before))
        return self.kind(map(self.part.put, before, kept))

    def check(self, name: str, value: Any, sizes: Sizes) -> Any:
        made = frozenset if self.kind in (set, frozenset) else tuple
        if type(value) not in ((set, frozenset) if made is frozenset else (tuple, list)):
            refuse(name, f"a {made.__name__}", f"a {type(value).__name__}")
        if self.size is not None:
            wanted = int(self.size) if self.size.isdigit() else sizes.setdefault(self.size, len(value))
            if len(value) != wanted:
                refuse(name, f"{wanted} of them", len(value))
        return made(self.part.check(f"{name}[{i}]", each, sizes) for i, each in enumerate(value))

    def inner(self) -> Iterable[Part | type]:
        return (self.part,)


class Row(Part):
    """A tuple of values of different types, which never change.

    Args:
        parts: The types.
    """

    def __init__(self, *parts: Part) -> None:
        assert all(part.is_constant for part in parts)
        self.parts = parts

    def check(self, name: str, value: Any, sizes: Sizes) -> tuple[Any, ...]:
        if type(value) not in (tuple, list) or len(value) != len(self.parts):
            refuse(name, f"{len(self.parts)} values", value)
        pairs = enumerate(zip(self.parts, value, strict=True))
        return tuple(part.check(f"{name}[{i}]", each, sizes) for i, (part, each) in pairs)

    def inner(self) -> Iterable[Part | type]:
        return self.parts


@dataclass(frozen=True)
class Dict(Part):
    """A dict; the keys never change."""

    key: Part
    part: Part
    is_constant: ClassVar[bool] = False

    def take(self, value: Mapping[Any, Any]) -> Snapshot:
        part = self.part
        return Snapshot(dict(value) if part.is_constant else {key: part.take(each) for key, each in value.items()})

    def put(self, value: Any, kept: Snapshot) -> dict[Any, Any]:
        before = {} if value is None else value
        return {key: self.part.put(before.get(key), each) for key, each in kept.items()}

    def check(self, name: str, value: Any, sizes: Sizes) -> Snapshot:
        if not isinstance(value, Mapping):
            refuse(name, "a dict", f"a {type(value).__name__}")
        checked = {self.key.check(f"{name}: key", key, sizes): each for key, each in value.items()}
        return Snapshot({key: self.part.check(f"{name}[{key!r}]", each, sizes) for key, each in checked.items()})

    def inner(self) -> Iterable[Part | type]:
        return self.key, self.part
