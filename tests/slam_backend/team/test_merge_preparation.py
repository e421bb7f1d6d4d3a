"""Merges of large maps are prepared beside the groups, and change nothing but the step in which they happen."""

import copy
import math
import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import contents
from builders.teams import IN_SLICES, SimulatedTeam, check_snapshot, large_maps, links, true_alignment

from slam_backend.fastslam import rejuvenation
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.particle_maps import ParticleMaps
from slam_backend.fastslam.rejuvenation import RejuvenationScheduler
from slam_backend.fastslam.reports import LandmarkIdMap, LandmarksCreated, MapReleased, RejuvenationReport, TeamReport
from slam_backend.fastslam.state import FilterState
from slam_backend.fastslam.step_input import InputBuffer
from slam_backend.geometry import between, transform_points
from slam_backend.maps.alignment import Alignment
from slam_backend.team import merge_preparation
from slam_backend.team import team as team_module
from slam_backend.team.branches import Branch, replay
from slam_backend.team.groups import Group
from slam_backend.team.merge_preparation import FIRST_WAIT, PATIENCE, MergePreparation
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

MERGING = MergeOptions(min_sigmas=5.0, min_sigmas_on_trial=0.05)
MOST = 400  # steps until two robots surely have merged


@pytest.fixture(autouse=True)
def _all_maps_are_large(monkeypatch: pytest.MonkeyPatch) -> None:
    large_maps(monkeypatch)
    monkeypatch.setattr(rejuvenation, "PIECE", 7)  # so that landmarks are written in several parts


def begun(seed: int = 112, num_robots: int = 2) -> tuple[SimulatedTeam, TeamSlam]:
    """Return robots in the step in which the preparation of a merge begins."""
    simulation = SimulatedTeam(num_robots, seed)
    team = simulation.build(attempts=AttemptOptions(every=20), merging=MERGING, **IN_SLICES)
    while team._preparation is None:
        assert team._step < MOST
        simulation.run(team, 1)
    return simulation, team


def run_until_over(simulation: SimulatedTeam, team: TeamSlam) -> list[TeamReport]:
    """Drive until the preparation is over."""
    reports: list[TeamReport] = []
    while team._preparation is not None:
        assert len(reports) < MOST
        reports += simulation.run(team, 1)
    return reports


def kinds(reports: list[TeamReport]) -> list[str]:
    """Return the kinds of all events."""
    return [event.kind for report in reports for event in report.events]


def pieces(patch: pytest.MonkeyPatch) -> list[int]:
    """Return a list to which each piece of the work of preparations adds 1."""
    done, work = [], MergePreparation._trial

    def counted(self: MergePreparation, *args: Any) -> Iterator[None]:
        for _ in work(self, *args):
            done.append(1)
            yield

    patch.setattr(MergePreparation, "_trial", counted)
    return done


def test_the_joint_filter_is_that_of_a_merge_that_replays_the_inputs_since(monkeypatch: pytest.MonkeyPatch) -> None:
    """Smoothed, written and replayed a little in each step, it equals one for which all is done at once."""
    made: list[tuple[FastSlam, Branch]] = []
    join = MergePreparation._join

    def noted(self: MergePreparation, *args: Any) -> None:
        join(self, *args)
        assert self.joint is not None
        made.append((copy.deepcopy(self.joint.filter), copy.copy(self.joint)))

    monkeypatch.setattr(MergePreparation, "_join", noted)
    done = pieces(monkeypatch)
    simulation, team = begun()
    log, record = InputBuffer(), team._records.log.record

    def both(step: int, inputs: Any) -> None:
        log.record(step, inputs)
        record(step, inputs)

    monkeypatch.setattr(team._records.log, "record", both)
    reports = run_until_over(simulation, team)
    assert kinds(reports) == ["attempt", "merge"]
    assert len(reports) > FIRST_WAIT + 4 * len(done) > FIRST_WAIT + 40
    ((joint, branch),) = made
    assert not joint.rejuvenate().reason
    joint.state.write_landmarks(ParticleMaps(8))
    branch.filter, branch.last_steps = joint, dict.fromkeys((0, 1), team._step - len(reports) + FIRST_WAIT - 1)
    replay(branch, log, dict.fromkeys((0, 1), team._step - 1), None)
    assert_same(contents(branch.filter), contents(team._groups[0].trunk.filter))
    assert team._groups[0].trunk.last_steps == dict.fromkeys((0, 1), team._step - 1)


