"""Masks in the forms of learning libraries."""

from typing import Any

import gymnasium
import numpy as np
import pytest
from builders.environments import room

from vslam_env import vslam_v0
from vslam_env.belief.observation_keys import KEYS, SCALES, key_spaces
from vslam_env.wrappers import MasksBesideVectors, MasksInInfos, Scaled

# pettingzoo.test imports connect_four in a way that pettingzoo itself deprecates
pytestmark = pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning")


def _env(observation_type: str = "dict", **changed: Any) -> Any:
    given = {"world": room(), "num_robots": 2, "num_particles": 10, "action_type": "goal", "max_cycles": 4} | changed
    return vslam_v0.parallel_env(observation_type=observation_type, **given)


def _episode(env: Any) -> tuple[list[Any], list[Any]]:
    """Play valid actions; return observations and infos of each time."""
    bare = _env()
    seen, infos = env.reset(seed=3)
    masks = bare.reset(seed=3)[0]
    kept = [seen], [infos]
    rng = np.random.default_rng(0)
    while env.agents:
        actions = {agent: int(rng.choice(np.flatnonzero(masks[agent]["action_mask"]))) for agent in env.agents}
        seen, _, _, _, infos = env.step(actions)
        masks = bare.step(actions)[0]
        kept[0].append(seen)
        kept[1].append(infos)
    return kept


@pytest.mark.parametrize("observation_type", ["dict", "flat"])
def test_wrapped_environments_pass_the_suite(observation_type: str) -> None:
    """PettingZoo's suite passes without masks in observations: it samples with masks of int8 only."""
    from pettingzoo.test import parallel_api_test

    env = MasksInInfos(_env(observation_type))
    parallel_api_test(env, num_cycles=6)
    env.reset(seed=0)
    np.testing.assert_array_equal(env.state(), env.unwrapped.state())
    assert env.observation_space("robot_0") is env.observation_space("robot_0")


def test_vectors_do_not_depend_on_the_observation_type() -> None:
    """Vectors of dict observations equal those of flat ones; both lie in their space beside the mask as float32."""
    env = MasksBesideVectors(_env("dict"))
    ours, theirs, plain = (_episode(each)[0] for each in (env, MasksBesideVectors(_env("flat")), _env("flat")))
    for one, two, three in zip(ours, theirs, plain, strict=True):
        for agent, seen in one.items():
            assert env.observation_space(agent).contains(seen)
            np.testing.assert_array_equal(seen["observations"], two[agent]["observations"])
            np.testing.assert_array_equal(seen["observations"], three[agent]["observation"])
            np.testing.assert_array_equal(seen["action_mask"], three[agent]["action_mask"])
            assert seen["action_mask"].dtype == np.float32


@pytest.mark.parametrize("observation_type", ["dict", "flat"])
def test_masks_move_to_the_infos(observation_type: str) -> None:
    """Infos have the masks at each time, observations everything else."""
    env = MasksInInfos(_env(observation_type))
    (ours, infos), plain = _episode(env), _episode(_env(observation_type))[0]
    for seen, info, whole in zip(ours, infos, plain, strict=True):
        for agent in whole:
            assert env.observation_space(agent).contains(seen[agent])
            np.testing.assert_array_equal(info[agent]["action_mask"], whole[agent]["action_mask"])
            if observation_type == "flat":
                np.testing.assert_array_equal(seen[agent], whole[agent]["observation"])
            else:
                assert set(seen[agent]) == set(whole[agent]) - {"action_mask"}


def test_environments_without_masks_are_refused() -> None:
    """Other actions have no masks, and images fit into no vector."""
    with pytest.raises(ValueError, match="action_type: expected 'goal', whose actions have masks, got 'discrete'"):
        MasksInInfos(_env(action_type="discrete"))
    with pytest.raises(ValueError, match="observe_images: expected False: images are no part of a vector"):
        MasksBesideVectors(_env(sensor="stereo", observe_images=True))


