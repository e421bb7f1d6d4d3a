"""Damaged states and environments of any options: refused, or harmless."""

import copy
import hashlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from builders.comparison import digest
from builders.damage import at, replaced, try_damaged
from builders.environments import MEETING, small_env, wander
from builders.random_environments import Case, check, drawn

from vslam_env import ExplorationEnv, load_state, save_state
from vslam_env.snapshots import state_version

pytestmark = pytest.mark.filterwarnings("ignore::RuntimeWarning")  # overflows of what is out of place do no harm

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
    while len(env.get_state()["episode"]["belief"]["team"]["merges"]["groups"][0]["branches"]) == 1:
        go_on(env, 1)
    return env


def under_way() -> ExplorationEnv:
    """Return an environment whose robots are on their ways to candidates."""
    env = begun(action_type="goal", decision_ticks=3)
    go_on(env, 20)
    return env


def with_rendered_eyes() -> ExplorationEnv:
    """Return an environment whose robots see with rendered eyes."""
    env = small_env(sensor="stereo", max_cycles=1000)
    env.reset(seed=5)
    go_on(env, 4)
    return env


ENVS: dict[str, Callable[[], ExplorationEnv]] = {
    "merged": merged,
    "split": split,
    "goal": under_way,
    "stereo": with_rendered_eyes,
}


def look(env: ExplorationEnv) -> None:
    """Look at all that can be asked of an environment."""
    for agent in env.possible_agents:
        env.belief(agent)
    env.state(), env.scene(), env.readings, env.events, env.episode.frames, env.get_state()


@pytest.mark.parametrize(
    ("kind", "seeds"),
    [(kind, range(350)) for kind in ("merged", "split", "goal")]
    + [pytest.param(kind, range(1000, 1250), marks=pytest.mark.slow) for kind in ("merged", "split", "goal")]
    + [pytest.param("stereo", range(150), marks=pytest.mark.slow)],
)
def test_damaged_states_are_refused_or_harmless(kind: str, seeds: range) -> None:
    """Of the damaged states of each kind most are refused, which changes nothing; from the others it goes on."""
    env = ENVS[kind]()
    expected = go_on(env.clone())

    def look_on(other: Any) -> None:
        go_on(env)
        if other["episode"] is not None:  # else it is a state of before the first reset
            look(env)

    counts = try_damaged(env, seeds, lambda: go_on(env) == expected, look_on)
    assert counts["refused"] > 0.5 * len(seeds)
    assert counts["accepted"] > 0.028 * len(seeds)


@pytest.mark.parametrize(
    ("way", "index", "says"),
    [
        (
            ["belief", "team", "merges", "groups", 0, "branches", 0, "filter", "maps", "map_of"],
            10**9,
            r"\.map_of: expected int",
        ),
        (["belief", "grids", "separated_since"], -9, r"\['grids'\]\['separated_since'\]: expected integers from -2 to"),
        (["ground_truth", "claims"], 10**9, r"\['ground_truth'\]\['claims'\]: expected integers from -3 to"),
        (["coverage", "found"], -3, r"\['coverage'\]\['found'\]: expected integers from 0 to"),
        (["simulator", "poses"], 1e300, r"\['simulator'\]\['poses'\]: expected numbers from"),
        (["simulator", "poses"], 1e5, "expected parts that fit together, got 'robots outside the world'"),
        (["belief", "candidates", "other_rows"], 1e9, r"\['candidates'\]: .* got 'positions that are not in the grid'"),
        (
            ["belief", "candidates", "frontiers", 0, "rows"],
            1e9,
            r"\['frontiers'\]\[0\]: .* got 'positions that are not",
        ),
    ],
)
def test_files_are_checked_as_states_are(way: list[Any], index: float, says: str, tmp_path: Path) -> None:
    """A forged file with the right checksum is refused by the name of what is out of range."""
    env = begun(action_type="goal", decision_ticks=3)
    go_on(env, 6)
    state = env.get_state()
    array = at(state["episode"], way).copy()
    array.reshape(-1)[0] = index
    save_state(replaced(state, ["episode", *way], array), tmp_path / "state")
    with pytest.raises(ValueError, match=r"^state\['episode'\]" + f".*{says}"):
        env.set_state(load_state(tmp_path / "state"))
    assert load_state(tmp_path / "state")["version"] == state_version()


def test_arrays_of_sensors_in_a_copied_state_are_rebuilt() -> None:
    """Numbers by which kernels look up walls and landmarks are derived again from the scenario's parts."""
    env = begun()
    state = copy.deepcopy(env.get_state())
    expected = go_on(env)
    sensor, scan = state["episode"]["scenario"].sensor, state["episode"]["scenario"].scan
    inner = (*sensor._sight, *scan._sight, state["episode"]["scenario"].coverage.rows)
    for array in (part for part in inner if isinstance(part, np.ndarray)):
        array[:] = np.iinfo(np.int32).max if array.dtype.kind == "i" else np.nan
    env.set_state(state)
    assert go_on(env) == expected


LONG_SIGHTED = {"sigma_disparity_px": 0.5, "max_range": 30.0}
UNSURE = {"proposal": "fastslam1", "rejuvenate_every": 7, "motion": {"sigma_across": 3.0, "sigma_heading": 3.0}}
FOUND = {
    "points beyond all that filters take": Case(
        seed=0, preset="standard", sensor="landmark", world=(60.0, 60.0), steps=40,
        changes={
            "landmark_sensor": {"camera": LONG_SIGHTED},
            "belief": {"filter": {"camera": LONG_SIGHTED | {"sigma_px": 0.4, "sigma_disparity_px": 1.0}}},
        },
    ),
    "paths drawn before any landmark": Case(
        seed=1192, preset="standard", sensor="landmark", world=(176.97753639403135, 133.34862938553124), steps=10,
        changes={
            "num_robots": 1, "action_type": "goal", "odometry": {"bias_heading_per_metre": 5.0},
            "landmark_sensor": {"false_points": 0.0}, "scan": {"max_range": 50.0}, "belief": {"filter": UNSURE},
        },
    ),
    "depths that are all but unknown": Case(
        seed=2, preset="standard", sensor="landmark", world="fig5", steps=12,
        changes={
            "num_robots": 1, "action_type": "goal", "odometry": {"bias_distance": 0.5},
            "belief": {"filter": {"rejuvenate_every": 5, "camera": {"sigma_px": 0.4, "sigma_disparity_px": 50.0}}},
        },
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", FOUND.values(), ids=FOUND)
def test_formerly_failing_environments_run(case: Case) -> None:
    """Environments in which an episode once broke, found by trials."""
    assert check(case)


def played(seeds: Iterable[int]) -> float:
    """Check the cases of some seeds; return the share of those that were played and not refused."""
    checked = [check(drawn(seed)) for seed in seeds]
    return sum(checked) / len(checked)


@pytest.mark.slow
def test_random_environments_run() -> None:
    """Nothing is raised in a step, nothing is NaN or outside its space, and all bytes repeat; most cases are played."""
    assert played(range(40)) > 0.5


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize("first", range(1000, 1075, 25))
def test_many_random_environments_run(first: int) -> None:
    """The same holds of more, of which some twenty-five can be refused more often than played."""
    assert played(range(first, first + 25)) > 0.3
