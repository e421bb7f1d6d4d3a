"""Teams of rejuvenated filters: merges, and snapshots across them."""

import copy
import pickle

import numpy as np
import pytest
from filter_contents import contents
from merged_pair import NEVER, false_alignment
from same_bits import assert_same
from simulated_team import SimulatedTeam

from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.smoother import rejuvenation as slices
from slam_backend.smoother.optimizer import find_mode
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.team import TeamSlam


def build(simulation, every=20, slice_steps=None):
    """Return a team that merges early."""
    return simulation.build(
        alignment=AlignmentOptions(min_inliers=9), attempts=AttemptOptions(every=20, new_candidates=2),
        rejuvenate_every=every, smoothing=SmoothingOptions(slice_steps=slice_steps),
    )  # fmt: skip


@pytest.mark.parametrize("slice_steps", [None, 24])
def test_a_merged_team_is_rejuvenated_and_knows_where_it_started(slice_steps):
    """Soon after a merge the joint filter is smoothed, at once or in slices; the other starts are then known."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation, slice_steps=slice_steps)
    joint = []
    for _ in range(100):
        told = team.step(*simulation.read()).rejuvenations
        joint += [report.reason for robots, report in told if robots == (0, 1, 2)]
    assert team.groups == ((0, 1, 2),)
    assert len(joint) >= 1
    assert set(joint) == {""}
    for robot in (1, 2):
        off = team.start_from_group(robot) - simulation.true_motion(robot, 0)
        assert np.hypot(off[0], off[1]) < 0.1
    assert simulation.position_errors(team).max() < 0.2


@pytest.mark.parametrize("slice_steps", [None, 12])
def test_a_snapshot_of_a_team_goes_on_through_merges_and_rejuvenations(slice_steps):
    """A restored team does, bit for bit, the same as the one that went on, its smoothers included."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation, slice_steps=slice_steps)
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


def test_a_merge_goes_on_from_what_both_groups_have_smoothed():
    """Just after a merge the joint smoother has all that the groups' smoothers had: nothing is done again."""
    simulation = SimulatedTeam(seed=101)
    team = build(simulation, slice_steps=12)
    before = {}
    for _ in range(90):
        known = {group: state["latest"] for group, state in before.items()}
        report = team.step(*simulation.read())
        before = {group.robots: smoother_of(group) for group in team._groups}
        for renaming in report.renamings:
            robots = renaming.robots_a + renaming.robots_b
            latest = before[tuple(sorted(robots))]["latest"][np.argsort(np.argsort(robots))]
            asked = np.concatenate([known[renaming.robots_a], known[renaming.robots_b]])
            assert (latest >= asked).all()
            assert (asked >= 0).all()
    assert team.groups == ((0, 1, 2),)


def smoother_of(group):
    """Return the graph of a group's joint filter as its state holds it."""
    return group.trunk.filter.get_state()["rejuvenation"]["graph"] or {"latest": np.full(len(group.robots), -1)}


def test_no_two_filters_work_on_their_smoothers_in_one_step(monkeypatch):
    """Robots that do not look for each other have steps of their own in which their filters may smooth."""
    simulation = SimulatedTeam(seed=101)
    smoothing = SmoothingOptions(slice_steps=4)
    team = simulation.build(attempts=AttemptOptions(enabled=False), rejuvenate_every=20, smoothing=smoothing)
    worked = []

    def noted(*arguments):
        worked.append(team._step)
        return find_mode(*arguments)

    monkeypatch.setattr(slices, "find_mode", noted)
    simulation.run(team, 60)
    assert len(worked) > 10
    assert len(set(worked)) == len(worked)


def test_after_an_undo_smoothers_are_as_if_they_had_never_been_joined():
    """Filters with all that their smoothers know are bit for bit those of a team that never merged, and stay so."""
    smoothing = SmoothingOptions(slice_steps=16, max_keys=40)
    (simulation, team), (other, twin) = (
        (run, run.build(attempts=NEVER, rejuvenate_every=20, smoothing=smoothing))
        for run in (SimulatedTeam(num_robots=2, seed=101) for _ in range(2))
    )
    simulation.run(team, 80)
    other.run(twin, 80)
    team.merge(0, 1, false_alignment(simulation, team, np.array([3.0, -2.0, 0.5])))
    while not any(event.kind == "undo" for event in team.events):
        assert len(simulation.run(team, 1)) == len(other.run(twin, 1)) == 1
        assert team._step < 400
    for _ in range(2):
        for robot in range(2):
            slam, same = (each._find(robot)[0].filter for each in (team, twin))
            assert_same(contents(slam), contents(same))
        simulation.run(team, 15)
        other.run(twin, 15)
