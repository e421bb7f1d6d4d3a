"""The page on smoothing shows the verdicts on filters as the code declares them."""

import re
from pathlib import Path

from slam_backend.fastslam.consistency import VERDICTS

PAGE = (Path(__file__).parents[2] / "docs" / "explanation" / "smoothing.md").read_text(encoding="utf-8")


def test_the_table_of_verdicts_is_that_of_the_code() -> None:
    """Words, conditions and their order are the same."""
    table = PAGE.partition("| verdict | if |\n|---|---|\n")[2].partition("\n\n")[0]
    assert re.findall(r"^\| (.+) \| (.+) \|$", table, re.MULTILINE) == list(VERDICTS.items())
