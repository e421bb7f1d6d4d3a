"""Refusals in the project's one form, and options that take the numbers of an interval."""

import re
from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any

import pytest

FORM = re.compile(r"[^:]+: expected .+, got .+[.?]", re.DOTALL)  # name, expected, got, and a cure


def refused(call: Callable[[], Any], begins: str) -> None:
    """Check that a call raises one ValueError in the project's form, which begins with these words."""
    with pytest.raises(ValueError, match="expected") as caught:
        call()
    text = str(caught.value).rstrip()
    assert text.startswith(begins), text
    assert FORM.fullmatch(text), text


def inside_and_outside(bounds: str) -> tuple[list[Any], list[Any]]:
    """Return the closed ends of an interval, and what is not in it: "3..100" of whole numbers, "(0, 1]" of others."""
    if ".." in bounds:
        low, high = (int(float(end)) for end in bounds.split(".."))
        return [low, high], [low - 1, high + 1, low + 0.5, True, "3"]
    low, high = map(float, bounds[1:-1].split(","))
    below, beyond = low - 1e-3 * max(abs(low), 1e-9), high + 1e-3 * max(abs(high), 1e-9)
    ends = [end for end, bracket in ((low, bounds[0]), (high, bounds[-1])) if bracket in "[]"]
    return ends, [low if bounds[0] == "(" else below, high if bounds[-1] == ")" else beyond, float("nan"), True, "0.5"]


def check_option(kind: type[Any], called: str, name: str, allowed: str | list[Any], beside: Mapping[str, Any]) -> None:
    """Check that an option takes the ends of its interval, and refuses what is outside or in a list, by its name.

    Args:
        kind: Class of options.
        called: Prefix of its names in errors, with a dot, or "".
        name: Option.
        allowed: Interval, or a list of values that are refused.
        beside: Other options that large numbers of this one need.
    """
    inside, outside = inside_and_outside(allowed) if isinstance(allowed, str) else ([], allowed)
    for value in inside:
        assert getattr(kind(**{name: value} | dict(beside)), name) == value
    for value in outside:
        refused(lambda value=value: kind(**{name: value}), f"{called}{name}: expected ")


def check_complete(kind: type[Any], table: Mapping[str, Any]) -> None:
    """Check that a table names all options of a class that are numbers, and no others that there are not."""
    names = {field.name: field.type for field in fields(kind)}
    numbers = {
        name for name, type_ in names.items() if re.match(r"(int|float)\b", str(getattr(type_, "__name__", type_)))
    }
    assert numbers <= table.keys() <= names.keys()
