"""`ExplorationVecEnv` returns the same results as each environment alone."""

import os
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

pytest.importorskip("stable_baselines3", reason="stable-baselines3 is not installed: pip install .[train]")

from sb3_contrib import MaskablePPO
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor

from training.vec_env import ExplorationVecEnv, env_seeds
from training.vec_env import make_vec_env as make_monitored
from vslam_env import vslam_v0
from vslam_env.config import EnvConfig
from vslam_env.reward import TeamMetrics, make_terms

GOALS = EnvConfig().replace(
    world="fig5", num_robots=2, action_type="goal", max_cycles=4, belief={"filter": {"num_particles": 10}}
)

make_vec_env = partial(make_monitored, monitor=False)


def _goals(masks: Any, rng: np.random.Generator) -> NDArray[np.int64]:
    return np.array([rng.choice(np.flatnonzero(mask)) for mask in masks])


def _assert_equal(ours: Any, theirs: Any) -> None:
    if isinstance(theirs, dict):
        assert set(ours) == set(theirs)
        for name in theirs:
            _assert_equal(ours[name], theirs[name])
    else:
        assert np.asarray(ours).dtype == np.asarray(theirs).dtype
        np.testing.assert_array_equal(ours, theirs)


def _toy(fails_at: int) -> Any:
    """Return a maker of a tiny environment of one agent that fails in some step; cloudpickle can serialise it."""

    class Toy(ParallelEnv):  # type: ignore[misc]
        possible_agents, render_mode = ("only",), None

        def observation_space(self, agent: str) -> spaces.Space[Any]:
            return spaces.Box(0.0, 9.0, (1,), np.float32)

        def action_space(self, agent: str) -> spaces.Space[Any]:
            return spaces.Discrete(2)

        def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
            self.agents, self.steps = ["only"], 0
            return {"only": np.zeros(1, np.float32)}, {"only": {}}

        def step(self, actions: Any) -> tuple[Any, ...]:
            self.steps += 1
            if self.steps == fails_at:
                raise ArithmeticError("no reward today")
            return {"only": np.zeros(1, np.float32)}, {"only": 0.0}, {"only": False}, {"only": False}, {"only": {}}

    return Toy


@pytest.fixture(scope="module")
def workers() -> Iterator[ExplorationVecEnv]:
    """Three environments of two robots in two processes."""
    env = make_vec_env(GOALS, 3, workers=2)
    yield env
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("where", ["here", "workers"])
def test_slots_equal_separate_environments(where: str, request: pytest.FixtureRequest) -> None:
    """Observations, rewards, ends and infos of two episodes equal those of a plain loop, with and without workers."""
    env = make_vec_env(GOALS, 3) if where == "here" else request.getfixturevalue("workers")
    env.seed(5)
    observations = env.reset()
    alone = [vslam_v0.parallel_env(config=GOALS) for _ in range(3)]
    first = [one.reset(seed=seed) for one, seed in zip(alone, env_seeds(5, 3), strict=True)]
    rng = np.random.default_rng(0)
    slots = [(e, agent) for e in range(3) for agent in GOALS.agents]
    for slot, (e, agent) in enumerate(slots):
        _assert_equal({name: rows[slot] for name, rows in observations.items()}, first[e][0][agent])
        _assert_equal(env.reset_infos[slot], first[e][1][agent])
    for step in range(6):
        actions = _goals(env.env_method("action_masks"), rng)
        observations, rewards, dones, infos = env.step(actions)
        results = [
            one.step(dict(zip(GOALS.agents, actions[2 * e : 2 * e + 2], strict=True))) for e, one in enumerate(alone)
        ]
        ended = step == GOALS.max_cycles - 1
        seen = [one.reset()[0] if ended else results[e][0] for e, one in enumerate(alone)]
        for slot, (e, agent) in enumerate(slots):
            _assert_equal({name: rows[slot] for name, rows in observations.items()}, seen[e][agent])
            assert rewards[slot] == np.float32(results[e][1][agent])
            assert dones[slot] == ended
            info = dict(infos[slot])
            assert info.pop("TimeLimit.truncated") is ended
            if ended:
                _assert_equal(info.pop("terminal_observation"), results[e][0][agent])
            _assert_equal(info, results[e][4][agent])


