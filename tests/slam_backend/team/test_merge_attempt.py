"""Merge attempts: smoothing both maps before they are aligned again, and how certain their motion must be."""

import copy
import math
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import contents
from builders.teams import NEVER, SimulatedTeam, check_snapshot, driven, false_alignment, links

from slam_backend.fastslam._kernels import add_gauge_covariance
from slam_backend.fastslam.rejuvenation import RejuvenationScheduler
from slam_backend.geometry import between, compose, rotate_covariances
from slam_backend.maps.alignment import DISTINCT_ROTATION, DISTINCT_TRANSLATION, AlignmentOptions, align_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team import merge
from slam_backend.team.communication import LANDMARK_BYTES
from slam_backend.team.filter_merging.merging import merge_filters, pair_filters, transform_covariance
from slam_backend.team.group_merging import MergePlan, relative_uncertainty, transform_uncertainty
from slam_backend.team.merge import MAX_SMOOTHING_STEPS as MOST_STEPS
from slam_backend.team.merge import Smoothing
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

STEPS = 80
AT_LAST = AttemptOptions(every=STEPS)  # the only attempt comes with the last step
AS_IT_IS = MergeOptions(smooth_first=False)
ANYHOW = MergeOptions(min_sigmas=0.0)  # maps alone decide
SOON = 40  # a few slices of each filter, every fourth step one


def team_with_deformed_maps(seed: int, attempts: AttemptOptions, **options: object) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots with few particles, whose maps are deformed, after `STEPS` steps."""
    return driven(2, seed, STEPS, attempts=attempts, num_particles=8, **options)


def both_maps(team: TeamSlam) -> tuple[LandmarkMap, LandmarkMap]:
    """Return the maps that an attempt compares."""
    return team.map(0, "mixture"), team.map(1, "mixture")


def attempt_begun(seed: int, incremental: bool, **options: Any) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots in the step in which their maps, as their filters bent them, have just been found to fit."""
    smoothing = SmoothingOptions(incremental=incremental)
    known = {"attempts": AT_LAST, "rejuvenate_every": 1000, "smoothing": smoothing} | options
    simulation, team = team_with_deformed_maps(seed, **known)
    assert team._merges.attempt is not None
    assert team.events == ()
    return simulation, team


def attempt_ended(seed: int, incremental: bool = False, **options: Any) -> tuple[SimulatedTeam, TeamSlam]:
    """Return the same two robots in the step in which the attempt ends."""
    simulation, team = attempt_begun(seed, incremental, **options)
    while not team.events:
        assert team._step < STEPS + SOON
        simulation.run(team, 1)
    return simulation, team


