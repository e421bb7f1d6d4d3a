"""The recipe of a first learning curve."""

from pathlib import Path

import numpy as np
import pytest
from builders.scripts import load_script

from agents import make_policy
from studies.learning.first_curve import PPO, Config, Trial, mean_return, play, trials

example = load_script(Path(__file__).parents[2] / "examples" / "first_curve.py")


def test_a_training_repeats_and_its_study_measures_it() -> None:
    """The same seed gives the same curve; the study has it, and level lines for policies that need no training."""
    config = Config(robots=(1,), decisions=800, seeds=1, episodes=1)
    assert [trial.policy for trial in trials(config)] == ["random_goals", "frontier", PPO]
    row = play(config, Trial(robots=1, policy=PPO, seed=3))
    _, points = example.train(1, 800, seed=3)
    assert [(point, value) for point, value in points] == [(800, row["curves"]["return_m"][0])]
    assert row["curves"]["time_s"] == [0.8]
    assert 0.0 < row["curves"]["return_m"][0] < 0.71
    level = play(config, Trial(robots=1, policy="frontier", seed=3))
    assert level["curves"]["return_m"] == [level["sampled"]] * 2


@pytest.mark.nightly
def test_the_curve_rises() -> None:
    """After 24,000 decisions returns are higher than those of random valid goals, from about half of them."""
    _, points = example.train(1, 24_000, seed=1)
    returns = np.array([value for _, value in points])
    random = mean_return(1, 20, lambda: make_policy("random_goals", "goal"))
    assert returns[:3].mean() < 0.7 * random
    assert returns[-5:].mean() > random
