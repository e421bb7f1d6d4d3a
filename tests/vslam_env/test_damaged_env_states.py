"""What is damaged of an environment's state is refused before anything is taken over, or does no harm."""

import copy
import hashlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from damage import damaged, replaced
from digests import digest
from small_env import MEETING, small_env, wander

from slam_backend.core.state_codec import ForeignObjectError, decoded, encoded
from vslam_env import ExplorationEnv, load_state, save_state
from vslam_env.snapshots import state_version
from vslam_env.state_kinds import ENV_KINDS

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # overflows of what is out of place do no harm

REPEATED = 20  # refusals after which the environment is looked at: it goes on as before
STEPS = 3


def begun(**options: Any) -> ExplorationEnv:
    """Return an environment whose two robots soon merge."""
    env = small_env(max_cycles=1000, **options)
    env.reset(seed=5, options={"start_poses": MEETING})
    return env


def go_on(env: ExplorationEnv, steps: int = STEPS) -> str:
    """Return the hash of all that further steps return."""
    total, rng = hashlib.sha256(), np.random.default_rng(3)
    for _ in range(steps):
        if env.agents:
            digest(env.step(wander(env, rng)), total)
    return total.hexdigest()


def merged() -> ExplorationEnv:
    """Return an environment whose robots have merged, a merge that can still be undone."""
    env = begun()
    go_on(env, 160)
    assert len(env.belief("robot_0").group) == 2
    return env


def split() -> ExplorationEnv:
    """Return an environment whose robots have merged and lost contact; existence is kept."""
    twin = begun(comm_loss=0.3)
    config = twin.config.replace(belief={"filter": {"existence": {}, "rejuvenate_every": 20}})
    env = ExplorationEnv(config, twin.world)
    env.reset(seed=5, options={"start_poses": MEETING})
    go_on(env, 150)
    while len(env.get_state()["episode"]["belief"]["team"]["groups"][0]["branches"]) == 1:
        go_on(env, 1)
    return env


def under_way() -> ExplorationEnv:
    """Return an environment whose robots are on their ways to candidates."""
    env = begun(action_type="goal", decision_ticks=3)
    go_on(env, 20)
    return env


ENVS: dict[str, Callable[[], ExplorationEnv]] = {"merged": merged, "split": split, "goal": under_way}


def look(env: ExplorationEnv) -> None:
    """Look at all that can be asked of an environment."""
    for agent in env.possible_agents:
        env.belief(agent)
    env.state(), env.scene(), env.readings, env.events, env.episode.frames, env.get_state()


def try_damaged(env: ExplorationEnv, seeds: range) -> dict[str, int]:
    """Set an environment to damaged states, as they are and through bytes; count what was refused."""
    state = env.get_state()
    twin = env.clone()
    expected = go_on(twin)
    refused = accepted = 0
    for seed in seeds:
        what, other = damaged(state, np.random.default_rng(seed))
        try:
            if seed % 4 == 0:
                other = decoded(encoded(other, ENV_KINDS), ENV_KINDS)
            env.set_state(other)
        except ForeignObjectError:
            continue
        except ValueError:
            refused += 1
            if refused % REPEATED == 0:
                assert go_on(env) == expected, what
                env.set_state(state)
            continue
        accepted += 1
        try:
            go_on(env)
            if other["episode"] is not None:  # else it is a state of before the first reset
                look(env)
        except Exception as error:
            raise AssertionError(f"seed {seed}: {what}") from error
        env.set_state(state)
    return {"refused": refused, "accepted": accepted}


@pytest.mark.parametrize("kind", ENVS)
def test_damaged_states_are_refused_or_harmless(kind: str) -> None:
    """Of 350 damaged states of each kind most are refused, which changes nothing; from the others it goes on."""
    counts = try_damaged(ENVS[kind](), range(350))
    assert counts["refused"] > 200
    assert counts["accepted"] > 10


@pytest.mark.slow
@pytest.mark.parametrize("kind", ENVS)
def test_many_damaged_states_are_refused_or_harmless(kind: str) -> None:
    """So it is with 2000 others."""
    assert try_damaged(ENVS[kind](), range(1000, 3000))["refused"] > 1200


@pytest.mark.slow
def test_damaged_states_of_rendered_eyes_are_refused_or_harmless() -> None:
    """So it is where robots see with rendered eyes."""
    env = small_env(sensor="stereo", max_cycles=1000)
    env.reset(seed=5)
    go_on(env, 4)
    assert try_damaged(env, range(300))["refused"] > 150


@pytest.mark.parametrize(
    ("way", "index", "says"),
    [
        (
            ["belief", "team", "groups", 0, "branches", 0, "filter", "maps", "map_of"],
            10**9,
            r"\['map_of'\]: expected int",
        ),
        (["belief", "grids", "parted"], 10**9, r"\['grids'\]\['parted'\]: expected integers from -2 to"),
        (["ledger", "books"], 10**9, r"\['ledger'\]\['books'\]: expected integers from -3 to"),
        (["coverage", "found"], -3, r"\['coverage'\]\['found'\]: expected integers from 0 to"),
        (["simulator", "poses"], 1e300, r"\['simulator'\]\['poses'\]: expected numbers from"),
        (["simulator", "poses"], 1e5, r"\['simulator'\]\['poses'\]: expected places in the world"),
        (["belief", "slots", 0, "rows"], 1e9, r"\['slots'\]\[0\]\['rows'\]: expected"),
    ],
)
def test_files_are_checked_as_states_are(way: list[Any], index: float, says: str, tmp_path: Path) -> None:
    """A forged file with the right checksum is refused by the name of what is out of range."""
    env = begun(action_type="goal", decision_ticks=3)
    go_on(env, 6)
    state = env.get_state()
    array = state["episode"]
    for key in way:
        array = array[key]
    array = array.copy()
    array.reshape(-1)[0] = index
    save_state(replaced(state, ["episode", *way], array), tmp_path / "state")
    with pytest.raises(ValueError, match=r"^state\['episode'\]" + f".*{says}"):
        env.set_state(load_state(tmp_path / "state"))
    assert load_state(tmp_path / "state")["version"] == state_version()


def test_nothing_within_the_sensors_of_a_copied_state_is_believed() -> None:
    """Numbers by which kernels look up walls and landmarks are derived again from the setting's parts."""
    env = begun()
    state = copy.deepcopy(env.get_state())
    expected = go_on(env)
    sensor, scan = state["episode"]["setting"].sensor, state["episode"]["setting"].scan
    inner = (*sensor._sight, *scan._sight, state["episode"]["setting"].coverage.laid)
    for array in (part for part in inner if isinstance(part, np.ndarray)):
        array[:] = np.iinfo(np.int32).max if array.dtype.kind == "i" else np.nan
    env.set_state(state)
    assert go_on(env) == expected
