"""Why maps were not merged, as `metrics.json` has it and as it is printed."""

from typing import Any

import pytest
from rich.console import Console

from slam_backend.maps.alignment_types import PairAttempts
from training.episodes.tables import pair_rows, print_refusals
from training.experiments.run_folder import plain


def tried(a: tuple[int, ...], b: tuple[int, ...], attempts: int, **refused: Any) -> PairAttempts:
    """Return the attempts of a pair; `refused` are the other fields."""
    told = {"refusals": {}, "last_reason": "", "last_step": None, "missed": "", "excess": float("nan")} | refused
    return PairAttempts(robots_a=a, robots_b=b, attempts=attempts, **told)


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
    """A console that keeps what is printed."""
    return Console(width=140, record=True, quiet=False, file=None, force_terminal=False)


def test_each_pair_has_a_row_and_so_have_groups_that_never_tried() -> None:
    """Robots bear their names; a pair is apart where the two share no map at the end."""
    rows = plain(pair_rows(PAIRS, GROUPS, names=[4, 5, 6, 7]))
    assert rows[0] == {
        "robots_a": [4], "robots_b": [5], "attempts": 3, "refused": {"too uncertain": 2},
        "last_reason": "too uncertain", "last_step": 74, "missed": "paths", "excess": 2.5, "apart": False,
    }  # fmt: skip
    assert (rows[1]["robots_a"], rows[1]["apart"], rows[1]["excess"]) == ([4, 5], True, None)
    never = [(row["robots_a"], row["robots_b"], row["last_step"]) for row in rows if not row["attempts"]]
    assert never == [([4, 5], [7], None), ([6], [7], None)]
    assert pair_rows(None, GROUPS) == []


def test_the_table_says_why_and_what_helps(console: Console, capsys: pytest.CaptureFixture[str]) -> None:
    """Counts of each reason, the last refusal with its step, and hints for the pairs that are apart alone."""
    print_refusals(console, plain(pair_rows(PAIRS, GROUPS)))
    text = console.export_text()
    for words in (
        "too uncertain (2)", "too uncertain at step 74 (paths 2.5)",
        "ambiguous (2)", "ambiguous at step 149", "ambiguous: The shared landmarks fit at several places",
        "never tried: The robots were out of contact",
    ):  # fmt: skip
        assert words in " ".join(text.split())
    assert "too uncertain: The way" not in text
    assert capsys.readouterr().out


def test_nothing_is_printed_where_nothing_was_refused(console: Console) -> None:
    """A team that merged at the first attempts, and one robot alone, have no table."""
    for pairs, groups in (((tried((0,), (1,), 1),), ((0, 1),)), ((), ((0,),))):
        print_refusals(console, pair_rows(pairs, groups))
    assert console.export_text() == ""
