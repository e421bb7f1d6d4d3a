"""Declarations of states, snapshots, and the restoration of objects; see `slam_backend.state`."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any, ClassVar, NoReturn, TypeVar

from slam_backend.core.validation import argument_error

HINT = "Pass it unchanged."
T = TypeVar("T")
Sizes = dict[str, Any]  # sizes by name, and whatever else an owner passes down to the checks


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
        from slam_backend.state.format import equal  # which builds on this module

        return isinstance(other, Mapping) and equal(self, other)

    __hash__ = None  # type: ignore[assignment]

    def __repr__(self) -> str:
        name = "mapping" if self.of is None else self.of.__name__
        return f"<snapshot of a {name}: {', '.join(map(str, self._parts))}>"

    def __reduce__(self) -> tuple[Any, ...]:
        return dict, (self._parts,)


class Part:
    """Type of a part of a state.

    Attributes:
        is_constant: Whether values never change, so that snapshots and objects share them.
    """

    is_constant: ClassVar[bool] = True

    def take(self, value: Any) -> Any:
        """Return the value as snapshots hold it."""
        return value

    def put(self, value: Any, kept: Any) -> Any:
        """Return the value that an object is to hold, given its present value and that of a snapshot."""
        return kept

    def check(self, name: str, value: Any, sizes: Sizes) -> Any:
        """Return a value as snapshots hold it, or raise a ValueError that begins with its name."""
        raise NotImplementedError

    def inner(self) -> "Iterable[Part | type]":
        """Return the types and classes on which this one depends."""
        return ()


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


def take(owner: Any) -> Snapshot:
    """Return a snapshot of an object; the object does not change."""
    kind: Any = type(owner)
    parts = {
        name: getattr(owner, at) if is_constant else part.take(getattr(owner, at))
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
        new = part.put(value, snapshot[name])
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
