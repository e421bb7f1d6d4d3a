"""Study of simpler estimators: the same actions give the same episode, and limits name what exceeds them."""

from dataclasses import asdict
from typing import Any

import numpy as np

from studies.batched.fidelity import COLUMNS, STUDY, Config, play, run_again, shortfalls, trials
from studies.filters import losses

SMALL = Config(
    worlds=("fig5",), presets=("standard",), duration=4.0, particles=(12,), robots=(2,), policies=("frontier",),
    seeds=1, seed=70, estimators=("no smoother",),
)  # fmt: skip


def test_actions_played_again_give_the_same_episode() -> None:
    """With the environment's own estimator poses, rewards and merges repeat to the bit."""
    (episode,) = losses.trials(SMALL)
    whole = losses.recorded(SMALL, episode)
    again = run_again(losses.environment(SMALL, episode), 70, "frontier", whole.actions)
    assert len(whole.actions) == len(whole.record.times) - 1
    np.testing.assert_array_equal(again.record.estimated, whole.record.estimated)
    np.testing.assert_array_equal(again.record.map_errors, whole.record.map_errors)
    assert again.record.merges == whole.record.merges


def test_a_trial_compares_with_the_environment() -> None:
    """Other estimators read the same: truth is equal, and ratios are those of the errors."""
    (trial,) = trials(SMALL)
    row = asdict(trial) | play(SMALL, trial)
    assert row["position_ratio"] > 0.0
    assert len(row["own_returns"]) == len(row["exact_returns"]) == 2
    assert len(row["delays"]) == 1
    (line,) = STUDY.tables[0].lines([row])
    assert line["estimator"] == "no smoother"


def test_limits_name_what_exceeds_them() -> None:
    """An equal estimator exceeds none, and each quantity is named alone."""
    row: dict[str, Any] = {
        "position_ratio": 1.0, "map_ratio": 1.0, "recall_change": 0.0, "map_error_change": 0.0,
        "own_returns": np.arange(3.0), "exact_returns": np.arange(3.0), "delays": np.zeros(2), "false_merges": 1,
        "exact_false_merges": 1,
    }  # fmt: skip
    assert shortfalls([row]) == "none"
    changes = {
        "position_ratio": 2.1, "map_ratio": 2.1, "recall_change": -0.05, "map_error_change": 0.04,
        "own_returns": np.array([0.0, 2.0, 1.0]), "delays": np.full(2, 11.0), "false_merges": 2,
    }  # fmt: skip
    for column, (name, value) in zip(COLUMNS, changes.items(), strict=True):
        assert shortfalls([row | {name: value}]) == column.title
