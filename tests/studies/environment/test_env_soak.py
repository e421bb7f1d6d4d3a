"""The soak test of environments detects what is wrong, and repeats."""

from typing import Any

import numpy as np
import pytest

from studies.environment import soak
from vslam_env import vslam_v1


def test_violated_invariants_are_detected(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot in a wall, an observation outside its space and a non-numeric info each end the soak test."""
    env = vslam_v1.parallel_env(world="fig5", num_robots=2, num_particles=3)
    returned: tuple[Any, ...] = env.reset(seed=1)
    soak.check(env, returned)
    returned[1]["robot_0"]["map_error"] = np.nan
    with pytest.raises(AssertionError, match="info of robot_0 not finite"):
        soak.check(env, returned)
    returned = env.reset(seed=1)
    returned[0]["robot_1"]["pose"][:] = np.inf
    with pytest.raises(AssertionError, match="observation of robot_1 outside its space"):
        soak.check(env, returned)
    returned = env.reset(seed=1)
    x1, y1, x2, y2 = env.world.walls[0]
    stuck = np.array([[0.5 * (x1 + x2), 0.5 * (y1 + y2) + 0.1, 0.0], env.true_poses[1]])
    monkeypatch.setattr(type(env), "true_poses", property(lambda self: stuck))
    with pytest.raises(AssertionError, match="a robot is inside a wall"):
        soak.check(env, returned)


def test_an_episode_is_played_to_its_end_and_repeats() -> None:
    """Two episodes of a seed return the same bytes, and those of another seed others."""
    config = soak.Config(episodes=2, seed=57)
    first, other = (soak.play(config, trial) for trial in soak.trials(config))
    again = soak.play(config, soak.Trial(seed=57))
    assert again | {"memory_mb": 0.0} == first | {"memory_mb": 0.0}
    assert other["digest"] != first["digest"]
    assert first["steps"] >= 50
    *_, line = soak.STUDY.tables[0].lines([first, other])
    assert (line["steps"].value, line["repeated"].value) == (first["steps"] + other["steps"], 0)


@pytest.mark.slow
@pytest.mark.nightly
def test_beginnings_do_not_depend_on_the_process() -> None:
    """The first steps of an episode have the same bytes beside another environment, from a state, and elsewhere."""
    reference = soak.beginning(5, 6)
    assert soak.beginning(5, 6, beside=True) == reference
    assert soak.beginning(5, 6, restored_at=3) == reference
    assert soak.in_another_process(5, 99, steps=6) == reference
    assert soak.beginning(6, 6) != reference