@pytest.mark.parametrize("most", [merge_preparation.MOST_PAIRS, 8])
def test_a_merge_that_was_prepared_is_right_and_watched(most: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its motion is right, its inliers are rows of the maps just before it, and later landmarks are noticed.

    All common landmarks are joined, even if only some of them pair the particles.
    """
    common: list[tuple[int, int]] = []
    join = MergePreparation._join

    def noted(self: MergePreparation, pair: tuple[Group, Group], *args: Any) -> None:
        ids = [self.maps[i].ids[self.alignment.inliers[:, i]] for i in range(2)]
        held = [np.isin(ids[i], pair[i].trunk.filter.state.maps.ids) for i in range(2)]
        join(self, pair, *args)
        assert self.renamed is not None
        joined = np.count_nonzero(self.renamed[:, 1] < self.end_of_common)
        common.append((int(np.count_nonzero(held[0] & held[1])), int(joined)))

    monkeypatch.setattr(MergePreparation, "_join", noted)
    monkeypatch.setattr(merge_preparation, "MOST_PAIRS", most)
    simulation, team = begun()
    reports = run_until_over(simulation, team)
    ((num_common, num_joined),) = common
    assert num_common == num_joined > 8
    attempt, merge = reports[-1].events
    assert merge.alignment is attempt.alignment
    assert math.isfinite(attempt.uncertainty)
    error = merge.alignment.transform - simulation.true_motion(0, 1)
    assert np.hypot(*error[:2]) < 0.3
    map_a, map_b = team.merged_maps(merge)
    rows = merge.alignment.inliers
    apart = map_a.means[rows[:, 0]] - transform_points(merge.alignment.transform, map_b.means[rows[:, 1]])
    assert len(rows) >= 8
    assert np.linalg.norm(apart, axis=1).max() < 0.6
    (watch,) = team._groups[0].trunk.monitors
    assert [side.robots for side in watch.sides] == [(0,), (1,)]
    assert watch.sides[0].oldest == team._step
    simulation.run(team, 150)
    assert team.groups == ((0, 1),)
    assert simulation.position_errors(team).max() < 0.4


def nearest(simulation: SimulatedTeam, descriptors: Any) -> list[int]:
    """Return the true landmarks that look most like some descriptors (n, d)."""
    return np.asarray(descriptors @ simulation.descriptors[0].T).argmax(axis=1).tolist()


def test_the_record_of_map_changes_tells_what_each_landmark_is() -> None:
    """Who follows it from the start knows the true landmark behind every id of the joint map."""
    simulation = SimulatedTeam(2, 112)
    team = simulation.build(attempts=AttemptOptions(every=20), merging=MERGING, **IN_SLICES)
    truth: dict[int, dict[int, int]] = {0: {}, 1: {}}
    seen: dict[int, list[list[int]]] = {}
    renewed = 0
    while len(team.groups) > 1 or team._step % 20:
        odometry, frames = simulation.read()
        report = team.step(odometry, frames)
        seen[report.step] = [nearest(simulation, frame.descriptors) for frame in frames]
        for change in report.map_changes:
            if isinstance(change, LandmarksCreated):
                renewed += change.step < report.step
                for landmark, true in zip(change.ids.tolist(), seen[change.step][change.robot], strict=True):
                    if landmark >= 0:
                        truth[change.number][landmark] = true
            elif isinstance(change, LandmarkIdMap):
                a, b, joint = change.maps
                truth[joint] = {new: truth[b][old] for old, new in change.ids_b.tolist()} | truth[a]
        seen = {step: names for step, names in seen.items() if step >= report.oldest_step}
    assert renewed > 0
    held = team.map(0)
    assert max(held.ids) >= merge_preparation.SPARED_IDS
    known = truth[team.maps[0]]
    same = [known[i] == true for i, true in zip(held.ids.tolist(), nearest(simulation, held.descriptors), strict=True)]
    assert np.mean(same) > 0.98  # noise may make two looks alike


@pytest.mark.parametrize("wait", [0, FIRST_WAIT, FIRST_WAIT + 6, FIRST_WAIT + 30, FIRST_WAIT + 60, FIRST_WAIT + 75])
def test_a_preparation_continues_from_a_snapshot(wait: int) -> None:
    """Taken before the joint filter is made, in its trial, while it is written or catches up: bit for bit the same."""
    simulation, team = begun()
    simulation.run(team, wait)
    assert team._preparation is not None
    reports = check_snapshot(simulation, team, [None] * MOST)
    assert kinds(reports)[:2] == ["attempt", "merge"]


def test_snapshots_and_copies_do_not_change_a_preparation() -> None:
    """A team of which a snapshot is taken after every step, and a copy of a team, merge in the same step as others."""
    simulation, team = begun()
    watched, copied = pickle.loads(pickle.dumps(team)), copy.deepcopy(team)
    while team._preparation is not None:
        reads = simulation.read()
        report = team.step(*reads)
        assert_same(watched.step(*reads), report)
        watched.get_state()
        if watched._preparation is not None:
            copied = copy.deepcopy(watched)
        assert_same(watched._events, team._events)
    assert_same(watched.get_state(), team.get_state())
    simulation.run(copied, 1)
    assert [event.kind for event in copied.events[-2:]] == ["attempt", "merge"]


def test_a_preparation_waits_for_contact_for_a_bounded_time() -> None:
    """Out of contact nothing is done, and after too long the merge is given up without an event or a trace."""
    for apart, merged in ((PATIENCE - 1, True), (PATIENCE + 1, False)):
        simulation, team = begun()
        simulation.run(team, FIRST_WAIT + 20)
        reports = simulation.run(team, apart, links(2))
        assert not kinds(reports)
        assert (team._preparation is not None) == merged
        if merged:
            assert kinds(run_until_over(simulation, team)) == ["attempt", "merge"]
        else:
            assert len(team.buffered_inputs) == 0
            simulation.run(team, MOST)
            assert len(team.groups) == 1  # by a later attempt


def test_a_preparation_ends_if_a_group_has_changed() -> None:
    """Where one of the groups merges with a third meanwhile, the pair is no longer there."""
    simulation, team = begun(113, num_robots=3)
    assert team._preparation is not None
    pair = team._preparation.pair
    third = next(robot for robot in range(3) if (robot,) not in pair)
    simulation.run(team, FIRST_WAIT + 20)
    team.merge(third, pair[0][0], true_alignment(simulation, team, *sorted((third, pair[0][0]))))
    reports = simulation.run(team, 1)
    assert team._preparation is None
    assert not kinds(reports)
    assert len(team.groups) == 2


@pytest.mark.parametrize("left", [3, 60, 190])
def test_earlier_merges_that_are_final_meanwhile_stay_final(left: int) -> None:
    """The joint filter goes on to watch those that its groups still watch; no map is released twice."""
    simulation = SimulatedTeam(3, 113)
    team = simulation.build(attempts=AttemptOptions(every=20), merging=MERGING, **IN_SLICES)
    simulation.run(team, 19)
    team.merge(0, 1, true_alignment(simulation, team, 0, 1))
    while team._preparation is None:
        assert team._step < MOST
        simulation.run(team, 1)
    (earlier,) = team._groups[0].trunk.monitors
    earlier.steps = MERGING.watch_steps - left
    reports = run_until_over(simulation, team)
    assert kinds(reports) == ["attempt", "merge"]
    assert len(team._groups[0].trunk.monitors) == (2 if left == 190 else 1)
    reports += simulation.run(team, 250)
    released = [change.number for report in reports for change in report.map_changes if isinstance(change, MapReleased)]
    assert sorted(released) == [0, 1, 2, 3]


REJUVENATE = FilterState.rejuvenate


def fails_if_joint(self: FilterState, smoother: RejuvenationScheduler) -> RejuvenationReport | None:
    """Fail to smooth a filter of several robots, at once."""
    return RejuvenationReport("no mode", math.nan, 0, 0) if self.num_robots > 1 else REJUVENATE(self, smoother)


@pytest.mark.parametrize("why", ["uncertain", "smoother"])
def test_a_prepared_merge_is_refused_by_its_trial(why: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the joint filter knows the motion badly, or cannot be smoothed, the attempt ends like any uncertain one."""
    simulation, team = begun()
    twin, other = copy.deepcopy(simulation), copy.deepcopy(team)
    if why == "uncertain":
        monkeypatch.setattr(merge_preparation, "judge_trial", lambda *args: (args[4], 50.0))
    else:
        monkeypatch.setattr(FilterState, "rejuvenate", fails_if_joint)
    simulation.run(team, FIRST_WAIT + 3)
    watched, reads = copy.deepcopy(team), copy.deepcopy(simulation)
    reports = simulation.run(team, 1)
    assert_same(reads.run(watched, 1), reports)
    while team._preparation is not None:
        watched.get_state()
        check_snapshot(copy.deepcopy(reads), copy.deepcopy(watched), [None])
        reports = simulation.run(team, 1)
        assert_same(reads.run(watched, 1), reports)
    assert_same(watched.get_state(), team.get_state())
    (event,) = reports[-1].events
    assert (event.kind, event.alignment.reason, event.alignment.missed) == ("attempt", "too uncertain", "paths")
    assert team.groups == ((0,), (1,))
    assert not team._schedule.may_try(((0,), (1,)), team._step)
    other._preparation = None
    monkeypatch.setattr(other._schedule, "is_due", lambda _: False)
    twin.run(other, team._step - other._step)
    for robot in range(2):  # their filters never noticed
        assert_same(contents(team._find(robot)[0].filter), contents(other._find(robot)[0].filter))


def test_a_trial_between_the_two_limits_merges(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the reduced limit is the stricter one, an uncertainty of at most 1 still passes, and events agree."""
    simulation, team = begun()
    team._merging = MergeOptions(min_sigmas=5.0, min_sigmas_on_trial=6.0)
    monkeypatch.setattr(merge_preparation, "judge_trial", lambda *args: (args[4], 0.9 / 5.0))
    reports = run_until_over(simulation, team)
    attempt, merge = reports[-1].events
    assert attempt.alignment.success
    assert merge.kind == "merge"
    assert attempt.uncertainty == pytest.approx(0.9)


def test_a_merge_that_was_prepared_can_still_be_deferred(monkeypatch: pytest.MonkeyPatch) -> None:
    """If waiting helps, a pair within the reduced limit alone is refused after all, and both groups stay."""
    simulation, team = begun()
    team._schedule._uncertainties.clear()  # as if it had been much larger before
    monkeypatch.setattr(merge_preparation, "judge_trial", lambda *args: (args[4], 2.0 / 5.0))
    reports = run_until_over(simulation, team)
    (attempt,) = reports[-1].events
    assert (attempt.kind, attempt.alignment.reason, attempt.alignment.missed) == ("attempt", "too uncertain", "paths")
    assert attempt.uncertainty == pytest.approx(2.0)
    assert team.groups == ((0,), (1,))
    assert team.maps == (0, 1)


def test_the_monitor_knows_what_each_side_found_alone() -> None:
    """Landmarks of either side that the merge did not fuse, those found during the preparation included."""
    simulation, team = begun()
    simulation.run(team, FIRST_WAIT - 2)
    simulation.run(team, 60, links(2))  # both sides find landmarks before the joint filter is made
    run_until_over(simulation, team)
    (watch,) = team._groups[0].trunk.monitors
    held = set(team._groups[0].trunk.filter.state.maps.ids.tolist()) - {-1}
    ours, theirs = watch.exclusive_landmarks
    common = held - ours - theirs
    assert len(ours & held) > 5
    assert len(theirs & held) > 5
    assert not ours & theirs
    assert len(common) >= 8
    assert common <= set(watch.pre_merge_maps[0].ids.tolist()) & set(watch.pre_merge_maps[1].ids.tolist())


def test_teams_with_an_exact_pose_merge_without_a_preparation() -> None:
    """Their filters cannot be smoothed any more: a merge waits for no trial, as in small maps."""
    simulation = SimulatedTeam(2, 112)
    team = simulation.build(attempts=AttemptOptions(every=20), merging=MERGING, **IN_SLICES)
    for step in range(300):
        poses = [between(simulation.starts[0], simulation.poses[0]), None] if step == 50 else None
        team.step(*simulation.read(), poses=poses)
        assert team._preparation is None or step < 50
        if len(team.groups) == 1:
            break
    assert [event.kind for event in team.events][-2:] == ["attempt", "merge"]


def test_a_preparation_that_finds_too_many_landmarks_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ids of the joint map must not be those of landmarks that the first group finds meanwhile."""
    monkeypatch.setattr(merge_preparation, "SPARED_IDS", 0)
    simulation, team = begun()
    assert kinds(run_until_over(simulation, team)) == []
    assert team.groups == ((0,), (1,))


def test_a_prepared_merge_can_be_undone(monkeypatch: pytest.MonkeyPatch) -> None:
    """The groups then go on as they were just before the merge, with the inputs since."""
    simulation, team = begun()
    reports = run_until_over(simulation, team)
    assert reports[-1].maps == (2, 2)
    monkeypatch.setattr(
        team_module, "find_inconsistent_merge", lambda trunk, *_: trunk.monitors[0] if trunk.monitors else None
    )
    later = simulation.run(team, 60)
    assert kinds(later)[0] == "undo"
    undone = next(report for report in later if report.events)
    assert undone.maps == (0, 1)
    assert MapReleased(2) in undone.map_changes
    for robot in range(2):
        assert team._find(robot)[0].filter.state.next_step == team._step
    assert simulation.position_errors(team).max() < 1.0


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        ({"pair": ((0,),)}, "pair"), ({"counts": (0, 0, -1, 0)}, "counts"), ({"uncertainty": -1.0}, "uncertainty"),
        ({"joint": {}}, "joint"), ({"renamed": np.zeros((2, 3), np.int64)}, "renamed"), ({"maps": ()}, "maps"),
        ({"replayed": (1,)}, "replayed"), ({"alignment": None}, "alignment"), ({"numbers": ("0", 1)}, "numbers"),
        ({"unsmoothed": 3}, "unsmoothed"), ({"oldest": 0}, "oldest"), ({"oldest": None}, "joint"),
        ({"alignment": Alignment.refused("ambiguous", 1.0)}, "alignment"),
    ],
)  # fmt: skip
def test_damaged_preparations_are_refused(damage: dict[str, Any], text: str) -> None:
    """The message names the part; the team that was to restore it is unchanged."""
    simulation, team = begun()
    simulation.run(team, FIRST_WAIT + 30)
    state = team.get_state()
    state["preparation"] |= damage
    restored = simulation.build(attempts=AttemptOptions(every=20), merging=MERGING, **IN_SLICES)
    before = restored.get_state()
    with pytest.raises(ValueError, match=rf"preparation'\]\['{text}'\]"):
        restored.set_state(state)
    assert_same(restored.get_state(), before)
