"""A team's lineup is that of its groups at any time, and one object as long as it stays the same."""

import numpy as np
from merged_pair import NEVER, false_alignment, links, true_alignment
from simulated_team import SimulatedTeam

from slam_backend.fastslam.reports import TeamReport
from slam_backend.team.branches import Branch
from slam_backend.team.groups import Lineup
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam


def oldest_unknown(branch: Branch, now: int) -> int:
    """Return the first step that a filter may still have to take in; the next one if there is none."""
    held = [1 + last for robot, last in branch.known.items() if robot not in branch.live]
    return min([now + 1, *held, *(side.oldest for watch in branch.watches for side in watch.sides)])


def check(team: TeamSlam, report: TeamReport) -> None:
    """Check that a team's lineup, and what its report says of that, are as the groups have it now."""
    assert team.lineup == Lineup.of(team._groups)
    assert team.lineup is team.lineup
    branches = [branch for group in team._groups for branch in group.branches]
    for robot, (group, branch, place) in enumerate(team.lineup.places):
        assert robot in branch.live
        assert branch.robots[place] == robot
        assert branch in group.branches
    assert (report.groups, report.maps) == (team.groups, tuple(branch.number for _, branch, _ in team.lineup.places))
    assert report.oldest_step == min(oldest_unknown(branch, report.step) for branch in branches)


def run(simulation: SimulatedTeam, team: TeamSlam, steps: int, contacts: object = None) -> list[str]:
    """Drive, check the lineup after each step, and return what became of merges."""
    before = len(team.events)
    for _ in range(steps):
        check(team, simulation.run(team, 1, contacts)[0])
    return [event.kind for event in team.events[before:]]


def test_it_follows_merges_forks_returns_undos_and_the_end_of_a_watch() -> None:
    """Each of these makes a new lineup; steps between them do not."""
    simulation = SimulatedTeam(num_robots=3, seed=101)
    team = simulation.build(attempts=NEVER, merging=MergeOptions(watch_steps=60))
    alone = team.lineup
    run(simulation, team, 80)
    assert team.lineup is alone
    team.merge(0, 1, false_alignment(simulation, team, np.array([3.0, -2.0, 0.5])))
    assert team.lineup == Lineup.of(team._groups)
    assert any("undo" in run(simulation, team, 1) for _ in range(100))
    assert team.lineup.mates == ((0,), (1,), (2,))
    team.merge(0, 2, true_alignment(simulation, team, 0, 2))
    run(simulation, team, 10)
    run(simulation, team, 10, links(3, (0, 1)))
    assert team.lineup.mates == ((0,), (1,), (2,))
    assert team.lineup.members == ((0, 2), (1,), (0, 2))
    run(simulation, team, 10)
    assert team.lineup.mates == ((0, 2), (1,), (0, 2))
    watched = team.lineup
    assert watched.oldest is not None
    run(simulation, team, 80)
    assert team.lineup.oldest is None
    assert len(team.lineup.numbers) < len(watched.numbers)


def test_it_is_found_anew_from_a_state() -> None:
    """Be the team the same as before or another one."""
    simulation = SimulatedTeam(num_robots=3, seed=102)
    team, other = (simulation.build(attempts=NEVER) for _ in range(2))
    simulation.run(team, 60)
    state = team.get_state()
    team.merge(0, 1, true_alignment(simulation, team, 0, 1))
    assert team.lineup.groups == ((0, 1), (2,))
    for one in (team, other):
        one.set_state(state)
        assert one.lineup == Lineup.of(one._groups)
        assert one.lineup.groups == ((0,), (1,), (2,))
