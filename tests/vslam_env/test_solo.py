import gymnasium
import numpy as np
import pytest
from small_env import room

from vslam_env import vslam_v0
from vslam_env.solo import SoloExplorationEnv


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


def test_action_masks() -> None:
    """The masks are those of the observation, under the name that masked learners ask for."""
    env = SoloExplorationEnv(world=room(), num_particles=20, action_type="goal")
    observation, _ = env.reset(seed=4)
    assert env.action_masks().dtype == np.bool_
    assert np.array_equal(env.action_masks(), observation["action_mask"])


def test_registered_name() -> None:
    """Gymnasium makes it by name; pictures come through the wrappers."""
    env = gymnasium.make("vslam_env/SoloExploration-v0", world=room(), num_particles=20, render_mode="rgb_array")
    env.reset(seed=0)
    frame = env.render()
    assert isinstance(frame, np.ndarray)
    assert frame.shape == (720, 960, 3)
    env.close()


def test_seeds_repeat() -> None:
    """One seed gives one episode."""
    env = SoloExplorationEnv(world="fig5", num_particles=20)
    first, second = (env.reset(seed=9)[0] for _ in range(2))
    assert all(np.array_equal(first[name], second[name]) for name in first)


def test_teams_are_refused() -> None:
    """More than one robot needs the parallel environment."""
    with pytest.raises(ValueError, match=r"num_robots: expected 1, got 3\. Use vslam_v0\.parallel_env for a team\."):
        SoloExplorationEnv(num_robots=3)


def test_belief_config_and_events() -> None:
    """What the environment tells beyond Gymnasium is that of the parallel one."""
    env = SoloExplorationEnv(world=room(), num_particles=20)
    env.reset(seed=0)
    assert env.config.num_robots == 1
    assert env.belief() is env.parallel.belief("robot_0")
    assert env.events == ()
