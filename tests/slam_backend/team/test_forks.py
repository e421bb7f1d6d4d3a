"""Robots of a group lose contact, go on with forks of the joint filter, and return."""

import copy
from typing import Any

import numpy as np
import pytest
from builders.comparison import assert_same
from builders.filters import contents
from builders.teams import SIZE, SimulatedTeam, check_snapshot, driven, links, merged_team, true_alignment
from scipy import stats

from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.geometry import between, wrap_angle
from slam_backend.team.branches import MAX_REPLAYED
from slam_backend.team.communication import LANDMARK_BYTES, POINT_BYTES, POSE_BYTES, contact_components
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import LandmarksCreated
from slam_backend.team.team import TeamSlam

FINAL = MergeOptions(watch_steps=0)


def readings_of(simulation: SimulatedTeam, steps: int, silent: tuple[int, ...] = ()) -> list[tuple[Any, Any]]:
    """Drive and return what was read; silent robots read nothing."""
    read = []
    for _ in range(steps):
        odometry, frames = simulation.read()
        for robot in silent:
            odometry[robot] = frames[robot] = None  # type: ignore[call-overload]
        read.append((odometry, frames))
    return read


def live(team: TeamSlam, readings: list[tuple[Any, Any]], contacts: Any = None) -> list[Any]:
    """Let a team live through readings."""
    return [team.step(odometry, frames, contacts) for odometry, frames in readings]


def branches(team: TeamSlam) -> set[tuple[int, ...]]:
    """Return which robots go by one filter."""
    return {team.same_filter(robot) for robot in range(team.num_robots)}


# ---------------------------------------------------------------------- who is in contact


def test_robots_relay_messages() -> None:
    """A chain a-b-c-d is one network; without its middle link it is two; the diagonal means nothing."""
    chain = links(4, (0, 1), (1, 2), (2, 3))
    assert contact_components(chain, 4).tolist() == [0, 0, 0, 0]
    assert len(set(contact_components(links(4, (0, 1), (2, 3)), 4).tolist())) == 2
    np.testing.assert_array_equal(contact_components(chain & ~np.eye(4, dtype=bool), 4), contact_components(chain, 4))
    assert contact_components(None, 3).tolist() == [0, 0, 0]


def test_a_group_in_a_chain_goes_by_one_filter() -> None:
    """A robot that reaches the others through one of them only is in contact: nothing forks, nothing is kept."""
    simulation = SimulatedTeam(seed=3)
    team, twin = (merged_team(copy.deepcopy(simulation), merging=FINAL) for _ in range(2))
    simulation.run(simulation.build(), 30)
    read = readings_of(simulation, 20)
    live(team, read, links(3, (0, 2), (2, 1)))
    live(twin, read)
    assert branches(team) == {(0, 1, 2)}
    assert len(team._records.log) == 0
    assert_same(contents(team._find(0)[0].filter), contents(twin._find(0)[0].filter))


# ---------------------------------------------------------------------- exactly, where nothing else happened