@pytest.mark.parametrize("observation_type", ["dict", "flat"])
@pytest.mark.parametrize("keys", ["driver", ("time_left", "pose", "action_mask")])
def test_slots_observe_the_chosen_keys(keys: Any, observation_type: str) -> None:
    """Arrays of the slots are those of each environment alone, with masks, whatever keys are chosen."""
    config = GOALS.replace(observation_keys=keys, observation_type=observation_type)
    env, alone = make_vec_env(config, 2, seed=5), [vslam_v0.parallel_env(config=config) for _ in range(2)]
    seen = [one.reset(seed=seed)[0] for one, seed in zip(alone, env_seeds(5, 2), strict=True)]
    observations = env.reset()
    for _ in range(2):
        for slot, (e, agent) in enumerate([(e, agent) for e in range(2) for agent in config.agents]):
            _assert_equal({name: rows[slot] for name, rows in observations.items()}, seen[e][agent])
        masks = env.env_method("action_masks")
        np.testing.assert_array_equal(masks, observations["action_mask"] != 0)
        actions = [int(np.flatnonzero(mask)[-1]) for mask in masks]
        observations = env.step(np.array(actions))[0]
        seen = [
            one.step(dict(zip(config.agents, actions[2 * e : 2 * e + 2], strict=True)))[0]
            for e, one in enumerate(alone)
        ]


def test_rollouts_equal_a_loop() -> None:
    """PPO's buffer has the observations and rewards of a loop; at the time limit the final value is added."""
    config = GOALS.replace(action_type="continuous", observation_type="flat", max_cycles=5)
    model = PPO("MlpPolicy", make_vec_env(config, 2), n_steps=8, batch_size=8, n_epochs=1, seed=3, device="cpu")
    _, callback = model._setup_learn(32, None)
    assert model.collect_rollouts(model.env, callback, model.rollout_buffer, 8)
    kept = model.rollout_buffer
    for e, seed in enumerate(env_seeds(3, 2)):
        env = vslam_v0.parallel_env(config=config)
        observations, _ = env.reset(seed=seed)
        for step in range(8):
            slots = list(enumerate(config.agents, 2 * e))
            for slot, agent in slots:
                np.testing.assert_array_equal(kept.observations[step, slot], observations[agent])
                assert kept.episode_starts[step, slot] == (step in (0, 5))
            clipped = {agent: np.clip(kept.actions[step, slot], -1.0, 1.0) for slot, agent in slots}
            observations, rewards, _, truncations, _ = env.step(clipped)
            for slot, agent in slots:
                reward = np.float32(rewards[agent])
                if truncations[agent]:
                    end = model.policy.obs_to_tensor(observations[agent])[0]
                    value = model.policy.predict_values(end)[0].item()
                    reward += model.gamma * value
                    assert abs(value) > 1e-6
                assert kept.rewards[step, slot] == pytest.approx(reward, rel=1e-6, abs=1e-9)
            if not env.agents:
                observations, _ = env.reset()


def test_episodes_are_monitored() -> None:
    """By default learners log return and length of episodes and find the masks; nothing else differs."""
    env, bare = make_monitored(GOALS, 2, seed=1), make_vec_env(GOALS, 2, seed=1)
    assert isinstance(env, VecMonitor)
    assert env.first_slots == bare.first_slots
    _assert_equal(env.reset(), bare.reset())
    rng, returns = np.random.default_rng(0), np.zeros(4)
    for step in range(GOALS.max_cycles):
        masks = bare.env_method("action_masks")
        np.testing.assert_array_equal(env.env_method("action_masks"), masks)
        actions = _goals(masks, rng)
        ours, theirs = env.step(actions), bare.step(actions)
        _assert_equal(ours[0], theirs[0])
        np.testing.assert_array_equal(ours[1], theirs[1])
        returns += theirs[1]
        for one, two in zip(ours[3], theirs[3], strict=True):
            assert set(one) - set(two) == ({"episode"} if step == GOALS.max_cycles - 1 else set())
    assert [info["episode"]["l"] for info in ours[3]] == [GOALS.max_cycles] * 4
    np.testing.assert_allclose([info["episode"]["r"] for info in ours[3]], returns, atol=1e-6)
    flat = make_monitored(GOALS.replace(observation_type="flat"), 1)
    model = MaskablePPO("MultiInputPolicy", flat, n_steps=4, batch_size=8, n_epochs=1, seed=3, device="cpu")
    model.learn(16)
    assert len(model.ep_info_buffer) == 4


