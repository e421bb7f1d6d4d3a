"""Episodes repeat from their seeds, free their memory, and share no writable arrays with the caller."""

import copy
import dataclasses
import gc
import hashlib
import tracemalloc
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import pytest
from builders.comparison import digest
from builders.environments import MEETING, small_env, turning, wander

from slam_backend.state import take
from vslam_env import ExplorationEnv
from vslam_env.belief.team_belief import TeamBelief

STEPS = {"continuous": 130, "discrete": 130, "goal": 25}  # two robots meet, and their maps are merged


def _returned_arrays(env: ExplorationEnv, results: Any) -> list[Any]:
    """Return all that a caller can hold after a step; of beliefs all but the grid, which follows the robot."""
    agents = env.possible_agents
    beliefs = [env.belief(agent) for agent in agents]
    rows = [{f.name: getattr(b, f.name) for f in dataclasses.fields(b) if f.name != "grid"} for b in beliefs]
    truth = [env.true_poses, env.true_start_poses, env.true_landmarks, env.state(), env.episode.true_path[-1]]
    episode = [env.episode.readings, env.episode.frames, env.episode.true_poses]
    return [
        results,
        rows,
        [belief.map for belief in beliefs],
        truth,
        episode,
        env.readings,
        env.events,
        env._team_metrics,
    ]


def _arrays(nest: Any) -> Iterator[np.ndarray]:
    """Yield all arrays in nested dicts, sequences and records."""
    if isinstance(nest, np.ndarray):
        yield nest
    elif isinstance(nest, Mapping):
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
def test_returned_arrays_do_not_change_later(action_type: str) -> None:
    """No returned array is in memory that later steps write to."""
    env = small_env(action_type=action_type, max_cycles=200)
    kept = []
    for results in _episode(env):
        held = _returned_arrays(env, results)
        kept.append((held, copy.deepcopy(held)))
    assert any(event.kind == "merge" for event in env.events)
    for held, then in kept:
        for one, other in zip(_arrays(held), _arrays(then), strict=True):
            np.testing.assert_array_equal(one, other)
        assert held[0][-1] == then[0][-1]  # infos


def test_read_only_arrays_cannot_be_made_writable() -> None:
    """No array of a belief, a map, an event, a frame or the world can be made writable by its holder."""
    env = small_env(max_cycles=200)
    for _ in _episode(env):
        pass
    beliefs = [env.belief(agent) for agent in env.possible_agents]
    maps = [belief.map for belief in beliefs] + [env.episode.belief.team.map(0)]
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
def test_writing_to_returned_arrays_changes_nothing(kind: dict[str, Any]) -> None:
    """An episode gives the same bytes when all writable arrays that it returned are filled with ones."""
    digests = []
    for writes in (False, True):
        env, said = small_env(max_cycles=200, **kind), hashlib.sha256()
        for results in _episode(env):
            digest(results, said)
            for array in _arrays(_returned_arrays(env, results)) if writes else ():
                if array.flags.writeable:
                    array.fill(1)
        digests.append(said.hexdigest())
    assert digests[0] == digests[1]


def test_a_belief_keeps_no_array_of_the_caller() -> None:
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
        assert any(event.kind == "merge" for event in belief.team.events)
        states.append(take(belief))
    assert states[0]["grids"]["updates"]
    for one, other in zip(*map(_arrays, states), strict=True):
        np.testing.assert_array_equal(one, other)


def test_true_ids_in_frames_are_copies() -> None:
    """The simulator reads its own again when robots return; writing to frames does not change them."""
    env = small_env()
    env.reset(seed=5, options={"start_poses": MEETING})
    names = env.episode.last_frames.padded_ids
    frames = env.episode.frames
    assert any(len(frame.true_ids) for frame in frames)
    assert not any(np.shares_memory(frame.true_ids, names) for frame in frames)


def _run(env: ExplorationEnv, seed: int, steps: int, beside: ExplorationEnv | None = None) -> str:
    """Return the hash of all that `steps` steps return, another environment stepping in between if there is one."""
    total = hashlib.sha256()
    rng, other_rng = np.random.default_rng(7), np.random.default_rng(8)
    digest(env.reset(seed=seed), total)
    if beside is not None:
        beside.reset(seed=99)
    for _ in range(steps):
        digest(env.step(wander(env, rng)), total)
        digest(env.state(), total)
        if beside is not None:
            beside.step(wander(beside, other_rng))
    return total.hexdigest()


