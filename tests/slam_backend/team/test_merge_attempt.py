"""Merge attempts: smoothing both maps before they are aligned again, and trial merges of uncertain pairs."""

import copy
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import contents
from builders.teams import IN_SLICES, NEVER, SimulatedTeam, check_snapshot, driven, false_alignment, large_maps, links

from slam_backend.fastslam import rejuvenation
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.fastslam.rejuvenation import RejuvenationScheduler
from slam_backend.geometry import between, compose
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, AlignmentOptions, align_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.smoother import rejuvenation as smoothing_of_paths
from slam_backend.smoother.graph import mean_pose
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team import group_merging, merge_attempt
from slam_backend.team.branches import restored_filter
from slam_backend.team.communication import LANDMARK_BYTES
from slam_backend.team.filter_merging.merging import merge_filters, pair_filters, transform_covariance
from slam_backend.team.group_merging import MergePlan, transform_uncertainty
from slam_backend.team.groups import Group
from slam_backend.team.merge_attempt import LEAST_STEPS, MOST_STEPS
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

STEPS = 80
AT_LAST = AttemptOptions(every=STEPS)  # the only attempt comes with the last step
AS_IT_IS = MergeOptions(smooth_first=False)


def team_with_deformed_maps(seed: int, attempts: AttemptOptions, **options: object) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots with few particles, whose maps are deformed, after `STEPS` steps."""
    return driven(2, seed, STEPS, attempts=attempts, num_particles=8, **options)


def both_maps(team: TeamSlam) -> tuple[LandmarkMap, LandmarkMap]:
    """Return the maps that an attempt compares."""
    return team.map(0, "mixture"), team.map(1, "mixture")


def smoothed(slam: FastSlam) -> FastSlam:
    """Return a copy with smoothed paths."""
    copied = restored_filter(slam.get_state())
    assert copied.rejuvenate().reason == ""
    return copied


def test_a_filter_that_never_rejuvenates_by_itself_can_be_rejuvenated() -> None:
    """It finds the same map as a filter that keeps a smoother, but for the initial estimate."""
    maps = []
    for every in (None, 1000):
        slam = team_with_deformed_maps(111, NEVER, rejuvenate_every=every)[1]._find(0)[0].filter
        before = slam.map()
        assert slam.rejuvenate().reason == ""
        assert (slam.state.rejuvenation is None) == (every is None)
        after = slam.map()
        moved = after.means[np.isin(after.ids, before.ids)] - before.means[np.isin(before.ids, after.ids)]
        assert np.abs(moved).max() > 0.01
        maps.append(after)
    assert_same(maps[0].ids, maps[1].ids)
    np.testing.assert_allclose(maps[0].means, maps[1].means, atol=1e-3)


def test_a_merge_uses_the_smoothed_maps() -> None:
    """What is merged, and by which motion, is what both filters are after a rejuvenation."""
    _, alone = team_with_deformed_maps(112, NEVER)
    _, team = team_with_deformed_maps(112, AT_LAST)
    sides = [smoothed(alone._find(robot)[0].filter) for robot in range(2)]
    rng = alone._rng
    unsmoothed = align_maps(*both_maps(alone), rng=rng)
    found = align_maps(sides[0].map("mixture"), sides[1].map("mixture"), rng=rng)
    assert [event.kind for event in team.events] == ["attempt", "merge"]
    assert_same(team.events[0].unsmoothed_alignment, unsmoothed)
    assert_same(team.events[1].alignment, found)
    assert_same(team.merged_maps(team.events[1]), tuple(side.map() for side in sides))
    watch = team._find(0)[0].monitors[0]
    for side, of_side, before in zip(watch.sides, sides, watch.pre_merge_maps, strict=True):
        assert_same(side.trunk["filter"]["poses"], of_side.get_state()["poses"])
        assert len(before) == len(of_side.map())


@pytest.mark.slow
def test_smoothed_maps_give_more_accurate_merges() -> None:
    """Over twelve pairs of deformed maps the error of the transforms is below 0.8 of that without smoothing."""
    errors = []
    for merging in (AS_IT_IS, MergeOptions()):
        found = []
        for seed in range(120, 132):
            simulation, team = team_with_deformed_maps(seed, AT_LAST, merging=merging)
            off = team.events[-1].alignment.transform - simulation.true_motion(0, 1)
            found.append(np.hypot(*off[:2]))
        errors.append(np.array(found))
    both = np.isfinite(errors[0]) & np.isfinite(errors[1])
    assert np.count_nonzero(both) >= 10
    assert np.sqrt(np.mean(errors[1][both] ** 2)) < 0.8 * np.sqrt(np.mean(errors[0][both] ** 2))


def test_maps_that_no_longer_fit_are_not_merged() -> None:
    """If only the unsmoothed maps can be aligned, the attempt is refused with the reason of the second alignment."""
    sigmas = []
    for merging in (AS_IT_IS, MergeOptions()):
        covariance = team_with_deformed_maps(113, AT_LAST, merging=merging)[1].events[-1].alignment.covariance
        sigmas.append(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    assert sigmas[0] < sigmas[1]
    strict = AlignmentOptions(max_sigma_position=float(np.mean(sigmas)))
    _, team = team_with_deformed_maps(113, AT_LAST, alignment=strict)
    event = team.events[0]
    assert (event.kind, event.alignment.reason) == ("attempt", "too uncertain")
    assert event.unsmoothed_alignment is not None
    assert event.unsmoothed_alignment.success
    assert len(team.events) == 1
    assert team.groups == ((0,), (1,))
    assert not team._schedule.may_try(((0,), (1,)), STEPS)


@pytest.mark.parametrize("every", [4, 2])
def test_maps_that_agree_less_after_smoothing_are_not_merged(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A diverged smoother is not trusted: the attempt is refused, and the filters are unchanged."""
    _, alone = team_with_deformed_maps(112, NEVER)
    original = merge_attempt.smoothed_maps

    def lost(a: Group, b: Group) -> tuple[LandmarkMap, LandmarkMap]:
        maps = original(a, b)
        assert maps is not None
        return maps[0].subset(np.flatnonzero(np.arange(len(maps[0])) % every)), maps[1]

    monkeypatch.setattr(merge_attempt, "smoothed_maps", lost)
    _, team = team_with_deformed_maps(112, AT_LAST)
    event = team.events[0]
    assert (len(team.events), event.alignment.reason) == (1, "too few inliers")
    assert event.unsmoothed_alignment is not None
    for robot in range(2):
        assert_same(contents(team._find(robot)[0].filter), contents(alone._find(robot)[0].filter))


