"""Kept rows of the benchmark: the page is theirs, and each of their files is the one that was submitted."""

import hashlib
import tomllib
from pathlib import Path

import pytest

from training.commands.helpers.plan import write_leaderboard

ROOT = Path(__file__).parents[3]
KEPT = sorted(each.parent for each in (ROOT / "benchmarks" / "vslam-bench-v1").glob("*/config.toml"))


def test_the_page_is_made_from_the_kept_rows(tmp_path: Path) -> None:
    """The leaderboard of the documentation is that which the command makes of the kept rows."""
    page = tmp_path / "leaderboard.md"
    write_leaderboard(KEPT, page)
    assert page.read_text(encoding="utf-8") == (ROOT / "docs" / "reference" / "leaderboard.md").read_text(
        encoding="utf-8"
    )


@pytest.mark.parametrize("folder", KEPT, ids=lambda folder: folder.name)
def test_kept_files_are_those_submitted(folder: Path) -> None:
    """The digests of a submission are those of its files."""
    card = tomllib.loads((folder / "submission.toml").read_text(encoding="utf-8"))
    digests = {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in card["files"]}
    assert digests == card["files"]
