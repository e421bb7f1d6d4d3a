"""Exploration benchmark: common worlds, metrics, summary and resuming."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from training.bench.exploration.config import ExplorationConfig, Trial
from training.bench.exploration.players import label, parted
from training.bench.exploration.report import STUDY, TABLES
from training.bench.exploration.trials import CURVE_POINTS, CURVES, count_merges, play
from training.episodes.runner import MergeRecord
from training.experiments.study import Column, ResultTable
from training.experiments.trial_store import TRIALS_FILE
from vslam_env import vslam_v0

SMALL = ExplorationConfig(
    policies=("frontier", "random_walk", "frontier@continuous"), worlds=("fig5",), robots=(2,), duration=8.0,
    particles=20, seeds=2, seed=200,
)  # fmt: skip
TOLD_M = 1e-3  # merges of an oracle are accurate to a tenth of a millimetre
OWN = """
class Stubborn:
    def reset(self):
        pass

    def act(self, observation, belief, rng):
        return int((observation["action_mask"] == 0).argmax())


class Failing(Stubborn):
    def act(self, observation, belief, rng):
        if belief.tick > 20:
            raise ValueError("gone\\nfor good")
        return 0


class Nonsense(Stubborn):
    def act(self, observation, belief, rng):
        return "left" if belief.tick > 20 else 0


class Slow(Stubborn):
    def act(self, observation, belief, rng):
        while belief.tick > 40:
            pass
        return 0
