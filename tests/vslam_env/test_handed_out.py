"""What an environment hands out is the caller's: steps leave it as it was, and who writes to it changes nothing."""

import copy
import dataclasses
import hashlib
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from digests import digest
from small_env import MEETING, small_env, turning, wander

from vslam_env import ExplorationEnv
from vslam_env.belief.team_belief import TeamBelief

STEPS = {"continuous": 130, "discrete": 130, "goal": 25}  # two robots meet, and their maps are merged


def _handed_out(env: ExplorationEnv, results: Any) -> list[Any]:
    """Return all that a caller can hold after a step; of beliefs all but the grid, which follows the robot."""
    agents = env.possible_agents
    beliefs = [env.belief(agent) for agent in agents]
    rows = [{f.name: getattr(b, f.name) for f in dataclasses.fields(b) if f.name != "grid"} for b in beliefs]
    truth = [env.true_poses, env.true_start_poses, env.true_landmarks, env.state(), env.episode.true_path[-1]]
    episode = [env.episode.readings, env.episode.frames, env.episode.true_poses]
    return [results, rows, [belief.map for belief in beliefs], truth, episode, env.readings, env.events, env._standing]


def _arrays(nest: Any) -> Iterator[np.ndarray]:
    """Yield all arrays in nested dicts, sequences and records."""
    if isinstance(nest, np.ndarray):
        yield nest
    elif isinstance(nest, dict):
        yield from _arrays(list(nest.values()))
    elif isinstance(nest, (list, tuple)):
        for entry in nest:
            yield from _arrays(entry)
    elif dataclasses.is_dataclass(nest):
        yield from _arrays([getattr(nest, field.name) for field in dataclasses.fields(nest)])


def _episode(env: ExplorationEnv) -> Iterator[Any]:
    """Yield what the reset and each step of an episode with a merge return."""
    rng = np.random.default_rng(2)
    yield env.reset(seed=5, options={"start_poses": MEETING})
    for _ in range(STEPS[env.config.action_type]):
        yield env.step(turning(env.agents) if env.config.action_type == "continuous" else wander(env, rng))


@pytest.mark.parametrize("action_type", ["continuous", "goal"])
def test_what_is_kept_stays_as_it_was(action_type: str) -> None:
    """Nothing that was handed out lies in memory that later steps write to."""
    env = small_env(action_type=action_type, max_cycles=200)
    kept = []
    for results in _episode(env):
        held = _handed_out(env, results)
        kept.append((held, copy.deepcopy(held)))
    assert any(event.kind == "merge" for event in env.events)
    for held, then in kept:
        for one, other in zip(_arrays(held), _arrays(then), strict=True):
            np.testing.assert_array_equal(one, other)
        assert held[0][-1] == then[0][-1]  # infos


def test_what_is_read_only_cannot_be_made_writable() -> None:
    """No array of a belief, a map, an event, a frame or the world lets who holds it lift the protection."""
    env = small_env(max_cycles=200)
    for _ in _episode(env):
        pass
    beliefs = [env.belief(agent) for agent in env.possible_agents]
    maps = [belief.map for belief in beliefs] + [env.episode.belief.filter_map(0)]
    kept = [beliefs, [belief.grid.cells for belief in beliefs], maps, env.events, env.world, env.readings]
    found = [array for array in _arrays(kept) if not array.flags.writeable]
    assert len(found) > 40
    for array in [*found, *(array[:1] for array in found), *(array.T for array in found)]:
        with pytest.raises(ValueError, match="cannot set WRITEABLE flag"):
            array.flags.writeable = True
        with pytest.raises(ValueError, match="cannot set WRITEABLE flag"):
            array.setflags(write=True)
    for record in (*beliefs, *maps):
        for array in _arrays(record):
            assert not array.flags.writeable


@pytest.mark.parametrize("kind", [{}, {"observation_type": "flat"}, {"action_type": "goal"}])
def test_who_writes_to_what_is_returned_changes_nothing(kind: dict[str, Any]) -> None:
    """An episode goes on with the same bytes though all arrays that can be written were filled with ones."""
    digests = []
    for writes in (False, True):
        env, said = small_env(max_cycles=200, **kind), hashlib.sha256()
        for results in _episode(env):
            digest(results, said)
            for array in _arrays(_handed_out(env, results)) if writes else ():
                if array.flags.writeable:
                    array.fill(1)
        digests.append(said.hexdigest())
    assert digests[0] == digests[1]


def test_a_belief_keeps_nothing_that_the_caller_may_write_to() -> None:
    """Who reuses the arrays of a tick's readings changes nothing, though scans are kept for merges to be taken back."""
    states = []
    for writes in (False, True):
        env, belief = small_env(max_cycles=200), None
        for _ in _episode(env):
            belief = belief or TeamBelief(env.config.belief, 2, env.episode.belief_seed, env.episode.body)
            readings = copy.deepcopy(env.episode.readings)
            belief.step(readings)
            for array in _arrays(readings) if writes else ():
                if array.flags.writeable:
                    array.fill(1)
        assert belief is not None
        assert any(event.kind == "merge" for event in belief.events)
        states.append(belief.get_state())
    assert states[0]["grids"]["strokes"]
    for one, other in zip(*map(_arrays, states), strict=True):
        np.testing.assert_array_equal(one, other)


def test_true_ids_are_not_those_of_the_books() -> None:
    """The simulator looks at those again when robots return; who writes to frames changes nothing there."""
    env = small_env()
    env.reset(seed=5, options={"start_poses": MEETING})
    names = env.episode._frames.names
    frames = env.episode.frames
    assert any(len(frame.true_ids) for frame in frames)
    assert not any(np.shares_memory(frame.true_ids, names) for frame in frames)
