"""Beliefs: attributes that are made when they are read."""

import copy
import dataclasses
import gc
import pickle
import weakref
from collections.abc import Callable

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.environments import MEETING, small_env, turning

from vslam_env import ExplorationEnv
from vslam_env.belief.team_belief import Belief

NAMES = [field.name for field in dataclasses.fields(Belief)]
VALUES = [name for name in NAMES if name not in ("grid", "looks")]  # these two are views, which follow the grid


def _begun() -> ExplorationEnv:
    env = small_env(max_cycles=400)
    env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(15):
        env.step(turning(env.agents))
    return env


def test_attributes_do_not_depend_on_when_they_are_read() -> None:
    """They are the same whichever is read first; what was read stays, the same object, after the next step."""
    rng = np.random.default_rng(0)
    for agent in ("robot_0", "robot_1"):
        one, other = _begun(), _begun()
        ordered, shuffled = one.belief(agent), other.belief(agent)
        for name in rng.permutation(NAMES):
            getattr(shuffled, name)
        for name in NAMES:
            first = getattr(ordered, name)
            assert getattr(ordered, name) is first
            if name in VALUES:
                assert_same(first, getattr(shuffled, name), name)
        before = copy.deepcopy([getattr(ordered, name) for name in VALUES])
        one.step(turning(one.agents))
        assert_same([getattr(ordered, name) for name in VALUES], before)


@pytest.mark.parametrize("change", [
    lambda env: env.step(turning(env.agents)), lambda env: env.set_state(env.get_state()),
])  # fmt: skip
def test_what_was_not_read_is_lost_with_the_next_step(change: Callable[[ExplorationEnv], object]) -> None:
    """One line says so, and the cure; beliefs that were materialised before can be read."""
    env = _begun()
    late, whole = env.belief("robot_0"), env.belief("robot_1").materialise()
    pose = late.pose
    change(env)
    for read in (lambda: late.candidates, late.materialise, lambda: copy.copy(late)):
        with pytest.raises(RuntimeError, match=r"^belief of tick 15: '\w+' was not read .* call materialise\(\)\.$"):
            read()
    assert late.pose is pose
    assert len(whole.candidates.valid) == 32
    with pytest.raises(AttributeError, match="no attribute 'poses'"):
        late.poses  # type: ignore[attr-defined]  # noqa: B018


@pytest.mark.parametrize("copied", [copy.copy, copy.deepcopy, lambda belief: pickle.loads(pickle.dumps(belief))])
def test_copies_are_whole(copied: Callable[[Belief], Belief]) -> None:
    """A copy or pickle has all attributes, whether they were read or not, and needs no environment."""
    env = _begun()
    kept = copied(env.belief("robot_0"))
    expected = {name: getattr(env.belief("robot_0"), name) for name in VALUES}
    env.step(turning(env.agents))
    del env
    for name, value in expected.items():
        assert_same(getattr(kept, name), value, name)
    assert kept.map.means.shape[1] == 3


def test_forgotten_beliefs_keep_nothing_alive() -> None:
    """Beliefs refer to their environment, not the other way round: nothing waits for the garbage collector."""
    env = _begun()
    env.belief("robot_0").pose.sum()
    team = weakref.ref(env.episode.belief)
    gc.disable()
    try:
        env.reset(seed=6)
        assert team() is None
    finally:
        gc.enable()


def test_candidates_are_found_from_when_they_are_first_read_on() -> None:
    """If that is at the reset, they are those of an environment that observes them; later they are valid."""
    observing, reading, late = (
        small_env(observation_keys=keys, max_cycles=200) for keys in ("all", "driver", "driver")
    )
    for env in (observing, reading, late):
        env.reset(seed=5, options={"start_poses": MEETING})
    for tick in range(60):
        expected, read = (env.belief("robot_0").candidates for env in (observing, reading))
        assert_same(read, expected)
        if tick == 30:
            late.set_state(late.get_state())
            found = late.belief("robot_1").candidates
            assert found.valid.any()
            assert np.isfinite(found.lengths[found.valid]).all()
        assert late.episode.belief.keeps_candidates == (tick >= 30)
        for env in (observing, reading, late):
            seen = env.step(turning(env.agents))[0]
            assert ("candidates" in seen["robot_0"]) == (env is observing)
