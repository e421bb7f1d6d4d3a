"""Before a merge both maps are straightened by the smoother, and have to align once more."""

from typing import Any

import numpy as np
import pytest
from filter_contents import contents
from merged_pair import NEVER
from same_bits import assert_same
from simulated_team import SimulatedTeam

from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import between
from slam_backend.maps.alignment import AlignmentOptions, align_maps
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.team import merge_attempt as trying
from slam_backend.team.branches import restored_filter
from slam_backend.team.communication import LANDMARK_BYTES
from slam_backend.team.filter_merging.merging import merge_filters, motion_covariance, paired
from slam_backend.team.groups import Group
from slam_backend.team.merge_scheduler import AttemptOptions
from slam_backend.team.options import MergeOptions
from slam_backend.team.team import TeamSlam

STEPS = 80
AT_LAST = AttemptOptions(every=STEPS)  # the only attempt comes with the last step
AS_IT_IS = MergeOptions(straighten=False)


def driven(seed: int, attempts: AttemptOptions, **options: object) -> tuple[SimulatedTeam, TeamSlam]:
    """Return two robots with few particles, whose maps are bent, after `STEPS` steps."""
    simulation = SimulatedTeam(num_robots=2, seed=seed)
    team = simulation.build(attempts=attempts, num_particles=8, **options)
    simulation.run(team, STEPS)
    return simulation, team


def both_maps(team: TeamSlam) -> tuple[LandmarkMap, LandmarkMap]:
    """Return the maps that an attempt compares."""
    return team.map(0, "mixture"), team.map(1, "mixture")


def straightened(slam: FastSlam) -> FastSlam:
    """Return a copy that is straightened."""
    copied = restored_filter(slam.get_state())
    assert copied.rejuvenate().reason == ""
    return copied


def test_a_filter_that_never_rejuvenates_can_be_told_to() -> None:
    """It finds the map that another one finds, which keeps a smoother, but for where it begins to seek."""
    maps = []
    for every in (None, 1000):
        slam = driven(111, NEVER, rejuvenate_every=every)[1]._find(0)[0].filter
        before = slam.map()
        assert slam.rejuvenate().reason == ""
        assert (slam.state.rejuvenation is None) == (every is None)
        after = slam.map()
        moved = after.means[np.isin(after.ids, before.ids)] - before.means[np.isin(before.ids, after.ids)]
        assert np.abs(moved).max() > 0.01
        maps.append(after)
    assert_same(maps[0].ids, maps[1].ids)
    np.testing.assert_allclose(maps[0].means, maps[1].means, atol=1e-3)


def test_a_merge_is_that_of_straightened_maps() -> None:
    """What is merged, and by which motion, is what both filters are after they were told to rejuvenate."""
    _, alone = driven(112, NEVER)
    _, team = driven(112, AT_LAST)
    sides = [straightened(alone._find(robot)[0].filter) for robot in range(2)]
    rng = alone._rng
    bent = align_maps(*both_maps(alone), rng=rng)
    found = align_maps(sides[0].map("mixture"), sides[1].map("mixture"), rng=rng)
    assert [event.kind for event in team.events] == ["attempt", "merge"]
    assert_same(team.events[0].bent, bent)
    assert_same(team.events[1].alignment, found)
    assert_same(team.merged_maps(team.events[1]), tuple(side.map() for side in sides))
    watch = team._find(0)[0].watches[0]
    for side, of_side, before in zip(watch.sides, sides, watch.before, strict=True):
        assert_same(side.trunk["filter"]["poses"], of_side.get_state()["poses"])
        assert len(before) == len(of_side.map())


@pytest.mark.slow
def test_straight_maps_are_merged_more_truly() -> None:
    """Over twelve pairs of bent maps the motions by which they are merged are off by less than 0.8 of the distance."""
    errors = []
    for merging in (AS_IT_IS, MergeOptions()):
        found = []
        for seed in range(120, 132):
            simulation, team = driven(seed, AT_LAST, merging=merging)
            off = team.events[-1].alignment.transform - simulation.true_motion(0, 1)
            found.append(np.hypot(*off[:2]))
        errors.append(np.array(found))
    both = np.isfinite(errors[0]) & np.isfinite(errors[1])
    assert np.count_nonzero(both) >= 10
    assert np.sqrt(np.mean(errors[1][both] ** 2)) < 0.8 * np.sqrt(np.mean(errors[0][both] ** 2))


def test_maps_that_no_longer_fit_are_not_merged() -> None:
    """Where only the bent maps are believed the attempt is refused, with the reason of the second alignment."""
    sigmas = []
    for merging in (AS_IT_IS, MergeOptions()):
        covariance = driven(113, AT_LAST, merging=merging)[1].events[-1].alignment.covariance
        sigmas.append(np.sqrt(np.linalg.eigvalsh(covariance[:2, :2])[-1]))
    assert sigmas[0] < sigmas[1]
    strict = AlignmentOptions(max_sigma_position=float(np.mean(sigmas)))
    _, team = driven(113, AT_LAST, alignment=strict)
    event = team.events[0]
    assert (event.kind, event.alignment.reason) == ("attempt", "too uncertain")
    assert event.bent is not None
    assert event.bent.success
    assert len(team.events) == 1
    assert team.groups == ((0,), (1,))
    assert not team._schedule.may_try(((0,), (1,)), STEPS)


