"""Configurations as nested plain values: taken apart, changed, checked, and put in the form that TOML knows."""

import dataclasses
import json
from collections.abc import Mapping
from typing import Any, TypeVar

import numpy as np
from pydantic import TypeAdapter, ValidationError

from slam_backend.core.validation import bad_argument

T = TypeVar("T")

NONE = "none"  # what TOML, which has no word for it, says for None


def validated(cls: type[T], values: Mapping[str, Any]) -> T:
    """Build `cls` from nested dicts, or raise the project's one error for the first thing that is wrong."""
    try:
        text = json.dumps(plain(values), default=str)
    except (ValueError, RecursionError) as error:  # an int of 5000 digits, or a part that holds itself
        raise bad_argument("config", "values that JSON can hold", "no such values", f"It says: {error}.") from error
    try:
        # Strict on JSON refuses 2.0, "2" and True as ints, but takes dicts for parts, lists for tuples, int for float.
        return TypeAdapter(cls).validate_json(text, strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        own = first.get("ctx", {}).get("error")
        if isinstance(own, ValueError):  # raised by a check of ours, which explains itself
            raise own from None
        name = ".".join(str(part) for part in first["loc"])
        if first["type"] == "unexpected_keyword_argument":
            raise bad_argument(name, "a known field", first["input"], "Check the spelling.") from None
        expected = first["msg"].removeprefix("Input should be ")
        raise bad_argument(name, expected, first["input"], "Correct this value.") from None


def plain(value: Any) -> Any:
    """Turn nested configurations into dicts, lists and numbers."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    if isinstance(value, Mapping):
        return {key: plain(entry) for key, entry in value.items()}
    if isinstance(value, tuple):
        return [plain(entry) for entry in value]
    return value.item() if isinstance(value, np.generic) else value


def merged(values: dict[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Return nested dicts with some entries changed; weights of rewards are replaced as a whole."""
    result = dict(values)
    for key, change in changes.items():
        change = plain(change)
        nested = isinstance(change, dict) and isinstance(result.get(key), dict) and key != "reward"
        result[key] = merged(result[key], change) if nested else change
    return result


def without_none(values: Mapping[str, Any], standard: Any) -> dict[str, Any]:
    """Return nested dicts without None: left out where the standard is None or knows no such entry, else `NONE`."""
    usual = standard if isinstance(standard, Mapping) else {}
    result: dict[str, Any] = {}
    for key, value in values.items():
        if isinstance(value, Mapping):
            result[key] = without_none(value, usual.get(key))
        elif value is not None:
            result[key] = value
        elif usual.get(key) is not None:
            result[key] = NONE
    return result


def with_none(values: Any) -> Any:
    """Turn the text `NONE` into None in nested dicts."""
    if isinstance(values, Mapping):
        return {key: with_none(value) for key, value in values.items()}
    return None if values == NONE else values
