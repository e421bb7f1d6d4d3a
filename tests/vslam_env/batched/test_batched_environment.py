"""The batched environment: JaxMARL's interface, the worlds of the environment, and what it refuses."""

from typing import Any

import numpy as np
import pytest
from builders.batched import jax, jnp

from vslam_env import vslam_v1
from vslam_env.config import EnvConfig

environment = pytest.importorskip("vslam_env.batched.environment")
CONFIG = EnvConfig(
    world="fig5", num_robots=2, observation_keys=("pose", "map_stats", "local_grid", "teammates_mask"), max_cycles=3,
    decision_ticks=10,
)  # fmt: skip
ENV, BATCH = environment.BatchedExploration(CONFIG, num_worlds=3, first_seed=5, rows=64), 2
RESET, STEP = jax.jit(jax.vmap(ENV.reset)), jax.jit(jax.vmap(ENV.step))


def keys(seed: int) -> Any:
    """Return a key for each environment of a batch."""
    return jax.random.split(jax.random.key(seed), BATCH)


def drawn_actions(seed: int, env: Any = ENV) -> Any:
    """Return random actions of all robots of a batch."""
    return {
        agent: jax.vmap(env.action_space(agent).sample)(jax.random.split(key, BATCH))
        for agent, key in zip(env.agents, jax.random.split(jax.random.key(seed), len(env.agents)), strict=True)
    }


@pytest.mark.nightly
def test_episodes_follow_each_other_and_repeat() -> None:
    """Dones come after the last step, with the reward of it and the first state of the next episode; bits repeat."""
    for _ in range(2):
        observations, state = RESET(keys(0))
        steps = []
        for seed in range(4):
            observations, state, rewards, dones, infos = STEP(keys(seed), state, drawn_actions(seed))
            steps.append((observations, state, rewards, dones, infos))
        assert [bool(dones["__all__"].all()) for *_, dones, _ in steps] == [False, False, True, False]
        assert [np.asarray(state.step).tolist() for _, state, *_ in steps] == [[1, 1], [2, 2], [0, 0], [1, 1]]
        observations, state, rewards, dones, infos = steps[2]
        np.testing.assert_array_equal(observations["robot_0"]["pose"], np.zeros((BATCH, 3)))
        assert np.asarray(state.episode.tick).tolist() == [0, 0]  # of the next episode
        assert (np.asarray(infos["map_error"]) != np.asarray(state.episode.scores.map_errors)).any()
        assert set(rewards) == {"robot_0", "robot_1"}
        assert set(dones) == {"robot_0", "robot_1", "__all__"}
        last = jax.tree.leaves(steps)
    for one, other in zip(last, jax.tree.leaves(steps), strict=True):
        np.testing.assert_array_equal(one, other)


def test_observations_lie_in_their_spaces_and_flat_ones_are_the_same() -> None:
    """Shapes and dtypes are those of the environment's spaces; a flat vector has the same numbers in the same order."""
    _, state = RESET(keys(1))
    observations, state, *_ = STEP(keys(1), state, drawn_actions(1))
    exact = vslam_v1.parallel_env(config=CONFIG).observation_space("robot_0")
    for agent in ENV.agents:
        for key, box in ENV.observation_space(agent).items():
            values = np.asarray(observations[agent][key])
            assert values.shape == (BATCH, *box.shape)
            assert values.dtype == exact[key].dtype
            assert exact[key].contains(values[0])
            assert bool(box.contains(observations[agent][key][0]))
    flat = environment.BatchedExploration(
        CONFIG.replace(observation_type="flat"), num_worlds=1, first_seed=5, rows=64
    )  # fmt: skip
    found = jax.jit(jax.vmap(flat.get_obs))(state)["robot_1"]
    parts = [
        np.asarray(observations["robot_1"][key]).reshape(BATCH, -1) / (255.0 if key == "local_grid" else 1.0)
        for key in CONFIG.observed
    ]
    np.testing.assert_allclose(found, np.concatenate(parts, axis=1), rtol=1e-6)
    assert found.shape[1:] == flat.observation_space("robot_1").shape
    assert found.shape[1:] == vslam_v1.parallel_env(config=flat.config).observation_space("robot_1").shape