def test_maps_with_exact_poses_are_merged_unsmoothed() -> None:
    """Poses that are given as exact leave nothing to smooth: the merge is that without `smooth_first`, bit for bit."""
    states = []
    for merging in (AS_IT_IS, MergeOptions()):
        simulation = SimulatedTeam(num_robots=2, seed=114)
        team = simulation.build(attempts=AT_LAST, num_particles=3, merging=merging)
        for _ in range(STEPS):
            odometry, frames = simulation.read()
            poses = [between(start, pose) for start, pose in zip(simulation.starts, simulation.poses, strict=True)]
            team.step(odometry, frames, poses=poses)
        assert len(team.groups) == 1
        assert team.events[0].unsmoothed_alignment is None
        states.append(team.get_state() | {"merging": None})
    assert_same(states[0], states[1])


def test_smoothed_maps_are_sent_again() -> None:
    """Both speakers send all their landmarks again, without descriptors."""
    sent = []
    for merging in (AS_IT_IS, MergeOptions()):
        _, team = team_with_deformed_maps(112, AT_LAST, merging=merging)
        sent.append(team.bytes_sent)
    again = [len(before) * LANDMARK_BYTES for before in team._find(0)[0].monitors[0].pre_merge_maps]
    assert (sent[1] - sent[0]).tolist() == again


