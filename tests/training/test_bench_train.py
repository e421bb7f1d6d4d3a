"""`vslam bench train`: what it times, what it says, and what it refuses."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("torch", reason="torch is not installed: pip install .[train]")
pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")
pytest.importorskip("tensorboard", reason="tensorboard is not installed: pip install .[train]")

from training import bench_train
from training.bench_train import Part, Replay, TrainBenchConfig, TrainBenchResult, WorkerRow, run_bench
from training.cli import app

runner = CliRunner()
SMALL = TrainBenchConfig(world="fig5", robots=1, envs=1, workers=(0,), steps=2)


def test_a_replay_gives_what_was_recorded() -> None:
    """The same steps come round again, with the spaces of the environment, and are inside them."""
    replay = Replay(SMALL.environment(), 3)
    replay.reset()
    told = [replay.step(None) for _ in range(2 * bench_train.RECORDED)]
    for first, second in zip(told, told[bench_train.RECORDED :], strict=False):
        assert first is second
    for step in told[: bench_train.RECORDED]:
        assert replay.observation_space("robot_0").contains(step[0]["robot_0"])
    assert not np.array_equal(told[0][0]["robot_0"]["local_grid"], told[-1][0]["robot_0"]["local_grid"])


def test_goals_are_judged() -> None:
    """The adapter must stay below its limit, and two workers must gain what was asked for."""
    rows = (WorkerRow(1, 100.0, 110.0, 95.0), WorkerRow(2, 170.0, 200.0, 160.0))
    result = TrainBenchResult({}, (Part("adapter", 4.0, 3.0),), rows, True)
    adapter, gain = result.goals()
    assert (adapter["measured"], adapter["met"]) == (4.0, True)
    assert (gain["measured"], gain["met"]) == (pytest.approx(1.7), False)


def test_stopping_early_leaves_what_there_is() -> None:
    """A bench that is stopped before its second trial says what the first one measured, and that it is incomplete."""
    asked: list[bool] = []

    def should_stop() -> bool:
        asked.append(True)
        return len(asked) > 1

    result = run_bench(SMALL, should_stop=should_stop)
    assert not result.complete
    assert [part.name for part in result.parts] == ["adapter", "masks"]
    assert result.workers == ()


@pytest.mark.slow
def test_the_command_writes_its_figures(tmp_path: Path) -> None:
    """The run folder and the JSON hold all parts of a decision, the rates over workers, and the goals."""
    out, file = tmp_path / "run", tmp_path / "figures.json"
    arguments = ["bench", "train", "--world", "fig5", "--robots", "1", "--envs", "1", "--workers", "0", "--steps", "3"]
    result = runner.invoke(app, [*arguments, "--out", str(out), "--json", str(file)])
    assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    assert figures == json.loads((out / "metrics.json").read_text())
    names = ["environment", "adapter", "masks", "network, drawing", "network, updating"]
    assert [part["name"] for part in figures["parts"]] == names
    assert [row["workers"] for row in figures["workers"]] == [0]
    assert figures["complete"]


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["--robots", "9"], "robots: expected an int from 1 to 8, got 9"),
        (["--workers", "x"], "workers: expected numbers with commas between"),
        (["--envs", "1", "--workers", "2"], "workers: expected at most one per environment, 1, got 2"),
        (["--world", "castle"], "world: expected one of 'office'"),
        (["--steps", "1"], "steps: expected an int >= 2, got 1"),
    ],
)
def test_bad_input_is_refused(arguments: list[str], says: str, tmp_path: Path) -> None:
    """Bad options are refused before a folder is made."""
    result = runner.invoke(app, ["bench", "train", *arguments, "--out", str(tmp_path / "run")])
    assert isinstance(result.exception, ValueError)
    assert says in str(result.exception)
    assert not (tmp_path / "run").exists()
