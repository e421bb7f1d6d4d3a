"""What random play says about choices: advantages by hand, choices against what was valid, and the table."""

import importlib.util
from pathlib import Path
from typing import Any

import numpy as np
import pytest

PATH = Path(__file__).parents[2] / "benchmarks" / "learning_signal.py"
SPEC = importlib.util.spec_from_file_location("learning_signal", PATH)
assert SPEC is not None
assert SPEC.loader is not None
learning_signal = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(learning_signal)


def _seen(candidates: list[list[float]]) -> dict[str, Any]:
    """Return an observation with candidates (length, size, distance of a teammate) in the first slots but one."""
    rows, mask = np.zeros((16, 5), np.float32), np.zeros(17, np.int8)
    rows[1 : 1 + len(candidates), 2:] = candidates
    mask[[0, *range(2, 2 + len(candidates))]] = 1
    return {"candidates": rows, "action_mask": mask}


def test_choices_are_told_against_what_was_valid() -> None:
    """The shorter, longer, unclaimed one of two lies one standard deviation above their mean in each."""
    two = _seen([[2.0, 3.0, 9.0], [8.0, 1.0, 4.0]])
    np.testing.assert_allclose(learning_signal.choice_of(two, 2), [1.0, 1.0, 1.0])
    np.testing.assert_allclose(learning_signal.choice_of(two, 3), [-1.0, -1.0, -1.0])
    assert not learning_signal.choice_of(two, 0).any()
    assert not learning_signal.choice_of(_seen([[2.0, 3.0, 9.0]]), 2).any()


def test_advantages_are_those_of_the_definition() -> None:
    """They are the discounted sums of surprises about a value that is fitted to the returns, scaled."""
    rng = np.random.default_rng(1)
    rewards, seen = rng.standard_normal((6, 5, 2)), rng.standard_normal((6, 5, 2, 3))
    scaled, explained = learning_signal.advantages(rewards, seen, 0.9, 0.7)
    returns = np.array([[sum(0.9**k * e[t + k] for k in range(5 - t)) for t in range(5)] for e in rewards])
    rows = seen.reshape(-1, 3)
    fit = np.linalg.lstsq(np.vstack([rows, 0.1 * np.eye(3)]), np.r_[returns.ravel(), 0.0, 0.0, 0.0])[0]
    values = np.concatenate([(rows @ fit).reshape(returns.shape), np.zeros((6, 1, 2))], axis=1)
    surprise = rewards + 0.9 * values[:, 1:] - values[:, :-1]
    by_hand = np.array([[sum(0.63**k * e[t + k] for k in range(5 - t)) for t in range(5)] for e in surprise])
    np.testing.assert_allclose(scaled, (by_hand - by_hand.mean()) / by_hand.std(), atol=1e-9)
    assert explained == pytest.approx(1.0 - np.mean((returns - values[:, :-1]) ** 2) / returns.var())


@pytest.mark.slow
def test_the_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Two episodes give a line for each reward and trace."""
    learning_signal.main(episodes=2)
    told = capsys.readouterr().out
    assert told.count("own_coverage") == len(learning_signal.TRACES)
    assert "shorter way" in told