def test_the_predicted_scatter_of_motions_is_that_of_the_merged_particles() -> None:
    """It is the scatter of the other robot's start over the joint filter's particles, known before the merge."""
    _, team = team_with_deformed_maps(112, NEVER)
    a, b = (team._find(robot)[0].filter for robot in range(2))
    alignment = align_maps(*both_maps(team), rng=np.random.default_rng(1))
    pairs = np.column_stack([a.map().ids[alignment.inliers[:, 0]], b.map().ids[alignment.inliers[:, 1]]])
    motion = pair_filters(a, b, alignment, pairs, np.random.default_rng(2)).motion
    foretold = transform_covariance(motion, alignment)
    joint, _ = merge_filters(a, b, alignment, pairs, np.random.default_rng(2))
    starts = joint.state.starts[1, :, : joint.num_particles].T
    np.testing.assert_allclose(foretold, np.cov(starts.T, bias=True), atol=1e-12)


def test_a_pair_too_uncertain_to_merge_waits_and_merges_later() -> None:
    """Where particles differ in the motion by more than is sure the attempt is refused, until waiting helps no more."""
    rhythm = AttemptOptions(every=20)
    _, team = team_with_deformed_maps(112, rhythm, merging=MergeOptions(min_sigmas=0.0))
    assert [event.kind for event in team.events] == ["attempt", "merge"]
    simulation, team = team_with_deformed_maps(112, rhythm, merging=MergeOptions(min_sigmas=1e4))  # 0.05 mm
    assert team.events[0].alignment.reason == "too uncertain"
    simulation.run(team, STEPS)
    *attempts, merge = team.events
    reasons = [event.alignment.reason for event in attempts]
    assert reasons.count("too uncertain") == len(reasons) - 1 >= 1
    assert reasons[-1] == ""
    assert merge.kind == "merge"
    assert len(team.groups) == 1


@pytest.mark.parametrize("how", [{}, {"merged_particles": 5}])
def test_checking_the_uncertainty_of_a_merge_changes_nothing(how: dict[str, Any]) -> None:
    """Whether particles agree is only looked at: the merge is bit for bit that of a team which does not ask."""
    states = [
        team_with_deformed_maps(112, AT_LAST, merging=MergeOptions(min_sigmas=sure, **how))[1].get_state()
        for sure in (0.0, 1e-6)
    ]
    assert_same(*({"filter": state["groups"], "rng": state["rng"]} for state in states))


def test_maps_of_an_unmonitored_merge_are_not_available() -> None:
    """Where merges are final, or nothing was merged, asking for the maps that were joined is refused."""
    _, team = team_with_deformed_maps(112, AT_LAST, merging=MergeOptions(watch_steps=0))
    for event in team.events:
        with pytest.raises(ValueError, match=r"merge: expected a merge still monitored, got 'the (attempt|merge) of"):
            team.merged_maps(event)


SOON = 40  # a few slices of each filter, every fourth step one


