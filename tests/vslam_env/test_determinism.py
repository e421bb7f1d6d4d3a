import hashlib
from typing import Any

import numpy as np
import pytest
from digests import digest
from small_env import small_env, wander

from vslam_env import ExplorationEnv


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


def test_resets_without_a_seed_go_on() -> None:
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


def test_streams_are_apart() -> None:
    """More measurements a frame shift neither the odometry nor the scans, nor does another number of particles."""
    logs = []
    eager = small_env().config.replace(landmark_sensor={"max_measurements": 9})
    changes: list[dict[str, Any]] = [{}, {"num_particles": 7}, {"config": eager}]
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


def test_oracles_leave_the_noise_alone() -> None:
    """With and without oracles the robots measure the same."""
    logs = []
    for on in (False, True):
        env = small_env(oracle_pose=on, oracle_association=on, oracle_merge=on)
        env.reset(seed=6)
        for _ in range(10):
            env.step({agent: np.array([0.5, 0.3]) for agent in env.agents})
        logs.append([(r.odometry, r.measurements.points, r.scan) for r in env.readings])
    for now, then in zip(*logs, strict=True):
        assert all(np.array_equal(a, b) for a, b in zip(now, then, strict=True))


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
