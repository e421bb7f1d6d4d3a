"""Which pairs of groups attempt a merge in which step, and how many bytes robots exchange."""

import numpy as np
import pytest
from builders.filters import looks
from builders.teams import SIZE, SimulatedTeam, driven

from slam_backend.fastslam.reports import Associations, StepReport
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.state import restore, take
from slam_backend.team.communication import LANDMARK_BYTES, POSE_BYTES, TrafficCounter
from slam_backend.team.merge_scheduler import AttemptOptions, MergeScheduler, PairKey
from slam_backend.team.options import MergeOptions

FIRST: PairKey = ((0,), (1, 3))
SECOND: PairKey = ((0,), (2,))


def map_of(names: list[int]) -> LandmarkMap:
    """A map of landmarks with unlike looks; the name is the id."""
    rows = np.array(names)
    means = np.column_stack([2.0 * rows, np.zeros(len(rows)), np.zeros(len(rows))])
    return LandmarkMap(means, np.tile(0.01 * np.eye(3), (len(rows), 1, 1)), looks(rows), ids=rows)


def schedule(every: int = 25, new_candidates: int = 3, longest_wait: int = 200) -> MergeScheduler:
    """A schedule whose alignments need four candidates."""
    options = AttemptOptions(every=every, new_candidates=new_candidates, longest_wait=longest_wait)
    return MergeScheduler(options, AlignmentOptions(min_inliers=4))


def pair_of(names: list[int]) -> tuple[LandmarkMap, LandmarkMap]:
    """Two maps that have just these landmarks in common."""
    return map_of([*names, 12]), map_of([11, *names])


def test_one_step_per_interval_is_due() -> None:
    """With every = 25, the last step of each 25 is due, and no other."""
    assert [step for step in range(100) if schedule().is_due(step)] == [24, 49, 74, 99]


def test_a_refused_pair_waits_for_the_next_attempts() -> None:
    """It waits 25 steps after each refusal; other pairs do not wait."""
    plan = schedule()
    for step in (24, 49, 149):
        plan.record(FIRST, step, success=False)
        assert [plan.may_try(FIRST, step + ahead) for ahead in (24, 25)] == [False, True]
        assert plan.may_try(SECOND, step + 1)


def test_a_pair_whose_logs_were_smoothed_waits_until_an_eighth_is_new() -> None:
    """Refused 800 steps on it tries again after 100, with the same candidates; early on it waits as any other does."""
    same = {FIRST: pair_of([0, 1, 2, 3, 4])}
    for step, wait in ((799, 100), (24, 25)):
        plan = schedule()
        assert plan.choose(same, step) == FIRST
        plan.record(FIRST, step, success=False, smoothed=True)
        assert not plan.may_try(FIRST, step + wait - 1)
        assert plan.may_try(FIRST, step + wait)
        assert plan.choose(same, step + wait) == FIRST


def test_a_pair_whose_logs_were_smoothed_does_not_wait_longer_than_the_longest_wait() -> None:
    """Refused 4,000 steps on it tries again after 200, and with few steps as early as any other."""
    for step, wait in ((3_999, 200), (799, 100), (24, 25)):
        plan = schedule()
        plan.record(FIRST, step, success=False, smoothed=True)
        assert not plan.may_try(FIRST, step + wait - 1)
        assert plan.may_try(FIRST, step + wait)


def test_an_uncertain_pair_waits_while_its_uncertainty_falls() -> None:
    """It waits the first time, and as long as its uncertainty falls by three tenths each time."""
    plan = schedule()
    assert [plan.should_defer(FIRST, doubt) for doubt in (4.0, 2.7, 1.8, 1.3)] == [True, True, True, False]
    assert [plan.should_defer(SECOND, doubt) for doubt in (4.0, 0.9, 4.0)] == [True, False, False]


def test_waiting_times_carry_over_to_larger_groups() -> None:
    """Robots that waited for each other keep waiting in larger groups, also after a restore; others start at zero."""
    plan = schedule()
    assert plan.should_defer(((0,), (2,)), 4.0)
    other = schedule()
    restore(other, take(plan))
    for known in (plan, other):
        assert not known.should_defer(((0, 1), (2, 3)), 4.0)
        assert known.should_defer(((0,), (4,)), 4.0)


def test_a_barred_pair_does_not_try_in_larger_groups_either() -> None:
    """Robots of the one side do not try with robots of the other until the bar ends; others do, and each side may."""
    plan = schedule()
    plan.block(((0,), (1, 3)), 60)
    barred: list[PairKey] = [((0,), (1, 3)), ((0, 2), (1, 3)), ((0,), (3,)), ((1,), (0, 2))]
    free: list[PairKey] = [((0,), (2,)), ((1, 3), (2,)), ((1,), (3,))]
    assert not any(plan.may_try(pair, 59) for pair in barred)
    assert all(plan.may_try(pair, 59) for pair in free)
    assert all(plan.may_try(pair, 60) for pair in barred)
    other = schedule()
    restore(other, take(plan))
    assert not other.may_try(barred[0], 59)


