"""Chosen keys of observations: the values of all keys, in any form of environment, and nothing else computed."""

import pickle
from collections.abc import Sequence
from functools import cache
from typing import Any

import gymnasium
import numpy as np
import pytest
from builders.environments import MEETING, SMALL_STEREO, room, small_env
from hypothesis import given, settings
from hypothesis import strategies as st

from vslam_env import EnvConfig, vslam_v0, vslam_v1
from vslam_env.belief.observation import flatten, observe, observe_team
from vslam_env.belief.observation_keys import KEYS, MASK, SETS
from vslam_env.belief.readings import Readings
from vslam_env.belief.team_belief import TeamBelief
from vslam_env.navigation.candidates import TeamCandidates
from vslam_env.navigation.global_grids import GlobalGrids
from vslam_env.wrappers import MasksBesideVectors, MasksInInfos

ACTION_TYPES = ("continuous", "discrete", "goal")
STEPS = 4
SOME = st.permutations([key for key in KEYS if key != MASK]).flatmap(
    lambda order: st.integers(1, len(order)).map(lambda count: order[:count])
)


def _env(action_type: str, **options: Any) -> Any:
    """Return an environment whose two robots share a map from the first steps on."""
    given = {"action_type": action_type, "num_particles": 5, "max_cycles": STEPS, "oracle_merge": True} | options
    return small_env(**given)


def _episode(env: Any) -> list[tuple[Any, Any]]:
    """Play the same actions whatever is observed; return observations and infos of each time."""
    rng = np.random.default_rng(1)
    seen = [env.reset(seed=5, options={"start_poses": MEETING})]
    while env.agents:
        if env.unwrapped.config.action_type == "continuous":
            actions: dict[str, Any] = {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents}
        else:
            actions = {agent: int(rng.integers(4)) for agent in env.agents}
        observations, _, _, _, infos = env.step(actions)
        seen.append((observations, infos))
    return seen


@cache
def _whole(action_type: str) -> list[tuple[Any, Any]]:
    """Return the episode with all keys."""
    seen = _episode(_env(action_type))
    assert seen[-1][0]["robot_0"]["teammates_mask"].any()
    return seen


def _chosen(some: Sequence[str], action_type: str) -> tuple[str, ...]:
    return (*some, MASK) if action_type == "goal" else tuple(some)


def _assert_same(observation: Any, expected: Any, where: Any = "") -> None:
    assert list(observation) == list(expected), where
    for key, value in observation.items():
        assert value.dtype == expected[key].dtype
        np.testing.assert_array_equal(value, expected[key], err_msg=f"{key} {where}")


@pytest.mark.parametrize("action_type", ACTION_TYPES)
@settings(max_examples=8)
@given(some=SOME)
def test_any_keys_have_the_values_of_all(action_type: str, some: list[str]) -> None:
    """Dicts hold the chosen keys in the order of all, with equal values, infos as well; vectors join them."""
    keys = _chosen(some, action_type)
    named = _env(action_type, observation_keys=keys)
    flat = _env(action_type, observation_keys=set(keys), observation_type="flat")
    assert named.config.observation_keys == flat.config.observation_keys == named.config.observed
    in_order = [key for key in KEYS if key in keys]
    for whole, ours, vectors in zip(_whole(action_type), _episode(named), _episode(flat), strict=True):
        assert ours[1] == whole[1]
        for agent, observation in ours[0].items():
            expected = {key: whole[0][agent][key] for key in in_order}
            _assert_same(observation, expected)
            assert named.observation_space(agent).contains(observation)
            vector = vectors[0][agent]
            assert flat.observation_space(agent).contains(vector)
            if MASK in keys:
                np.testing.assert_array_equal(vector[MASK], expected[MASK])
                vector = vector["observation"]
            np.testing.assert_array_equal(vector, flatten(expected))


@pytest.mark.parametrize("observation_type", ["dict", "flat"])
@settings(max_examples=4)
@given(some=SOME)
def test_wrappers_follow_the_keys(observation_type: str, some: list[str]) -> None:
    """Masks beside vectors and masks in infos take what is chosen, and their spaces contain it."""
    options = {"observation_keys": [*some, MASK], "observation_type": observation_type}
    beside, moved = MasksBesideVectors(_env("goal", **options)), MasksInInfos(_env("goal", **options))
    for whole, ours, theirs in zip(_whole("goal"), _episode(beside), _episode(moved), strict=True):
        for agent, observation in ours[0].items():
            expected = {key: whole[0][agent][key] for key in KEYS if key in some}
            assert beside.observation_space(agent).contains(observation)
            np.testing.assert_array_equal(observation["observations"], flatten(expected))
            np.testing.assert_array_equal(observation[MASK], whole[0][agent][MASK])
            assert moved.observation_space(agent).contains(theirs[0][agent])
            np.testing.assert_array_equal(theirs[1][agent][MASK], whole[0][agent][MASK])
            if observation_type == "dict":
                _assert_same(theirs[0][agent], expected)
            else:
                np.testing.assert_array_equal(theirs[0][agent], flatten(expected))


