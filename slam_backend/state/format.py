"""Comparison of states, their records as dicts, and the number of their format; see `slam_backend.state`."""

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from types import FunctionType
from typing import Any

import numpy as np

from slam_backend.state import CLASS, Part, options_in


def equal(one: Any, other: Any) -> bool:
    """Return whether two states are equal bit for bit; whether they are snapshots or plain dicts does not matter."""
    if isinstance(one, np.ndarray) and isinstance(other, np.ndarray):
        return (one.dtype, one.shape, one.tobytes()) == (other.dtype, other.shape, other.tobytes())
    if isinstance(one, Mapping) and isinstance(other, Mapping):
        return list(one) == list(other) and all(map(equal, one.values(), other.values()))
    if type(one) in (tuple, list) and type(other) in (tuple, list):
        return len(one) == len(other) and all(map(equal, one, other))
    if type(one) is type(other) and (hasattr(one, "STATE") or is_dataclass(one)):
        return one is other or equal(parts_of(one), parts_of(other))
    return type(one) is type(other) and bool(one == other or (one != one and other != other))


def parts_of(record: Any) -> dict[str, Any]:
    """Return the fields of a record or of options by name, with the name of the class."""
    kind: Any = type(record)
    names = kind.STATE.parts if hasattr(kind, "STATE") else [f.name for f in fields(record) if f.init]
    return {CLASS: kind.__name__} | {name: getattr(record, name) for name in names}


def format_of(kind: type) -> str:
    """Return a number of the declarations that the state of a class depends on; another one after any change."""
    waiting: list[Part | type] = [kind]
    texts: dict[type, str] = {}
    while waiting:
        one = waiting.pop()
        if isinstance(one, Part):
            waiting += one.inner()
        elif one not in texts and hasattr(one, "STATE"):
            texts[one] = " ".join(f"{name}={_text(part)}" for name, part in one.STATE.parts.items())
            waiting += one.STATE.parts.values()
        elif one not in texts:
            texts[one] = " ".join(f.name for f in fields(one))
            waiting += options_in(one)
    lines = sorted(f"{one.__name__}: {text}" for one, text in texts.items())
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()[:12]


def _text(value: Any) -> str:
    """Return a declaration as text."""
    if isinstance(value, FunctionType) and value.__name__ == "<lambda>":
        value = value()
    if isinstance(value, (type, FunctionType)):
        return value.__name__
    if isinstance(value, Part):
        return f"{type(value).__name__}({', '.join(f'{name}={_text(part)}' for name, part in vars(value).items())})"
    if isinstance(value, (tuple, Sequence)) and not isinstance(value, str):
        return f"({', '.join(map(_text, value))})"
    if isinstance(value, Mapping):
        return f"({', '.join(f'{name}={_text(part)}' for name, part in value.items())})"
    return repr(value)
