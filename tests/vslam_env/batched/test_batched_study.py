"""Study of simpler estimators: the Gaussian belief on the readings of an episode."""

from dataclasses import asdict

import numpy as np

from studies import losses
from studies.bounds.gaussian_team import gaussian_team
from studies.fidelity import STUDY, Config, play, trials

SMALL = Config(
    worlds=("fig5",), presets=("standard",), duration=6.0, particles=(12,), robots=(2,), policies=("frontier",),
    seeds=1, estimators=("one Gaussian",),
)  # fmt: skip


def test_a_trial_has_errors_of_the_same_size() -> None:
    """Poses stay near the truth for a few seconds, recall is that of the environment, and returns are finite."""
    (trial,) = trials(SMALL)
    row = asdict(trial) | play(SMALL, trial)
    assert 0.0 < row["position_ratio"] < 10.0
    assert abs(row["recall_change"]) < 0.05
    assert abs(row["map_error_change"]) < 0.05
    assert np.isfinite(row["own_returns"]).all()
    assert row["false_merges"] == 0
    (line,) = STUDY.tables[0].lines([row])
    assert line["estimator"] == "one Gaussian"


def test_paths_have_each_tick_once() -> None:
    """Paths begin at the start and have one pose a tick, the last chunk included."""
    config = SMALL.model_copy(update={"duration": 2.5})
    episode = losses.recorded(config, losses.trials(config)[0])
    team = gaussian_team(episode)
    assert team.paths.shape == episode.true_paths.shape
    np.testing.assert_allclose(team.paths[:, 0], 0.0, atol=1e-6)