@pytest.mark.parametrize("keys", ["driver", ("time_left", "candidates"), ("global_grid",)])
def test_environments_of_one_robot_follow_the_keys(keys: Any) -> None:
    """The environment of one robot, and vectors of these, observe what is chosen."""
    options: dict[str, Any] = {"world": room(), "num_particles": 5, "max_cycles": 9, "observation_keys": keys}
    one = gymnasium.make("vslam_env/SoloExploration-v1", **options)
    many = gymnasium.make_vec("vslam_env/SoloExploration-v1", num_envs=2, vectorization_mode="sync", **options)
    whole = gymnasium.make("vslam_env/SoloExploration-v1", **options | {"observation_keys": "all"})
    seen, together, expected = (env.reset(seed=3)[0] for env in (one, many, whole))
    for _ in range(3):
        _assert_same(seen, {key: expected[key] for key in one.unwrapped.config.observed})
        assert one.observation_space.contains(seen)
        for key, value in seen.items():
            np.testing.assert_array_equal(together[key][0], value)
        action = np.array([0.5, 0.2], np.float32)
        seen, together, expected = one.step(action)[0], many.step(np.array([action, action]))[0], whole.step(action)[0]
    many.close()


def test_images_come_beside_the_chosen_keys() -> None:
    """`observe_images` adds the image to whatever keys are chosen."""
    config = EnvConfig(num_robots=1, sensor="stereo", observe_images=True, observation_keys=("scan",))
    env = vslam_v1.parallel_env(room(), config=config.replace(stereo=SMALL_STEREO), num_particles=5)
    seen = env.reset(seed=0)[0]["robot_0"]
    assert list(seen) == ["scan", "image"]
    assert env.observation_space("robot_0").contains(seen)


def test_version_0_observes_all() -> None:
    """Names of version 0 mean all keys, unless keys or a configuration with keys are given."""
    with pytest.warns(DeprecationWarning, match="out of date"):
        solo: Any = gymnasium.make("vslam_env/SoloExploration-v0", world=room()).unwrapped
    assert solo.config.observation_keys == "all"
    given = EnvConfig(observation_keys="driver")
    for version, kept in ((vslam_v0, "all"), (vslam_v1, "driver")):
        assert version.parallel_env(room(), 1).config.observation_keys == kept
        assert version.parallel_env(room(), 1, observation_keys=["scan", "pose"]).config.observed == ("pose", "scan")
        assert version.parallel_env(config=given).config == given
        assert version.parallel_env(config=EnvConfig()).config.observation_keys == "all"
        assert version.env(room(), 1).unwrapped.config.observation_keys == kept
        assert version.raw_env(room(), 1).unwrapped.config.observation_keys == kept
    assert vslam_v1.parallel_env(preset="large").config.observation_keys == "goal"
    with pytest.raises(ValueError, match=r"^version: expected 0 or 1, got 2\. Omit it"):
        gymnasium.make("vslam_env/SoloExploration-v1", version=2)


def test_chosen_keys_survive_files_copies_and_snapshots() -> None:
    """TOML, `replace`, `clone` and pickling keep the keys; names keep their meaning with other actions."""
    config = EnvConfig(observation_keys=("scan", "pose", "scan"))
    assert config.observation_keys == ("pose", "scan")
    assert EnvConfig.from_toml_text(config.to_toml()) == config
    assert config.replace(observation_keys="goal", action_type="goal").observed[-1] == MASK
    assert EnvConfig(observation_keys="all", action_type="goal").observed == KEYS
    env = _env("discrete", observation_keys=("pose", "time_left"))
    env.reset(seed=1)
    copies = env.clone(), pickle.loads(pickle.dumps(env))
    actions = dict.fromkeys(env.agents, 1)
    expected = env.step(actions)[0]
    for copy in copies:
        seen = copy.step(actions)[0]
        for agent in env.agents:
            _assert_same(seen[agent], expected[agent])


@settings(max_examples=30)
@given(some=SOME)
def test_beliefs_offer_every_key(some: list[str]) -> None:
    """One belief gives what the environment shows with all keys, whatever is asked."""
    env, expected = _observed()
    for agent in env.agents:
        keys = [*some, MASK]
        ours = observe(env.belief(agent), keys)
        _assert_same(ours, {key: expected[agent][key] for key in KEYS if key in keys})
    with pytest.raises(ValueError, match=r"^keys: expected .*, got 'poze'\. .*Give keys, as in \('pose', 'scan'\)\."):
        observe(env.belief("robot_0"), ["poze"])


