"""Damaged states: a tree of dicts, sequences, records and arrays in which one part is not what it was."""

from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slam_backend.state.codec import ForeignObjectError, decode, encode

REPEATED = 20  # refusals after which it is looked whether anything has changed
STOP = 0.08  # chance that a container is damaged itself, and not something in it
KINDS = (np.float64, np.float32, np.int64, np.int32, np.bool_, object)
HUGE = (2**62, 10**9, 10**6, 2**31 - 1)


def children(value: Any) -> list[Any]:
    """Return the keys, places or names of the parts of a value; none of what has no parts."""
    if isinstance(value, Mapping):
        return list(value)
    if isinstance(value, (tuple, list)):
        return list(range(len(value)))
    if is_dataclass(value) and not isinstance(value, type):
        return [field.name for field in fields(value)]
    return []


def part(value: Any, key: Any) -> Any:
    """Return a part of a value."""
    return getattr(value, key) if is_dataclass(value) else value[key]


def with_part(value: Any, key: Any, new: Any) -> Any:
    """Return a copy of a value with another part; no constructor looks at it."""
    if isinstance(value, Mapping):
        return dict(value) | {key: new}
    if is_dataclass(value):
        copied = object.__new__(type(value))
        for field in fields(value):
            object.__setattr__(copied, field.name, new if field.name == key else getattr(value, field.name))
        return copied
    entries = [*value[:key], new, *value[key + 1 :]]
    return tuple.__new__(type(value), entries) if isinstance(value, tuple) else entries


def descend(tree: Any, rng: np.random.Generator) -> list[Any]:
    """Return the way to some part of a tree."""
    way: list[Any] = []
    while keys := children(tree):
        if way and rng.random() < STOP:
            break
        way.append(keys[int(rng.integers(len(keys)))])
        tree = part(tree, way[-1])
    return way


def at(tree: Any, way: list[Any]) -> Any:
    """Return the part at the end of a way."""
    for key in way:
        tree = part(tree, key)
    return tree


def replaced(tree: Any, way: list[Any], new: Any) -> Any:
    """Return a copy of a tree with another part at the end of a way; all else is shared."""
    if not way:
        return new
    return with_part(tree, way[0], replaced(part(tree, way[0]), way[1:], new))


def damaged(tree: Any, rng: np.random.Generator) -> tuple[str, Any]:
    """Return a tree in which one part is damaged, and what was done."""
    way = descend(tree, rng)
    value = at(tree, way)
    acts = acts_on(value, tree, rng)
    name = list(acts)[int(rng.integers(len(acts)))]
    if name == "missing":
        inner = at(tree, way[:-1])
        if isinstance(inner, Mapping):
            return f"{way} missing", replaced(tree, way[:-1], {k: v for k, v in inner.items() if k != way[-1]})
        name = "none"
    return f"{way} {name}", replaced(tree, way, acts[name]())


def acts_on(value: Any, tree: Any, rng: np.random.Generator) -> dict[str, Callable[[], Any]]:
    """Return what may be done to a value."""
    acts: dict[str, Callable[[], Any]] = {
        "none": lambda: None,
        "text": lambda: "x",
        "swapped": lambda: at(tree, descend(tree, rng)),
        "missing": lambda: None,
    }
    if isinstance(value, np.ndarray):
        acts |= {f"element {i}": lambda: element(value, rng) for i in range(12)}
        acts |= {
            "kind": lambda: value.astype(KINDS[int(rng.integers(len(KINDS)))]),
            "cut": lambda: value[: len(value) // 2] if value.ndim else value,
            "cut columns": lambda: value[..., :-1] if value.ndim else value,
            "grown": lambda: np.concatenate([value, value]) if value.ndim else value,
            "turned": lambda: value.T,
            "flat": lambda: value.ravel(),
            "filled": lambda: np.full_like(value, some_number(value.dtype, value.shape, rng)),
            "shuffled": lambda: rng.permutation(value.copy()) if value.ndim else value,
        }
    elif isinstance(value, (bool, int, float)):
        numbers = (-1, 0, 1, 10**6, 2**62, 2**70, -(2**62), 1e300, -1.0, float("nan"), float("inf"), True)
        acts |= {f"number {i}": lambda: numbers[int(rng.integers(len(numbers)))] for i in range(8)}
    elif isinstance(value, (tuple, list)) and value:
        acts |= {
            "shorter": lambda: value[:-1] if type(value) in (tuple, list) else tuple(value)[:-1],
            "longer": lambda: (*value, value[0]),
            "empty": lambda: type(value)() if type(value) in (tuple, list) else (),
            "reversed": lambda: value[::-1],
        }
    elif isinstance(value, Mapping) and value:
        acts |= {"empty": dict, "renamed": lambda: {(k + 1 if isinstance(k, int) else k): v for k, v in value.items()}}
    elif isinstance(value, (set, frozenset)):
        acts |= {"odd": lambda: type(value)((-5, 10**12))}
    return acts


def some_number(dtype: Any, shape: tuple[int, ...], rng: np.random.Generator) -> Any:
    """Return a number of a kind that is out of place."""
    if dtype.kind == "f":
        return [np.nan, np.inf, -np.inf, 1e30, 1e300, -1.0, 0.0, 1e6, 1e-300][int(rng.integers(9))]
    if dtype.kind == "b":
        return bool(rng.integers(2))
    bounds = np.iinfo(dtype)
    others = [-1, -2, 0, 1, *shape, *HUGE, bounds.min, bounds.max, int(rng.integers(1000))]
    return int(np.clip(others[int(rng.integers(len(others)))], bounds.min, bounds.max))


def element(value: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return an array with another number somewhere."""
    changed = value.copy()
    if value.size and value.dtype.kind in "biuf":
        with np.errstate(over="ignore"):
            changed.reshape(-1)[int(rng.integers(value.size))] = some_number(value.dtype, value.shape, rng)
    return changed


def try_damaged(
    subject: Any,
    seeds: Iterable[int],
    is_unchanged: Callable[[], bool],
    go_on: Callable[[Any], None],
) -> dict[str, int]:
    """Set a subject to damaged states, as they are and through bytes; return how many it refused and accepted.

    Args:
        subject: Object with get_state and set_state.
        seeds: Seeds of the damages.
        is_unchanged: Returns whether the subject is as before; asked after some refusals.
        go_on: Lets the subject go on from a state that it has accepted, which it gets.
    """
    state, refused, accepted = subject.get_state(), 0, 0
    for seed in seeds:
        what, other = damaged(state, np.random.default_rng(seed))
        try:
            if seed % 4 == 0:
                other = decode(encode(other))
            subject.set_state(other)
        except ForeignObjectError:
            continue
        except ValueError:
            refused += 1
            if refused % REPEATED == 0:
                assert is_unchanged(), what
                subject.set_state(state)
            continue
        accepted += 1
        try:
            go_on(other)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {what}") from error
        subject.set_state(state)
    return {"refused": refused, "accepted": accepted}


class Trap:
    """What a pickle of makes a file when it is read."""

    def __init__(self, file: Path) -> None:
        self.file = file

    def __reduce__(self) -> Any:
        """Return the call that a pickle would make."""
        return Path.touch, (self.file,)
