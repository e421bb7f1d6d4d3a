"""Comparison of run folders: options that differ, metrics, paired differences."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.experiments.run_folder import RunFolder
from training.report.comparison import compare_folders


def bench(folder: Path, policy: str, errors: dict[int, float], command: str = "bench exploration") -> Path:
    """Write the folder of a bench of one policy, with a map error for each seed."""
    run = RunFolder.create(folder, command, {"policies": [policy], "seeds": len(errors)}, 0)
    trials = [
        {
            "policy": policy,
            "world": world,
            "robots": 3,
            "seed": seed,
            "map_error": error + shift,
            "curves": {"time_s": []},
        }
        for world, shift in (("maze", 0.1), ("office", 0.0))
        for seed, error in errors.items()
    ]
    run.write_metrics({"trials": trials})
    run.write_text("curves.csv", f"world,policy,time_s,map_error\nmaze,{policy},0,0.7\nmaze,{policy},1,0.6\n")
    return folder


def test_benches_of_two_policies_are_paired_by_seed(tmp_path: Path, vslam: Any) -> None:
    """Policies that tell two folders apart are compared on common seeds, place by place, with an interval."""
    one = bench(tmp_path / "one", "frontier", {1: 0.5, 2: 0.4, 3: 0.6})
    other = bench(tmp_path / "other", "mine=m:Own", {2: 0.3, 3: 0.45, 4: 0.9})
    found = compare_folders(one, other)
    rows = {row.where: row for row in found.differences}
    assert rows.keys() == {"maze", "office"}
    row = rows["maze"]
    assert (row.metric, row.seeds) == ("map_error", 2)
    assert (row.one, row.other) == (pytest.approx(0.6), pytest.approx(0.475))
    assert row.difference == pytest.approx(np.mean([-0.1, -0.15]))
    assert row.low is not None
    assert row.high is not None
    assert -0.15 <= row.low + 1e-9 <= row.difference <= row.high - 1e-9 <= -0.1
    assert ("policies", "['frontier']", "['mine=m:Own']") in found.options
    page = tmp_path / "compare.html"
    said = vslam("compare", str(one), str(other), "--json", "-", "--out", str(page))
    assert said.status == 0
    assert [line["seeds"] for line in json.loads(said.out)["differences"]] == [2, 2]
    assert "95 % over 2 seeds" in said.err
    text = page.read_text()
    assert '"one: frontier"' in text
    assert '"other: mine"' in text


def test_runs_are_compared_by_the_means_over_robots(run: Path, tmp_path: Path, vslam: Any) -> None:
    """A run is compared with itself without a difference, and its curves are in one chart."""
    said = vslam("compare", str(run), str(run), "--out", str(tmp_path / "c.html"))
    assert said.status == 0
    assert "All options are equal." in said.out
    found = {row.metric: row for row in compare_folders(run, run).differences}
    metrics = json.loads((run / "metrics.json").read_text())
    assert found["map_error"].one == pytest.approx(np.mean([row["map_error"] for row in metrics["robots"]]))
    assert {row.difference for row in found.values()} == {0.0}
    assert "map error E, mean over robots" in (tmp_path / "c.html").read_text()


def test_runs_without_common_metrics_are_refused(run: Path, tmp_path: Path) -> None:
    """Runs of commands with nothing in common cannot be compared."""
    other = RunFolder.create(tmp_path / "other", "paper fig1", {}, 0)
    other.write_metrics({"odometry": [{"path_rms_m": 1.0}]})
    with pytest.raises(
        ValueError, match="folders: expected two run folders with metrics in common, got a run of 'run'"
    ):
        compare_folders(run, other.path)
