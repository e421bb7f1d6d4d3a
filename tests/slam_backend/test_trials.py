"""Pairs that are not sure merge on trial: the joint filter, smoothed, says how sure the motion is."""

from typing import Any

import numpy as np
import pytest
from filter_contents import contents
from merged_pair import NEVER
from same_bits import assert_same
from simulated_team import SimulatedTeam

from slam_backend.maps.alignment import AlignmentOptions, align_maps
from slam_backend.smoother.graph import mean_pose
from slam_backend.team import group_merging as group_changes
from slam_backend.team.group_merging import MergePlan
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

STEPS = 60
NEVER_SURE = 1e4  # deviations: 0.05 mm


def driven(attempts: AttemptOptions, **options: Any) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots with few particles after some steps."""
    simulation = SimulatedTeam(num_robots=2, seed=112)
    team = simulation.build(attempts=attempts, num_particles=8, **options)
    simulation.run(team, STEPS)
    return simulation, team


def planned(team: TeamSlam) -> MergePlan:
    """Return the plan of a merge of both robots, with its particles paired."""
    first, second = team._groups
    found = align_maps(team.map(0, "mixture"), team.map(1, "mixture"))
    return MergePlan.of(first, second, found).paired(MergeOptions(), np.random.default_rng(1))


def test_a_trial_leaves_both_filters_as_they_are() -> None:
    """It makes a joint filter of its own, and tells the motion and the doubt that this one has."""
    _, team = driven(NEVER)
    plan = planned(team)
    before = [contents(slam) for slam in plan.filters]
    trial = plan.on_trial(MergeOptions(), AlignmentOptions(), np.random.default_rng(2))
    assert trial is not None
    for slam, kept in zip(plan.filters, before, strict=True):
        assert_same(contents(slam), kept)
    tried, doubt = trial
    assert tried.joint is not None
    joint = tried.joint[0]
    np.testing.assert_allclose(tried.alignment.transform, mean_pose(joint.state.starts[1, :, : joint.num_particles]))
    assert_same(tried.alignment.inliers, plan.alignment.inliers)
    assert 0.0 < doubt < 1.0


def test_a_trial_whose_merge_would_be_undone_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where more landmarks have moved among each other than a merge may move, the doubt has no bound."""
    _, team = driven(NEVER)
    plan = planned(team)
    for share, bounded in ((0.2, True), (0.21, False)):
        monkeypatch.setattr(group_changes, "moved_share", lambda *_, share=share: share)
        trial = plan.on_trial(MergeOptions(), AlignmentOptions(), np.random.default_rng(2))
        assert trial is not None
        assert np.isfinite(trial[1]) == bounded


def test_a_refused_trial_leaves_no_trace() -> None:
    """Groups and random streams are bit for bit those of a team that makes no trials."""
    at_last = AttemptOptions(every=STEPS)
    states = [
        driven(at_last, merging=MergeOptions(sure=NEVER_SURE, least_sure=least))[1].get_state()
        for least in (0.0, NEVER_SURE)
    ]
    for state in states:
        assert [event.alignment.reason for event in state["events"]] == ["too uncertain"]
    assert_same(*({"groups": state["groups"], "rng": state["rng"]} for state in states))


def test_a_pair_merges_by_the_motion_of_its_trial_when_two_agree() -> None:
    """The first trial waits; a later one is taken as it is: where the joint filter lets b start is what is reported."""
    simulation = SimulatedTeam(num_robots=2, seed=112)
    merging = MergeOptions(sure=NEVER_SURE, least_sure=1.0)
    team = simulation.build(attempts=AttemptOptions(every=20), num_particles=8, merging=merging)
    while len(team.groups) > 1 and team._step < 400:
        simulation.run(team, 1)
    *refused, last, merge = team.events
    assert [event.kind for event in (last, merge)] == ["attempt", "merge"]
    assert {event.alignment.missed for event in refused} <= {"paths", "repeat", ""}
    assert any(event.alignment.missed == "paths" for event in refused)
    assert merge.alignment is last.alignment
    joint = team._groups[0].trunk.filter
    starts = joint.state.starts[1, :, : joint.num_particles]
    np.testing.assert_allclose(merge.alignment.transform, mean_pose(starts), atol=1e-12)
