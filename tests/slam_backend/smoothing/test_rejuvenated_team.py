"""Teams of rejuvenated filters: merges, and snapshots across them."""

import copy
import pickle

import numpy as np
from same_bits import assert_same
from simulated_team import SimulatedTeam

from slam_backend.alignment import AlignmentOptions
from slam_backend.attempts import AttemptOptions
from slam_backend.team import TeamSlam


def build(simulation, every=20):
    """Return a team that merges early."""
    return simulation.build(
        alignment=AlignmentOptions(min_inliers=9), attempts=AttemptOptions(every=20, new_candidates=2),
        rejuvenate_every=every,
    )  # fmt: skip


def rejuvenations(team):
    """Return the last step's reports of the filters of all groups, with the number of their robots."""
    branches = [branch for group in team._groups for branch in group.branches]
    reports = [(len(b.robots), b.report.rejuvenation) for b in branches if b.report is not None]
    return [(robots, report) for robots, report in reports if report is not None]


def test_a_merged_team_is_rejuvenated_and_knows_where_it_started():
    """In the step after a merge the joint filter is smoothed; the other starts are then known."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation)
    joint = []
    for _ in range(90):
        team.step(*simulation.read())
        joint += [report.reason for robots, report in rejuvenations(team) if robots == 3]
    assert team.groups == ((0, 1, 2),)
    assert len(joint) >= 1
    assert set(joint) == {""}
    for robot in (1, 2):
        off = team.start_from_group(robot) - simulation.true_motion(robot, 0)
        assert np.hypot(off[0], off[1]) < 0.1
    assert simulation.position_errors(team).max() < 0.2


def test_a_snapshot_of_a_team_goes_on_through_merges_and_rejuvenations():
    """A restored team does, bit for bit, the same as the one that went on, its smoothers included."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation)
    simulation.run(team, 50)
    state = pickle.loads(pickle.dumps(team.get_state()))
    restored, readings = TeamSlam(3, seed=99), copy.deepcopy(simulation)
    restored.set_state(state)
    merges = 0
    for report in simulation.run(team, 40):
        twin = restored.step(*readings.read())
        assert_same(twin, report, "report")
        merges += len(report.renamings)
    assert merges >= 1
    assert_same(restored.get_state(), team.get_state())
