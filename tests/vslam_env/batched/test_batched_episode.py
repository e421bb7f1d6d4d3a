"""Episodes of batched teams: rewards, batches, and what they refuse."""

from functools import partial
from typing import Any

import numpy as np
import pytest
from builders.batched import jax, jnp

from vslam_env import vslam_v1
from vslam_env.config import EnvConfig
from vslam_env.presets import preset_config

episode = pytest.importorskip("vslam_env.batched.episode")
world = pytest.importorskip("vslam_env.batched.world")
CONFIG = preset_config("standard").replace(world="fig5", num_robots=2, action_type="continuous")
RULES, TICKS = episode.Rules.of(CONFIG, 192), 60


def scenes(*seeds: int) -> Any:
    """Return a batch of scenes."""
    env = vslam_v1.parallel_env(config=CONFIG)
    drawn = []
    for seed in seeds:
        env.reset(seed=seed)
        drawn.append(world.Scene.of(env.episode.scenario, 40, 400))
    return jax.tree.map(lambda *values: jnp.stack(values), *drawn)


@partial(jax.jit, static_argnames=("rules",))
def play(scenes: Any, keys: Any, commands: Any, rules: Any) -> Any:
    """Return the first and the last states of a batch of episodes, and the rewards (n, T, K)."""

    def of_scene(scene: Any, key: Any) -> Any:
        first = episode.reset(scene, key, rules)
        keys = jax.random.split(key, len(commands))

        def tick(so_far: Any, given: Any) -> Any:
            return episode.step(so_far, given[0], scene, given[1], rules)

        last, rewards = jax.lax.scan(tick, first, (commands, keys))
        return first, last, rewards

    return jax.vmap(of_scene)(scenes, keys)


def test_rewards_are_the_fall_of_the_error_and_runs_repeat() -> None:
    """Rewards of a batch add up to the fall of E, maps grow, all is finite, and equal keys give equal bits."""
    batch, keys = scenes(1, 2), jax.random.split(jax.random.key(3), 2)
    commands = jnp.tile(jnp.array([[0.3, 0.5], [0.3, -0.5]]), (TICKS, 1, 1))
    first, last, rewards = play(batch, keys, commands, RULES)
    fall = np.asarray(first.scores.map_errors - last.scores.map_errors)
    np.testing.assert_allclose(np.asarray(rewards).sum(axis=1), fall, atol=1e-5)
    assert (fall > 0.0).all()
    assert (np.asarray(last.scores.map_recalls) > np.asarray(first.scores.map_recalls)).all()
    assert np.asarray(last.tick).tolist() == [TICKS, TICKS]
    assert all(np.isfinite(part).all() for part in jax.tree.leaves(last._replace(waits=None)))
    starts = np.asarray(last.belief.robots[..., 5:7])
    assert np.isfinite(starts).all()
    again = play(batch, keys, commands, RULES)
    for one, other in zip(jax.tree.leaves(last), jax.tree.leaves(again[1]), strict=True):
        np.testing.assert_array_equal(one, other)
    off = np.asarray(last.poses[..., :2]) - np.asarray(batch.starts[..., :2])
    believed = np.asarray(last.belief.robots[..., :2])
    assert np.abs(np.hypot(*off.reshape(-1, 2).T) - np.hypot(*believed.reshape(-1, 2).T)).max() < 0.3


@pytest.mark.parametrize(
    ("name", "value"), [("oracle_merge", True), ("comm_range", 5.0), ("action_type", "goal"), ("reward", {"time": 1.0})]
)
def test_what_batched_teams_do_not_know_is_refused_by_name(name: str, value: Any) -> None:
    """Options beyond those that are simulated raise with their name."""
    with pytest.raises(ValueError, match=f"{name}: expected"):
        episode.Rules.of(EnvConfig(**{"action_type": "continuous", name: value}), 100)
