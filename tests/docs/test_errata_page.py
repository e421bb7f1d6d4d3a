"""The ledger of equations, and every other page, name existing code and tests."""

import re
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).parents[2]
TESTS = {file.name: file.read_text(encoding="utf-8") for file in (ROOT / "tests").rglob("*.py")}
PAGES = {
    page.relative_to(ROOT / "docs").as_posix(): page.read_text(encoding="utf-8")
    for page in sorted((ROOT / "docs").rglob("*.md"))
}
LEDGER = [
    [cell.strip() for cell in line.strip("|").split(" | ")]
    for line in PAGES["reference/errata.md"].splitlines()
    if line.startswith("| ") and not line.startswith("| equation")
]
NAMED_TEST = re.compile(r"`(?:[\w/]*/)?(\w+\.py|)::(\w+)`")


def _assert_there(text: str) -> int:
    """Check that all tests named in a text exist, and return their number; `::test` refers to the file before it."""
    file, named = "", NAMED_TEST.findall(text)
    for given, test in named:
        file = given or file
        assert re.search(rf"^def {test}\(", TESTS[file], re.MULTILINE), f"{file}::{test}"
    return len(named)


@pytest.mark.parametrize(("functions", "tests"), [row[1:3] for row in LEDGER], ids=[row[0] for row in LEDGER])
def test_the_ledger_names_functions_and_tests_that_exist(functions: str, tests: str) -> None:
    """Every row names at least one existing function of the package and one existing test."""
    paths = re.findall(r"`([^`]+)`", functions)
    assert paths
    for path in paths:
        found: Any = import_module("slam_backend")
        for name in path.split("."):
            if not hasattr(found, name):  # a module that is not imported yet
                import_module(f"{found.__name__}.{name}")
            found = getattr(found, name)
    assert _assert_there(tests)


@pytest.mark.parametrize("page", [name for name, text in PAGES.items() if NAMED_TEST.search(text)])
def test_tests_named_on_pages_exist(page: str) -> None:
    """A test that a page cites as evidence exists."""
    assert _assert_there(PAGES[page])
