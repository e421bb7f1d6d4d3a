"""A state shares arrays with the running environment: they are read-only."""

import copy
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.environments import MEETING, SMALL_STEREO, room, small_env, wander
from builders.shared_arrays import arrays_in, can_be_written, scribble, shared, shared_and_writable
from test_damaged_env_states import go_on, merged, split

from vslam_env import EnvConfig, ExplorationEnv, load_state, save_state, vslam_v0
from vslam_env.presets import preset_config


def driven(env: ExplorationEnv, steps: int, options: dict[str, Any] | None = None) -> ExplorationEnv:
    """Return an environment after some steps."""
    env.reset(seed=5, options=options)
    rng = np.random.default_rng(0)
    for _ in range(steps):
        env.step(wander(env, rng))
    return env


def meeting(steps: int, changes: dict[str, Any], **options: Any) -> ExplorationEnv:
    """Return the small room, in which two robots soon merge, after some steps."""
    config = small_env(max_cycles=1000, **options).config.replace(**changes)
    return driven(ExplorationEnv(config, room()), steps, {"start_poses": MEETING})


def with_eyes() -> ExplorationEnv:
    """Return the small room with small rendered eyes, whose images are observed."""
    config: EnvConfig = preset_config("standard", "stereo").replace(stereo=SMALL_STEREO, observe_images=True)
    return driven(small_env(config=config), 3)


REJUVENATED = {"belief": {"filter": {"rejuvenate_every": 20}, "attempts": {"every": 5}}}
FASTSLAM1 = {"belief": {"filter": {"proposal": "fastslam1", "existence": {}}}}
NAMED = {"landmark_sensor": {"false_points": 1.0}}  # some measurements are named -1
ENVS: dict[str, Callable[[], ExplorationEnv]] = {
    "hall, goal, lost contacts": lambda: driven(
        vslam_v0.parallel_env(world="hall", action_type="goal", comm_loss=0.5, num_particles=20), 25
    ),
    "merged": merged,
    "split": split,
    "rejuvenated": lambda: meeting(220, REJUVENATED),
    "fastslam1": lambda: meeting(60, FASTSLAM1),
    "oracles": lambda: meeting(30, NAMED, oracle_pose=True, oracle_association=True, oracle_merge=True),
    "oracle merges, radios of short range": lambda: meeting(120, {}, comm_range=4.0, comm_loss=0.3, oracle_merge=True),
    "goal": lambda: meeting(30, {}, action_type="goal"),
    "stereo": with_eyes,
}


@pytest.mark.parametrize("name", ENVS)
def test_arrays_shared_by_a_state_are_read_only(name: str, tmp_path: Path) -> None:
    """That holds for states of the environment, among each other as well, and for those that it is set to."""
    env = ENVS[name]()
    state = env.get_state()
    assert shared(state, env)
    assert not shared_and_writable(state, env)
    assert not shared_and_writable(state, env.get_state())
    save_state(state, tmp_path / "state")
    for other in (pickle.loads(pickle.dumps(state)), copy.deepcopy(state), load_state(tmp_path / "state"), state):
        env.set_state(other)
        assert not shared_and_writable(other, env)


@pytest.mark.slow
@pytest.mark.parametrize("name", ENVS)
def test_writing_into_a_state_changes_no_environment(name: str) -> None:
    """A state has no writable array; an environment continues unchanged when those of a copy are overwritten."""
    env = ENVS[name]()
    twins = [env.clone() for _ in range(3)]
    reference = go_on(twins[0], 25)
    assert scribble(env.get_state()) == 0
    assert go_on(env, 25) == reference
    start = twins[1].get_state()
    for other in (pickle.loads(pickle.dumps(start)), copy.deepcopy(start)):
        twins[2].set_state(other)
        assert scribble(other) > 0
        assert go_on(twins[2], 25) == reference


def test_the_coverage_cells_of_a_scenario_cannot_be_written() -> None:
    """Snapshots share them; an environment that is set to its own state does not look at it again."""
    env = merged()
    state = env.get_state()
    scenario = state["episode"]["scenario"]
    with pytest.raises(ValueError, match="read-only"):
        scenario.coverage.rows[:] = 2**31 - 1
    with pytest.raises(ValueError, match="cannot set WRITEABLE flag"):
        scenario.coverage.rows.setflags(write=True)
    assert not any(array.size and can_be_written(array) for _, array in arrays_in(scenario))
    twin = env.clone()
    env.set_state(state)
    assert go_on(env, 5) == go_on(twin, 5)