@pytest.mark.parametrize(
    ("gap", "options"),
    [(1, {}), (20, {}), (45, {}), (45, {"existence": ExistenceModel()}), (45, {"rejuvenate_every": 25})],
)
def test_a_replay_gives_the_result_of_unbroken_contact(gap: int, options: dict[str, Any]) -> None:
    """Where only the robot out of contact reads something, the joint filter ends bit for bit as if never broken.

    Particles, maps, weights, random stream and logs agree: what is read is taken in once, in order, later.
    """
    simulation = SimulatedTeam(num_robots=2, seed=5)
    team, twin = (merged_team(copy.deepcopy(simulation), merging=FINAL, **options) for _ in range(2))
    simulation.run(simulation.build(), 30)
    away = readings_of(simulation, gap, silent=(0,))
    back = readings_of(simulation, 1 + gap // (MAX_REPLAYED - 1), silent=(0,))
    live(team, away, links(2))
    assert branches(team) == {(0,), (1,)}
    live(team, back)
    live(twin, away + back)
    assert branches(team) == {(0, 1)}
    assert_same(contents(team._find(0)[0].filter), contents(twin._find(0)[0].filter))
    for robot in range(2):
        assert_same(team._find(robot)[0].filter.log(robot).arrays(), twin._find(robot)[0].filter.log(robot).arrays())
    more = readings_of(simulation, 5)
    for one, other in zip(live(team, more), live(twin, more), strict=True):
        assert_same(one.associations, other.associations)


def test_the_joint_filter_holds_the_pose_and_the_fork_follows_the_robot() -> None:
    """Without contact the joint filter leaves the absent robot where it was, and the robot's fork follows it."""
    simulation = SimulatedTeam(num_robots=2, seed=5)
    team = merged_team(simulation)
    before = team.pose(1)
    live(team, readings_of(simulation, 25, silent=(0,)), links(2))
    assert_same(team.pose(1, seen_by=0), before)
    assert np.hypot(*(team.pose(1).mean - before.mean)[:2]) > 2.0
    assert simulation.position_errors(team)[1] < 0.3


def test_a_filter_knows_its_members_only() -> None:
    """Asking for the pose of a robot of another group in one's own map frame is refused."""
    team = SimulatedTeam(seed=1).build()
    with pytest.raises(ValueError, match=r"robot: expected one of \(0,\), got 2\. Name a robot in this filter\."):
        team.pose(2, seen_by=0)


def test_at_most_twenty_buffered_steps_are_taken_in_per_step() -> None:
    """After 50 steps apart, three steps of contact replay 20, 20 and 12 steps; the fork lasts until then."""
    simulation = SimulatedTeam(num_robots=2, seed=5)
    team = merged_team(simulation, merging=FINAL)
    live(team, readings_of(simulation, 50), links(2))
    assert [len(team._find(robot)[0].filter.log(1)) for robot in range(2)] == [30, 80]
    for told, apart in ((50, True), (70, True), (83, False)):
        report = live(team, readings_of(simulation, 1))[0]
        assert len(team._find(0)[0].filter.log(1)) == told
        assert (len(branches(team)) == 2) == apart
        assert (report.maps[0] != report.maps[1]) == apart
    assert len(team._records.log) == 0
    assert simulation.position_errors(team).max() < 0.3


# ---------------------------------------------------------------------- in distribution


@pytest.mark.slow
def test_a_replay_has_the_distribution_of_unbroken_contact() -> None:
    """Over 40 seeds, errors after 40 steps apart come from the same distribution as with unbroken contact.

    Kolmogorov-Smirnov over the errors of both robots in position and heading, and of the number of landmarks; false
    alarm below 1e-3 each.
    """
    errors: dict[bool, list[Any]] = {True: [], False: []}
    for seed in range(40):
        start = SimulatedTeam(num_robots=2, seed=300 + seed)
        for broken, own in errors.items():
            simulation = copy.deepcopy(start)
            team = merged_team(simulation, merging=FINAL, seed=seed + 1000 * broken)
            live(team, readings_of(simulation, 40), links(2) if broken else None)
            live(team, readings_of(simulation, 3))
            assert branches(team) == {(0, 1)}
            turns = [wrap_angle(team.pose(0).mean[2] - between(simulation.starts[0], simulation.poses[0])[2])]
            own.append([*simulation.position_errors(team), *turns, len(team.map(0))])
    for one, other in zip(np.array(errors[True]).T, np.array(errors[False]).T, strict=True):
        assert stats.ks_2samp(one, other).pvalue > 1e-3


# ---------------------------------------------------------------------- bytes


def test_bytes_of_a_return_are_counted() -> None:
    """The returning robot sends its odometry and measurements, and receives what has changed since it left."""
    simulation = SimulatedTeam(num_robots=2, seed=5)
    team = merged_team(simulation, merging=FINAL)
    before = dict(zip(team.map(0).ids.tolist(), team.map(0).counts.tolist(), strict=True))
    away = readings_of(simulation, 12)
    live(team, away, links(2))
    sent = team.bytes_sent
    silence: Any = ([None, None], [None, None])
    report = live(team, [silence])[0]
    measured = sum(len(frames[1]) for _, frames in away)
    told = 12 * POSE_BYTES + measured * (POINT_BYTES + 4 * SIZE)
    assert team.bytes_sent[1] - sent[1] == told + POSE_BYTES  # the last one for the step in contact
    after = dict(zip(team.map(0).ids.tolist(), team.map(0).counts.tolist(), strict=True))
    changed = sum(before.get(name) != count for name, count in after.items())
    own = {i for entry in report.map_changes if isinstance(entry, LandmarksCreated) for i in entry.ids.tolist()}
    new = sum(name not in before and name not in own for name in after)
    assert team.bytes_sent[0] - sent[0] == changed * LANDMARK_BYTES + new * 4 * SIZE + POSE_BYTES
    assert new > 0


def test_a_robot_alone_sends_nothing() -> None:
    """While no robot hears them, no byte is counted."""
    simulation = SimulatedTeam(num_robots=2, seed=5)
    team = merged_team(simulation)
    sent = team.bytes_sent
    live(team, readings_of(simulation, 10), links(2))
    np.testing.assert_array_equal(team.bytes_sent, sent)


# ---------------------------------------------------------------------- more than two


def test_the_larger_part_keeps_the_joint_filter() -> None:
    """Of a group of three the two that stay together keep its map's number; the third gets a copy."""
    simulation = SimulatedTeam(seed=3)
    team = merged_team(simulation, 20)
    number = team.maps[0]
    live(team, readings_of(simulation, 1), links(3, (1, 2)))
    assert branches(team) == {(0,), (1, 2)}
    assert team.maps[1] == team.maps[2] == number != team.maps[0]
    assert team.trunk_robots(0) == (1, 2)
    assert team.groups == ((0, 1, 2),)


def test_parts_that_meet_away_from_the_joint_filter_join() -> None:
    """Two robots that left one after the other, and meet, go by one filter; the third takes both in on return."""
    simulation = SimulatedTeam(seed=3)
    team = merged_team(simulation, 20)
    live(team, readings_of(simulation, 10), links(3, (0, 1)))
    live(team, readings_of(simulation, 10), links(3))
    assert branches(team) == {(0,), (1,), (2,)}
    live(team, readings_of(simulation, 4), links(3, (1, 2)))
    assert branches(team) == {(0,), (1, 2)}
    live(team, readings_of(simulation, 4))
    assert branches(team) == {(0, 1, 2)}
    assert simulation.position_errors(team).max() < 0.3


def test_a_robot_that_meets_another_group_can_merge_with_it() -> None:
    """A robot away from its group merges with a third; the one left behind hears of it when it returns.

    Meanwhile it knows of its old group only, in that group's frame.
    """
    simulation, team = driven(3, 3, 30, num_particles=13)
    team.merge(1, 2, true_alignment(simulation, team, 1, 2))
    live(team, readings_of(simulation, 5), links(3))
    live(team, readings_of(simulation, 1), links(3, (0, 2)))
    assert team.trunk_robots(1) == (2,)
    team.merge(0, 2, true_alignment(simulation, team, 0, 2))
    assert team.groups == ((0, 1, 2),)
    live(team, readings_of(simulation, 5), links(3, (0, 2)))
    assert [team.known_robots(robot) for robot in range(3)] == [(0, 1, 2), (1, 2), (0, 1, 2)]
    assert simulation.position_errors(team).max() < 0.3
    live(team, readings_of(simulation, 2))
    assert [team.known_robots(robot) for robot in range(3)] == [(0, 1, 2)] * 3
    assert branches(team) == {(0, 1, 2)}
    assert simulation.position_errors(team).max() < 0.3


def test_only_robots_with_the_joint_filter_merge() -> None:
    """A merge through a robot with an outdated fork is refused."""
    simulation, team = driven(3, 3, 10, num_particles=13)
    team.merge(0, 1, true_alignment(simulation, team, 0, 1))
    live(team, readings_of(simulation, 1), links(3))
    assert team.trunk_robots(1) == (0,)
    with pytest.raises(ValueError, match=r"robot_a: expected one of \(0,\), got 1\. Merge through a robot that uses"):
        team.merge(1, 2, true_alignment(simulation, team, 1, 2))


# ---------------------------------------------------------------------- snapshots


@pytest.mark.parametrize("steps_before", [45, 62])
def test_a_team_with_forks_continues_from_a_snapshot_bit_for_bit(steps_before: int) -> None:
    """Before the return, and in the midst of a replay, a restored team does the same as the one that went on."""
    simulation = SimulatedTeam(seed=4)
    team = merged_team(simulation, 20)
    plan = [links(3, (0, 1))] * 20 + [links(3)] * 20 + [None] * 20  # type: ignore[list-item]
    for contacts in plan[: steps_before - 20]:
        live(team, readings_of(simulation, 1), contacts)
    check_snapshot(simulation, team, plan[steps_before - 20 :])
    assert branches(team) == {(0, 1, 2)}


@pytest.mark.parametrize("options", [{}, {"rejuvenate_every": 6}, {"existence": ExistenceModel()}])
def test_a_fork_in_the_memory_of_the_last_one_does_the_same(options: dict[str, Any]) -> None:
    """A filter that is no longer needed leaves nothing behind in the next fork, nor in states and copies."""
    simulation = SimulatedTeam(seed=4)
    team = merged_team(simulation, 20, **options)
    other = copy.deepcopy(team)
    for apart in ((0, 1), (1, 2), (0, 2)):
        for contacts, steps in ((links(3, apart), 12), (None, 6)):
            readings = readings_of(simulation, steps)
            spare = team._records.spare
            live(team, readings, contacts)
            live(other, readings, contacts)
            assert_same(team.get_state(), other.get_state())
            forks = [branch.filter for group in team._groups for branch in group.branches[1:]]
            assert len(forks) == (contacts is not None)
            assert all(fork is spare for fork in forks if spare is not None)
        assert branches(team) == {(0, 1, 2)}
        assert team._records.spare is not None
        assert copy.deepcopy(team)._records.spare is None
        other._records.spare = None
