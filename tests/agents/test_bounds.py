"""Bounds: they need the truth, repeat themselves and are no worse than their base policy in what they maximise."""

from typing import Any

import numpy as np
import pytest

from agents import make_bound, make_team_policy
from tests.agents.test_policies import ROOM
from vslam_env import ExplorationEnv, vslam_v0


def _env(**options: Any) -> ExplorationEnv:
    given: dict[str, Any] = {"world": ROOM, "num_robots": 2, "num_particles": 10, "action_type": "goal"}
    return vslam_v0.parallel_env(max_cycles=8, **given | options)


def _play(env: ExplorationEnv, team: Any, seed: int) -> tuple[list[Any], float]:
    """Return the actions of an episode, and its reward averaged over the robots."""
    team.reset()
    observations, _ = env.reset(seed=seed)
    rng, log, total = np.random.default_rng(seed), [], 0.0
    while env.agents:
        actions = team.act(observations, {agent: env.belief(agent) for agent in env.agents}, rng)
        log.append(actions)
        observations, rewards, *_ = env.step(actions)
        total += float(np.mean(list(rewards.values())))
    return log, total


def test_a_rollout_leaves_the_environment_as_it_is_and_repeats_itself() -> None:
    """Trying in the twin does not change the environment: the same seed gives the same actions, also after a reset."""
    env = _env()
    team = make_bound("rollout", env)
    first = _play(env, team, 3)
    assert len(first[0]) == 8
    assert _play(env, team, 3) == first


@pytest.mark.slow
def test_a_rollout_earns_more_than_its_base_policy() -> None:
    """In the mean of six episodes of 8 s, all of which a rollout foresees, it earns more than the nearest frontier."""
    leads = []
    for seed in range(6):
        env = _env()
        usual = _play(_env(), make_team_policy("frontier", "goal"), seed)[1]
        leads.append(_play(env, make_bound("rollout", env), seed)[1] - usual)
    assert np.mean(leads) > 0.0


def test_bounds_need_what_they_know() -> None:
    """Unknown bounds, other actions and missing oracles are refused."""
    with pytest.raises(ValueError, match="bound: expected one of 'oracles', 'rollout', got 'best'"):
        make_bound("best", _env())
    with pytest.raises(ValueError, match="env: expected an environment with goal actions, got 'discrete'"):
        make_bound("rollout", _env(action_type="discrete"))
    with pytest.raises(ValueError, match="with all oracles, got 'one without oracle_association'"):
        make_bound("oracles", _env(oracle_pose=True))
    env = _env(oracle_pose=True, oracle_association=True, oracle_merge=True)
    assert _play(env, make_bound("oracles", env), 1)[0] == _play(env, make_team_policy("frontier", "goal"), 1)[0]
