"""The glossary defines each term once and gives its place in the code."""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

PAGE = (Path(__file__).parents[2] / "docs" / "glossary.md").read_text(encoding="utf-8")
ROWS = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in PAGE.splitlines()
    if re.match(r"\| (?!term |not )", line) and line.count(" | ") == 3
]


def _resolve(name: str) -> Any:
    """Import the longest prefix of a dotted name that is a module, and get the rest from it."""
    parts = name.split(".")
    for end in range(len(parts), 0, -1):
        try:
            found: Any = import_module(".".join(parts[:end]))
        except ModuleNotFoundError:
            continue
        for part in parts[end:]:
            found = getattr(found, part)
        return found
    raise ModuleNotFoundError(name)


@pytest.mark.parametrize("row", ROWS, ids=[row[0] for row in ROWS])
def test_each_term_has_a_definition_and_names_code_that_exists(row: list[str]) -> None:
    """A definition is one sentence or a list of phrases with a full stop; each name can be imported."""
    _term, symbol, definition, code = row
    assert symbol
    assert definition.endswith(".")
    names = re.findall(r"`([\w.]+)`", code)
    assert names
    assert all(_resolve(name) is not None for name in names)


def test_no_term_is_explained_twice() -> None:
    """Each term is defined once."""
    terms = [term for row in ROWS for term in row[0].split(", ")]
    assert len(terms) > 60
    assert len(set(terms)) == len(terms)
