"""State of objects, declared once: snapshots, their restoration and their checks.

A class lists the parts of its state, from which `take` makes a snapshot and `restore` returns to it:

>>> from slam_backend.core.random_state import Generator
>>> class Counter:
...     STATE = State(sums=Array(INT64, "K", low=0), rng=Generator())
...     def __init__(self) -> None:
...         self._sums, self.rng = np.zeros(3, np.int64), np.random.default_rng(0)
>>> counter = Counter()
>>> before = take(counter)
>>> counter._sums += 5
>>> restore(counter, before)
>>> counter._sums.tolist()
[0, 0, 0]

Names of parts are names of attributes or properties, with or without a leading underscore. A class may have hooks:
`make_room(snapshot)` provides arrays of the right sizes, before parts are set. `rebuild()` computes what follows from
the state, after that. `check_state(parts, sizes)` raises if kernels would go wrong with parts that are within their
bounds one by one.

A snapshot cannot be changed, nor can its arrays: `restore` takes it without checks. Copies, pickles and files of a
snapshot are plain dicts, which `accepted` turns into a snapshot again. It checks types, shapes and bounds, because
kernels trust the indices that they get.

Sizes have names. The first array with a name in its shape defines it; names in capitals also hold for children.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, fields, is_dataclass
from functools import cache
from types import FunctionType
from typing import Any, ClassVar, NoReturn, TypeVar, get_args, get_type_hints

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_constant, as_read_only, constant_copy
from slam_backend.core.validation import argument_error

HINT = "Pass it unchanged."
LARGEST = 1e12  # limit of plain numbers [m, rad, 1]; squares and products of a few of them are finite
MAX_DISTANCE = 1e7  # limit of poses and landmarks [m, rad]
MAX_INT = 1 << 62  # limit of counts and steps: sums of two of them fit int64
MAX_LANDMARKS = 1 << 30  # limit of landmark ids: tables are as long as the largest id
MAX_DESCRIPTOR = 1e6  # limit of components of descriptors; squared distances do not overflow float32

BOOL, INT8, UINT8 = np.dtype(np.bool_), np.dtype(np.int8), np.dtype(np.uint8)
INT32, INT64 = np.dtype(np.int32), np.dtype(np.int64)
FLOAT32, FLOAT64 = np.dtype(np.float32), np.dtype(np.float64)

CLASS = "class"  # key of the name of a record's class in files
T = TypeVar("T")
Sizes = dict[str, Any]  # sizes by name, and whatever else an owner passes down to the checks
Bound = int | float | str | None  # a number, or the name of a size: less than it
Kind = type | Callable[[], type]  # a class, or a function that returns one that is not defined yet


def refuse(name: str, expected: str, got: object) -> NoReturn:
    """Raise the error for a part of a state."""
    raise argument_error(name, expected, got, HINT)


class Snapshot(Mapping[Any, Any]):
    """Read-only mapping: the state of an object, or a mapping in one. Copies and pickles are plain dicts.

    Args:
        parts: The content, which the caller does not change afterwards.
        of: Class of the object; None for a mapping in a state.
    """

    __slots__ = ("_parts", "of")
    _parts: dict[Any, Any]
    of: type | None

    def __init__(self, parts: dict[Any, Any], of: type | None = None) -> None:
        object.__setattr__(self, "_parts", parts)
        object.__setattr__(self, "of", of)

    def __setattr__(self, name: str, value: Any) -> NoReturn:
        raise AttributeError(f"{name}: expected a copy to change, got a snapshot. Make one with dict(state).")

    def __getitem__(self, key: Any) -> Any:
        return self._parts[key]

    def __iter__(self) -> Iterator[Any]:
        return iter(self._parts)

    def __len__(self) -> int:
        return len(self._parts)

    def __or__(self, other: Mapping[Any, Any]) -> dict[Any, Any]:
        return self._parts | dict(other)

    def __eq__(self, other: object) -> bool:
        from slam_backend.core.state_format import equal  # which builds on this module

        return isinstance(other, Mapping) and equal(self, other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        name = "mapping" if self.of is None else self.of.__name__
        return f"<snapshot of a {name}: {', '.join(map(str, self._parts))}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self._parts,)


class State:
    """Declaration of the state of a class.

    Args:
        parts: Type of each part, by name.
    """

    def __init__(self, **parts: "Part") -> None:
        self.parts = parts
        self._attributes: list[tuple[str, str, Part, bool]] | None = None

    def attributes(self, owner: Any) -> list[tuple[str, str, "Part", bool]]:
        """Return name, attribute and type of each part, and whether its values never change, given an object."""
        if self._attributes is None:
            names = {name: f"_{name}" if hasattr(owner, f"_{name}") else name for name in self.parts}
            self._attributes = [(name, names[name], part, part.is_constant) for name, part in self.parts.items()]
        return self._attributes


def with_state(**parts: "Part") -> Callable[[type[T]], type[T]]:
    """Declare the `STATE` of a named tuple, in whose body type checkers take every name for a field; a decorator."""

    def declare(kind: type[T]) -> type[T]:
        kind.STATE = State(**parts)  # type: ignore[attr-defined]
        return kind

    return declare


def is_stateful(kind: type) -> bool:
    """Return whether a class declares a state."""
    return isinstance(getattr(kind, "STATE", None), State)


class Part:
    """Type of a part of a state.

    Attributes:
        is_constant: Whether values never change, so that snapshots and objects share them.
    """

    is_constant: ClassVar[bool] = True

    def _take(self, value: Any) -> Any:
        """Return the value as snapshots hold it."""
        return value

    def _put(self, value: Any, kept: Any) -> Any:
        """Return the value that an object is to hold, given its present value and that of a snapshot."""
        return kept

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        """Return a value as snapshots hold it, or raise a ValueError that begins with its name."""
        raise NotImplementedError

    def _inner(self) -> "Iterable[Part | type]":
        """Return the types and classes on which this one depends."""
        return ()


def take(owner: Any) -> Snapshot:
    """Return a snapshot of an object; the object does not change."""
    kind: Any = type(owner)
    parts = {
        name: getattr(owner, at) if is_constant else part._take(getattr(owner, at))
        for name, at, part, is_constant in kind.STATE.attributes(owner)
    }
    return Snapshot(parts, kind)


def restore(owner: Any, snapshot: Snapshot) -> None:
    """Return an object to a snapshot; arrays of the same shape are overwritten in place."""
    assert snapshot.of is type(owner)
    kind: Any = type(owner)
    if hasattr(owner, "make_room"):
        owner.make_room(snapshot)
    for name, at, part, is_constant in kind.STATE.attributes(owner):
        value = None if is_constant else getattr(owner, at, None)
        new = part._put(value, snapshot[name])
        if is_constant or new is None or new is not value:
            setattr(owner, at, new)
    if hasattr(owner, "rebuild"):
        owner.rebuild()


def restored(snapshot: Snapshot, owner: Any = None) -> Any:
    """Return an object in the state of a snapshot: the given one if it is of the same class, else a new one.

    A new one comes from the class method `from_state(snapshot)`. Classes without this method need no constructor, and
    all parts of their state are attributes without a leading underscore.
    """
    kind: Any = snapshot.of
    if type(owner) is not kind:
        if hasattr(kind, "from_state"):
            return kind.from_state(snapshot)
        owner = object.__new__(kind)
    restore(owner, snapshot)
    return owner


def accepted(kind: type, name: str, state: Any, sizes: Sizes | None = None) -> Snapshot:
    """Return a state as a snapshot of a class, or raise a ValueError that names the part that is wrong.

    Args:
        kind: Class with a `STATE`.
        name: Name of the state in the error.
        state: Snapshot of this class, which is not looked at, or any other value.
        sizes: Sizes and other things that the checks need, by name.
    """
    if type(state) is Snapshot and state.of is kind:
        return state
    try:
        snapshot: Snapshot = Child(kind)._check(name, state, {} if sizes is None else dict(sizes))
        return snapshot
    except ValueError:
        raise
    except Exception as error:  # of any kind, RecursionError among them: the state may hold anything
        got = f"'{type(error).__name__}: {error}' while checking it"
        raise argument_error(name, "what get_state returned", got, HINT) from error


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

    def _check(self, name: str, value: Any, sizes: Sizes) -> int:
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

    def _check(self, name: str, value: Any, sizes: Sizes) -> float:
        if not isinstance(value, float) or not (self.low <= value <= self.high or (self.nan and value != value)):
            refuse(name, f"a float from {self.low:g} to {self.high:g}", value)
        return float(value)


@dataclass(frozen=True)
class Flag(Part):
    """A bool."""

    def _check(self, name: str, value: Any, sizes: Sizes) -> bool:
        if type(value) is not bool:
            refuse(name, "a bool", value)
        return value


@dataclass(frozen=True)
class Text(Part):
    """A text; one of `choices` if there are any."""

    choices: tuple[str, ...] = ()

    def _check(self, name: str, value: Any, sizes: Sizes) -> str:
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

    def _take(self, value: Any) -> Any:
        return None if value is None else self.part._take(value)

    def _put(self, value: Any, kept: Any) -> Any:
        return None if kept is None else self.part._put(value, kept)

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        return None if value is None else self.part._check(name, value, sizes)

    def _inner(self) -> Iterable[Part | type]:
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

    def _take(self, value: NDArray[Any]) -> NDArray[Any]:
        if self.constant:
            return value
        return as_read_only(value) if self.renewed else constant_copy(value)

    def _put(self, value: Any, kept: NDArray[Any]) -> NDArray[Any]:
        if self.constant:
            return kept
        if self.renewed or type(value) is not np.ndarray or value.shape != kept.shape or not value.flags.writeable:
            return kept.copy()
        value[...] = kept
        return value

    def _check(self, name: str, value: Any, sizes: Sizes) -> NDArray[Any]:
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

    def _take(self, value: Iterable[Any]) -> Any:
        made = frozenset if self.kind in (set, frozenset) else tuple
        return made(value) if self.part.is_constant else made(map(self.part._take, value))

    def _put(self, value: Any, kept: Any) -> Any:
        if self.part.is_constant:
            return kept if self.kind in (tuple, frozenset) else self.kind(kept)
        before = [*(() if value is None else value)][: len(kept)]
        before += [None] * (len(kept) - len(before))
        return self.kind(map(self.part._put, before, kept))

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        made = frozenset if self.kind in (set, frozenset) else tuple
        if type(value) not in ((set, frozenset) if made is frozenset else (tuple, list)):
            refuse(name, f"a {made.__name__}", f"a {type(value).__name__}")
        if self.size is not None:
            wanted = int(self.size) if self.size.isdigit() else sizes.setdefault(self.size, len(value))
            if len(value) != wanted:
                refuse(name, f"{wanted} of them", len(value))
        return made(self.part._check(f"{name}[{i}]", each, sizes) for i, each in enumerate(value))

    def _inner(self) -> Iterable[Part | type]:
        return (self.part,)


class Row(Part):
    """A tuple of values of different types, which never change.

    Args:
        parts: The types.
    """

    def __init__(self, *parts: Part) -> None:
        assert all(part.is_constant for part in parts)
        self.parts = parts

    def _check(self, name: str, value: Any, sizes: Sizes) -> tuple[Any, ...]:
        if type(value) not in (tuple, list) or len(value) != len(self.parts):
            refuse(name, f"{len(self.parts)} values", value)
        pairs = enumerate(zip(self.parts, value, strict=True))
        return tuple(part._check(f"{name}[{i}]", each, sizes) for i, (part, each) in pairs)

    def _inner(self) -> Iterable[Part | type]:
        return self.parts


@dataclass(frozen=True)
class Dict(Part):
    """A dict; the keys never change."""

    key: Part
    part: Part
    is_constant: ClassVar[bool] = False

    def _take(self, value: Mapping[Any, Any]) -> Snapshot:
        part = self.part
        return Snapshot(dict(value) if part.is_constant else {key: part._take(each) for key, each in value.items()})

    def _put(self, value: Any, kept: Snapshot) -> dict[Any, Any]:
        before = {} if value is None else value
        return {key: self.part._put(before.get(key), each) for key, each in kept.items()}

    def _check(self, name: str, value: Any, sizes: Sizes) -> Snapshot:
        if not isinstance(value, Mapping):
            refuse(name, "a dict", f"a {type(value).__name__}")
        checked = {self.key._check(f"{name}: key", key, sizes): each for key, each in value.items()}
        return Snapshot({key: self.part._check(f"{name}[{key!r}]", each, sizes) for key, each in checked.items()})

    def _inner(self) -> Iterable[Part | type]:
        return self.key, self.part


# ---------------------------------------------------------------------- objects


def _class(kind: Kind) -> type:
    """Return a class, or that which a function returns."""
    return kind() if isinstance(kind, FunctionType) else kind  # type: ignore[return-value]


def _source(name: str, value: Any, kind: type) -> Callable[[str], Any]:
    """Return the function that looks up parts of an object of a class or of a mapping by name, or raise."""
    if type(value) is kind:
        return lambda part: getattr(value, part)
    if not isinstance(value, Mapping):
        refuse(name, f"a {kind.__name__}", f"a {type(value).__name__}")
    return lambda part: value[part] if part in value else refuse(name, f"a {kind.__name__}", f"no {part!r}")


DONE = "checked values"  # among the sizes: what has been checked, so that shared parts are checked once and stay shared


class _OfClass(Part):
    """Part that refers to a class.

    Args:
        kind: The class, or a function that returns it.
        sizes: Names of sizes in the class, with their names in its owner.
    """

    def __init__(self, kind: Kind, **sizes: str) -> None:
        self._kind, self._sizes = kind, sizes

    @property
    def kind(self) -> type:
        """The class."""
        return _class(self._kind)

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        done = sizes.setdefault(DONE, {})
        inner = {size: number for size, number in sizes.items() if size.isupper()}
        inner |= {size: sizes[outer] for size, outer in self._sizes.items()}
        key = id(value), type(self), self.kind, *((size, id(number)) for size, number in inner.items())
        if key not in done:
            done[key] = self._checked(name, value, inner | {DONE: done}), value  # the value, so that its `id` is unique
        return done[key][0]

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Any:
        raise NotImplementedError

    def _inner(self) -> Iterable[Part | type]:
        return (self.kind,)


class Child(_OfClass):
    """An object with a `STATE` of its own; it is restored in place, or made as a new one, see `restored`."""

    is_constant = False

    def _take(self, value: Any) -> Snapshot:
        return take(value)

    def _put(self, value: Any, kept: Snapshot) -> Any:
        return restored(kept, value)

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Snapshot:
        kind: Any = self.kind
        if not isinstance(value, Mapping):
            refuse(name, "what get_state returned", f"a {type(value).__name__}")
        parts: dict[str, Any] = {}
        for key, part in kind.STATE.parts.items():
            if key not in value:
                refuse(name, "what get_state returned", f"a mapping without {key!r}")
            parts[key] = part._check(f"{name}[{key!r}]", value[key], sizes)
        _check_together(kind, name, parts, sizes)
        return Snapshot(parts, kind)


class Saved(Child):
    """A snapshot that an object holds, of an object with a `STATE`."""

    is_constant = True

    def _take(self, value: Snapshot) -> Snapshot:
        return value

    def _put(self, value: Any, kept: Snapshot) -> Snapshot:
        return kept


class Record(_OfClass):
    """An immutable record with read-only arrays, whose `STATE` lists its fields; snapshots and objects share it.

    A class that is not built from these fields alone has a method `from_parts`, which takes them by name.
    """

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Any:
        kind: Any = self.kind
        look = _source(name, value, kind)
        parts = {key: part._check(f"{name}.{key}", look(key), sizes) for key, part in kind.STATE.parts.items()}
        _check_together(kind, name, parts, sizes)
        if type(value) is kind and all(parts[key] is look(key) for key in parts):
            return value
        return getattr(kind, "from_parts", kind)(**parts)


class OneOf(Part):
    """A record of one of several classes.

    Args:
        kinds: The classes.
    """

    def __init__(self, *kinds: type) -> None:
        self._records = {kind.__name__: Record(kind) for kind in kinds}

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        found = value.get(CLASS) if isinstance(value, Mapping) else type(value).__name__
        if not isinstance(found, str) or found not in self._records:
            refuse(name, f"one of {', '.join(self._records)}", f"a {type(value).__name__}")
        return self._records[found]._check(name, value, sizes)

    def _inner(self) -> Iterable[Part | type]:
        return self._records.values()


class ChildOf(Part):
    """An object of one of several classes with a `STATE`; its snapshot has the name of the class among its parts.

    Args:
        kinds: The classes, or functions that return them.
    """

    is_constant = False

    def __init__(self, *kinds: Kind) -> None:
        self._kinds = kinds

    def _take(self, value: Any) -> Snapshot:
        return _with_class(take(value))

    def _put(self, value: Any, kept: Snapshot) -> Any:
        return restored(kept, value)

    def _check(self, name: str, value: Any, sizes: Sizes) -> Snapshot:
        children = {kind.__name__: Child(kind) for kind in map(_class, self._kinds)}
        found = value.get(CLASS) if isinstance(value, Mapping) else None
        if not isinstance(found, str) or found not in children:
            refuse(name, f"the state of one of {', '.join(children)}", f"a {type(value).__name__}")
        return _with_class(children[found]._check(name, value, sizes))

    def _inner(self) -> Iterable[Part | type]:
        return map(_class, self._kinds)


def _with_class(snapshot: Snapshot) -> Snapshot:
    """Return a snapshot with the name of its class among its parts."""
    assert snapshot.of is not None
    return Snapshot({CLASS: snapshot.of.__name__} | dict(snapshot), snapshot.of)


class Options(_OfClass):
    """A frozen dataclass of options, perhaps with others in its fields; its constructor checks them."""

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Any:
        kind = self.kind
        try:
            built = _built(value, {one.__name__: one for one in options_in(kind)})
        except Exception as error:  # of any kind: unchecked options may hold anything
            raise argument_error(name, f"{kind.__name__} that can be built", f"'{error}'", HINT) from error
        if type(built) is not kind:
            refuse(name, f"{kind.__name__} that can be built", f"a {type(value).__name__}")
        return built


def built_options(kind: type[T], name: str, value: Any) -> T:
    """Return options of a class, or of a mapping of a file, rebuilt by their constructors, or raise a ValueError."""
    built: T = Options(kind)._check(name, value, {})
    return built


def _built(value: Any, classes: Mapping[str, type]) -> Any:
    """Return options rebuilt by their constructors, from an object or from a mapping of a file."""
    is_mapping = isinstance(value, Mapping)
    kind: Any = classes.get(value.get(CLASS, "")) if is_mapping else type(value)
    if kind not in classes.values():
        return dict(value) if is_mapping else value
    look = _source("options", value, kind)
    return kind(**{f.name: _built(look(f.name), classes) for f in fields(kind) if f.init})


@cache
def options_in(kind: type) -> tuple[type, ...]:
    """Return a class of options and those that its fields may hold."""
    found = [kind]
    for hint in get_type_hints(kind).values() if is_dataclass(kind) else ():
        for one in (hint, *get_args(hint)):
            if isinstance(one, type) and is_dataclass(one):
                found += options_in(one)
    return tuple(dict.fromkeys(found))


def _check_together(kind: type, name: str, parts: Mapping[str, Any], sizes: Sizes) -> None:
    """Call the hook `check_state` of a class, if there is one; its error gets the name."""
    if hasattr(kind, "check_state"):
        try:
            kind.check_state(parts, sizes)
        except ValueError as error:
            raise argument_error(name, "parts that fit together", f"'{error}'", HINT) from error
