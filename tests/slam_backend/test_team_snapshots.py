"""Snapshots of a team: `get_state` and `set_state`."""

import copy
import pickle

import pytest
from same_bits import assert_same
from simulated_team import SimulatedTeam

from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.team import TeamSlam


@pytest.mark.parametrize("steps_before", [40, 70])
def test_a_team_goes_on_from_a_snapshot_bit_for_bit_through_later_merges(steps_before: int) -> None:
    """A restored team, built with other options and another seed, does the same as the one that went on."""
    simulation = SimulatedTeam(seed=2)
    team = simulation.build(
        alignment=AlignmentOptions(min_inliers=9), attempts=AttemptOptions(every=20, new_candidates=2)
    )
    simulation.run(team, steps_before)
    state = pickle.loads(pickle.dumps(team.get_state()))
    restored = TeamSlam(3, seed=99)
    restored.set_state(state)
    kept, readings = copy.deepcopy(state), copy.deepcopy(simulation)
    merges = 0
    for report in simulation.run(team, 50):
        twin = restored.step(*readings.read())
        assert_same(twin, report, "report")
        merges += len(report.renamings)
    assert merges >= 1
    assert_same(restored.get_state(), team.get_state())
    assert_same(state, kept)  # the snapshot itself did not change meanwhile