"""


@pytest.fixture
def own_policy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Custom policy in the current folder that always chooses an invalid action."""
    (tmp_path / "a_users_policies.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    yield "a_users_policies:Stubborn"
    sys.modules.pop("a_users_policies", None)


@pytest.fixture(scope="module")
def rows() -> list[dict[str, Any]]:
    """One seed of a small benchmark: three policies, without and with all oracles."""
    return [play(SMALL, trial) for trial in SMALL.trials() if trial.seed == SMALL.seed]


def _row(policy: str, seed: int, oracle: str = "none", **figures: Any) -> dict[str, Any]:
    """Return a row in which all other metrics are one half."""
    columns = (column.name for table in TABLES for column in table.columns)
    values = dict.fromkeys(columns, 0.5) | figures
    line = {"time_s": [0.0, 1.0]} | {name: [0.0, 0.1 * seed] for name in CURVES}
    return (
        {"policy": policy, "world": "office", "robots": 3, "oracle": oracle, "seed": seed} | values | {"curves": line}
    )


def test_all_policies_of_a_seed_have_the_same_world() -> None:
    """Walls, landmarks and starts depend only on the seed and the split, not on policy, action type or oracle."""

    def met(config: ExplorationConfig, trial: Trial) -> tuple[bytes, ...]:
        env = vslam_v0.parallel_env(config=config.environment(trial))
        env.reset(seed=trial.seed)
        return env.scene().walls.tobytes(), env.true_landmarks.tobytes(), env.true_start_poses.tobytes()

    places = {seed: {met(SMALL, trial) for trial in SMALL.trials() if trial.seed == seed} for seed in (200, 201)}
    assert [len(found) for found in places.values()] == [1, 1]
    other = ExplorationConfig.from_mapping(SMALL.to_mapping() | {"split": "test", "seed": 200})
    assert len({*places[200], *places[201], met(other, other.trials()[0])}) == 3


def test_oracles_remove_pose_errors(rows: list[dict[str, Any]]) -> None:
    """With all oracles poses have no error; without, they have; both run for the requested time."""
    for row in rows:
        has_oracle = row["oracle"] == "all"
        assert (row["pose_error"] < TOLD_M) is has_oracle
        assert (row["ate_start_m"] < TOLD_M) is has_oracle
        assert row["curves"]["time_s"][-1] == pytest.approx(8.0)
        assert len(row["curves"]["coverage"]) == CURVE_POINTS
        assert row["curves"]["coverage"][-1] == row["coverage"] > row["curves"]["coverage"][0]
        assert row["curves"]["pose_error"][-1] == pytest.approx(row["pose_error"])
        assert row["curves"]["coverage"][0] <= row["mean_coverage"] <= max(row["curves"]["coverage"]) + 1e-9


def test_a_trial_repeats_itself(rows: list[dict[str, Any]]) -> None:
    """A repeated trial has the same metrics, except decision times."""
    again, untimed = play(SMALL, SMALL.trials()[0]), {"decision_ms": 0.0, "decision_p99_ms": 0.0, "curves": 0}
    assert {**again, **untimed} == {**rows[0], **untimed}
    for name in ("time_s", *CURVES):
        np.testing.assert_array_equal(again["curves"][name], rows[0]["curves"][name])


def test_custom_policies_can_be_compared(own_policy: str) -> None:
    """A policy can be given by its module; each of its invalid actions is counted."""
    config = ExplorationConfig(policies=(own_policy,), worlds=("fig5",), robots=(2,), duration=4.0, particles=10)
    row = play(config, config.trials()[0])
    assert row["invalid_actions"] == 2 * 4  # two robots, one decision per second
    assert row["way_m"] == 0.0


def test_team_policies_and_bounds_are_marked() -> None:
    """Team policies and bounds run by their labels, which stay in the rows; the bound `oracles` has all oracles."""
    labels = ("mtsp@team", "oracles@bound", "rollout@bound")
    config = ExplorationConfig(policies=labels, worlds=("fig5",), robots=(2,), duration=3.0, particles=10)
    rows = [play(config, trial) for trial in config.trials() if trial.oracle == "none" and trial.seed == config.seed]
    assert [row["policy"] for row in rows] == list(labels)
    assert rows[1]["pose_error"] < TOLD_M < rows[0]["pose_error"]
    assert all(row["decision_p99_ms"] >= row["decision_ms"] > 0.0 for row in rows)


@pytest.mark.parametrize(
    ("label", "says"),
    [
        ("mtsp@flight", "mtsp@: expected one of 'goal', 'continuous', 'discrete', 'team', got 'flight'"),
        ("frontier@bound", "bound: expected one of 'oracles', 'rollout', got 'frontier'"),
        ("best@team", "policy: expected one of 'frontier', .* got 'best'"),
        ("rollout", "policy: expected one of 'frontier', .* got 'rollout'"),
    ],
)
def test_unknown_labels_are_refused(label: str, says: str) -> None:
    """Unknown policies, bounds and action types are refused with the known ones."""
    with pytest.raises(ValueError, match=says):
        ExplorationConfig(policies=(label,))


def test_policies_that_fail_do_not_stop_the_others(vslam: Any, own_policy: str, tmp_path: Path) -> None:
    """A policy that raises, returns nonsense or never returns costs one line each; all other episodes are kept."""
    out, module = tmp_path / "run", own_policy.split(":")[0]
    names = ["frontier", *(f"{module}:{name}" for name in ("Failing", "Nonsense", "Slow"))]
    done = vslam(
        "bench", "exploration", "--policies", ",".join(names), "--worlds", "fig5", "--robots", "2", "--oracles", "none",
        "--max-seconds", "6", "--particles", "10", "--seeds", "2", "--decision-limit", "0.5", "--out", str(out),
    )  # fmt: skip
    assert done.status == 2
    lines = [line for line in done.out.splitlines() if line.startswith("error")]
    for name, says in (
        ("Failing", "expected act() to return, got ValueError: gone for good (a_users_policies.py, line"),
        ("Nonsense", "actions['robot_0']: expected an int from 0 to"),
        ("Slow", "expected decisions within 0.5 s, got one of at least 0.5 s"),
    ):
        assert [line for line in lines if f"policy '{module}:{name}'" in line and says in line], (says, done.out)
    assert len(lines) == 3
    assert "6 of 8 trials failed" in done.out
    kept = [json.loads(line)["policy"] for line in (out / TRIALS_FILE).read_text().splitlines()]
    assert kept == ["frontier", "frontier"]
    assert (out / "tables.md").read_text().startswith("**Coverage, fig5, K=2**")


def _merge(time: float, error_m: float, undone: float | None = None) -> MergeRecord:
    return MergeRecord(round(10 * time), time, (0,), (1,), 9, error_m, 1.0, undone)


def test_merges_are_right_false_or_undone() -> None:
    """A merge is false if wrong for 20 s or at the end; one that is undone earlier is neither false nor right."""
    merges = [_merge(5.0, 0.1), _merge(9.0, 0.2), _merge(11.0, 0.7), _merge(12.0, 0.9, 31.0), _merge(13.0, 0.9, 33.0)]
    assert count_merges([*merges, _merge(2.0, 0.1, 3.0)]) == {
        "right_merges": 2, "false_merges": 2, "undone_merges": 3, "first_merge_s": 5.0, "last_merge_s": 9.0,
    }  # fmt: skip
    assert count_merges([])["first_merge_s"] is None


def _table(name: str) -> ResultTable:
    return next(table for table in TABLES if table.name == name)


def test_policies_are_compared_with_the_first_on_common_seeds() -> None:
    """Differences are relative to the first policy, seed by seed, with the same oracle."""
    rows = [_row("a", seed, mean_coverage=0.1 * seed) for seed in (1, 2, 3, 4)]
    rows += [_row("b", seed, mean_coverage=0.1 * seed + 0.2) for seed in (1, 2, 4, 9)]
    (line,) = _table("policies").lines(rows)
    assert (line["policy"], line["oracle"]) == ("b", "none")
    np.testing.assert_allclose(line["over time [%]"], [20.0, 20.0, 20.0])
    assert _table("policies").cells(line)[:3] == ["b", "none", "20.0 (20.0 .. 20.0)"]
    assert _table("oracles").lines(rows) == []


def test_oracles_are_compared_in_pairs() -> None:
    """Each policy is compared with itself without the oracle; unknown values do not count."""
    rows = [
        _row("a", seed, oracle, map_error=0.1 * seed - 0.05 * (oracle == "all"), pose_error=None)
        for oracle in ("all", "none")
        for seed in (1, 2)
    ]
    (line,) = _table("oracles").lines(rows)
    assert line["oracle"] == "all"
    assert line["E [cm]"].value == pytest.approx(-5.0)
    assert line["pose [cm]"].value is None
    assert _table("policies").lines(rows) == []


def test_means_skip_seeds_without_a_merge() -> None:
    """The mean time of the first merge is over the seeds with a merge."""
    rows = [_row("a", 1, first_merge_s=None), _row("a", 2, first_merge_s=30.0)]
    (line,) = _table("merges").lines(rows)
    assert line["first [s]"].value == 30.0
    assert _table("coverage").lines(rows)[0]["seeds"].value == 2
    assert STUDY.curves is not None
    assert [line["coverage"] for line in STUDY.curves.lines([_row("a", 1), _row("a", 3)])] == pytest.approx([0.0, 0.2])


def test_tables_name_world_and_team_in_their_titles() -> None:
    """There is a table for each world and number of robots, with a line for each policy and oracle."""
    rows = [_row("a", 1), _row("a", 1, "all"), _row("a", 1) | {"world": "maze"}]
    table = ResultTable(
        name="", title="T", by=("world", "robots", "policy", "oracle"), columns=(Column("coverage", digits=0),),
        each=("world", "robots"), words={"robots": ("robots", lambda robots: f"K={robots}")},
    )  # fmt: skip
    parts = dict(table.parts(table.lines(rows)))
    assert table.headings == ["policy", "oracle", "coverage [%]"]
    assert parts == {"T, office, K=3": [["a", "none", "50"], ["a", "all", "50"]], "T, maze, K=3": [["a", "none", "50"]]}


def test_stored_trials_are_not_run_again(vslam: Any, own_policy: str, tmp_path: Path) -> None:
    """A stored trial is not run again; a truncated one is, with the same results."""
    out = tmp_path / "run"
    command = (
        "bench", "exploration", "--policies", f"frontier,{own_policy}", "--worlds", "fig5", "--robots", "2",
        "--oracles", "none", "--max-seconds", "3", "--particles", "10", "--seeds", "2", "--first-seed", "200",
        "--out", str(out),
    )  # fmt: skip
    assert vslam(*command).status == 0
    kept = (out / TRIALS_FILE).read_text().splitlines()
    first = json.loads((out / "metrics.json").read_text())
    assert [(row["policy"], row["seed"]) for row in first["trials"]] == [
        ("frontier", 200), (own_policy, 200), ("frontier", 201), (own_policy, 201),
    ]  # fmt: skip
    assert len((out / "trials.csv").read_text().splitlines()) == 5
    assert len((out / "curves.csv").read_text().splitlines()) == 1 + 2 * CURVE_POINTS
    assert (out / "curves.png").read_bytes().startswith(b"\x89PNG")
    assert (out / "tables.md").read_text().startswith("**Coverage, fig5, K=2**")
    (out / TRIALS_FILE).write_text("\n".join([*kept[:3], kept[3][:40]]))
    said = vslam(*command)
    assert said.status == 0
    assert "3 of 4 trials are finished, 1 are left" in said.out
    assert "…" not in said.out
    assert (out / TRIALS_FILE).read_text().splitlines()[:3] == kept[:3]
    again = json.loads((out / "metrics.json").read_text())["trials"]
    untimed = {"decision_ms": 0.0, "decision_p99_ms": 0.0}
    assert [row | untimed for row in again] == [row | untimed for row in first["trials"]]


def test_paths_are_stored_absolute(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A benchmark can be resumed from another folder: worlds in files have absolute paths."""
    (tmp_path / "room.json").write_text(
        '{"name": "room", "walls": [[0, 0, 9, 0], [9, 0, 9, 7], [9, 7, 0, 7], [0, 7, 0, 0]]}'
    )
    monkeypatch.chdir(tmp_path)
    config = ExplorationConfig.from_mapping({"worlds": ["office", "room.json"]})
    assert config.worlds == ("office", str(tmp_path / "room.json"))
    assert config.environment(config.trials()[-1]).world_split is None  # a single layout has no splits
    assert config.environment(config.trials()[0]).world_split == "validation"
    assert ExplorationConfig.from_mapping(config.to_mapping() | {"seed": 0}) == config


def test_labels_name_policies_in_tables() -> None:
    """`LABEL=POLICY` plays the policy and is shown by its label; one label for two policies is refused."""
    player = parted("mine=frontier@discrete")
    assert (player.name, player.action_type, player.role) == ("frontier", "discrete", "robot")
    assert label("mine=frontier@discrete") == "mine@discrete"
    assert label("best=oracles@bound") == "best@bound"  # bounds stay marked
    config = ExplorationConfig(policies=("a=frontier", "b=frontier"), seeds=1)
    assert [trial.policy for trial in config.trials()[:2]] == ["a=frontier", "b=frontier"]
    with pytest.raises(ValueError, match="policies: expected a different label for each policy, got 'a'"):
        ExplorationConfig(policies=("a=frontier", "a=random_goals"))
    with pytest.raises(ValueError, match="policies: expected a different label for each policy, got 'frontier'"):
        ExplorationConfig(policies=("frontier", "frontier=random_goals"))
    with pytest.raises(ValueError, match="policy: expected one of 'frontier'"):
        ExplorationConfig(policies=("a=unknown",))
