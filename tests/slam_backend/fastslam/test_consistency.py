"""A filter that claims too much is warned of, an honest one hardly ever is, and the test is part of the state."""

from dataclasses import asdict, replace
from typing import Any

import numpy as np
import pytest
from builders.teams import MOTION, NEVER, SimulatedTeam, links, merged_team

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.consistency import (
    FALSE_ALARM_RATE,
    LOW_ESS,
    NIS_BOUNDS,
    USUAL,
    VERDICTS,
    Consistency,
    ConsistencyTest,
    ConsistencyWarning,
)
from slam_backend.fastslam.filter import FastSlam
from slam_backend.models.odometry import OdometryModel


def tell(answers: Any, share: FloatArray) -> bool:
    """Return whether a test warns in a life of frames that show the signs with these probabilities (T, 4)."""
    test = ConsistencyTest()
    for step, (near, far, low, rejected) in enumerate(answers.random(share.shape) < share):
        nis = NIS_BOUNDS[1] + 1.0 if far else NIS_BOUNDS[0] + 1.0 if near else 1.0
        test.update(step, nis, 0.5 * LOW_ESS if low else 1.0, 4, 3 if rejected else 1)
    return bool(test.report().warnings)


def test_false_alarm_rate_is_below_the_stated_bound() -> None:
    """Of 400 lives of 3,000 frames that show each sign as often as an honest filter may, at most 1 % are warned of.

    By Ville's inequality 4 are expected at most; more than 10 have a probability below 0.003.
    """
    rng = np.random.default_rng(0)
    share = np.tile(USUAL, (3000, 1))
    share[:, 0] -= USUAL[1]  # beyond the farther bound is beyond the nearer one, too
    alarms = sum(tell(rng, share) for _ in range(400))
    assert alarms <= 10
    assert pytest.approx(0.01) == FALSE_ALARM_RATE


@pytest.mark.parametrize("sign", [0, 2, 3])
@pytest.mark.parametrize("begins", [0, 2000])
def test_an_inconsistent_filter_is_detected_whenever_it_begins(sign: int, begins: int) -> None:
    """A sign in three frames of ten, six times the usual share, is found within 200 frames, early or late."""
    rng = np.random.default_rng(sign)
    share = np.tile(np.array(USUAL) / 2.0, (begins + 200, 1))
    share[begins:, sign] = 0.3
    assert all(tell(rng, share) for _ in range(20))
    assert not any(tell(rng, share[:begins]) for _ in range(20))


def life(seed: int, assumed: float = 1.0, bias: FloatArray | None = None, **options: Any) -> FastSlam:
    """Return the filter of a robot that goes round a ring, with odometry noise assumed so many times the true one."""
    simulation = SimulatedTeam(1, seed)
    motion = OdometryModel(**{name: assumed * sigma for name, sigma in asdict(MOTION).items()})
    chosen: dict[str, Any] = {"num_particles": 50, "motion": motion, "rejuvenate_every": 25}
    slam = FastSlam(seed=seed, **(chosen | options))
    for _ in range(250):
        odometry, frames = simulation.read()
        if bias is not None and odometry[0] is not None:
            odometry = [odometry[0] + bias]
        slam.step(odometry, frames)
    return slam


@pytest.mark.slow
def test_false_alarms_on_a_matched_model() -> None:
    """Sixty filters that assume the true noise: none is warned of, with and without rejuvenation (1 % is stated)."""
    for seed in range(30):
        for every in (None, 25):
            assert not life(seed, rejuvenate_every=every).consistency.warnings


@pytest.mark.parametrize(
    "changes", [{"assumed": 1 / 3, "rejuvenate_every": None}, {"bias": np.array([0.0, 0.0, 0.015])}]
)
def test_mismatched_odometry_is_found(changes: dict[str, Any]) -> None:
    """Odometry three times as bad as assumed, or with a biased turn, is reported within 250 steps, with what to try."""
    told = [life(seed, **changes).consistency for seed in range(3)]
    assert all("nis" in [warning.sign for warning in one.warnings] for one in told)
    assert "assume more odometry noise" in told[0].warnings[0].text
    assert told[0].to_mapping()["warnings"][0]["text"] == told[0].warnings[0].text


def test_an_underconfident_filter_gives_no_warning() -> None:
    """Twice the true noise of odometry and camera is assumed: the mean NIS is far below 3, and nothing is said."""
    told = life(0, assumed=2.0).consistency
    assert told.nis_mean < 3.0
    assert told.warnings == ()


@pytest.mark.parametrize(
    ("nis_mean", "verdict"),
    [
        (4.1, "over-confident"), (4.001, "over-confident"), (4.0, "consistent"), (1.0, "consistent"),
        (0.999, "cautious"), (float("nan"), "unknown"),
    ],
)  # fmt: skip
def test_a_verdict_follows_the_mean_nis_and_warnings(nis_mean: float, verdict: str) -> None:
    """Without warnings the mean decides; a warning makes any filter inconsistent."""
    told = Consistency(100, nis_mean, 0.0, 0.0, 0.0, ())
    assert told.verdict == told.to_mapping()["verdict"] == verdict
    assert verdict in VERDICTS
    assert replace(told, warnings=(ConsistencyWarning("ess", 3, 0.5),)).verdict == "inconsistent"


def test_the_consistency_test_continues_from_a_state() -> None:
    """A restored filter reports the same as the original, and its state holds the running sums."""
    slam = life(1)
    twin = FastSlam(num_particles=3)
    twin.set_state(slam.get_state())
    assert twin.consistency == slam.consistency
    simulation = SimulatedTeam(1, 5)
    for _ in range(30):
        odometry, frames = simulation.read()
        for each in (slam, twin):
            each.step(odometry, frames)
    assert twin.consistency == slam.consistency
    assert twin.get_state()["consistency"] == slam.get_state()["consistency"]


def test_rejected_measurements_and_empty_frames_do_not_count() -> None:
    """Measurements named -1 are none, and a step without any is no frame."""
    simulation = SimulatedTeam(1, 0)
    slam = FastSlam(num_particles=7)
    for _ in range(20):
        odometry, frames = simulation.read()
        slam.step(odometry, frames, identities=[[-1] * len(frames[0])])
        slam.step(odometry, [None])
    assert slam.consistency.frames == 0


def test_diagnostics_are_per_robot_and_a_merge_keeps_warnings() -> None:
    """A team's figures are those of the filter that a robot goes by; a joint filter keeps both sides' warnings."""
    simulation = SimulatedTeam(2, 0)
    wrong = OdometryModel(**{name: sigma / 5.0 for name, sigma in asdict(MOTION).items()})
    team = simulation.build(attempts=NEVER, num_particles=13, motion=wrong)
    simulation.run(team, 150, links(2))
    before = [team.consistency(robot) for robot in range(2)]
    assert [row["warnings"] for row in team.diagnostics] == [float(len(one.warnings)) for one in before]
    assert all(one.warnings for one in before)
    joint = ConsistencyTest.joined(*(group.trunk.filter._consistency for group in team._groups)).report()
    assert joint.frames == sum(each.frames for each in before)
    assert joint.nis_share == pytest.approx(sum(each.nis_share * each.frames for each in before) / joint.frames)
    assert {one.sign for one in joint.warnings} == {one.sign for each in before for one in each.warnings}
    simulation = SimulatedTeam(2, 1)
    merged = merged_team(simulation)
    frames = merged.consistency(0).frames
    simulation.run(merged, 3)
    assert merged.consistency(0) == merged.consistency(1)
    assert merged.consistency(0).frames == frames + 3
