"""`vslam bench speed env`: rows, budget of a step, and missing packages."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from training.bench.speed import plays as env_timing
from training.bench.speed import profile as env_budget
from training.bench.speed.config import EnvSpeedConfig
from training.bench.speed.env import OTHER, PART, STEP, STUDY, trials
from training.bench.speed.plays import (
    BURST,
    Play,
    play_alternating,
    play_peer,
    ratio_of_bursts,
    record_actions,
    summarise_us,
)
from training.cli import app
from vslam_env import vslam_v0

runner = CliRunner()


class _Nested:
    """Class with a slow method that calls another slow one, with its own clock [ns]."""

    now = 0

    def outer(self) -> None:
        """Take 2 us plus the time of `inner`."""
        _Nested.now += 2000
        self.inner()

    def inner(self) -> None:
        """Take 4 us."""
        _Nested.now += 4000


def test_nested_phases_are_not_counted_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The time of an inner phase is subtracted from the outer one; the rest belongs to no phase."""
    phases = tuple(env_budget.Phase(name, ((_Nested, name),)) for name in ("outer", "inner"))
    monkeypatch.setattr(env_budget, "PHASES", phases)
    monkeypatch.setattr(env_budget.time, "perf_counter_ns", lambda: _Nested.now)
    untouched = [_Nested.outer, _Nested.inner]

    def step(_: Any) -> None:
        _Nested.now += 1000
        _Nested().outer()

    rows = env_budget.measure_budget(step, [None] * 3)
    assert list(rows) == ["outer", "inner", env_budget.REST]
    assert [row["median_us"] for row in rows.values()] == [2.0, 4.0, 1.0]
    assert [row["mean_us"] for row in rows.values()] == [2.0, 4.0, 1.0]
    assert [_Nested.outer, _Nested.inner] == untouched


def test_a_step_calls_all_phases() -> None:
    """Over 25 ticks each phase is called, and afterwards the package is unchanged."""
    before = [owner.__dict__[name] for phase in env_budget.PHASES for owner, name in phase.calls]
    env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=10)
    env.reset(seed=3)
    actions = [{agent: np.array([0.3, 0.5]) for agent in env.agents}] * 25
    rows = env_budget.measure_budget(env.step, actions)
    assert all(row["mean_us"] > 0.0 for row in rows.values())
    assert [owner.__dict__[name] for phase in env_budget.PHASES for owner, name in phase.calls] == before


def test_recorded_actions_repeat_the_path() -> None:
    """Recorded actions of a policy lead a new environment along the same path."""
    env = vslam_v0.parallel_env(world="fig5", num_robots=2, num_particles=10)
    actions = record_actions(env, 7, 12)
    poses = env.true_poses
    env.reset(seed=7)
    for action in actions:
        env.step(action)
    np.testing.assert_array_equal(env.true_poses, poses)


def test_times_are_summed_up() -> None:
    """Median, mean, 99 % quantile, minimum and rates use all durations, the undisturbed time the best repeats."""
    times = summarise_us(np.array([1.0, 2.0, 3.0, 4.0, 100.0]) * 1e-6)
    assert [times[name] for name in ("median_us", "mean_us", "min_us", "calls")] == pytest.approx([3.0, 22.0, 1.0, 5])
    assert (times["per_second"], times["per_second_mean"]) == pytest.approx((1e6 / 3.0, 1e6 / 22.0))
    assert 90.0 < times["p99_us"] <= 100.0
    times = summarise_us(np.array([[5.0, 90.0, 7.0], [80.0, 6.0, 70.0]]) * 1e-6)
    assert [times[name] for name in ("undisturbed_us", "min_us", "calls")] == pytest.approx([6.0, 5.0, 3])
    assert times["median_us"] == pytest.approx(38.5)


def test_without_the_peer_package_there_is_no_comparison(monkeypatch: pytest.MonkeyPatch) -> None:
    """If the package of the comparison is not installed, nothing is timed instead."""
    monkeypatch.setattr(env_timing, "PEER", "a_missing_package")
    assert play_peer(3, 0, 2) is None


