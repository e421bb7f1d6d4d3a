"""Tables of merges from the results of soak tests."""

import json
from pathlib import Path
from typing import Any

import pytest

from studies.merging import tables

KEPT = sorted((Path(__file__).parents[2] / "benchmarks" / "merge_soak").glob("*.json"))


def merge(seed: int, metres: float, bent: float | None) -> dict[str, Any]:
    """Merge with the given error, and error without smoothing."""
    return {
        "seed": seed, "world": "office", "step": 49, "robots_a": [0, 2], "robots_b": [1], "error_m": metres,
        "error_deg": 1.0, "bent_m": bent, "bent_deg": None if bent is None else 2.0, "wrong_pairs": 0.0,
        "later_m": 0.1, "later_deg": 0.5,
    }  # fmt: skip


def test_smoothed_and_unsmoothed_errors_are_tabulated() -> None:
    """Merges with both values give root mean square, 95 %, worst, far and false ones; the farthest come first."""
    merges = [merge(1, 0.3, 0.6), merge(2, 0.4, 0.4), merge(3, 0.2, None)]
    lines = tables.straight_table(merges).splitlines()
    assert lines[0].startswith("| maps of 2 merges |")
    assert lines[2] == "| unsmoothed | 0.510 | 0.59 | 0.60 | 2 | 1 |"
    assert lines[3] == "| smoothed | 0.354 | 0.40 | 0.40 | 1 | 0 |"
    worst = tables.worst_table(merges, 2).splitlines()[2:]
    assert worst[0] == "| 2 | office | 0+2 with 1 | 49: 0.40 m, 1.0° | 0.10 m, 0.5° | 0% |"
    assert [line.split()[1] for line in worst] == ["2", "1"]


def test_forced_merges_are_excluded_from_comparisons() -> None:
    """Only merges that were not forced are compared with the truth."""
    soaks = [
        {"setting": {"forced": forced}, "merges": [merge(seed, 0.1, None)]} for seed, forced in ((1, True), (2, 0))
    ]
    assert [found["seed"] for found in tables.own_merges(soaks)] == [2]


def test_stored_soaks_can_be_read() -> None:
    """Each stored soak test has a row."""
    lines = tables.fates_table(tables.read_soaks(KEPT)).splitlines()
    assert [line.split()[1] for line in lines[2:]] == [file.stem for file in KEPT]


@pytest.mark.parametrize("content", ["", "[]", json.dumps({"setting": {}})])
def test_other_files_are_refused(tmp_path: Path, content: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """The error gives the file."""
    monkeypatch.chdir(tmp_path)
    file = Path("other.json")
    file.write_text(content)
    with pytest.raises(ValueError, match=r"files: expected soaks of merging.soak --json, got 'other\.json'"):
        tables.read_soaks([file])
