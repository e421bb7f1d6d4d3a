"""Episodes leave nothing behind."""

import gc
import tracemalloc

import numpy as np
import pytest
from small_env import MEETING, small_env, wander

from vslam_env import ExplorationEnv

KIB = 1024


@pytest.mark.slow
def test_an_episode_leaves_nothing_behind() -> None:
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
