"""Learning signal of rewards: advantages by hand, relative choices, discounted returns, tables."""

from functools import partial
from typing import Any

import numpy as np
import pytest

from studies.learning import reward_signal as learning_signal
from vslam_env import CANDIDATE_FEATURES, NUM_CANDIDATES, vslam_v1
from vslam_env.config import TICK


def _seen(candidates: list[list[float]]) -> dict[str, Any]:
    """Return an observation with candidates (length, size, distance of a teammate) in all first slots but one."""
    rows = np.zeros((NUM_CANDIDATES, len(CANDIDATE_FEATURES)), np.float32)
    mask = np.zeros(1 + NUM_CANDIDATES, np.int8)
    columns = [CANDIDATE_FEATURES.index(name) for name in ("path_length", "size", "teammate_path_length")]
    rows[1 : 1 + len(candidates), columns] = candidates
    mask[[0, *range(2, 2 + len(candidates))]] = 1
    return {"candidates": rows, "action_mask": mask}


def test_choices_are_relative_to_valid_candidates() -> None:
    """Of two candidates, the shorter, longer, unclaimed one is one standard deviation above their mean in each."""
    two = _seen([[2.0, 3.0, 9.0], [8.0, 1.0, 4.0]])
    np.testing.assert_allclose(learning_signal.choice_features(two, 2), [1.0, 1.0, 1.0])
    np.testing.assert_allclose(learning_signal.choice_features(two, 3), [-1.0, -1.0, -1.0])
    assert not learning_signal.choice_features(two, 0).any()
    assert not learning_signal.choice_features(_seen([[2.0, 3.0, 9.0]]), 2).any()


def test_advantages_match_the_definition() -> None:
    """Advantages are the scaled discounted sums of temporal differences to a fitted value."""
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


@pytest.mark.parametrize("gamma", [1.0, 0.999, 0.99])
def test_returns_match_the_definition(gamma: float) -> None:
    """Discounts weigh the map error of early steps; shaping alone pays the first error, whatever comes after it."""
    errors = np.random.default_rng(2).uniform(0.2, 0.7, 301)
    paid = np.column_stack([errors[:-1] - errors[1:], -TICK * errors[1:]])
    found = learning_signal.returns_of(paid, errors, gamma)
    assert list(found) == list(learning_signal.RETURNS)
    later = sum(gamma ** (t - 1) * errors[t] for t in range(1, 300))
    last = gamma**299 * errors[300]
    assert found["map_error"] == pytest.approx(errors[0] - (1.0 - gamma) * later - last)
    assert found["running_cost"] == pytest.approx(-TICK * (later + last))
    value_of_the_end = errors[300]  # return of shaping only from there on
    assert found["shaping"] + gamma**300 * value_of_the_end == pytest.approx(errors[0])


def test_spinning_and_idle_policies() -> None:
    """A full turn takes 4.2 s; the spinning policy never stops, and the idle one never starts."""

    def turned(name: str, ticks: int) -> Any:
        policy = learning_signal.PLAYERS[name]()
        policy.reset()
        actions = [policy.act(None, None, np.random.default_rng(0)) for _ in range(ticks)]
        assert not any(action[0] for action in actions)
        return 1.5 * TICK * sum(action[1] for action in actions) / (2.0 * np.pi)

    assert turned("one turn, then stay", 200) == pytest.approx(1.0, abs=0.01)
    assert turned("spin", 200) == pytest.approx(4.775, abs=0.01)
    assert turned("idle", 200) == 0.0


def test_episode_records_have_rewards_and_errors() -> None:
    """The record has the environment's rewards and the errors between them; the last map is smoothed after its cost."""
    weights = {"map_error": 1.0, "running_cost": 1.0}
    env = vslam_v1.parallel_env(world="fig5", num_robots=2, num_particles=5, max_cycles=12, reward=weights)
    paid, errors = learning_signal.play_ticks(env, learning_signal.PLAYERS["spin"], 0)
    assert (paid.shape, errors.shape) == ((12, 2), (13,))
    expected = np.column_stack([errors[:-1] - errors[1:], -TICK * errors[1:]])
    np.testing.assert_allclose(paid[:-1], expected[:-1], atol=1e-12)
    assert paid[-1, 0] == pytest.approx(expected[-1, 0], abs=1e-12)
    assert paid[-1, 1] == pytest.approx(expected[-1, 1], abs=1e-3)
    assert errors[-1] < errors[0]


def test_the_table_compares_with_the_frontier() -> None:
    """Each row shows means, and the differences to the frontier on the same seeds."""
    found = {
        (reward, gamma, policy): np.array([0.5, 1.0]) - (policy != learning_signal.FRONTIER) * np.array([0.25, 0.5])
        for reward in learning_signal.RETURNS
        for gamma in learning_signal.DISCOUNTS
        for policy in learning_signal.PLAYERS
    }
    lines = learning_signal.table_of(found).splitlines()
    assert len(lines) == 2 + len(learning_signal.RETURNS) * len(learning_signal.PLAYERS)
    assert lines[2] == "| default | nearest frontier |" + " 0.750 |  |" * 3
    assert lines[3].startswith("| default | random walk | 0.375 | -0.375 (-0.500 .. -0.250) |")


@pytest.mark.slow
def test_returns_are_printed(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """In two short episodes each the frontier has the largest default reward in each line."""
    monkeypatch.setattr(learning_signal.vslam_v1, "parallel_env", partial(vslam_v1.parallel_env, max_cycles=400))
    learning_signal.returns(seeds=2)
    lines = [line.split(" | ") for line in capsys.readouterr().out.splitlines() if line.startswith("| default")]
    assert len(lines) == len(learning_signal.PLAYERS)
    for line in lines[1:]:
        assert all(float(lines[0][column]) > float(line[column]) for column in (2, 4, 6))


@pytest.mark.slow
def test_the_table_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    """Two episodes give a line for each reward and lambda."""
    learning_signal.choices(episodes=2)
    output = capsys.readouterr().out
    assert output.count("own_coverage") == len(learning_signal.TRACES)
    assert "shorter path" in output