def test_a_refused_pair_needs_new_candidates() -> None:
    """The same candidates are not tried again, nor with two new ones; with three new ones they are."""
    plan = schedule()
    names = [0, 1, 2, 3, 4]
    assert plan.choose({FIRST: pair_of(names)}, 49) == FIRST
    plan.record(FIRST, 24, success=False)
    assert plan.choose({FIRST: pair_of(names)}, 49) is None
    assert plan.choose({FIRST: pair_of([*names, 5, 6])}, 49) is None
    assert plan.choose({FIRST: pair_of([*names, 5, 6, 7])}, 49) == FIRST


def test_candidates_count_as_new_after_the_longest_wait() -> None:
    """After `longest_wait` steps the same candidates count as new: their landmarks are known better by then."""
    plan = schedule(longest_wait=200)
    same = {FIRST: pair_of([0, 1, 2, 3])}
    plan.choose(same, 24)
    plan.record(FIRST, 24, success=False)
    assert plan.choose(same, 224) is None
    assert plan.choose(same, 225) == FIRST


def test_too_few_candidates_make_no_attempt() -> None:
    """A pair with fewer candidates than an alignment needs does not try."""
    assert schedule().choose({FIRST: pair_of([0, 1, 2])}, 49) is None
    assert schedule().choose({FIRST: pair_of([0, 1, 2, 3])}, 49) == FIRST
    assert schedule().choose({}, 49) is None


def test_the_pair_with_the_most_new_candidates_tries() -> None:
    """Most new candidate matches win; of equals, the first."""
    few, many = pair_of([0, 1, 2, 3]), pair_of([0, 1, 2, 3, 4])
    assert schedule().choose({FIRST: few, SECOND: many}, 49) == SECOND
    assert schedule().choose({FIRST: many, SECOND: few}, 49) == FIRST
    assert schedule().choose({FIRST: few, SECOND: few}, 49) == FIRST
    plan = schedule()
    plan.choose({SECOND: many}, 49)
    plan.record(SECOND, 24, success=False)
    assert plan.choose({FIRST: few, SECOND: many}, 49) == FIRST


def test_a_merge_drops_the_records_of_the_merged_groups() -> None:
    """After a success, no record names a robot of the merged groups; others keep waiting."""
    plan = schedule()
    third: PairKey = ((1, 3), (2,))
    other: PairKey = ((4,), (5,))
    for pair in (FIRST, SECOND, third, other):
        plan.record(pair, 24, success=False)
    plan.record(SECOND, 49, success=True)
    assert plan.may_try(FIRST, 25)
    assert plan.may_try(SECOND, 25)
    assert plan.may_try(third, 25)
    assert not plan.may_try(other, 25)