def test_rewards_are_the_fall_of_the_error_and_robots_know_where_they_are() -> None:
    """Rewards of an episode add up to the fall of E, maps grow, beliefs follow the truth, and all is finite."""
    _, state = RESET(keys(3))
    earned, first = np.zeros((BATCH, 2)), state.episode.scores
    for seed in range(2):
        _, state, rewards, _, infos = STEP(keys(seed), state, drawn_actions(seed))
        earned += np.column_stack([rewards[agent] for agent in ENV.agents])
    last = state.episode.scores
    np.testing.assert_allclose(earned, first.map_errors - last.map_errors, atol=1e-5)
    assert (np.asarray(last.map_recalls) > np.asarray(first.map_recalls)).all()
    assert (np.asarray(infos["map_recall"]) == np.asarray(last.map_recalls)).all()
    assert (np.asarray(infos["pose_error"]) < 0.2).all()
    covariance = np.asarray(state.episode.belief.covariance)
    assert np.isfinite(covariance).all()
    np.testing.assert_array_equal(covariance, covariance.swapaxes(1, 2))


def test_worlds_are_those_of_the_environment() -> None:
    """World i has the starts, biases and landmarks of the environment's reset with seed first_seed + i."""
    exact = vslam_v1.parallel_env(config=CONFIG)
    for i in range(3):
        exact.reset(seed=5 + i)
        scenario = exact.episode.scenario
        np.testing.assert_allclose(ENV.scenes.starts[i], scenario.true_starts, rtol=1e-6)
        np.testing.assert_allclose(ENV.scenes.bias[i], scenario.bias, rtol=1e-6)
        assert np.asarray(ENV.scenes.observable[i]).sum() == scenario.observable_landmarks.sum()
    _, state = RESET(keys(2))
    worlds = np.asarray(jax.jit(jax.vmap(lambda key: ENV.reset(key)[1].world))(jax.random.split(jax.random.key(0), 64)))
    assert set(worlds.tolist()) == {0, 1, 2}
    np.testing.assert_array_equal(state.episode.poses, ENV.scenes.starts[state.world])


def test_actions_mean_the_same_as_in_the_environment() -> None:
    """Both types become the same commands; what learners draw beyond a space is clipped."""
    discrete = environment.BatchedExploration(CONFIG.replace(action_type="discrete"), num_worlds=1, rows=64)
    assert [discrete._command(jnp.array([i])).tolist() for i in range(4)] == [
        [0.0, 0.0], [1.0, 0.0], [0.0, 1.5], [0.0, -1.5],
    ]  # fmt: skip
    assert ENV._command(jnp.array([1.0, -1.0])).tolist() == [1.0, -1.5]
    assert ENV._command(jnp.array([-1.0, 0.5])).tolist() == pytest.approx([-0.3, 0.75])
    assert ENV._command(jnp.array([7.0, -9.0])).tolist() == [1.0, -1.5]
    assert discrete.action_space("robot_0").n == 4
    assert bool(discrete.action_space("robot_0").contains(drawn_actions(0, discrete)["robot_0"][0]))
    assert set(ENV.get_avail_actions(None)) == set(ENV.agents) == set(ENV.agent_classes["robot"])


def test_bad_input_is_refused_before_anything_is_compiled(monkeypatch: pytest.MonkeyPatch) -> None:
    """Numbers out of range, unknown agents, batches beyond the memory and 64-bit flags raise with their names."""
    for name, value in {"rows": 3, "num_worlds": 0, "first_seed": -1}.items():
        with pytest.raises(ValueError, match=f"{name}: expected"):
            environment.BatchedExploration(CONFIG, **{name: value})
    with pytest.raises(ValueError, match="agent: expected one of"):
        ENV.action_space("robot_7")
    with pytest.raises(ValueError, match=r"batch: expected at most \d+ in .* GB of free memory, got 100000000"):
        ENV.check_batch(100_000_000)
    with pytest.raises(ValueError, match="batch: expected"):
        ENV.check_batch(0)
    ENV.check_batch(BATCH)
    monkeypatch.setattr(environment, "free_memory", lambda: None)
    ENV.check_batch(100_000_000)  # a device that does not say
    jax.config.update("jax_enable_x64", True)
    try:
        with pytest.raises(ValueError, match="jax_enable_x64: expected False"):
            environment.BatchedExploration(CONFIG)
    finally:
        jax.config.update("jax_enable_x64", False)
