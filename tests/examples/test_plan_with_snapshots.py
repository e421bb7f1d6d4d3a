from pathlib import Path

import numpy as np
import pytest
from builders.scripts import load_script

PATH = Path(__file__).parents[2] / "examples" / "plan_with_snapshots.py"
example = load_script(PATH)


@pytest.mark.slow
def test_planning_beats_its_base_policy() -> None:
    """Over eight episodes of 20 decisions random shooting in a twin removes more map error than its base policy."""
    alone = [example.play(seed, 20, 0, 5) for seed in range(200, 208)]
    planned = [example.play(seed, 20, 6, 5) for seed in range(200, 208)]
    assert np.mean(planned) > 1.05 * np.mean(alone)


def test_planning_does_not_change_the_environment() -> None:
    """Evaluating plans in a twin does not change later steps of the environment."""
    envs = [example.vslam_v1.parallel_env(action_type="goal", num_robots=2, world="fig5") for _ in range(2)]
    for env in envs:
        env.reset(seed=5)
    example.best_plan(envs[0], envs[0].clone(), 2, 2, np.random.default_rng(0))
    paid = [example.follow(env, {}, 3) for env in envs]
    assert paid[0] == paid[1]
