"""An attempt of filters that smooth in slices takes some steps: their maps are straight before they align once more."""

import copy
import pickle

import numpy as np
import pytest
from merged_pair import links
from same_bits import assert_same
from simulated_team import SimulatedTeam

from slam_backend.maps.alignment import align_maps
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.team.merge_attempt import MOST_STEPS
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.team import TeamSlam

STEPS = 80
AT_LAST = AttemptOptions(every=STEPS)  # the first attempt comes with the last step
SOON = 40  # a few slices of each filter, every fourth step one


def trying(seed: int) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots in the step in which their maps, as their filters bent them, have just been found to fit."""
    simulation = SimulatedTeam(num_robots=2, seed=seed)
    smoothing = SmoothingOptions(slice_steps=20)
    team = simulation.build(attempts=AT_LAST, num_particles=8, rejuvenate_every=1000, smoothing=smoothing)
    simulation.run(team, STEPS)
    assert team._schedule.straightening is not None
    assert team.events == ()
    return simulation, team


def test_an_attempt_goes_on_when_both_maps_are_straight() -> None:
    """In the step after the second filter has drawn its particles anew the maps align again, and merge by that."""
    simulation, team = trying(112)
    bent = team._schedule.straightening
    assert bent is not None
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
    assert_same(attempt.bent, bent.bent)
    watch = team._find(0)[0].watches[0]
    assert_same(align_maps(*watch.before, rng=rng), merge.alignment)
    assert team._schedule.straightening is None


def test_an_attempt_goes_on_from_a_snapshot() -> None:
    """A team restored between two slices does the same, bit for bit, as the one that went on."""
    simulation, team = trying(115)
    simulation.run(team, 1)
    state = pickle.loads(pickle.dumps(team.get_state()))
    restored, readings = TeamSlam(2, seed=99), copy.deepcopy(simulation)
    restored.set_state(state)
    for report in simulation.run(team, SOON):
        assert_same(restored.step(*readings.read()), report)
    assert [event.kind for event in restored.events] == ["attempt", "merge"]
    assert_same(restored.get_state(), team.get_state())


@pytest.mark.parametrize("apart", [MOST_STEPS // 2, MOST_STEPS])
def test_an_attempt_outlives_contact_lost_for_a_while(apart: int) -> None:
    """Maps are straightened without contact; they align in the first step with it, unless that comes too late."""
    simulation, team = trying(112)
    simulation.run(team, apart, links(2))
    assert team.events == ()
    assert (team._schedule.straightening is None) == (apart == MOST_STEPS)
    simulation.run(team, 1)
    assert [event.kind for event in team.events] == ([] if apart == MOST_STEPS else ["attempt", "merge"])
    simulation.run(team, STEPS + SOON - apart)
    assert [event.kind for event in team.events] == ["attempt", "merge"]


def test_an_attempt_waits_for_straight_maps_no_longer_than_it_may() -> None:
    """Filters that read nothing do not smooth: their maps are taken as they are, and nobody else waits for ever."""
    _, team = trying(112)
    for _ in range(MOST_STEPS + 1):
        assert team.events == ()
        team.step([None, None], [None, None])
    attempt = team.events[0]
    assert attempt.step == STEPS - 1 + MOST_STEPS + 1
    assert attempt.bent is not None
    np.testing.assert_allclose(attempt.alignment.transform, attempt.bent.transform, atol=1e-9)


@pytest.mark.parametrize(("every", "slices"), [(None, 20), (1000, None)])
def test_only_a_smoother_that_works_in_slices_can_be_waited_for(every: int | None, slices: int | None) -> None:
    """Without one, or where it does all at once, the attempt is over in the step in which it is made."""
    simulation = SimulatedTeam(num_robots=2, seed=112)
    smoothing = SmoothingOptions(slice_steps=slices)
    team = simulation.build(attempts=AT_LAST, num_particles=8, rejuvenate_every=every, smoothing=smoothing)
    assert not team._find(0)[0].filter.smooths_in_slices
    simulation.run(team, STEPS)
    assert [event.step for event in team.events] == [STEPS - 1] * 2