def test_actions_out_of_bounds_name_the_cure() -> None:
    """The error names both wrappers that clip actions, and the one of Gymnasium mends it."""
    env = gymnasium.make(
        "vslam_env/SoloExploration-v1", world=room(), num_particles=10, max_cycles=3, disable_env_checker=True
    )
    env.reset(seed=0)
    with pytest.raises(
        ValueError, match=r"two numbers in \[-1, 1\], got .*ClipAction, or clip_actions_v0 of SuperSuit"
    ):
        env.step(np.array([1.5, 0.0], np.float32))
    clipped = gymnasium.wrappers.ClipAction(env)
    clipped.reset(seed=0)
    clipped.step(np.array([1.5, 0.0], np.float32))


@pytest.mark.parametrize("action_type", ["continuous", "goal"])
def test_scaled_observations_are_of_the_order_of_one(action_type: str) -> None:
    """Scaled observations are float32, small, in their spaces, and hold the same in dicts and vectors."""
    kinds = {kind: Scaled(_env(kind, action_type=action_type, max_cycles=20)) for kind in ("dict", "flat")}
    bare = _env("dict", action_type=action_type, max_cycles=20)
    seen = {kind: env.reset(seed=3)[0] for kind, env in kinds.items()}
    plain = bare.reset(seed=3)[0]
    rng = np.random.default_rng(0)
    while bare.agents:
        for agent in bare.agents:
            whole, flat = seen["dict"][agent], seen["flat"][agent]
            assert kinds["dict"].observation_space(agent).contains(whole)
            assert kinds["flat"].observation_space(agent).contains(flat)
            vector = flat["observation"] if action_type == "goal" else flat
            parts = {name: value for name, value in whole.items() if name != "action_mask"}
            np.testing.assert_allclose(vector, np.concatenate([value.ravel() for value in parts.values()]), rtol=1e-6)
            assert vector.dtype == np.float32
            assert np.abs(vector).max() < 10.0
            grid = plain[agent]["local_grid"]
            assert parts["local_grid"].shape == (3, 12, 12)
            assert parts["local_grid"].mean() == pytest.approx(grid.mean() / 255.0, rel=1e-5)
        actions = {agent: _valid(bare, agent, plain[agent], rng) for agent in bare.agents}
        seen = {kind: env.step(actions)[0] for kind, env in kinds.items()}
        plain = bare.step(actions)[0]


def _valid(env: Any, agent: str, seen: Any, rng: np.random.Generator) -> Any:
    """Return a random action that is valid."""
    if "action_mask" in seen:
        return int(rng.choice(np.flatnonzero(seen["action_mask"])))
    space = env.action_space(agent)
    return rng.uniform(space.low, space.high).astype(np.float32)


def test_scaled_environments_pass_the_checkers() -> None:
    """PettingZoo's suite and Gymnasium's checker pass, beliefs are those of the environment, and `state` is scaled."""
    from gymnasium.utils.env_checker import check_env
    from pettingzoo.test import parallel_api_test

    env = Scaled(_env("flat", action_type="discrete"))
    parallel_api_test(env, num_cycles=6)
    env.reset(seed=0)
    bare, scaled = (state[:-2].reshape(2, -1) for state in (env.unwrapped.state(), env.state()))
    metres = [0, 1, 4, 5]  # true and estimated positions
    np.testing.assert_allclose(scaled[:, metres], 0.1 * bare[:, metres], rtol=1e-6)
    np.testing.assert_array_equal(np.delete(scaled, metres, 1), np.delete(bare, metres, 1))
    np.testing.assert_array_equal(env.state()[-2:], env.unwrapped.state()[-2:])
    assert env.belief("robot_0").robot == 0
    solo = gymnasium.make(
        "vslam_env/SoloExploration-v1", wrap=Scaled, world=room(), num_particles=10, max_cycles=3,
        disable_env_checker=True,
    )  # fmt: skip
    check_env(solo.unwrapped, skip_render_check=True)
    assert solo.observation_space["local_grid"].shape == (3, 12, 12)


@pytest.mark.parametrize("name", [name for name in KEYS if name != "action_mask"])
def test_every_column_has_a_scale(name: str) -> None:
    """Each key has one factor for all its columns, or one for each."""
    assert len(SCALES[name]) in (1, key_spaces(32, 8.0)[name].shape[-1])