def attempts_made(seed: int, incremental: bool, merging: MergeOptions) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots that try every 20 steps, after `STEPS` steps."""
    smoothing = SmoothingOptions(incremental=incremental)
    return team_with_deformed_maps(
        seed, AttemptOptions(every=20), rejuvenate_every=1000, smoothing=smoothing, merging=merging
    )


WAYS = pytest.mark.parametrize("incremental", [False, True])


def test_a_filter_that_never_rejuvenates_by_itself_can_be_rejuvenated() -> None:
    """It finds the same map as a filter that keeps a smoother, but for the initial estimate."""
    maps = []
    for every in (None, 1000):
        slam = team_with_deformed_maps(111, NEVER, rejuvenate_every=every)[1]._find(0)[0].filter
        before = slam.map()
        assert slam.rejuvenate().reason == ""
        assert (slam.rejuvenation is None) == (every is None)
        after = slam.map()
        moved = after.means[np.isin(after.ids, before.ids)] - before.means[np.isin(before.ids, after.ids)]
        assert np.abs(moved).max() > 0.01
        maps.append(after)
    assert_same(maps[0].ids, maps[1].ids)
    np.testing.assert_allclose(maps[0].means, maps[1].means, atol=1e-3)


@WAYS
def test_an_attempt_continues_once_both_maps_are_smoothed(incremental: bool) -> None:
    """In the step after the second filter has drawn new particles the maps align again, and merge by that."""
    simulation, team = attempt_begun(112, incremental, merging=ANYHOW)
    assert team._merges.attempt is not None
    smoothing = team._merges.attempt.phase
    assert isinstance(smoothing, Smoothing)
    drawn: dict[int, int] = {}
    for step in range(STEPS, STEPS + SOON):
        rng, filters = copy.deepcopy(team._merges.rng), [team._find(robot)[0].filter for robot in range(2)]
        report = simulation.run(team, 1)[0]
        drawn |= {robot: step for robots, _ in report.rejuvenations for robot in robots if len(robots) == 1}
        if team.events:
            break
    attempt, merge = team.events
    assert [attempt.kind, merge.kind] == ["attempt", "merge"]
    assert attempt.step == merge.step == 1 + max(drawn.values())
    assert sorted(drawn) == [0, 1]
    assert_same(attempt.unsmoothed_alignment, smoothing.unsmoothed)
    watch = team._find(0)[0].monitors[0]
    assert_same(align_maps(*watch.pre_merge_maps, rng=rng), merge.alignment)
    assert_same(team.merged_maps(merge), tuple(slam.map() for slam in filters))
    assert team._merges.attempt is None


@pytest.mark.slow
def test_smoothed_maps_give_more_accurate_merges() -> None:
    """Over twelve pairs of deformed maps the error of the transforms is below 0.8 of that without smoothing."""
    errors: list[list[float]] = [[], []]
    for seed in range(120, 132):
        unsmoothed = team_with_deformed_maps(seed, AT_LAST, merging=MergeOptions(smooth_first=False, min_sigmas=0.0))
        for (simulation, team), found in zip((unsmoothed, attempt_ended(seed, merging=ANYHOW)), errors, strict=True):
            off = team.events[-1].alignment.transform - simulation.true_motion(0, 1)
            found.append(float(np.hypot(*off[:2])))
    plain, smoothed = np.array(errors)
    both = np.isfinite(plain) & np.isfinite(smoothed)
    assert np.count_nonzero(both) >= 10
    assert np.sqrt(np.mean(smoothed[both] ** 2)) < 0.8 * np.sqrt(np.mean(plain[both] ** 2))


def test_maps_that_no_longer_fit_are_not_merged() -> None:
    """If only the unsmoothed maps can be aligned, the attempt is refused with the reason of the second alignment."""
    sigmas = []
    (attempt, _) = attempt_ended(113, merging=ANYHOW)[1].events
    assert attempt.unsmoothed_alignment is not None
    for found in (attempt.unsmoothed_alignment, attempt.alignment):
        sigmas.append(np.sqrt(np.linalg.eigvalsh(found.covariance[:2, :2])[-1]))
    assert sigmas[0] < sigmas[1]
    strict = AlignmentOptions(max_sigma_position=float(np.mean(sigmas)))
    _, team = attempt_ended(113, alignment=strict)
    (event,) = team.events
    assert (event.kind, event.alignment.reason) == ("attempt", "too uncertain")
    assert event.unsmoothed_alignment is not None
    assert event.unsmoothed_alignment.success
    assert np.isnan(event.uncertainty)
    assert team.groups == ((0,), (1,))
    assert not team._merges.schedule.may_try(((0,), (1,)), event.step + 1)


@pytest.mark.parametrize("every", [4, 2])
def test_maps_that_agree_less_after_smoothing_are_not_merged(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A diverged smoother is not trusted: the attempt is refused."""
    original = merge.mixture_maps

    def lost(pair: Any) -> tuple[LandmarkMap, LandmarkMap]:
        maps = original(pair)
        return maps[0].subset(np.flatnonzero(np.arange(len(maps[0])) % every)), maps[1]

    monkeypatch.setattr(merge, "mixture_maps", lost)
    _, team = attempt_ended(112)
    (event,) = team.events
    assert event.alignment.reason == "too few inliers"
    assert event.unsmoothed_alignment is not None
    assert len(team.groups) == 2