@cache
def _observed() -> tuple[Any, Any]:
    env = _env("goal", max_cycles=9)
    env.reset(seed=5, options={"start_poses": MEETING})
    return env, env.step({"robot_0": 1, "robot_1": 1})[0]


def test_what_was_skipped_is_complete_when_it_is_read() -> None:
    """Beliefs that were never asked for pictures and candidates show those of beliefs that showed them at each tick."""
    readings: list[tuple[Readings, ...]] = []
    env = small_env(max_cycles=400)
    env.recorder = readings.append
    env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(150):
        env.step({agent: np.array([0.3, 0.4]) for agent in env.agents})
    assert any(event.kind == "merge" for event in env.events)
    often, once = (
        TeamBelief(env.config.belief, 2, env.episode.belief_seed, env.episode.body) for _ in range(2)
    )  # fmt: skip
    for tick, now in enumerate(readings):
        often.step(now)
        once.step(now)
        whole = observe_team(often.view(), KEYS)
        few = observe_team(once.view(SETS["driver"]), SETS["driver"])
        late = observe_team(once.view(), KEYS) if tick in (0, 1, 77, len(readings) - 1) else None
        for robot in range(2):
            _assert_same(few[robot], {key: whole[robot][key] for key in SETS["driver"]}, tick)
            if late is not None:
                _assert_same(late[robot], whole[robot], tick)


@pytest.mark.parametrize("action_type", ["continuous", "discrete"])
def test_nothing_is_computed_that_no_key_shows(action_type: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Drivers' observations draw no global grids and describe no candidates."""

    def unexpected(*args: Any) -> None:
        raise AssertionError("this is not needed")

    for kind, name in ((GlobalGrids, "update"), (TeamCandidates, "features")):
        monkeypatch.setattr(kind, name, unexpected)
    _episode(_env(action_type, observation_keys="driver"))
    with pytest.raises(AssertionError, match="not needed"):
        _episode(_env(action_type))


BAD: dict[str, tuple[Any, str]] = {
    "an unknown set": (
        "drivers",
        r"'goal', 'all' or a tuple of keys, got 'drivers'\. Did you mean 'driver'\?",
    ),
    "a key for a set": ("pose", r"or a tuple of keys, got 'pose'\. Write \('pose',\) for a single key"),
    "an unknown key": (
        ("pose", "scans"),
        r"known keys, got 'scans'\. Did you mean 'scan'\? The keys are pose,",
    ),
    "images": (("image",), r"expected keys other than images, got 'image'\. Choose images by observe_images=True"),
    "a mask": (
        ("pose", MASK),
        r"no 'action_mask' with discrete actions, got .*\. Leave 'action_mask' out, or",
    ),
    "no key": ((), r"expected at least one key besides the mask, got \(\)\. Add a key such as 'pose'"),
    "a number": (3, r"expected the name of a set or a tuple of keys, got 3\. For example \('pose', 'scan'\)"),
    "a number for a key": ((3,), r"expected known keys, got 3\. The keys are pose,"),
}


@pytest.mark.parametrize(("keys", "says"), BAD.values(), ids=BAD)
def test_bad_keys_name_the_cure(keys: Any, says: str) -> None:
    """One line says what was expected, what was given and what helps, wherever the keys are given."""
    makers = (
        lambda: EnvConfig(action_type="discrete", observation_keys=keys),
        lambda: EnvConfig(action_type="discrete").replace(observation_keys=keys),
        lambda: vslam_v0.parallel_env(action_type="discrete", observation_keys=keys),
        lambda: vslam_v1.env(action_type="discrete", observation_keys=keys),
    )
    for make in makers:
        with pytest.raises(ValueError, match=f"^observation_keys: .*{says}") as caught:
            make()
        assert "\n" not in str(caught.value)


def test_goal_actions_need_their_mask() -> None:
    """Keys without the mask are refused with `goal` actions, also where the actions are chosen later."""
    says = r"^observation_keys: expected 'action_mask' among .* with goal actions, got \('pose',\)\. Add 'action_mask'"
    for make in (
        lambda: vslam_v1.parallel_env(action_type="goal", observation_keys=("pose",)),
        lambda: EnvConfig(observation_keys=("pose",)).replace(action_type="goal"),
    ):
        with pytest.raises(ValueError, match=says):
            make()
    with pytest.raises(ValueError, match="observation_keys: expected at least one key besides the mask"):
        EnvConfig(action_type="goal", observation_keys=(MASK,))
