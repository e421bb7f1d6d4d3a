"""Parts of states: objects, records and options."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import FunctionType
from typing import Any, TypeVar, get_args, get_type_hints

from slam_backend.core.validation import argument_error
from slam_backend.state.declaration import HINT, Part, Sizes, Snapshot, refuse, restored, take

CLASS = "class"  # key of the name of a record's class in files
DONE = "checked values"  # among the sizes: what has been checked, so that shared parts are checked once and stay shared
T = TypeVar("T")
Kind = type | Callable[[], type]  # a class, or a function that returns one that is not defined yet


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
        snapshot: Snapshot = Child(kind).check(name, state, {} if sizes is None else dict(sizes))
        return snapshot
    except ValueError:
        raise
    except Exception as error:  # of any kind, RecursionError among them: the state may hold anything
        got = f"'{type(error).__name__}: {error}' while checking it"
        raise argument_error(name, "what get_state returned", got, HINT) from error


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

    def check(self, name: str, value: Any, sizes: Sizes) -> Any:
        done = sizes.setdefault(DONE, {})
        inner = {size: number for size, number in sizes.items() if size.isupper()}
        inner |= {size: sizes[outer] for size, outer in self._sizes.items()}
        key = id(value), type(self), self.kind, *((size, id(number)) for size, number in inner.items())
        if key not in done:
            done[key] = self._checked(name, value, inner | {DONE: done}), value  # the value, so that its `id` is unique
        return done[key][0]

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Any:
        raise NotImplementedError

    def inner(self) -> Iterable[Part | type]:
        return (self.kind,)


class Child(_OfClass):
    """An object with a `STATE` of its own; it is restored in place, or made as a new one, see `restored`."""

    is_constant = False

    def take(self, value: Any) -> Snapshot:
        return take(value)

    def put(self, value: Any, kept: Snapshot) -> Any:
        return restored(kept, value)

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Snapshot:
        kind: Any = self.kind
        if not isinstance(value, Mapping):
            refuse(name, "what get_state returned", f"a {type(value).__name__}")
        parts: dict[str, Any] = {}
        for key, part in kind.STATE.parts.items():
            if key not in value:
                refuse(name, "what get_state returned", f"a mapping without {key!r}")
            parts[key] = part.check(f"{name}[{key!r}]", value[key], sizes)
        _check_together(kind, name, parts, sizes)
        return Snapshot(parts, kind)


class Saved(Child):
    """A snapshot that an object holds, of an object with a `STATE`."""

    is_constant = True

    def take(self, value: Snapshot) -> Snapshot:
        return value

    def put(self, value: Any, kept: Snapshot) -> Snapshot:
        return kept


class Record(_OfClass):
    """An immutable record with read-only arrays, whose `STATE` lists its fields; snapshots and objects share it.

    A class that is not built from these fields alone has a method `from_parts`, which takes them by name.
    """

    def _checked(self, name: str, value: Any, sizes: Sizes) -> Any:
        kind: Any = self.kind
        look = _source(name, value, kind)
        parts = {key: part.check(f"{name}.{key}", look(key), sizes) for key, part in kind.STATE.parts.items()}
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

    def check(self, name: str, value: Any, sizes: Sizes) -> Any:
        found = value.get(CLASS) if isinstance(value, Mapping) else type(value).__name__
        if not isinstance(found, str) or found not in self._records:
            refuse(name, f"one of {', '.join(self._records)}", f"a {type(value).__name__}")
        return self._records[found].check(name, value, sizes)

    def inner(self) -> Iterable[Part | type]:
        return self._records.values()


class ChildOf(Part):
    """An object of one of several classes with a `STATE`; its snapshot has the name of the class among its parts.

    Args:
        kinds: The classes, or functions that return them.
    """

    is_constant = False

    def __init__(self, *kinds: Kind) -> None:
        self._kinds = kinds

    def take(self, value: Any) -> Snapshot:
        return _with_class(take(value))

    def put(self, value: Any, kept: Snapshot) -> Any:
        return restored(kept, value)

    def check(self, name: str, value: Any, sizes: Sizes) -> Snapshot:
        children = {kind.__name__: Child(kind) for kind in map(_class, self._kinds)}
        found = value.get(CLASS) if isinstance(value, Mapping) else None
        if not isinstance(found, str) or found not in children:
            refuse(name, f"the state of one of {', '.join(children)}", f"a {type(value).__name__}")
        return _with_class(children[found].check(name, value, sizes))

    def inner(self) -> Iterable[Part | type]:
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
    built: T = Options(kind).check(name, value, {})
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