def test_plays_alternate_in_bursts() -> None:
    """Each play starts over and makes all its calls in order, in alternating bursts."""
    heard: list[tuple[str, int]] = []
    count = 2 * BURST + 3

    def play(name: str) -> Play:
        return Play(lambda: heard.append((name, -1)), lambda i: heard.append((name, i)), range(count))

    assert play_alternating([play("a"), play("b")], 2).shape == (2, 2, count)
    for name in "ab":
        assert [i for each, i in heard if each == name] == [-1, *range(count)] * 2
    first, second, third = range(BURST), range(BURST, 2 * BURST), range(2 * BURST, count)
    turns = [("a", first), ("b", first), ("b", second), ("a", second), ("a", third), ("b", third)]
    assert heard[2 : 2 + 2 * count] == [(name, i) for name, calls in turns for i in calls]


def test_ratios_do_not_depend_on_machine_speed() -> None:
    """The ratio of two alternating plays does not depend on variations of the machine's speed between bursts."""
    slowed = np.repeat([1.0, 7.0, 2.0], BURST) * np.array([[1.0], [4.0]])
    assert ratio_of_bursts(3e-6 * slowed, 1e-6 * slowed) == pytest.approx(3.0)


def test_each_load_changes_one_number_of_the_base() -> None:
    """The first numbers are the base, whose parts are timed, too; every other row changes one of them."""
    config = EnvSpeedConfig(robots=(2, 1), particles=(10, 20), worlds=("fig5", "hall"), modes=("driver", "goal"))
    base, *others = (trial for trial in trials(config) if trial.kind == STEP)
    assert len(others) == 4
    names = ("robots", "particles", "world", "mode")
    for trial in trials(config):
        changed = sum(getattr(trial, name) != getattr(base, name) for name in names)
        assert changed == (trial in others)


def test_parts_of_a_step_are_summed_up() -> None:
    """The table of parts ends with their sum."""
    rows = [
        {"kind": PART, "name": name, "median_us": us, "mean_us": us} for name, us in (("scans", 2.0), ("rest", 3.0))
    ]
    table = STUDY.tables[1]
    assert [table.cells(line) for line in table.lines(rows)] == [
        ["scans", "2", "2"],
        ["rest", "3", "3"],
        ["all", "5", "5"],
    ]


@pytest.mark.slow
def test_the_command_writes_its_results(tmp_path: Path) -> None:
    """The run folder and the JSON have rows, budget, snapshots and resets; the config repeats the run."""
    out, file = tmp_path / "run", tmp_path / "figures.json"
    arguments = ["bench", "speed", "env", "--robots", "1", "--particles", "5", "--worlds", "fig5", "--modes",
                 "flat,goal", "--steps", "4", "--no-peer"]  # fmt: skip
    result = runner.invoke(app, [*arguments, "--out", str(out), "--json", str(file)])
    assert result.exit_code == 0, result.output
    figures = json.loads(file.read_text())
    assert figures == json.loads((out / "metrics.json").read_text())
    rows = [row for row in figures["trials"] if row["kind"] == STEP]
    assert [row["mode"] for row in rows] == ["flat", "goal"]
    assert all(row["calls"] == 4 and row["walls"] == 11 for row in rows)
    others = {row["name"]: row for row in figures["trials"] if row["kind"] == OTHER}
    assert {"get_state", "clone", "simulator only"} <= others.keys()
    assert others["reset"]["calls"] > 0
    assert sum(row["kind"] == PART for row in figures["trials"]) == len(env_budget.PHASES) + 1
    again = ["bench", "speed", "env", "--config", str(out / "config.toml"), "--out", str(tmp_path / "again")]
    result = runner.invoke(app, again)
    assert result.exit_code == 0, result.output
    repeated = json.loads((tmp_path / "again" / "metrics.json").read_text())["trials"]
    assert [row["mode"] for row in repeated] == [row["mode"] for row in figures["trials"]]
