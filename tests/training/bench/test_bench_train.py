"""`vslam bench train`: timed parts, output, and refusals."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

pytest.importorskip("torch", reason="torch is not installed: pip install .[train]")
pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: pip install .[train]")
pytest.importorskip("sb3_contrib", reason="sb3-contrib is not installed: pip install .[train]")
pytest.importorskip("tensorboard", reason="tensorboard is not installed: pip install .[train]")

from training.bench.config import TrainBenchConfig
from training.bench.train.bench import run_bench
from training.bench.train.timing import ADAPTER_ALONE, RECORDED, Replay, WorkerTimes, record, summarise_workers
from training.cli import app

runner = CliRunner()
SMALL = TrainBenchConfig(world="fig5", robots=1, envs=1, workers=(0,), steps=2)


def test_a_replay_repeats_the_recording() -> None:
    """The recorded steps repeat in a cycle, with the spaces of the environment, and are inside them."""
    replay = Replay(record(SMALL.environment(), 3))
    replay.reset()
    results = [replay.step(None) for _ in range(2 * RECORDED)]
    for first, second in zip(results, results[RECORDED:], strict=False):
        assert first is second
    for step in results[:RECORDED]:
        assert replay.observation_space("robot_0").contains(step[0]["robot_0"])
    assert not np.array_equal(results[0][0]["robot_0"]["local_grid"], results[-1][0]["robot_0"]["local_grid"])


def test_worker_times_are_summarised() -> None:
    """Gain and work are medians of each step relative to one worker; balance is mean over slowest."""
    alone = WorkerTimes(
        workers=1, masks=np.array([0.0, 0.0, 1.0]), steps=np.array([4.0, 6.0, 3.0]),
        spent=np.array([[[4.0, 3.0]], [[5.0, 4.0]], [[3.0, 2.0]]]),
    )  # fmt: skip
    two = WorkerTimes(
        workers=2, masks=np.array([0.5, 0.0, 0.0]), steps=np.array([1.5, 5.0, 2.5]),
        spent=np.array([[[1.0, 1.0], [1.25, 2.0]], [[2.0, 3.0], [4.5, 3.0]], [[1.5, 1.0], [2.0, 1.0]]]),
    )  # fmt: skip
    first, second = summarise_workers((alone, two), slots=12)
    assert (first["work"], first["gain"], first["gain_low"], first["gain_high"]) == (None, None, None, None)
    assert (first["balance"], second["balance"]) == (1.0, 1.0)  # 3/4, 1, 1
    assert second["gain"] == pytest.approx(1.6)  # 4/2, 6/5, 4/2.5
    assert second["gain_low"] == pytest.approx(1.2)
    assert second["gain_high"] == pytest.approx(2.0)
    assert second["work"] == pytest.approx(1.0)  # 3/3, 6/4, 2/2
    assert second["beside_us"] == pytest.approx(1e6 / 12 * 0.5)  # 1/4, 1/2, 1/2
    rates = (second["per_second"], second["best_per_second"], second["mean_per_second"])
    np.testing.assert_allclose(rates, (12 / 2.5, 12 / 2.0, 36 / 9.5))
    assert summarise_workers((two,), slots=12)[0]["gain"] is None


def test_stopping_early_keeps_finished_results() -> None:
    """A benchmark stopped before its third trial has the results of the second, and is marked incomplete."""
    asked: list[bool] = []

    def should_stop() -> bool:
        asked.append(True)
        return len(asked) > 2

    result = run_bench(SMALL, should_stop=should_stop)
    assert not result["complete"]
    assert [part["name"] for part in result["parts"]] == [ADAPTER_ALONE, "masks"]
    assert result["workers"] == []


@pytest.mark.slow
def test_the_command_writes_its_results(tmp_path: Path) -> None:
    """The run folder and the JSON have all parts of a decision, and the rates over workers."""
    out, file = tmp_path / "run", tmp_path / "figures.json"
    arguments = ["bench", "train", "--world", "fig5", "--robots", "1", "--envs", "1", "--workers", "0", "--steps", "3"]
    result = runner.invoke(app, [*arguments, "--out", str(out), "--json", str(file)])
    assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    assert figures == json.loads((out / "metrics.json").read_text())
    names = ["environment", "adapter, between steps", ADAPTER_ALONE, "masks", "network, sampling", "network, update"]
    assert [part["name"] for part in figures["parts"]] == names
    assert [row["workers"] for row in figures["workers"]] == [0]
    assert figures["complete"]