@pytest.mark.parametrize("every", [4, 2])
def test_maps_that_agree_on_less_once_straight_are_not_merged(every: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """A smoother that has lost its way is not believed: the attempt is refused, and the filters are as they were."""
    _, alone = driven(112, NEVER)
    original = trying.straightened

    def lost(a: Group, b: Group) -> tuple[LandmarkMap, LandmarkMap]:
        maps = original(a, b)
        assert maps is not None
        return maps[0].subset(np.flatnonzero(np.arange(len(maps[0])) % every)), maps[1]

    monkeypatch.setattr(trying, "straightened", lost)
    _, team = driven(112, AT_LAST)
    event = team.events[0]
    assert (len(team.events), event.alignment.reason) == (1, "too few inliers")
    assert event.bent is not None
    for robot in range(2):
        assert_same(contents(team._find(robot)[0].filter), contents(alone._find(robot)[0].filter))


def test_what_cannot_be_bent_is_merged_as_it_is() -> None:
    """Poses that are given as exact leave nothing to smooth: the merge is that without `straighten`, bit for bit."""
    states = []
    for merging in (AS_IT_IS, MergeOptions()):
        simulation = SimulatedTeam(num_robots=2, seed=114)
        team = simulation.build(attempts=AT_LAST, num_particles=3, merging=merging)
        for _ in range(STEPS):
            odometry, frames = simulation.read()
            poses = [between(start, pose) for start, pose in zip(simulation.starts, simulation.poses, strict=True)]
            team.step(odometry, frames, poses=poses)
        assert len(team.groups) == 1
        assert team.events[0].bent is None
        states.append(team.get_state() | {"merging": None})
    assert_same(states[0], states[1])


def test_straightened_maps_are_sent_once_more() -> None:
    """Both speakers send all their landmarks again, without descriptors."""
    sent = []
    for merging in (AS_IT_IS, MergeOptions()):
        _, team = driven(112, AT_LAST, merging=merging)
        sent.append(team.bytes_sent)
    again = [len(before) * LANDMARK_BYTES for before in team._find(0)[0].watches[0].before]
    assert (sent[1] - sent[0]).tolist() == again


def test_whether_to_straighten_is_a_bool() -> None:
    """A number is refused."""
    with pytest.raises(ValueError, match=r"merging\.straighten: expected True or False, got 1\. Give a bool"):
        MergeOptions(straighten=1)  # type: ignore[arg-type]


def test_the_spread_of_motions_is_that_of_the_particles_that_a_merge_makes() -> None:
    """It is the scatter of where the joint filter's particles let the other robot start, told before the merge."""
    _, team = driven(112, NEVER)
    a, b = (team._find(robot)[0].filter for robot in range(2))
    alignment = align_maps(*both_maps(team), rng=np.random.default_rng(1))
    pairs = np.column_stack([a.map().ids[alignment.inliers[:, 0]], b.map().ids[alignment.inliers[:, 1]]])
    motion = paired(a, b, alignment, pairs, np.random.default_rng(2)).motion
    foretold = motion_covariance(motion, alignment)
    joint, _ = merge_filters(a, b, alignment, pairs, np.random.default_rng(2))
    starts = joint.state.starts[1, :, : joint.num_particles].T
    np.testing.assert_allclose(foretold, np.cov(starts.T, bias=True), atol=1e-12)


def test_a_pair_too_uncertain_to_merge_waits_and_merges_later() -> None:
    """Where particles differ in the motion by more than is sure the attempt is refused, until waiting helps no more."""
    rhythm = AttemptOptions(every=20)
    _, team = driven(112, rhythm, merging=MergeOptions(sure=0.0))
    assert [event.kind for event in team.events] == ["attempt", "merge"]
    simulation, team = driven(112, rhythm, merging=MergeOptions(sure=1e4))  # 0.05 mm
    assert team.events[0].alignment.reason == "too uncertain"
    simulation.run(team, STEPS)
    *attempts, merge = team.events
    reasons = [event.alignment.reason for event in attempts]
    assert reasons.count("too uncertain") == len(reasons) - 1 >= 1
    assert reasons[-1] == ""
    assert merge.kind == "merge"
    assert len(team.groups) == 1


@pytest.mark.parametrize("how", [{}, {"merged_particles": 5}])
def test_being_sure_leaves_no_trace(how: dict[str, Any]) -> None:
    """Whether particles agree is only looked at: the merge is bit for bit that of a team which does not ask."""
    states = [driven(112, AT_LAST, merging=MergeOptions(sure=sure, **how))[1].get_state() for sure in (0.0, 1e-6)]
    assert_same(*({"filter": state["groups"], "rng": state["rng"]} for state in states))


def test_how_sure_a_merge_has_to_be_is_a_number_of_deviations() -> None:
    """Fewer than none are refused."""
    with pytest.raises(ValueError, match=r"merging\.sure: expected a finite number >= 0, got -1\.0\. Use 5, or 0"):
        MergeOptions(sure=-1.0)


def test_maps_of_a_merge_that_is_not_watched_are_not_at_hand() -> None:
    """Where merges are final, or nothing was merged, asking for the maps that were joined is refused."""
    _, team = driven(112, AT_LAST, merging=MergeOptions(watch_steps=0))
    for event in team.events:
        with pytest.raises(ValueError, match=r"merge: expected a merge still watched, got 'the (attempt|merge) of"):
            team.merged_maps(event)
