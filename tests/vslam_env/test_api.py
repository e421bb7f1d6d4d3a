import inspect
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pettingzoo
import pytest
from builders.environments import room, small_env
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from vslam_env import ExplorationEnv, vslam_v0, vslam_v1
from vslam_env.solo import SoloExplorationEnv

# pettingzoo.test imports connect_four in a way that pettingzoo itself deprecates
pytestmark = pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning")


@pytest.mark.parametrize("action_type", ["continuous", "goal"])
@pytest.mark.parametrize("observation_type", ["dict", "flat"])
def test_gymnasium_env(action_type: str, observation_type: str) -> None:
    """Gymnasium's checker passes the environment of one robot."""
    env = gymnasium.make(
        "vslam_env/SoloExploration-v1",
        world=room(),
        num_particles=20,
        max_cycles=10,
        action_type=action_type,
        observation_type=observation_type,
        disable_env_checker=True,
    )
    gymnasium_check_env(env.unwrapped, skip_render_check=True)


@pytest.mark.filterwarnings("ignore:Your observation .* has an unconventional shape:UserWarning")
@pytest.mark.parametrize("observation_type", ["dict", "flat"])
def test_stable_baselines3(observation_type: str) -> None:
    """Stable-Baselines3's checker passes the environment of one robot."""
    env = gymnasium.make(
        "vslam_env/SoloExploration-v1", world=room(), num_particles=20, max_cycles=10, observation_type=observation_type
    )
    sb3_check_env(env.unwrapped)


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="pettingzoo.make came with 1.27")
@pytest.mark.parametrize(("version", "keys"), [(0, "all"), (1, "driver")])
def test_pettingzoo_make(version: int, keys: str) -> None:
    """Both kinds of environment are made by name, with the keys of the version."""
    name = f"vslam_env/Exploration-v{version}"
    env = pettingzoo.make("parallel", name, world=room(), num_robots=2, max_cycles=3)
    assert isinstance(env.unwrapped, ExplorationEnv)
    assert (env.max_cycles, env.config.observation_keys) == (3, keys)
    turns = pettingzoo.make("aec", name, world=room(), num_robots=2)
    turns.reset(seed=0)
    assert turns.agent_selection == "robot_0"


def test_metadata_and_spaces() -> None:
    """Names, spaces and attributes are those that PettingZoo's wrappers look for."""
    env = small_env()
    assert env.metadata["name"] == str(env) == "vslam_env/Exploration"
    assert env.metadata["render_modes"] == ["human", "rgb_array"]
    assert env.metadata["is_parallelizable"]
    assert env.possible_agents == ["robot_0", "robot_1"]
    for agent in env.possible_agents:
        assert env.observation_space(agent) is env.observation_space(agent) is env.observation_spaces[agent]
        assert env.action_space(agent) is env.action_space(agent) is env.action_spaces[agent]
    assert env.action_space("robot_0") is not env.action_space("robot_1")
    assert env.action_space("robot_0") == env.action_space("robot_1")


@pytest.mark.parametrize(
    "make", [vslam_v0.parallel_env, vslam_v0.env, vslam_v0.raw_env, vslam_v1.env, vslam_v1.raw_env]
)
def test_all_constructors_take_the_same_arguments(make: Callable[..., Any]) -> None:
    """The signature is that of `vslam_v1.parallel_env`, and the world may come first without its name."""
    parameters = inspect.signature(make).parameters
    assert parameters == inspect.signature(vslam_v1.parallel_env).parameters
    assert make.__doc__
    assert make(room(), 2).possible_agents == ["robot_0", "robot_1"]


def test_solo_is_the_parallel_environment_of_one_robot() -> None:
    """The same seed and actions give the same observations, rewards and infos as the parallel environment."""
    options = {"world": room(), "num_particles": 20, "max_cycles": 8}
    solo = SoloExplorationEnv(**options)
    team = vslam_v0.parallel_env(num_robots=1, **options)
    observation, info = solo.reset(seed=4)
    observations, infos = team.reset(seed=4)
    ended = False
    while not ended:
        assert all(np.array_equal(observation[name], observations["robot_0"][name]) for name in observation)
        assert info == infos["robot_0"]
        action = np.array([0.5, 0.3], np.float32)
        observation, reward, terminated, truncated, info = solo.step(action)
        observations, rewards, _, truncations, infos = team.step({"robot_0": action})
        assert reward == rewards["robot_0"]
        assert (terminated, truncated) == (False, truncations["robot_0"])
        ended = truncated
    assert team.agents == []
    assert (solo.config.num_robots, solo.events) == (1, ())
    assert solo.belief() is solo.parallel.belief("robot_0")


def test_action_masks() -> None:
    """The masks are those of the observation, under the name that masked learners ask for."""
    env = SoloExplorationEnv(world=room(), num_particles=20, action_type="goal")
    observation, _ = env.reset(seed=4)
    assert env.action_masks().dtype == np.bool_
    assert np.array_equal(env.action_masks(), observation["action_mask"])


def test_registered_name() -> None:
    """Gymnasium makes it by name; pictures come through the wrappers."""
    env = gymnasium.make("vslam_env/SoloExploration-v1", world=room(), num_particles=20, render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert isinstance(frame, np.ndarray)
    assert frame.shape == (720, 960, 3)
    env.close()