def test_termination_is_not_truncation() -> None:
    """If episodes terminate, the slots are done and `TimeLimit.truncated` is false."""
    env = make_vec_env(GOALS.replace(stop_at_recall=1e-9, max_cycles=50), 1, seed=1)
    env.reset()
    rng = np.random.default_rng(0)
    for _ in range(50):
        _, _, dones, infos = env.step(_goals(env.env_method("action_masks"), rng))
        if dones.any():
            break
    assert dones.all()
    assert [info["TimeLimit.truncated"] for info in infos] == [False, False]
    assert all("terminal_observation" in info for info in infos)


@pytest.mark.parametrize("where", ["here", "workers"])
def test_results_are_copies(where: str, request: pytest.FixtureRequest) -> None:
    """Results of a step are not changed by later steps, and changing them changes no later mask."""
    env = make_vec_env(GOALS, 1) if where == "here" else request.getfixturevalue("workers")
    env.seed(2)
    first = env.reset()
    kept = {name: rows.copy() for name, rows in first.items()}
    masks = env.env_method("action_masks")
    actions = _goals(masks, np.random.default_rng(1))
    masks[0][:] = False
    second = env.step(actions)[0]
    _assert_equal(first, kept)
    assert not any(np.shares_memory(first[name], second[name]) for name in first)
    second["action_mask"][:] = 0
    assert all(mask[0] for mask in env.env_method("action_masks"))


@pytest.mark.parametrize("where", ["here", "workers"])
def test_results_share_no_memory(where: str, request: pytest.FixtureRequest) -> None:
    """Results of a step share no memory with other steps; writing to them changes neither other nor later ones."""
    env = make_vec_env(GOALS, 3) if where == "here" else request.getfixturevalue("workers")
    twin = make_vec_env(GOALS, 3)
    rng = np.random.default_rng(6)
    for each in (env, twin):
        each.seed(8)
    handed, expected = [env.reset()], [twin.reset()]
    for _ in range(6):  # beyond the end of an episode
        actions = _goals(twin.env_method("action_masks"), rng)
        (observations, rewards, dones, infos), (theirs, *_) = env.step(actions), twin.step(actions)
        handed += [observations, {"rewards": rewards, "dones": dones}]
        handed += [info["terminal_observation"] for info in infos if "terminal_observation" in info]
        expected.append(theirs)
        _assert_equal(observations, theirs)
        for rows in observations.values():
            rows[...] = 77
    arrays = [array for each in handed for array in each.values()]
    assert len(arrays) == 2 * 6 + len(handed[0]) * (7 + 6)  # rewards and dones; of 7 times, and of 6 slots' ends
    for i, array in enumerate(arrays):
        assert array.flags.writeable
        assert not any(np.shares_memory(array, other) for other in arrays[:i])
    _assert_equal(handed[0], expected[0])


@pytest.mark.parametrize("where", ["here", "workers"])
def test_time_in_environments_is_recorded(where: str, request: pytest.FixtureRequest) -> None:
    """There are the seconds of the last step's environments for each process, at most the time of the step."""
    env = make_vec_env(GOALS, 3) if where == "here" else request.getfixturevalue("workers")
    env.seed(3)
    env.reset()
    begin = time.perf_counter()
    env.step(np.zeros(6, np.int64))
    took = time.perf_counter() - begin
    assert env.spent.shape == ((1, 2) if where == "here" else (2, 2))
    assert (env.spent > 0.0).all()
    assert (env.spent[:, 0] <= took).all()


