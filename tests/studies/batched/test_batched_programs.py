"""Programs about batched teams: their trials, and commands that exist."""

import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import typer
from scipy.stats import kendalltau

from studies.batched import on_gpu, ranks
from training.bench.speed import batched
from training.bench.speed.config import BatchedSpeedConfig
from training.cli import app


def test_commands_of_the_program_exist() -> None:
    """Each command parses, its options exist, and its results have a folder of their own."""
    folders = set()
    for command in on_gpu.commands(Path("runs/gpu")):
        found: Any = typer.main.get_command(app)
        words = command[3:]
        while getattr(found, "commands", None) is not None:
            found = found.commands[words.pop(0)]
        known = {name for parameter in found.params for name in parameter.opts}
        assert {word for word in words if word.startswith("--")} <= known, shlex.join(command)
        folders.add(words[words.index("--out") + 1])
    assert folders == {"runs/gpu/rate", "runs/gpu/driver", "runs/gpu/evaluation"}


def test_the_environment_is_timed_beside_batches() -> None:
    """It comes first, in processes of its own; without any it is left out."""
    config = BatchedSpeedConfig(batches=(8, 16), beside=3)
    assert [(trial.kind, trial.number) for trial in batched.trials(config)] == [
        ("environment", 3), ("batched", 8), ("batched", 16),
    ]  # fmt: skip
    assert all(trial.kind == "batched" for trial in batched.trials(config.replace(beside=0)))
    small = config.replace(beside=1, world="fig5", robots=1, steps=2, decision_ticks=1)
    assert batched.play(small, batched.trials(small)[0])["ticks_per_second"] > 0.0


@pytest.mark.parametrize("name", list(ranks.DRIVERS))
def test_drivers_act_within_their_space_and_see_walls(name: str) -> None:
    """Actions are two numbers; before a wall robots do not drive on."""
    rng = np.random.default_rng(0)
    seen = {"scan": np.full(32, 8.0, np.float32), "local_grid": np.zeros((3, 48, 48), np.uint8)}
    seen["local_grid"][0, :40] = 255
    act = ranks.driver(name)
    for _ in range(20):
        action = act(seen, rng)
        assert action.shape == (2,)
        assert np.abs(action).max() <= 1.5
    assert act(seen | {"scan": np.full(32, 0.4, np.float32)}, rng)[0] <= 0.0


def test_a_frontier_is_approached() -> None:
    """Free floor that ends on the left is where to turn."""
    grid = np.zeros((3, 48, 48), np.uint8)
    grid[0, 10:38, 10:38] = 255
    grid[1, 9], grid[1, 38], grid[1, :, 38] = 255, 255, 255
    seen = {"scan": np.full(32, 8.0, np.float32), "local_grid": grid}
    assert ranks.frontier(seen, np.random.default_rng(0))[1] > 0.5
    assert ranks.frontier(seen | {"local_grid": grid[:, :, ::-1]}, np.random.default_rng(0))[1] < -0.5


def test_ranks_compare_the_means_of_drivers() -> None:
    """Kendall's tau is that of the means over seeds."""
    rng = np.random.default_rng(0)
    rows = [
        {"policy": name, "exact": i + 0.1 * rng.normal(), "batched": [2, 0, 1, 3][i] + 0.1 * rng.normal()}
        for i, name in enumerate("abcd")
        for _ in range(5)
    ]
    assert ranks.tau(rows) == pytest.approx(kendalltau([0, 1, 2, 3], [2, 0, 1, 3]).statistic)
    lines = ranks.STUDY.tables[1].lines(rows)
    assert len(lines) == 1


def test_one_driver_has_no_rank() -> None:
    """A single driver, and a model that is not there, are refused by name."""
    with pytest.raises(ValueError, match="policies: expected at least two"):
        ranks.Config(policies=("spin",))
    with pytest.raises(ValueError, match="policies: expected a model that vslam train wrote, got no such file"):
        ranks.Config(policies=("spin", "runs/none"))
