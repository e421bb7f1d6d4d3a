"""Scale benchmark: timed episodes, pairs that should merge, report and resuming."""

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from training.bench.config import ScaleBenchConfig, ScaleTrial
from training.bench.exploration.trials import CURVE_POINTS
from training.bench.scale.report import curves, draw_scale, markdown, summarise
from training.bench.scale.trials import CURVES, TRIALS_FILE, play, sharing_pairs
from training.cli import app

FEW = (
    "bench", "scale", "--extents", "20,30", "--robots", "2", "--max-seconds", "4", "--particles", "5", "--seeds", "1",
    "--first-seed", "100",
)  # fmt: skip


def test_pairs_that_share_landmarks_should_merge() -> None:
    """A pair counts if it is in one group, or if its maps contain 15 common true landmarks; false points do not."""
    claims = [np.arange(20), np.arange(20), np.arange(5, 40), np.r_[np.arange(14), np.full(9, -1)], np.full(30, -1)]
    record: Any = SimpleNamespace(groups=((0, 1), (2,), (3,), (4,)), map_claims=claims)
    assert sharing_pairs(record) == (3, 1)  # 0-1 merged; 0-2 and 1-2 share 15


def test_trials_cover_all_combinations_and_set_the_world() -> None:
    """Each seed has every extent and number of robots; the world has that extent, in the chosen split."""
    config = ScaleBenchConfig(family="office", extents=(30.0, 60.0), robots=(2, 1), seeds=2, seed=7)
    trials = config.trials()
    assert len(trials) == 8
    assert {trial.seed for trial in trials[:4]} == {7}
    assert trials[2] == ScaleTrial(family="office", extent=60.0, robots=2, seed=7)
    environment = config.environment(trials[2])
    assert (environment.world, environment.num_robots, environment.world_split) == ("office:extent=60", 2, "validation")
    assert environment.max_seconds == 600.0


def test_an_episode_is_timed_and_a_wrong_policy_costs_one_line(monkeypatch: Any, tmp_path: Path) -> None:
    """Each step is timed; rates and quantiles agree with each other; a policy that raises leaves its error."""
    config = ScaleBenchConfig(extents=(20.0,), robots=(2,), duration=4.0, particles=5, seeds=1, seed=101)
    (trial,) = config.trials()
    row = play(config, trial)
    assert 0.0 < row["median_ms"] <= row["p99_ms"] <= row["longest_ms"]
    assert 1e3 / row["longest_ms"] <= row["steps_per_s"]
    assert min(row["get_state_ms"], row["set_state_ms"], row["snapshot_mb"], row["reset_s"]) > 0.0
    assert 0.0 < row["coverage"] < 1.0
    assert row["memory_mb"] is None or row["memory_mb"] > 50.0
    assert set(row["curves"]) == {"time_s", *CURVES}
    assert row["curves"]["coverage"][-1] == row["coverage"]
    assert len(row["curves"]["step_ms"]) == CURVE_POINTS
    (tmp_path / "scale_failing.py").write_text(
        "class Failing:\n def reset(self): pass\n def act(self, observation, belief, rng): raise ValueError('gone')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    assert "gone" in play(config.replace(policy="scale_failing:Failing"), trial)["failed"]


def test_a_run_is_reported_and_resumed(tmp_path: Path) -> None:
    """The folder holds tables, curves and a picture; a stopped run plays only what is missing."""
    out = tmp_path / "run"
    first = CliRunner().invoke(app, [*FEW, "--out", str(out)])
    assert first.exit_code == 0, first.output
    assert {path.name for path in out.iterdir()} >= {
        "metrics.json",
        "tables.md",
        "trials.csv",
        "curves.csv",
        "scale.png",
    }
    metrics = json.loads((out / "metrics.json").read_text())
    assert [line["extent"] for line in metrics["summary"]] == [20.0, 30.0]
    assert (out / "tables.md").read_text().startswith("| cost | steps/s |")
    lines = (out / TRIALS_FILE).read_text().splitlines()
    assert len(lines) == 2
    (out / TRIALS_FILE).write_text(lines[1] + "\n")
    again = CliRunner().invoke(app, [*FEW, "--out", str(out)])
    assert again.exit_code == 0, again.output
    assert (out / TRIALS_FILE).read_text().splitlines()[0] == lines[1]
    assert len((out / TRIALS_FILE).read_text().splitlines()) == 2


def test_figures_are_means_over_seeds(tmp_path: Path) -> None:
    """Lines and curves hold the mean of both seeds; unknown memory stays unknown; the picture is drawn."""
    rows = []
    for seed, scale in ((1, 1.0), (2, 3.0)):
        config = ScaleBenchConfig(extents=(20.0,), robots=(1,), duration=3.0, particles=3, seeds=1, seed=seed)
        rows.append(play(config, config.trials()[0]) | {"median_ms": scale, "memory_mb": None})
    (line,) = summarise(rows)
    assert (line["seeds"], line["median_ms"], line["memory_mb"]) == (2, 2.0, None)
    over_time = curves(rows)
    assert over_time[-1]["coverage"] == pytest.approx(np.mean([row["coverage"] for row in rows]))
    assert "| 20 m, K=1 |" in markdown([line])
    draw_scale(tmp_path / "scale.png", [line], over_time)
    assert (tmp_path / "scale.png").stat().st_size > 10_000
