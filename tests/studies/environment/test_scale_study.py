"""Scale benchmark: timed episodes, pairs that should merge, report and resuming."""

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from studies.environment.scale import STUDY, Config, Trial, environment, play, sharing_pairs, trials
from training.bench.exploration.trials import CURVE_POINTS
from training.commands.study import run_program
from training.episodes.guard import PolicyError

PROGRAM = [
    sys.executable, "-m", "studies.environment.scale", "--extents", "20,30", "--robots", "2", "--max-seconds", "4",
    "--particles", "5", "--seeds", "1", "--first-seed", "100",
]  # fmt: skip


def test_pairs_that_share_landmarks_should_merge() -> None:
    """A pair counts if it is in one group, or if its maps contain 15 common true landmarks; false points do not."""
    claims = [np.arange(20), np.arange(20), np.arange(5, 40), np.r_[np.arange(14), np.full(9, -1)], np.full(30, -1)]
    record: Any = SimpleNamespace(groups=((0, 1), (2,), (3,), (4,)), map_claims=claims)
    assert sharing_pairs(record) == (3, 1)  # 0-1 merged; 0-2 and 1-2 share 15


def test_trials_cover_all_combinations_and_set_the_world() -> None:
    """Each seed has every extent and number of robots; the world has that extent, in the chosen split."""
    config = Config(family="office", extents=(30.0, 60.0), robots=(2, 1), seeds=2, seed=7)
    played = trials(config)
    assert len(played) == 8
    assert {trial.seed for trial in played[:4]} == {7}
    assert played[2] == Trial(family="office", extent=60.0, robots=2, seed=7)
    found = environment(config, played[2])
    assert (found.world, found.num_robots, found.world_split) == ("office:extent=60", 2, "validation")
    assert found.max_seconds == 600.0


def test_an_episode_is_timed_and_a_wrong_policy_costs_one_line(monkeypatch: Any, tmp_path: Path) -> None:
    """Each step is timed; rates and quantiles agree with each other; a policy that raises leaves its error."""
    config = Config(extents=(20.0,), robots=(2,), duration=4.0, particles=5, seeds=1, seed=101)
    (trial,) = trials(config)
    row = play(config, trial)
    assert 0.0 < row["median_ms"] <= row["p99_ms"] <= row["longest_ms"]
    assert 1e3 / row["longest_ms"] <= row["steps_per_s"]
    assert min(row["get_state_ms"], row["set_state_ms"], row["snapshot_mb"], row["reset_s"]) > 0.0
    assert 0.0 < row["coverage"] < 1.0
    assert row["memory_mb"] is None or row["memory_mb"] > 50.0
    assert set(row["curves"]) == {"time_s", "coverage", "map_error", "pose_error", "step_ms"}
    assert row["curves"]["coverage"][-1] == row["coverage"]
    assert len(row["curves"]["step_ms"]) == CURVE_POINTS
    (tmp_path / "scale_failing.py").write_text(
        "class Failing:\n def reset(self): pass\n def act(self, observation, belief, rng): raise ValueError('gone')\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    with pytest.raises(PolicyError, match="gone"):
        play(config.replace(policy="scale_failing:Failing"), trial)


def test_a_run_is_reported_and_resumed(tmp_path: Path) -> None:
    """The folder holds tables, curves and pictures; a stopped run plays only what is missing."""
    out = tmp_path / "run"
    program = [*PROGRAM, "--out", str(out)]
    subprocess.run(program, capture_output=True, check=True)
    names = {"metrics.json", "tables.md", "trials.csv", "curves.csv", "curves.png", "scale.png", "steps.csv"}
    assert {path.name for path in out.iterdir()} >= names
    tables = json.loads((out / "metrics.json").read_text())["tables"]
    assert [line["extent"] for line in tables["errors"]] == [20.0, 30.0]
    assert "| extent | robots | steps/s |" in (out / "tables.md").read_text()
    file = out / "trials.jsonl"
    lines = file.read_text().splitlines()
    assert len(lines) == 2
    file.write_text(lines[1] + "\n")
    subprocess.run(program, capture_output=True, check=True)
    assert file.read_text().splitlines()[0] == lines[1]
    assert len(file.read_text().splitlines()) == 2


@pytest.mark.parametrize(("options", "said"), [
    ("--policy unknown", "policy: expected one of 'frontier'"),
    ("--extents 300", "extent: expected a finite number > 0 and <= 200, got 300"),
    ("--extents 0", "extents: expected a finite number > 0"), ("--family maze", "family: expected one of 'rooms'"),
])  # fmt: skip
def test_bad_options_are_refused_before_a_folder_is_made(
    options: str, said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """One line names the option."""
    out = tmp_path / "run"
    monkeypatch.setattr(sys, "argv", [*PROGRAM[2:], *options.split(), "--out", str(out)])
    with pytest.raises(SystemExit, match="2"):
        run_program(STUDY)
    assert said in capsys.readouterr().err
    assert not out.exists()


def test_tables_and_curves_are_means_over_seeds() -> None:
    """Lines and curves hold the mean of both seeds; unknown memory stays unknown."""
    rows = []
    for seed, scale in ((1, 1.0), (2, 3.0)):
        config = Config(extents=(20.0,), robots=(1,), duration=3.0, particles=3, seeds=1, seed=seed)
        (trial,) = trials(config)
        rows.append(asdict(trial) | play(config, trial) | {"median_ms": scale, "memory_mb": None})
    steps, snapshots, *_ = (table.lines(rows) for table in STUDY.tables)
    assert steps[0]["median [ms]"].value == 2.0
    assert snapshots[0]["memory [MB]"].value is None
    assert STUDY.curves is not None
    over_time = STUDY.curves.lines(rows)
    assert over_time[-1]["coverage"] == pytest.approx(np.mean([row["coverage"] for row in rows]))
