"""Returns of scripted policies: discounts by the definition, tables."""

from dataclasses import asdict
from typing import Any

import numpy as np
import pytest

from studies.learning import returns
from vslam_env import vslam_v1
from vslam_env.config import TICK


@pytest.mark.parametrize("gamma", [1.0, 0.999, 0.99])
def test_returns_match_the_definition(gamma: float) -> None:
    """Discounts weigh the map error of early steps; shaping alone pays the first error, whatever comes after it."""
    errors = np.random.default_rng(2).uniform(0.2, 0.7, 301)
    paid = np.column_stack([errors[:-1] - errors[1:], -TICK * errors[1:]])
    found = returns.returns_of(paid, errors, gamma)
    assert list(found) == list(returns.REWARDS)
    later = sum(gamma ** (t - 1) * errors[t] for t in range(1, 300))
    last = gamma**299 * errors[300]
    assert found["map_error"] == pytest.approx(errors[0] - (1.0 - gamma) * later - last)
    assert found["running_cost"] == pytest.approx(-TICK * (later + last))
    value_of_the_end = errors[300]  # return of shaping only from there on
    assert found["shaping"] + gamma**300 * value_of_the_end == pytest.approx(errors[0])


def test_spinning_and_idle_policies() -> None:
    """A full turn takes 4.2 s; the spinning policy never stops, and the idle one never starts."""

    def turned(name: str, ticks: int) -> Any:
        policy = returns.PLAYERS[name]()
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
    paid, errors = returns.play_ticks(env, returns.PLAYERS["spin"], 0)
    assert (paid.shape, errors.shape) == ((12, 2), (13,))
    expected = np.column_stack([errors[:-1] - errors[1:], -TICK * errors[1:]])
    np.testing.assert_allclose(paid[:-1], expected[:-1], atol=1e-12)
    assert paid[-1, 0] == pytest.approx(expected[-1, 0], abs=1e-12)
    assert paid[-1, 1] == pytest.approx(expected[-1, 1], abs=1e-3)
    assert errors[-1] < errors[0]


def test_the_tables_compare_with_the_frontier() -> None:
    """Each line shows means, and the differences to the frontier on the same seeds."""
    rows = [
        {"policy": policy, "seed": seed, "returns": {"map_error": {f"gamma {g:g}": value for g in returns.DISCOUNTS}}}
        for seed, own in enumerate((0.5, 1.0))
        for policy, value in ((returns.FRONTIER, own), ("idle", 0.5 * own))
    ]
    means, differences = returns.STUDY.tables
    found = [means.cells(line) for line in means.lines(returns.unfold(rows))]
    assert found[0] == [returns.FRONTIER, *3 * ["0.750 (0.500 .. 1.00)"]]
    (line,) = differences.lines(returns.unfold(rows))
    assert line["reward"] == "default"
    assert differences.cells(line) == ["idle", *3 * ["-0.375 (-0.500 .. -0.250)"]]


@pytest.mark.slow
def test_the_frontier_has_the_largest_default_reward() -> None:
    """In two short episodes each the frontier has the largest default reward with any discount."""
    config = returns.Config(seeds=2, duration=40.0)
    rows = returns.unfold([asdict(trial) | returns.play(config, trial) for trial in returns.trials(config)])
    first, *others = (line for line in returns.STUDY.tables[0].lines(rows) if line["reward"] == "default")
    assert (first["policy"], len(others)) == (returns.FRONTIER, len(returns.PLAYERS) - 1)
    for line in others:
        assert all(first[f"gamma {g:g}"].value > line[f"gamma {g:g}"].value for g in returns.DISCOUNTS)