def attempt_begun(seed: int) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots in the step in which their maps, as their filters bent them, have just been found to fit."""
    smoothing = SmoothingOptions(slice_steps=20)
    simulation, team = driven(
        2, seed, STEPS, attempts=AT_LAST, num_particles=8, rejuvenate_every=1000, smoothing=smoothing
    )
    assert team._schedule.pending_attempt is not None
    assert team.events == ()
    return simulation, team


def test_an_attempt_continues_once_both_maps_are_smoothed() -> None:
    """In the step after the second filter has drawn new particles the maps align again, and merge by that."""
    simulation, team = attempt_begun(112)
    pending = team._schedule.pending_attempt
    assert pending is not None
    drawn: dict[int, int] = {}
    for step in range(STEPS, STEPS + SOON):
        rng = copy.deepcopy(team._rng)
        report = simulation.run(team, 1)[0]
        drawn |= {robot: step for robots, _ in report.rejuvenations for robot in robots if len(robots) == 1}
        if team.events:
            break
    attempt, merge = team.events
    assert [attempt.kind, merge.kind] == ["attempt", "merge"]
    assert attempt.step == merge.step == 1 + max(drawn.values())
    assert sorted(drawn) == [0, 1]
    assert_same(attempt.unsmoothed_alignment, pending.alignment)
    watch = team._find(0)[0].monitors[0]
    assert_same(align_maps(*watch.pre_merge_maps, rng=rng), merge.alignment)
    assert team._schedule.pending_attempt is None


def test_an_attempt_continues_from_a_snapshot() -> None:
    """A team restored between two slices does the same, bit for bit, as the one that went on."""
    simulation, team = attempt_begun(115)
    simulation.run(team, 1)
    check_snapshot(simulation, team, [None] * SOON)
    assert [event.kind for event in team.events] == ["attempt", "merge"]


@pytest.mark.parametrize("apart", [MOST_STEPS // 2, MOST_STEPS])
def test_an_attempt_survives_a_temporary_loss_of_contact(apart: int) -> None:
    """Maps are smoothed without contact, and aligned in the first step with it unless a time limit has passed."""
    simulation, team = attempt_begun(112)
    simulation.run(team, apart, links(2))
    assert team.events == ()
    assert (team._schedule.pending_attempt is None) == (apart == MOST_STEPS)
    simulation.run(team, 1)
    assert [event.kind for event in team.events] == ([] if apart == MOST_STEPS else ["attempt", "merge"])
    simulation.run(team, STEPS + SOON - apart)
    assert [event.kind for event in team.events] == ["attempt", "merge"]


def test_an_attempt_waits_for_smoothed_maps_for_a_bounded_time() -> None:
    """Filters without input are not smoothed: their maps are used as they are, and other robots do not wait."""
    _, team = attempt_begun(112)
    for _ in range(MOST_STEPS + 1):
        assert team.events == ()
        team.step([None, None], [None, None])
    attempt = team.events[0]
    assert attempt.step == STEPS - 1 + MOST_STEPS + 1
    assert attempt.unsmoothed_alignment is not None
    np.testing.assert_allclose(attempt.alignment.transform, attempt.unsmoothed_alignment.transform, atol=1e-9)


@pytest.mark.parametrize(("every", "slices"), [(None, 20), (1000, None)])
def test_only_a_smoother_that_works_in_slices_can_be_waited_for(every: int | None, slices: int | None) -> None:
    """Without one, or where it does all at once, the attempt is over in the step in which it is made."""
    simulation = SimulatedTeam(num_robots=2, seed=112)
    smoothing = SmoothingOptions(slice_steps=slices)
    team = simulation.build(attempts=AT_LAST, num_particles=8, rejuvenate_every=every, smoothing=smoothing)
    assert not team._find(0)[0].filter.smooths_incrementally
    simulation.run(team, STEPS)
    assert [event.step for event in team.events] == [STEPS - 1] * 2


@pytest.mark.parametrize(("most", "turns"), [(10**6, {0, 1}), (0, {0})])
def test_large_joint_graphs_are_smoothed_in_one_of_four_steps(
    most: int, turns: set[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A joint filter smooths in the turns of all its robots; with a large graph in that of the first alone."""
    monkeypatch.setattr(rejuvenation, "LARGE_GRAPH", most)
    smoothing = SmoothingOptions(slice_steps=20)
    simulation, team = driven(2, 112, STEPS, attempts=NEVER, num_particles=8, rejuvenate_every=20, smoothing=smoothing)
    team.merge(0, 1, align_maps(team.map(0, "mixture"), team.map(1, "mixture")))
    smoothed, run = [], RejuvenationScheduler.run

    def noted(self: RejuvenationScheduler, *args: Any) -> Any:
        smoothed.append(team._step % 4)
        return run(self, *args)

    monkeypatch.setattr(RejuvenationScheduler, "run", noted)
    simulation.run(team, SOON)
    assert len(smoothed) > 4
    assert set(smoothed) == turns