@pytest.mark.parametrize("every", [None, 1000])
def test_maps_with_exact_poses_are_merged_unsmoothed(every: int | None) -> None:
    """Poses that are given as exact leave nothing to smooth: the merge is that without `smooth_first`, bit for bit."""
    states = []
    for merging in (AS_IT_IS, MergeOptions()):
        simulation = SimulatedTeam(num_robots=2, seed=114)
        team = simulation.build(attempts=AT_LAST, num_particles=3, merging=merging, rejuvenate_every=every)
        for _ in range(STEPS):
            odometry, frames = simulation.read()
            poses = [between(start, pose) for start, pose in zip(simulation.starts, simulation.poses, strict=True)]
            team.step(odometry, frames, poses=poses)
        assert len(team.groups) == 1
        assert team.events[0].unsmoothed_alignment is None
        states.append(team.get_state()["merges"] | {"merging": None})
    assert_same(states[0], states[1])


def test_smoothed_maps_are_sent_again() -> None:
    """Both speakers send all their landmarks again, without descriptors, in the step of the second alignment."""
    simulation, team = attempt_begun(112, False)
    while not team.events:
        before = team.bytes_sent
        simulation.run(team, 1)
    again = [len(one) * LANDMARK_BYTES for one in team._find(0)[0].monitors[0].pre_merge_maps]
    assert (team.bytes_sent - before).tolist() == again


def test_the_predicted_scatter_of_motions_is_that_of_the_merged_particles() -> None:
    """It is the scatter of the other robot's start over the joint filter's particles, known before the merge."""
    _, team = team_with_deformed_maps(112, NEVER)
    a, b = (team._find(robot)[0].filter for robot in range(2))
    alignment = align_maps(*both_maps(team), rng=np.random.default_rng(1))
    pairs = np.column_stack([a.map().ids[alignment.inliers[:, 0]], b.map().ids[alignment.inliers[:, 1]]])
    motion = pair_filters(a, b, alignment, pairs, np.random.default_rng(2)).motion
    foretold = transform_covariance(motion, alignment)
    joint, _ = merge_filters(a, b, alignment, pairs, np.random.default_rng(2))
    starts = joint.starts[1, :, : joint.num_particles].T
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
        team_with_deformed_maps(112, AT_LAST, merging=MergeOptions(min_sigmas=sure, **how))[1].get_state()["merges"]
        for sure in (0.0, 1e-6)
    ]
    assert_same(*({"groups": state["groups"], "rng": state["rng"]} for state in states))


def test_maps_of_an_unmonitored_merge_are_not_available() -> None:
    """Where merges are final, or nothing was merged, asking for the maps that were joined is refused."""
    _, team = team_with_deformed_maps(112, AT_LAST, merging=MergeOptions(watch_steps=0))
    for event in team.events:
        with pytest.raises(ValueError, match=r"merge: expected a merge still monitored, got 'the (attempt|merge) of"):
            team.merged_maps(event)


@WAYS
def test_an_attempt_continues_from_a_snapshot(incremental: bool) -> None:
    """A team restored while an attempt waits does the same, bit for bit, as the one that went on, and merges."""
    simulation, team = attempt_begun(115, incremental)
    simulation.run(team, 1)
    assert team._merges.attempt is not None
    check_snapshot(simulation, team, [None] * SOON)
    assert [event.kind for event in team.events] == ["attempt", "merge"]


