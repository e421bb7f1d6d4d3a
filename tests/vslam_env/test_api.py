import inspect
from collections.abc import Callable
from typing import Any

import gymnasium
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check_env
from small_env import room, small_env
from stable_baselines3.common.env_checker import check_env as sb3_check_env

from vslam_env import ExplorationEnv, vslam_v0

# pettingzoo.test imports connect_four in a way that pettingzoo itself deprecates
pytestmark = pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning")


@pytest.mark.parametrize("action_type", ["continuous", "discrete", "goal"])
@pytest.mark.parametrize("observation_type", ["dict", "flat"])
def test_parallel_api(action_type: str, observation_type: str) -> None:
    """PettingZoo's own test of parallel environments passes, with warnings as errors."""
    from pettingzoo.test import parallel_api_test

    parallel_api_test(small_env(action_type=action_type, observation_type=observation_type), num_cycles=12)


@pytest.mark.parametrize("action_type", ["continuous", "discrete"])
def test_aec_api(action_type: str) -> None:
    """PettingZoo's own test of turn-based environments passes, with warnings as errors."""
    from pettingzoo.test import api_test

    api_test(
        vslam_v0.env(
            world=room(), num_robots=2, num_particles=20, max_cycles=8, action_type=action_type, observation_type="flat"
        ),
        num_cycles=20,
    )


@pytest.mark.filterwarnings("ignore:Observation is not a NumPy array")
@pytest.mark.filterwarnings("ignore:Observation space for each agent probably should be")
def test_aec_api_with_named_observations() -> None:
    """The same holds for named observations and masked goals; the test only remarks that they are dicts."""
    from pettingzoo.test import api_test

    env = vslam_v0.env(world=room(), num_robots=2, num_particles=20, max_cycles=5, action_type="goal")
    api_test(env, num_cycles=10)


@pytest.mark.parametrize("action_type", ["continuous", "goal"])
@pytest.mark.parametrize("observation_type", ["dict", "flat"])
def test_gymnasium_env(action_type: str, observation_type: str) -> None:
    """Gymnasium's checker passes the environment of one robot."""
    env = gymnasium.make(
        "vslam_env/SoloExploration-v0",
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
        "vslam_env/SoloExploration-v0", world=room(), num_particles=20, max_cycles=10, observation_type=observation_type
    )
    sb3_check_env(env.unwrapped)


@pytest.mark.skipif(not hasattr(pettingzoo, "make"), reason="pettingzoo.make came with 1.27")
def test_pettingzoo_make() -> None:
    """Both kinds of environment are made by name."""
    env = pettingzoo.make("parallel", "vslam_env/Exploration-v0", world=room(), num_robots=2, max_cycles=3)
    assert isinstance(env.unwrapped, ExplorationEnv)
    assert env.max_cycles == 3
    turns = pettingzoo.make("aec", "vslam_env/Exploration-v0", world=room(), num_robots=2)
    turns.reset(seed=0)
    assert turns.agent_selection == "robot_0"


def test_metadata_and_spaces() -> None:
    """Names, spaces and attributes are those that PettingZoo's wrappers look for."""
    env = small_env()
    assert env.metadata["name"] == str(env) == "vslam_env/Exploration-v0"
    assert env.metadata["render_modes"] == ["human", "rgb_array"]
    assert env.metadata["is_parallelizable"]
    assert env.possible_agents == ["robot_0", "robot_1"]
    for agent in env.possible_agents:
        assert env.observation_space(agent) is env.observation_space(agent) is env.observation_spaces[agent]
        assert env.action_space(agent) is env.action_space(agent) is env.action_spaces[agent]
    assert env.action_space("robot_0") is not env.action_space("robot_1")
    assert env.action_space("robot_0") == env.action_space("robot_1")


@pytest.mark.parametrize("make", [vslam_v0.env, vslam_v0.raw_env])
def test_turn_based_environments_take_the_same_arguments(make: Callable[..., Any]) -> None:
    """The signature is that of `parallel_env`, and the world may come first without its name."""
    parameters = inspect.signature(make).parameters
    assert parameters == inspect.signature(vslam_v0.parallel_env).parameters
    assert make(room(), 2).possible_agents == ["robot_0", "robot_1"]
