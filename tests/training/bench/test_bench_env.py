"""`vslam bench env`: its rows, the budget of a step, and what it says where something is missing."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from training.bench.config import EnvBenchConfig
from training.bench.env import profile as env_budget
from training.bench.env import timing as env_timing
from training.bench.env.bench import run_bench
from training.bench.env.timing import (
    BURST,
    Play,
    play_in_turn,
    play_peer,
    ratio_of_bursts,
    record_actions,
    summarise_us,
)
from training.cli import app
from vslam_env import vslam_v0

runner = CliRunner()


class _Nested:
    """A class with a slow method that calls another slow one, by a clock of its own [ns]."""

    now = 0

    def outer(self) -> None:
        """Take 2 us, and what `inner` takes."""
        _Nested.now += 2000
        self.inner()

    def inner(self) -> None:
        """Take 4 us."""
        _Nested.now += 4000


def test_nested_phases_are_not_counted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """What an inner phase takes is taken off the outer one; the rest is what is in no phase."""
    phases = tuple(env_budget.Phase(name, ((_Nested, name),)) for name in ("outer", "inner"))
    monkeypatch.setattr(env_budget, "PHASES", phases)
    monkeypatch.setattr(env_budget.time, "perf_counter_ns", lambda: _Nested.now)
    untouched = [_Nested.outer, _Nested.inner]

    def step(_: Any) -> None:
        _Nested.now += 1000
        _Nested().outer()

    rows = {row["phase"]: row for row in env_budget.measure_budget(step, [None] * 3)}
    assert list(rows) == ["outer", "inner", env_budget.REST]
    assert [row["median_us"] for row in rows.values()] == [2.0, 4.0, 1.0]
    assert [row["mean_us"] for row in rows.values()] == [2.0, 4.0, 1.0]
    assert [_Nested.outer, _Nested.inner] == untouched


def test_all_phases_take_part_in_a_step() -> None:
    """Over 25 ticks each phase is called, and afterwards nothing of the package is changed."""
    before = [owner.__dict__[name] for phase in env_budget.PHASES for owner, name in phase.calls]
    env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=10)
    env.reset(seed=3)
    actions = [{agent: np.array([0.3, 0.5]) for agent in env.agents}] * 25
    rows = env_budget.measure_budget(env.step, actions)
    assert all(row["mean_us"] > 0.0 for row in rows)
    assert [owner.__dict__[name] for phase in env_budget.PHASES for owner, name in phase.calls] == before


def test_recorded_actions_play_again() -> None:
    """Actions that a policy took lead a fresh environment along the same way."""
    env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=10)
    actions = record_actions(env, 7, 12)
    poses = env.true_poses
    env.reset(seed=7)
    for action in actions:
        env.step(action)
    np.testing.assert_array_equal(env.true_poses, poses)


def test_times_are_summed_up() -> None:
    """Median, mean, 99th percentile, least and rates are of all durations, the undisturbed time of best repeats."""
    times = summarise_us(np.array([1.0, 2.0, 3.0, 4.0, 100.0]) * 1e-6)
    assert [times[name] for name in ("median_us", "mean_us", "min_us", "calls")] == pytest.approx([3.0, 22.0, 1.0, 5])
    assert (times["per_second"], times["per_second_mean"]) == pytest.approx((1e6 / 3.0, 1e6 / 22.0))
    assert 90.0 < times["p99_us"] <= 100.0
    times = summarise_us(np.array([[5.0, 90.0, 7.0], [80.0, 6.0, 70.0]]) * 1e-6)
    assert [times[name] for name in ("undisturbed_us", "min_us", "calls")] == pytest.approx([6.0, 5.0, 3])
    assert times["median_us"] == pytest.approx(38.5)


def test_a_missing_peer_is_none(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the peer package is not installed, nothing is timed in its place."""
    monkeypatch.setattr(env_timing, "PEER", "a_package_that_nobody_has")
    assert play_peer(3, 0, 2) is None


def test_plays_take_turns() -> None:
    """Each play begins anew and makes all its calls in order, burst by burst beside the other."""
    heard: list[tuple[str, int]] = []
    count = 2 * BURST + 3

    def play(name: str) -> Play:
        return Play(lambda: heard.append((name, -1)), lambda i: heard.append((name, i)), range(count))

    assert play_in_turn([play("a"), play("b")], 5, 2).shape == (2, 2, count - 5)
    for name in "ab":
        assert [i for each, i in heard if each == name] == [-1, *range(count)] * 2
    first, second, third = range(BURST), range(BURST, 2 * BURST), range(2 * BURST, count)
    turns = [("a", first), ("b", first), ("b", second), ("a", second), ("a", third), ("b", third)]
    assert heard[2 : 2 + 2 * count] == [(name, i) for name, calls in turns for i in calls]


def test_what_slows_both_plays_leaves_their_ratio() -> None:
    """Calls that take three times as long as those beside them do so whatever the machine does from burst to burst."""
    slowed = np.repeat([1.0, 7.0, 2.0], BURST) * np.array([[1.0], [4.0]])
    assert ratio_of_bursts(3e-6 * slowed, 1e-6 * slowed) == pytest.approx(3.0)


def test_loads_differ_from_the_base_one_by_one() -> None:
    """The first numbers make the base; every other row differs from it in one of them."""
    loads = EnvBenchConfig(robots=(2, 1), particles=(10, 20), worlds=("fig5", "hall"), modes=("dict", "goal")).loads()
    assert len(loads) == 5
    base = loads[0]
    for load in loads[1:]:
        assert sum(getattr(load, name) != getattr(base, name) for name in ("robots", "particles", "world", "mode")) == 1


def test_stopping_early_leaves_what_there_is() -> None:
    """A bench that is stopped after two trials is incomplete and says no more than it measured."""
    config = EnvBenchConfig(robots=(1,), particles=(5,), worlds=("fig5",), modes=("dict",), steps=3, peer=False)
    asked: list[bool] = []

    def should_stop() -> bool:
        asked.append(True)
        return len(asked) > 2

    result = run_bench(config, should_stop=should_stop)
    assert not result["complete"]
    assert len(result["rows"]) == 1
    assert result["budget"]
    assert result["simulator"] is None
    assert not result["snapshots"]


def test_the_command_writes_its_figures(tmp_path: Path) -> None:
    """The run folder and the JSON hold rows, budget, snapshots and resets; the config repeats the run."""
    out, file = tmp_path / "run", tmp_path / "figures.json"
    arguments = ["bench", "env", "--robots", "1", "--particles", "5", "--worlds", "fig5", "--modes", "flat,goal",
                 "--steps", "4", "--no-peer"]  # fmt: skip
    result = runner.invoke(app, [*arguments, "--out", str(out), "--json", str(file)])
    assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    assert figures == json.loads((out / "metrics.json").read_text())
    assert [row["mode"] for row in figures["rows"]] == ["flat", "goal"]
    assert all(row["calls"] == 4 and row["walls"] == 11 for row in figures["rows"])
    assert figures["complete"]
    assert figures["peer"] is None
    assert {"get_state", "clone"} <= figures["snapshots"].keys()
    assert figures["reset"]["calls"] > 0
    again = runner.invoke(app, ["bench", "env", "--config", str(out / "config.toml"), "--out", str(tmp_path / "again")])
    assert again.exit_code == 0, again.output
    rows = json.loads((tmp_path / "again" / "metrics.json").read_text())["rows"]
    assert [row["mode"] for row in rows] == ["flat", "goal"]