@WAYS
@pytest.mark.parametrize("apart", [MOST_STEPS // 2, MOST_STEPS])
def test_an_attempt_survives_a_temporary_loss_of_contact(apart: int, incremental: bool) -> None:
    """Maps are smoothed without contact, and aligned in the first step with it unless a time limit has passed."""
    simulation, team = attempt_begun(112, incremental)
    simulation.run(team, apart, links(2))
    assert team.events == ()
    assert (team._merges.attempt is None) == (apart == MOST_STEPS)
    simulation.run(team, 1)
    assert [event.kind for event in team.events] == ([] if apart == MOST_STEPS else ["attempt", "merge"])
    simulation.run(team, STEPS + SOON - apart)
    assert [event.kind for event in team.events] == ["attempt", "merge"]


@WAYS
def test_an_attempt_waits_for_smoothed_maps_for_a_bounded_time(incremental: bool) -> None:
    """Filters without input are not smoothed: their maps are used as they are, and other robots do not wait."""
    _, team = attempt_begun(112, incremental, merging=ANYHOW)
    for _ in range(MOST_STEPS + 1):
        assert team.events == ()
        team.step([None, None], [None, None])
    attempt = team.events[0]
    assert attempt.step == STEPS - 1 + MOST_STEPS + 1
    assert attempt.unsmoothed_alignment is not None
    np.testing.assert_allclose(attempt.alignment.transform, attempt.unsmoothed_alignment.transform, atol=1e-9)


@pytest.mark.parametrize(
    ("every", "merging"), [(None, MergeOptions()), (1000, MergeOptions(smooth_first=False))], ids=["none", "unasked"]
)
def test_without_a_smoother_an_attempt_does_not_wait(every: int | None, merging: MergeOptions) -> None:
    """Where nothing is to be smoothed, the attempt is over in the step in which it is made."""
    _, team = team_with_deformed_maps(112, AT_LAST, rejuvenate_every=every, merging=merging)
    assert [event.step for event in team.events] == [STEPS - 1] * 2
    assert team.events[0].unsmoothed_alignment is None


def test_joint_filters_smooth_in_the_turns_of_all_their_robots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of four steps each robot has one, in which its filter does a slice; a joint filter has those of all of them."""
    smoothing = SmoothingOptions(incremental=True, slice_share=0.01)
    simulation, team = driven(2, 112, STEPS, attempts=NEVER, num_particles=8, rejuvenate_every=20, smoothing=smoothing)
    smoothed, run = [], RejuvenationScheduler.run

    def noted(self: RejuvenationScheduler, *args: Any) -> Any:
        smoothed.append((self._num_robots, team._step % 4))
        return run(self, *args)

    monkeypatch.setattr(RejuvenationScheduler, "run", noted)
    simulation.run(team, SOON)
    assert set(smoothed) == {(1, 0), (1, 1)}
    smoothed.clear()
    team.merge(0, 1, align_maps(*both_maps(team)))
    simulation.run(team, SOON)
    assert len(smoothed) > 4
    assert set(smoothed) == {(2, 0), (2, 1)}


FEW_STEPS = 60
NEVER_SURE = 1e4  # deviations: 0.05 mm


def planned(team: TeamSlam) -> MergePlan:
    """Return the plan of a merge of both robots."""
    first, second = team._groups
    return MergePlan.of(first, second, align_maps(*both_maps(team)))


def smoothed_pair(**options: Any) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots whose filters have just been smoothed, as an attempt does."""
    known = {"attempts": NEVER, "num_particles": 100, "rejuvenate_every": 1000} | options
    simulation, team = driven(2, 112, FEW_STEPS, **known)
    for robot in range(2):
        assert not team._find(robot)[0].filter.rejuvenate().reason
    return simulation, team


@WAYS
def test_the_joint_graph_tells_the_motion_and_its_uncertainty(incremental: bool) -> None:
    """They are those of the joint filter after the merge, once it is smoothed; nothing is drawn, no filter changes."""
    _, team = smoothed_pair(smoothing=SmoothingOptions(incremental=incremental))
    plan = planned(team)
    before = [contents(slam) for slam in plan.filters]
    start = plan.relative_start()
    assert start is not None
    found, uncertainty = plan.with_motion(start), relative_uncertainty(start.covariance)
    for slam, kept in zip(plan.filters, before, strict=True):
        assert_same(contents(slam), kept)
    assert_same(found.alignment.inliers, plan.alignment.inliers)
    covariance = found.alignment.covariance
    position, heading = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), math.sqrt(covariance[2, 2])
    assert uncertainty == pytest.approx(max(position / DISTINCT_TRANSLATION, heading / DISTINCT_ROTATION))
    joint, _ = merge_filters(*plan.filters, found.alignment, found.pairs, np.random.default_rng(2))
    assert not joint.rejuvenate().reason
    off = between(joint.start_pose(1), found.alignment.transform)
    assert off @ np.linalg.solve(covariance, off) < 1.0
    pose = joint.start_pose(1)
    claimed = rotate_covariances(pose[2], joint.start_covariances[1])
    add_gauge_covariance(joint.gauge_covariance, pose[None], claimed[None])
    np.testing.assert_allclose(np.diag(claimed), np.diag(covariance), rtol=0.5)


def test_without_smoothed_graphs_there_is_no_motion_of_a_joint_graph() -> None:
    """A filter without a smoother, or one that has not worked yet, has no graph; so has one with exact poses."""
    _, smoothed = smoothed_pair()
    exact = smoothed._find(1)[0].filter
    exact.step([None], [None], poses=[exact.pose().mean])
    teams = [driven(2, 112, FEW_STEPS, num_particles=8, rejuvenate_every=every)[1] for every in (None, 1000)]
    for team in (*teams, smoothed):
        assert planned(team).relative_start() is None


def test_a_refused_attempt_draws_nothing_for_the_merge() -> None:
    """The random stream is that of the alignments alone, with paired particles, too; groups are those of before."""
    _, alone = team_with_deformed_maps(112, NEVER)
    _, team = team_with_deformed_maps(112, AT_LAST, merging=MergeOptions(min_sigmas=NEVER_SURE))
    assert [event.alignment.missed for event in team.events] == ["paths"]
    align_maps(*both_maps(alone), rng=alone._merges.rng)
    assert_same(team._merges.rng.bit_generator.state, alone._merges.rng.bit_generator.state)
    for robot in range(2):
        assert_same(*(contents(each._find(robot)[0].filter) for each in (team, alone)))


@WAYS
def test_an_uncertain_pair_merges_where_waiting_does_not_help(incremental: bool) -> None:
    """Above 1 the first attempt waits for a second one; the merge then begins from the alignment of the maps."""
    simulation, team = attempts_made(112, incremental, MergeOptions(min_sigmas=NEVER_SURE))
    while len(team.groups) > 1 and team._step < 400:
        rng = copy.deepcopy(team._merges.rng)
        simulation.run(team, 1)
    *refused, last, merge = team.events
    assert [event.kind for event in (last, merge)] == ["attempt", "merge"]
    assert len(refused) >= 1
    assert {event.alignment.missed for event in refused} <= {"paths", ""}
    assert last.uncertainty > 1.0
    assert merge.alignment is last.alignment
    assert_same(align_maps(*team._groups[0].trunk.monitors[0].pre_merge_maps, rng=rng), merge.alignment)


@WAYS
def test_a_certain_pair_merges_by_its_first_motion(incremental: bool) -> None:
    """Up to an uncertainty of 1 no second motion is waited for."""
    _, team = attempt_ended(112, incremental)
    attempt, merge = team.events
    assert (attempt.kind, merge.kind) == ("attempt", "merge")
    assert 0.0 < attempt.uncertainty <= 1.0


def test_the_uncertainty_of_paired_particles_includes_the_gauge_covariance() -> None:
    """It is that of the motion between the groups' starts: of the particles, and of samples of both gauges."""
    simulation, team = driven(2, 3, 60, num_particles=13)
    alignment = false_alignment(simulation, team, np.zeros(3))
    a, b = (group.trunk.filter for group in team._groups)
    plan = MergePlan.of(*team._groups, alignment)
    pairing = plan.pair_particles(MergeOptions(), np.random.default_rng(1))
    covariance = transform_covariance(pairing.motion, alignment)
    before = transform_uncertainty(plan, pairing)

    rng = np.random.default_rng(0)
    frames = [np.diag([3e-2, 1e-2, 9e-3]), np.diag([1e-2, 5e-2, 4e-3])]
    moved_a, moved_b = (rng.multivariate_normal(np.zeros(3), frame, size=100_000) for frame in frames)
    covariance += np.cov(compose(compose(moved_a, alignment.transform), moved_b).T)
    position, heading = math.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]), math.sqrt(covariance[2, 2])

    for slam, frame in zip((a, b), frames, strict=True):
        slam.gauge_covariance[:] = frame
    after = transform_uncertainty(plan, pairing)
    np.testing.assert_allclose(after, max(position / DISTINCT_TRANSLATION, heading / DISTINCT_ROTATION), rtol=0.03)
    assert after > 1.5 * before