@pytest.mark.parametrize("every", [25, 10])
def test_a_team_tries_at_most_one_pair_in_so_many_steps(every: int) -> None:
    """At most one attempt falls into each stretch of `every` steps, and its merge follows in the same step."""
    _, team = driven(3, 1, 130, attempts=AttemptOptions(every=every))
    attempts = [event.step for event in team.events if event.kind == "attempt"]
    assert attempts
    assert len({step // every for step in attempts}) == len(attempts)
    for attempt, following in zip(team.events, [*team.events[1:], None], strict=True):
        if attempt.kind == "attempt" and attempt.alignment.success:
            assert following is not None
            assert (following.kind, following.step) == ("merge", attempt.step)


def test_refused_attempts_of_a_team_wait_and_need_new_candidates() -> None:
    """Between attempts of one pair that cannot succeed lie at least 5, 10, 20, 40 ... steps."""
    simulation = SimulatedTeam(num_robots=2, seed=6, separate=True, aliased=True)
    team = simulation.build(attempts=AttemptOptions(every=5))
    simulation.run(team, 150)
    steps = [event.step for event in team.events]
    assert len(steps) >= 3
    for gap, wait in zip(np.diff(steps), [5, 10, 20, 40, 80], strict=False):
        assert gap >= wait


def test_one_contact_between_two_groups_is_enough() -> None:
    """Only the pairs in contact try; a member in contact brings its whole group along."""
    simulation = SimulatedTeam(seed=1)
    team = simulation.build()
    contacts = np.eye(3, dtype=bool)
    contacts[1, 2] = contacts[2, 1] = True
    simulation.run(team, 110, contacts)
    assert team.groups == ((0,), (1, 2))
    assert {(event.robots_a, event.robots_b) for event in team.events} == {((1,), (2,))}
    contacts = np.eye(3, dtype=bool)
    contacts[0, 2] = contacts[2, 0] = True
    simulation.run(team, 40, contacts)
    assert team.groups == ((0, 1, 2),)


def test_maps_without_appearance_and_with_too_many_pairs_make_no_attempt() -> None:
    """Without appearance, a pair of maps with more than 10,000 pairs of landmarks is passed over; others still try."""
    plan = MergeScheduler(AttemptOptions(), AlignmentOptions(min_inliers=4, appearance=False))
    means = np.column_stack([np.arange(101.0), np.zeros((101, 2))])
    huge = LandmarkMap(means, np.tile(0.01 * np.eye(3), (101, 1, 1)), np.ones((101, 4)) / 2.0)
    assert plan.choose({FIRST: (huge, huge)}, 24) is None
    assert plan.choose({FIRST: (huge, huge), SECOND: pair_of([0, 1, 2, 3])}, 24) == SECOND


LOOK = 4 * 13  # bytes of a descriptor of `looks`


def counted_map(counts: dict[int, int]) -> LandmarkMap:
    """A map of landmarks with given ids and counts."""
    ids = np.array(list(counts))
    n = len(ids)
    return LandmarkMap(np.zeros((n, 3)), np.tile(np.eye(3), (n, 1, 1)), looks(ids), list(counts.values()), ids)


def report_of(rows: tuple[int, ...], associations: list[list[int]], created: list[list[int]]) -> StepReport:
    """A report of a joint step of the robots in some rows; what each robot's measurements became, row by row."""
    findings = Associations.from_arrays(
        *([np.array(ids, np.int64) for ids in each] for each in (associations, created))
    )
    named, made = (np.concatenate([each[row] for row in rows if row >= 0]) for each in (associations, created))
    counts = np.sum(made >= 0), 0, np.sum(named >= 0), np.sum(named < 0)
    return StepReport(findings, rows, *counts, ess=1.0, nis=3.0, resampled=False)


def test_new_landmarks_are_sent_with_descriptors_and_changed_ones_without() -> None:
    """A first exchange costs whole landmarks; a second only what is new, and what changed without its descriptor."""
    counter = TrafficCounter(3)
    counter.record_maps(0, 2, counted_map({1: 4, 5: 2}), counted_map({7: 1}))
    assert counter.sent == [2 * (LANDMARK_BYTES + LOOK), 0, LANDMARK_BYTES + LOOK]
    counter.record_maps(0, 2, counted_map({1: 4, 5: 3, 6: 1}), counted_map({7: 1}))
    assert counter.sent == [3 * (LANDMARK_BYTES + LOOK) + LANDMARK_BYTES, 0, LANDMARK_BYTES + LOOK]


def test_each_pair_of_robots_has_its_own_record_of_what_was_sent() -> None:
    """Each pair of robots has its own record of what was sent."""
    counter = TrafficCounter(3)
    counter.record_maps(0, 1, counted_map({1: 4}), counted_map({2: 1}))
    counter.record_maps(0, 2, counted_map({1: 4}), counted_map({2: 1}))
    assert counter.sent == [2 * (LANDMARK_BYTES + LOOK), LANDMARK_BYTES + LOOK, LANDMARK_BYTES + LOOK]


def test_members_of_a_group_send_poses_and_the_landmarks_they_touched() -> None:
    """Per step a robot sends its pose, each landmark it matched or made, and descriptors of those it made."""
    counter = TrafficCounter(4)
    counter.record_step(report_of((1, 3), [[8], [4, -1, 9], [], [2]], [[8], [-1, -1, 9], [], [-1]]), 13)
    sent = np.array([0, POSE_BYTES + 2 * LANDMARK_BYTES + LOOK, 0, POSE_BYTES + LANDMARK_BYTES])
    np.testing.assert_array_equal(counter.sent, sent)
    counter.record_step(report_of((1, 3), [[8], [4, 9], [], [2]], [[8], [-1, -1], [], [-1]]), 13)
    sent += [0, POSE_BYTES + 2 * LANDMARK_BYTES, 0, POSE_BYTES + LANDMARK_BYTES]
    np.testing.assert_array_equal(counter.sent, sent)


def test_a_robot_that_has_left_does_not_send() -> None:
    """The joint filter continues with the robots in contact."""
    counter = TrafficCounter(3)
    counter.record_step(report_of((0, -1, 2), [[4], [7], [2]], [[4], [-1], [-1]]), 13)
    assert counter.sent == [POSE_BYTES + LANDMARK_BYTES + LOOK, 0, POSE_BYTES + LANDMARK_BYTES]


def test_robots_that_merge_send_maps_and_then_a_few_hundred_bytes_a_step() -> None:
    """The first attempt costs both whole maps; a step of the joint filter a pose and what was seen in it."""
    simulation = SimulatedTeam(num_robots=2, seed=1)
    team = simulation.build(merging=MergeOptions(smooth_first=False))
    for _ in range(110):
        if team.events:
            break
        assert team.bytes_sent.tolist() == [0, 0]
        simulation.run(team, 1)
    sent = team.bytes_sent
    assert (sent > 0).all()
    np.testing.assert_array_equal(sent % (LANDMARK_BYTES + 4 * SIZE), 0)
    assert team.groups == ((0, 1),)
    simulation.run(team, 1)
    largest = POSE_BYTES + 5 * (LANDMARK_BYTES + 4 * SIZE)
    assert ((team.bytes_sent - sent >= POSE_BYTES) & (team.bytes_sent - sent <= largest)).all()
    team.bytes_sent[:] = 0  # a copy
    assert (team.bytes_sent > 0).all()