@pytest.mark.parametrize(("action_type", "steps"), [("continuous", 300), ("goal", 30)])
def test_one_seed_gives_the_same_bytes(action_type: str, steps: int) -> None:
    """300 ticks repeat byte for byte in a fresh environment, in a used one, and with another stepping beside."""

    def fresh() -> ExplorationEnv:
        return small_env(world="fig5", action_type=action_type, max_cycles=500)

    first, second = fresh(), fresh()
    reference = _run(first, 11, steps)
    assert _run(second, 11, steps, beside=fresh()) == reference
    assert _run(first, 11, steps) == reference
    assert _run(second, 12, steps) != reference


def test_resets_without_a_seed_continue_the_sequence() -> None:
    """Resets without a seed give new worlds; the sequence of them repeats from the seed; zero is a seed."""
    env = small_env(world="fig5")
    walls = []
    for seed in (0, None, None, 0, None):
        env.reset(seed=seed)
        walls.append(env.world.walls)
    assert np.array_equal(walls[0], walls[3])
    assert np.array_equal(walls[1], walls[4])
    assert not np.array_equal(walls[0], walls[1])
    assert not np.array_equal(walls[1], walls[2])


def test_a_first_reset_without_a_seed_is_random() -> None:
    """Two environments that were never seeded differ."""
    starts = []
    for _ in range(2):
        env = small_env()
        env.reset()
        starts.append(env.true_start_poses)
    assert not np.array_equal(*starts)


def test_random_streams_are_independent() -> None:
    """Neither more measurements a frame, nor another number of particles, nor an oracle shift odometry or scans."""
    logs = []
    eager = small_env().config.replace(landmark_sensor={"max_measurements": 9})
    changes: list[dict[str, Any]] = [{}, {"num_particles": 7}, {"config": eager}]
    changes.append({"oracle_pose": True, "oracle_association": True, "oracle_merge": True})
    for change in changes:
        env = small_env(max_cycles=15, **change)
        env.reset(seed=6)
        log = []
        for _ in range(15):
            env.step({agent: np.array([0.5, 0.3]) for agent in env.agents})
            log.append([(reading.odometry, reading.scan) for reading in env.readings])
        logs.append(log)
    for other in logs[1:]:
        for now, then in zip(logs[0], other, strict=True):
            for a, b in zip(now, then, strict=True):
                assert np.array_equal(a[0], b[0])
                assert np.array_equal(a[1], b[1])


def test_world_seed_fixes_the_building_only() -> None:
    """The option `world_seed` gives the same walls and landmarks under any seed, with other starts and noise."""
    env = small_env(world="fig5")
    worlds, starts = [], []
    for seed in (1, 2):
        env.reset(seed=seed, options={"world_seed": 5})
        worlds.append(env.world)
        starts.append(env.true_start_poses)
    assert np.array_equal(worlds[0].walls, worlds[1].walls)
    assert worlds[0].landmarks is not None
    assert worlds[1].landmarks is not None
    assert np.array_equal(worlds[0].landmarks.positions, worlds[1].landmarks.positions)
    assert np.array_equal(worlds[0].landmarks.descriptors, worlds[1].landmarks.descriptors)
    assert not np.array_equal(*starts)


KIB = 1024


@pytest.mark.slow
def test_an_episode_leaks_no_memory() -> None:
    """An episode with a merge, played again in the same environment and in a new one, leaves no more than before.

    Less than a grid of one robot, that is: caches of the interpreter take some kilobytes.
    """

    def play(env: ExplorationEnv) -> None:
        rng = np.random.default_rng(7)
        env.reset(seed=5, options={"start_poses": MEETING})
        for _ in range(100):
            env.step(wander(env, rng))
        assert any(event.kind == "merge" for event in env.events)

    env = small_env(max_cycles=1000)
    play(env)
    tracemalloc.start()
    try:
        held = []
        for _ in range(2):
            play(env)
            play(small_env(max_cycles=1000))
            gc.collect()
            held.append((tracemalloc.get_traced_memory()[0], len(gc.get_objects())))
    finally:
        tracemalloc.stop()
    (first, objects), (last, more) = held
    assert last - first < 64 * KIB
    assert more - objects < 300