def test_seeds_repeat_and_differ() -> None:
    """A seed repeats its episodes; neighbouring seeds share no seed of an environment; None is random."""
    env = make_vec_env(GOALS, 2)
    states = []
    for seed in (7, 7, 8, None):
        given = env.seed(seed)
        assert given[0] == given[1] != given[2]
        env.reset()
        states.append(np.concatenate(env.env_method("state", indices=env.first_slots)))
    np.testing.assert_array_equal(states[0], states[1])
    assert not np.array_equal(states[1], states[2])
    assert not np.array_equal(states[2], states[3])
    assert not set(env_seeds(7, 100)) & set(env_seeds(8, 100))
    assert env_seeds(7, 3) == env_seeds(7, 100)[:3]


def test_options_reach_the_next_reset_only() -> None:
    """A list of options is by slot; the first slot of an environment decides."""
    env = make_vec_env(GOALS.replace(world="office", min_start_distance=2.0), 2, seed=0)
    env.set_options([{"world_seed": 3}, {}, {"world_seed": 4}, {}])
    env.reset()
    layouts = [world.walls for world in env.get_attr("world", indices=env.first_slots)]
    alone = vslam_v0.parallel_env(config=GOALS.replace(world="office", min_start_distance=2.0))
    for layout, seed in zip(layouts, (3, 4), strict=True):
        alone.reset(seed=99, options={"world_seed": seed})
        np.testing.assert_array_equal(layout, alone.world.walls)
    env.reset()
    assert not np.array_equal(env.get_attr("world", 0)[0].walls, layouts[0])


@pytest.mark.parametrize("where", ["here", "workers"])
def test_attributes_and_methods(where: str, request: pytest.FixtureRequest) -> None:
    """Attributes and methods are those of each slot's environment, in the order of the indices."""
    env = make_vec_env(GOALS, 3) if where == "here" else request.getfixturevalue("workers")
    env.seed(4)
    env.reset()
    assert env.num_envs == 6
    assert env.first_slots == [0, 2, 4]
    assert env.get_attr("agent") == ["robot_0", "robot_1"] * 3
    env.set_attr("max_cycles", 9, indices=[4])
    assert env.get_attr("max_cycles", indices=[5, 0]) == [9, GOALS.max_cycles]
    env.set_attr("max_cycles", GOALS.max_cycles)
    states = env.env_method("state")
    np.testing.assert_array_equal(states[0], states[1])
    np.testing.assert_array_equal(env.env_method("state", indices=[4, 0])[1], states[0])
    assert env.has_attr("action_masks")
    assert env.has_attr("events")
    assert not env.has_attr("nothing_of_that_name")
    assert env.env_is_wrapped(object, indices=[0, 1]) == [False, False]


def test_only_goal_actions_have_masks() -> None:
    """MaskablePPO calls `has_attr("action_masks")`; flat observations have the mask too."""
    assert make_vec_env(GOALS.replace(observation_type="flat"), 1).has_attr("action_masks")
    assert not make_vec_env(GOALS.replace(action_type="discrete"), 1).has_attr("action_masks")


def test_pictures() -> None:
    """`render` tiles one image per environment, as SB3's recorders expect."""
    env = make_vec_env(GOALS, 2, seed=0, render_mode="rgb_array")
    env.reset()
    assert env.render_mode == "rgb_array"
    assert [image.shape for image in env.get_images()] == [(720, 960, 3)] * 2
    tiled = env.render()
    assert tiled.dtype == np.uint8
    assert tiled.size >= 2 * 720 * 960 * 3


