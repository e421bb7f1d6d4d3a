"""Alignment and scores of pairs of real maps."""

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from studies.merging.mrclam_pairs import STUDY, Config, play, trials
from tests.training.small_logs import write_log


def played(config: Config) -> list[dict[str, Any]]:
    """Return the rows of all trials."""
    return [asdict(trial) | play(config, trial) for trial in trials(config)]


def test_exact_maps_are_aligned_exactly(tmp_path: Path) -> None:
    """Without noise the maps of both robots are aligned to centimetres, by barcodes and by geometry only."""
    write_log(tmp_path, noise=0.0)
    rows = played(Config(path=str(tmp_path), durations=(0.0,), particles=20))
    assert [row["barcodes"] for row in rows] == ["given", "hidden"]
    for row in rows:
        assert (row["robot_a"], row["robot_b"]) == (2, 5)
        if row["barcodes"] == "given":
            assert row["accepted"]
            assert row["inliers"] >= row["shared"] - 1
        if row["accepted"]:
            assert row["error_m"] < 0.1
            assert row["error_deg"] < 2.0
            assert not row["false"]


def test_refusals_are_no_false_alignments() -> None:
    """Pairs with few shared landmarks are not counted; refused pairs have no errors."""
    aligned = {"duration": 0.0, "barcodes": "given", "enough": True, "accepted": True, "false": False}
    aligned |= {"error_m": 0.1, "error_deg": 1.0}
    refused = {"duration": 0.0, "barcodes": "given", "enough": False, "accepted": False}
    (line,) = STUDY.tables[0].lines([aligned, aligned | {"false": True, "error_m": 0.6}, refused])
    assert [line[name].value for name in ("pairs with 5 in common", "aligned", "false")] == [2, 2, 1]
    assert line["worst [m]"].value == 0.6
    assert STUDY.tables[0].lines([refused])[0]["median [m]"].value is None


def test_the_program_leaves_a_table(tmp_path: Path) -> None:
    """There is one line per duration and barcodes, on the console, as Markdown and in metrics.json."""
    write_log(tmp_path, noise=1.0)
    out = tmp_path / "run"
    program = [sys.executable, "-m", "studies.merging.mrclam_pairs", "--path", str(tmp_path), "--durations", "30,0"]
    done = subprocess.run(
        [*program, "--particles", "10", "--out", str(out)], capture_output=True, text=True, check=True
    )
    assert "Pairwise alignment" in done.stdout
    assert "| all | hidden | 1 |" in (out / "tables.md").read_text()
    lines = json.loads((out / "metrics.json").read_text())["tables"]["pairs"]
    assert [line["duration"] for line in lines] == [30.0, 30.0, 0.0, 0.0]


@pytest.mark.slow
def test_real_maps_are_aligned_by_barcodes_and_never_falsely_without(data_dir: Path) -> None:
    """After 200 s all ten pairs of data set 7 are aligned by barcodes; without them few are, none of them wrongly."""
    path = data_dir / "mrclam" / "MRCLAM_Dataset7"
    rows = played(Config(path=str(path), durations=(200.0,), particles=50, seed=100))
    given, hidden = STUDY.tables[0].lines(rows)
    assert given["false"].value == hidden["false"].value == 0
    assert given["aligned"].value == 10
    assert given["median [°]"].value < 2.0
    assert given["worst [m]"].value < 0.5
    assert np.median([row["error_m"] for row in rows if "error_m" in row]) < 0.1
