"""The page on own logs has a row for each cause that the diagnosis may name."""

import re
from pathlib import Path

from slam_backend.diagnosis import CAUSES

PAGE = Path(__file__).parents[2] / "docs" / "tutorials" / "own_log.md"


def test_the_table_of_mistakes_is_that_of_the_code() -> None:
    """Rows are the causes, in the order of the code."""
    table = PAGE.read_text(encoding="utf-8").partition("## Likely mistakes\n")[2].partition("\n\n")[0]
    assert re.findall(r"^\| ([a-z][^|]*?) \|", table, re.MULTILINE) == list(CAUSES)
