"""Random streams as parts of states, see `slam_backend.state`."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.state.declaration import Part, Sizes, Snapshot, refuse
from slam_backend.state.values import Array, Each, Int, Maybe, Row, Text

STREAMS = ("PCG64", "PCG64DXSM", "MT19937", "Philox", "SFC64")
PLACES = {"has_uint32": 1, "uinteger": 2**32 - 1, "buffer_pos": 4, "pos": 624}  # largest numbers; numpy checks none


def _frozen(state: dict[str, Any]) -> Snapshot:
    """Return the state of a bit generator with read-only mappings and arrays."""
    parts: dict[str, Any] = {}
    for key, value in state.items():
        kind = type(value)
        parts[key] = _frozen(value) if kind is dict else as_read_only(value) if kind is np.ndarray else value
    return Snapshot(parts)


def _thawed(state: Any) -> Any:
    """Return the state of a bit generator as numpy takes it."""
    return {key: _thawed(value) for key, value in state.items()} if isinstance(state, Mapping) else state


@dataclass(frozen=True)
class Generator(Part):
    """A random generator of numpy, which is replaced by a new one: its bit generator may be shared, or another kind."""

    is_constant: ClassVar[bool] = False

    def take(self, value: np.random.Generator) -> Snapshot:
        return _frozen(value.bit_generator.state)  # type: ignore[arg-type]

    def put(self, value: Any, kept: Snapshot) -> np.random.Generator:
        bits = getattr(np.random, kept["bit_generator"])(0)
        bits.state = _thawed(kept)
        return np.random.Generator(bits)

    def check(self, name: str, value: Any, sizes: Sizes) -> Snapshot:
        return checked_stream(name, value)


def checked_stream(name: str, value: Any) -> Snapshot:
    """Return the state of a bit generator, read-only, or raise a ValueError: numpy checks little of it."""
    if not isinstance(value, Mapping) or value.get("bit_generator") not in STREAMS:
        refuse(name, "the state of one of " + ", ".join(STREAMS), value)
    state: Snapshot = _like(name, "", value, getattr(np.random, value["bit_generator"])(0).state)
    return state


def _like(name: str, key: str, value: Any, other: Any) -> Any:
    """Return a part of the state of a bit generator, read-only, or raise unless it has the form of another one."""
    if isinstance(other, Mapping):
        if not isinstance(value, Mapping) or set(value) != set(other):
            refuse(name, f"a dict with {', '.join(other)}", value)
        return Snapshot({key: _like(f"{name}[{key!r}]", key, value[key], part) for key, part in other.items()})
    if isinstance(other, np.ndarray):
        return Array(other.dtype, " ".join(map(str, other.shape)), 0, np.iinfo(other.dtype).max).check(name, value, {})
    return (Text((other,)) if isinstance(other, str) else Int(0, PLACES.get(key, 2**128 - 1))).check(name, value, {})


@dataclass(frozen=True)
class Seed(Part):
    """A seed sequence of numpy, with the number of its children."""

    is_constant: ClassVar[bool] = False

    def take(self, value: np.random.SeedSequence) -> tuple[Any, ...]:
        entropy = value.entropy if isinstance(value.entropy, (int, type(None))) else tuple(map(int, value.entropy))
        return entropy, tuple(value.spawn_key), value.pool_size, value.n_children_spawned

    def put(self, value: Any, kept: tuple[Any, ...]) -> np.random.SeedSequence:
        entropy, spawn_key, pool, children = kept
        return np.random.SeedSequence(entropy, spawn_key=spawn_key, pool_size=pool, n_children_spawned=children)

    def check(self, name: str, value: Any, sizes: Sizes) -> tuple[Any, ...]:
        number = Int(0, 1 << 4096)
        is_many = type(value) in (tuple, list) and len(value) > 0 and type(value[0]) in (tuple, list)
        return Row(Each(number) if is_many else Maybe(number), Each(number), Int(4, 64), Int(0, 2**32 - 1)).check(
            name, value, sizes
        )