FEW_STEPS = 60
NEVER_SURE = 1e4  # deviations: 0.05 mm


def planned(team: TeamSlam) -> MergePlan:
    """Return the plan of a merge of both robots, with its particles paired."""
    first, second = team._groups
    found = align_maps(team.map(0, "mixture"), team.map(1, "mixture"))
    return MergePlan.of(first, second, found).with_pairing(MergeOptions(), np.random.default_rng(1))


def test_a_trial_leaves_both_filters_as_they_are() -> None:
    """It makes a joint filter of its own, and returns its motion and uncertainty."""
    _, team = driven(2, 112, FEW_STEPS, num_particles=8)
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


@pytest.mark.parametrize("existence", [None, ExistenceModel()])
def test_a_trial_is_a_merge_that_is_smoothed(existence: ExistenceModel | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Landmarks of the most probable particle suffice, and the memory that those of all take does not matter."""
    _, team = driven(2, 112, FEW_STEPS, num_particles=8, existence=existence)
    plan = planned(team)
    joints, mixtures = [], []
    for part, unused in ((10**6, ParticleMaps(8)), (7, copy.deepcopy(plan.filters[0].state.maps))):
        monkeypatch.setattr(rejuvenation, "PART", part)
        trial = plan.on_trial(MergeOptions(), AlignmentOptions(), np.random.default_rng(2))
        assert trial is not None
        assert trial[0].joint is not None
        joint = trial[0].joint[0]
        assert joint.state.maps.num_particles == 1
        mixtures.append(joint.map("mixture"))
        joint.state.write_landmarks(unused)
        joint.state.write_landmarks(ParticleMaps(8))  # nothing is left to be written
        mixtures.append(joint.map("mixture"))
        joints.append(contents(joint))
    assert len(mixtures[0]) > 14
    for mixture in mixtures[1:]:
        for name in ("means", "covariances", "descriptors", "counts", "ids"):
            assert_same(getattr(mixture, name), getattr(mixtures[0], name))
    whole, _ = merge_filters(
        *plan.filters, plan.alignment, plan.pairs, np.random.default_rng(2), None, pairing=plan.pairing
    )
    assert not whole.rejuvenate().reason
    for joint in joints:
        assert_same(joint, contents(whole))


@pytest.mark.parametrize("slice_steps", [None, 90])
def test_trials_of_large_maps_claim_no_more_than_the_gaussian_at_the_mode(
    slice_steps: int | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their covariance is the larger one, for joined keyframes times 1.3 squared; the motion is that of small maps.

    For what is joined after 6,000 steps, which is widened, it is times 0.8 squared.
    """
    monkeypatch.setattr(smoothing_of_paths, "LONG_RUN", 0)
    smoothing = SmoothingOptions(slice_steps=slice_steps)
    options: Any = {"attempts": NEVER, "rejuvenate_every": 1000, "smoothing": smoothing}
    trials = []
    for particles in (2, 400):
        plan = planned(driven(2, 112, FEW_STEPS, num_particles=particles, **options)[1])
        for most in (10**6, 0):
            monkeypatch.setattr(smoothing_of_paths, "LARGE_MAP", most)
            trial = plan.on_trial(MergeOptions(), AlignmentOptions(), np.random.default_rng(2))
            assert trial is not None
            trials.append(trial)
    for (small, _), (large, _) in (trials[:2], trials[2:]):
        assert small.joint is not None
        assert large.joint is not None
        of_small, of_large = (plan.joint[0].state.rejuvenation for plan in (small, large))
        assert of_small.starts_at_mode is None  # as in a short run
        np.testing.assert_array_equal(of_large.starts_at_mode[0], 0.0)  # the first robot defines the frame
        np.testing.assert_array_equal(large.alignment.transform, small.alignment.transform)
    scatter = trials[2][0].alignment.covariance
    at_mode = trials[3][0].joint[0].state.rejuvenation.starts_at_mode[1]  # type: ignore[index,union-attr]
    np.testing.assert_allclose(np.diag(scatter), np.diag(at_mode), rtol=0.3)  # nearly all 400 samples carry weight
    for small, large in zip(trials[::2], trials[1::2], strict=True):
        assert large[1] >= 1.3 * small[1]
    for factor, steps, expected in (
        (0.5, 6000, 1.3**2),
        (2.0, 6000, 2.0 * 1.3**2),
        (0.5, 12_000, (1.3**2 + 0.8**2) / 2),
    ):
        at_mode = np.stack([np.zeros((3, 3)), factor * scatter])
        smoother = SimpleNamespace(starts_at_mode=at_mode, graph=SimpleNamespace(latest=np.array([steps, steps])))
        joint: Any = SimpleNamespace(state=SimpleNamespace(rejuvenation=smoother))
        np.testing.assert_allclose(group_merging._cautious(scatter, joint, 1), expected * scatter)
    assert group_merging._variance_factor(np.full(8, 24_000)) == pytest.approx(0.25 * 1.3**2 + 0.75 * 0.8**2)


def test_the_joint_graph_claims_hardly_more_than_a_trial(monkeypatch: pytest.MonkeyPatch) -> None:
    """In large maps it finds the motion and its covariance at the mode, to which a trial adds the last few steps."""
    _, team = driven(2, 112, FEW_STEPS, **IN_SLICES)
    plan = planned(team)
    assert plan.by_graphs() is None
    large_maps(monkeypatch)
    for slam in plan.filters:
        slam.rejuvenate()  # as an attempt does
    before = [contents(slam) for slam in plan.filters]
    claimed = plan.by_graphs()
    assert claimed is not None
    for slam, kept in zip(plan.filters, before, strict=True):
        assert_same(contents(slam), kept)
    trial = plan.on_trial(MergeOptions(), AlignmentOptions(), np.random.default_rng(2))
    assert trial is not None
    sigmas = np.sqrt(np.diag(trial[0].alignment.covariance))
    assert (np.abs(claimed[0].alignment.transform - trial[0].alignment.transform) < 2.0 * sigmas).all()
    assert 0.5 * trial[1] < claimed[1] < 1.1 * trial[1]
    assert_same(claimed[0].alignment.inliers, plan.alignment.inliers)
    _, alone = driven(2, 112, FEW_STEPS, num_particles=8)
    assert planned(alone).by_graphs() is None  # without smoothers there are no graphs


@pytest.mark.parametrize("is_large", [False, True])
def test_attempts_of_large_maps_end_without_a_trial_if_their_graph_is_uncertain(
    is_large: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """They are refused as by a trial, no earlier than ten steps after they began; groups stay as they were."""
    tried = []
    on_trial = MergePlan.on_trial

    def noted(self: MergePlan, *args: Any) -> Any:
        tried.append(self)
        return on_trial(self, *args)

    monkeypatch.setattr(MergePlan, "on_trial", noted)
    if is_large:
        large_maps(monkeypatch)
    merging = MergeOptions(min_sigmas=NEVER_SURE, min_sigmas_on_trial=NEVER_SURE)
    simulation, team = driven(2, 112, STEPS, attempts=AT_LAST, merging=merging, **IN_SLICES)
    begun = team._step - 1
    while not team.events:
        simulation.run(team, 1)
    (attempt,) = team.events
    assert (attempt.alignment.reason, attempt.alignment.missed) == ("too uncertain", "paths")
    assert np.isfinite(attempt.uncertainty)
    assert attempt.uncertainty > 1.0
    assert bool(tried) != is_large
    if is_large:
        assert attempt.step - begun >= LEAST_STEPS


def test_groups_with_large_maps_merge_by_a_trial_once_their_graph_agrees_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    """The first estimate of the joint graph waits for a second one; then a merge is prepared, which a trial decides."""
    large_maps(monkeypatch)
    simulation = SimulatedTeam(num_robots=2, seed=112)
    merging = MergeOptions(min_sigmas=NEVER_SURE, min_sigmas_on_trial=1.0)
    team = simulation.build(attempts=AttemptOptions(every=20), merging=merging, **IN_SLICES)
    while len(team.groups) > 1 and team._step < 400:
        simulation.run(team, 1)
    *refused, last, merge = team.events
    assert [event.kind for event in (last, merge)] == ["attempt", "merge"]
    assert {event.alignment.missed for event in refused} <= {"paths", "repeat", ""}
    assert merge.alignment is last.alignment
    watch = team._groups[0].trunk.monitors[0]
    rows = merge.alignment.inliers
    for side in (0, 1):
        assert rows[:, side].max() < len(watch.pre_merge_maps[side])
    motion = mean_pose(team._groups[0].trunk.filter.state.starts[1, :, :8])
    np.testing.assert_allclose(merge.alignment.transform, motion, atol=0.2)  # of the trial, some steps ago


def test_a_trial_whose_merge_would_be_undone_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """If more landmarks are deformed than a merge may deform, the uncertainty is infinite."""
    _, team = driven(2, 112, FEW_STEPS, num_particles=8)
    plan = planned(team)
    for share, bounded in ((0.2, True), (0.21, False)):
        monkeypatch.setattr(group_merging, "deformed_fraction", lambda *_, share=share: share)
        trial = plan.on_trial(MergeOptions(), AlignmentOptions(), np.random.default_rng(2))
        assert trial is not None
        assert np.isfinite(trial[1]) == bounded


def test_a_refused_trial_changes_nothing() -> None:
    """Groups and random streams are bit for bit those of a team that makes no trials."""
    at_last = AttemptOptions(every=FEW_STEPS)
    states = [
        driven(
            2,
            112,
            FEW_STEPS,
            attempts=at_last,
            num_particles=8,
            merging=MergeOptions(min_sigmas=NEVER_SURE, min_sigmas_on_trial=least),
        )[1].get_state()
        for least in (0.0, NEVER_SURE)
    ]
    for state in states:
        assert [event.alignment.reason for event in state["events"]] == ["too uncertain"]
    assert_same(*({"groups": state["groups"], "rng": state["rng"]} for state in states))


def test_a_pair_merges_by_the_motion_of_its_trial_when_two_agree() -> None:
    """The first trial waits; a later one is taken as it is: where the joint filter lets b start is what is reported."""
    simulation = SimulatedTeam(num_robots=2, seed=112)
    merging = MergeOptions(min_sigmas=NEVER_SURE, min_sigmas_on_trial=1.0)
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


def test_the_uncertainty_of_a_trial_includes_the_gauge_covariance() -> None:
    """It is that of the motion between the groups' starts: of the particles, and of samples of both gauges."""
    simulation, team = driven(2, 3, 60, num_particles=13)
    alignment = false_alignment(simulation, team, np.zeros(3))
    a, b = (group.trunk.filter for group in team._groups)
    plan = MergePlan.of(*team._groups, alignment).with_pairing(MergeOptions(), team._rng)
    assert plan.pairing is not None
    covariance = transform_covariance(plan.pairing.motion, alignment)
    before = transform_uncertainty(plan)

    rng = np.random.default_rng(0)
    frames = [np.diag([3e-2, 1e-2, 9e-3]), np.diag([1e-2, 5e-2, 4e-3])]
    moved_a, moved_b = (rng.multivariate_normal(np.zeros(3), frame, size=100_000) for frame in frames)
    covariance += np.cov(compose(compose(moved_a, alignment.transform), moved_b).T)
    position, heading = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), math.sqrt(covariance[2, 2])

    for slam, frame in zip((a, b), frames, strict=True):
        slam.state.gauge_covariance[:] = frame
    after = transform_uncertainty(plan)
    np.testing.assert_allclose(after, max(position / DISTINCT_TRANSLATION, heading / DISTINCT_ROTATION), rtol=0.03)
    assert after > 1.5 * before
