"""Study of simpler estimators: batched teams on the readings of an episode, and in its world."""

from dataclasses import asdict

import numpy as np
import pytest

from studies.batched.fidelity import STUDY, Config, play, trials
from studies.bounds import gaussian_team
from vslam_env.batched.scoring import Scores

SMALL = Config(
    worlds=("fig5",), presets=("standard",), duration=3.0, particles=(12,), robots=(2,),
    policies=("frontier@continuous",), seeds=1, estimators=("one Gaussian", "batched"),
)  # fmt: skip


@pytest.mark.nightly
def test_trials_have_errors_of_the_same_size() -> None:
    """Poses stay near the truth for a few seconds, recall is that of the environment, and returns are finite."""
    rows = [asdict(trial) | play(SMALL, trial) for trial in trials(SMALL)]
    for row in rows:
        assert 0.0 < row["position_ratio"] < 10.0
        assert abs(row["recall_change"]) < 0.15
        assert abs(row["map_error_change"]) < 0.1
        assert np.isfinite(row["own_returns"]).all()
        assert row["false_merges"] == 0
    assert [line["estimator"] for line in STUDY.tables[0].lines(rows)] == ["one Gaussian", "batched"]


def test_parts_of_an_episode_become_paths_and_merges() -> None:
    """Paths are relative to the starts as known in each tick; a merge half a metre off is a false one."""
    rng = np.random.default_rng(0)
    robots, poses = rng.normal(size=(7, 2, 8)), rng.normal(size=(7, 2, 3))
    robots[..., 5:], poses[0] = 0.0, 0.0
    robots[:, 1, 5] = 0.6
    scores = Scores(np.array([0.7, 0.6]), np.zeros(2), np.ones(2))
    parts = [
        gaussian_team.Part(end, robots[ticks], poses[ticks], np.array(groups), scores)
        for end, ticks, groups in ((0, slice(1), [0, 1]), (3, slice(1, 4), [0, 1]), (6, slice(4, 7), [0, 0]))
    ]
    team = gaussian_team.joined(parts)
    assert team.paths.shape == (2, 7, 3)
    np.testing.assert_allclose(team.paths[0, :, :2], robots[:, 0, :2])
    np.testing.assert_allclose(team.paths[1, :, 0], robots[:, 1, 0] - 0.6)
    np.testing.assert_array_equal(team.true_paths[1], poses[:, 1])
    assert (team.merges, team.false_merges) == ([6], 1)
    np.testing.assert_array_equal(team.map_errors, [[0.7, 0.7], [0.6, 0.6]])


def test_robots_that_choose_goals_have_no_actions_for_batched_teams() -> None:
    """Policies of another action type are refused by name."""
    with pytest.raises(ValueError, match="policy: expected policies with @continuous"):
        SMALL.model_copy(update={"policies": ("frontier",)}).check()
