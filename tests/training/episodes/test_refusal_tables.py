"""Refusals of merges in `metrics.json` and on the console."""

from typing import Any

import pytest
from rich.console import Console

from slam_backend.team.reports import PairAttempts
from training.episodes.tables import pair_rows, print_refusals
from training.experiments.run_folder import plain


def tried(a: tuple[int, ...], b: tuple[int, ...], attempts: int, **refused: Any) -> PairAttempts:
    """Return the attempts of a pair; `refused` are the other fields."""
    fields = {"refusals": {}, "last_reason": "", "last_step": None, "missed": "", "excess": float("nan")} | refused
    return PairAttempts(robots_a=a, robots_b=b, attempts=attempts, **fields)


PAIRS = (
    tried(
        (0,), (1,), 3, refusals={"too uncertain": 2}, last_reason="too uncertain", last_step=74, missed="paths",
        excess=2.5,
    ),
    tried((0, 1), (2,), 2, refusals={"ambiguous": 2}, last_reason="ambiguous", last_step=149),
)  # fmt: skip
GROUPS = ((0, 1), (2,), (3,))


@pytest.fixture
def console() -> Console:
    """Console that records its output."""
    return Console(width=140, record=True, quiet=False, file=None, force_terminal=False)


def test_each_pair_of_groups_has_a_row() -> None:
    """Robots have their numbers; a pair is apart if the two share no map at the end."""
    rows = plain(pair_rows(PAIRS, GROUPS, numbers=[4, 5, 6, 7]))
    assert rows[0] == {
        "robots_a": [4], "robots_b": [5], "attempts": 3, "refused": {"too uncertain": 2},
        "last_reason": "too uncertain", "last_step": 74, "missed": "paths", "excess": 2.5, "apart": False,
    }  # fmt: skip
    assert (rows[1]["robots_a"], rows[1]["apart"], rows[1]["excess"]) == ([4, 5], True, None)
    never = [(row["robots_a"], row["robots_b"], row["last_step"]) for row in rows if not row["attempts"]]
    assert never == [([4, 5], [7], None), ([6], [7], None)]
    assert pair_rows(None, GROUPS) == []


def test_the_table_has_reasons_and_hints(console: Console, capsys: pytest.CaptureFixture[str]) -> None:
    """The table has counts of each reason and the last refusal with its step; hints are for pairs still apart."""
    print_refusals(console, plain(pair_rows(PAIRS, GROUPS)))
    text = console.export_text()
    for words in (
        "too uncertain (2)", "too uncertain at step 74 (paths 2.5)",
        "ambiguous (2)", "ambiguous at step 149", "ambiguous: The shared landmarks fit at several places",
        "not attempted: The robots were out of contact",
    ):  # fmt: skip
        assert words in " ".join(text.split())
    assert "too uncertain: The way" not in text
    assert capsys.readouterr().out


def test_without_refusals_there_is_no_table(console: Console) -> None:
    """A team that merged at its first attempts, and a single robot, have no table."""
    for pairs, groups in (((tried((0,), (1,), 1),), ((0, 1),)), ((), ((0,),))):
        print_refusals(console, pair_rows(pairs, groups))
    assert console.export_text() == ""
