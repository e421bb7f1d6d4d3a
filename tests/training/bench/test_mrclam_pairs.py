"""Alignment and scores of pairs of real maps."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_logs import write_log

from training.bench.alignment.mrclam import align_log, align_pairs, summarise
from training.bench.config import MrclamPairsConfig
from training.replay.config import MrclamConfig
from training.replay.core import replay_log
from training.replay.readers import read_mrclam


def test_exact_maps_are_aligned_exactly(tmp_path: Path) -> None:
    """Without noise the maps of both robots are aligned to centimetres, by barcodes and by geometry only."""
    write_log(tmp_path, noise=0.0)
    log = read_mrclam(tmp_path, alone=True)
    rows = align_pairs(replay_log(log, MrclamConfig(path=str(tmp_path), particles=20)), log)
    assert {(row["barcodes"], row["method"]) for row in rows} == {
        (barcodes, method) for barcodes in ("given", "hidden") for method in ("ransac",)
    }
    for row in rows:
        assert row["robots"] == [2, 5]
        if row["barcodes"] == "given":
            assert row["accepted"]
            assert row["inliers"] >= row["shared"] - 1
        if row["accepted"]:
            assert row["error_m"] < 0.1
            assert row["error_deg"] < 2.0


def row(**changed: Any) -> dict[str, Any]:
    """Return the row of an aligned pair."""
    return {
        "duration_s": None, "robots": [1, 2], "shared": 15, "barcodes": "given", "method": "ransac", "accepted": True,
        "reason": "", "inliers": 15, "error_m": 0.1, "error_deg": 1.0,
    } | changed  # fmt: skip


def test_large_errors_count_as_false() -> None:
    """Large errors count as false, refusals do not; pairs with few shared landmarks are not counted."""
    refused = {"accepted": False, "reason": "ambiguous", "error_m": None, "error_deg": None}
    rows = [row(), row(error_m=0.6), row(error_deg=7.0), row(**refused), row(shared=3, **refused)]
    line = summarise(rows)[0]
    assert (line["pairs"], line["accepted"], line["false"]) == (4, 3, 2)
    assert line["median_m"] == 0.1
    assert line["worst_deg"] == 7.0
    assert summarise([row(**refused)])[0]["median_m"] is None


def test_the_command_leaves_a_table(vslam: Any, tmp_path: Path) -> None:
    """There is one line per duration, barcodes and method, on the console, as Markdown and in metrics.json."""
    write_log(tmp_path, noise=1.0)
    out = tmp_path / "run"
    options = ("--path", str(tmp_path), "--durations", "30,0", "--particles", "10", "--out", str(out))
    said = vslam("bench", "mrclam", *options)
    assert said.status == 0
    assert "Pairwise alignment" in said.out
    assert len((out / "table.md").read_text().splitlines()) == 2 + 4
    metrics = json.loads((out / "metrics.json").read_text())
    assert [line["duration_s"] for line in metrics["summary"]] == [30.0] * 2 + [None] * 2
    assert len(metrics["pairs"]) == 4


@pytest.mark.slow
def test_real_maps_are_aligned_by_barcodes_and_never_falsely_without(data_dir: Path) -> None:
    """After 200 s all ten pairs of data set 7 are aligned by barcodes; without them few are, none of them wrongly."""
    path = data_dir / "mrclam" / "MRCLAM_Dataset7"
    rows = align_log(MrclamPairsConfig(path=str(path), durations=(200.0,), particles=50, seed=100))
    for line in summarise(rows):
        assert line["false"] == 0
        if line["barcodes"] == "given":
            assert line["accepted"] == 10
            assert line["median_deg"] < 2.0
            assert line["worst_m"] < 0.5
    assert np.median([row["error_m"] for row in rows if row["error_m"] is not None]) < 0.1