class _Merges:
    """Custom reward term, known to workers by value."""

    name, weight = "merges", 0.5

    def __call__(self, before: TeamMetrics, after: TeamMetrics) -> NDArray[np.float64]:
        return np.full(len(after.map_errors), 1.0 + after.merges - before.merges)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_custom_rewards_reach_all_environments(workers: int) -> None:
    """Terms given as objects replace the rewards of the configuration, in this process and in workers."""
    env = make_vec_env(GOALS, 2, workers, reward=[*make_terms({"time": 1.0}), _Merges()])
    env.reset()
    _, rewards, _, infos = env.step(np.zeros(4, np.int64))
    env.close()
    assert all(info["reward/merges"] == 0.5 for info in infos)
    np.testing.assert_allclose(rewards, [0.5 + info["reward/time"] for info in infos])


def test_differing_robots_are_refused() -> None:
    """All slots have the same observation space, action space and render mode."""
    other = GOALS.replace(action_type="discrete")
    makers = [partial(vslam_v0.parallel_env, config=config) for config in (GOALS, other)]
    with pytest.raises(ValueError, match="observation_space: expected the same for all agents"):
        ExplorationVecEnv(makers)
    with pytest.raises(ValueError, match="makers: expected at least one function"):
        ExplorationVecEnv([])
    shown = partial(vslam_v0.parallel_env, config=GOALS, render_mode="rgb_array")
    with pytest.raises(ValueError, match="render_mode: expected the same for all"):
        ExplorationVecEnv([makers[0], shown])


def test_bad_numbers_are_refused() -> None:
    """Numbers of environments, workers and actions, and seeds, are checked, with hints."""
    with pytest.raises(ValueError, match="num_envs: expected an int >= 1, got 0"):
        make_vec_env(GOALS, 0)
    with pytest.raises(ValueError, match="workers: expected an int >= 0, got -1"):
        make_vec_env(GOALS, 1, workers=-1)
    with pytest.raises(ValueError, match="workers: expected at most one per environment, 1, got 2"):
        make_vec_env(GOALS, 1, workers=2)
    with pytest.raises(ValueError, match="config: expected at least one configuration, got \\[\\]"):
        make_vec_env([], 1)
    env = make_vec_env(GOALS, 1)
    with pytest.raises(ValueError, match="seed: expected an int >= 0, got -3"):
        env.seed(-3)
    env.reset()
    with pytest.raises(ValueError, match="actions: expected 2 actions, got 3"):
        env.step(np.zeros(3, np.int64))
    with pytest.raises(RuntimeError, match=r"step_wait: .* Call step_async\(\) first"):
        env.step_wait()


@pytest.mark.slow
def test_workers_prepare_before_anything_else(tmp_path: Path) -> None:
    """Each worker calls `prepare` once before its environments are made; errors in it are raised here."""

    def prepare() -> None:
        (tmp_path / str(os.getpid())).touch(exist_ok=False)

    env = ExplorationVecEnv([_toy(fails_at=9)] * 3, 2, prepare)
    env.reset()
    env.step(np.zeros(3, np.int64))
    env.close()
    called = [int(file.name) for file in tmp_path.iterdir()]
    assert len(called) == 2
    assert os.getpid() not in called

    def fail() -> None:
        raise ArithmeticError("nothing is ready")

    with pytest.raises(ArithmeticError, match="nothing is ready"):
        ExplorationVecEnv([_toy(fails_at=9)], 1, fail)


@pytest.mark.slow
def test_errors_of_workers_are_raised() -> None:
    """An error in a worker is raised here with its location and ends the workers; so does the death of a worker."""
    env = ExplorationVecEnv([_toy(fails_at=2)], workers=1)
    env.reset()
    env.step(np.zeros(1, np.int64))
    with pytest.raises(ArithmeticError, match="no reward today") as raised:
        env.step(np.zeros(1, np.int64))
    assert "In a worker:" in raised.value.__notes__[0]
    with pytest.raises(RuntimeError, match="expected running workers, got closed ones"):
        env.step(np.zeros(1, np.int64))
    env = ExplorationVecEnv([_toy(fails_at=9)], workers=1)
    env.reset()
    env._slots._pool._processes[0].kill()
    with pytest.raises(RuntimeError, match="worker 0: expected an answer of environments 0 to 0, got an exit"):
        env.step(np.zeros(1, np.int64))
