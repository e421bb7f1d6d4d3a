"""Diagnosis of a log's set-up: usual mistakes are named, right logs are not blamed."""

from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slam_backend.diagnosis import CAUSES, LOOK_ALIKES, diagnose, find_look_alikes, find_motions
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.smoother.log_arrays import ODOMETRY, LogArrays
from slam_backend.smoother.reassociation import LandmarkTable
from slam_backend.team.team import TeamSlam
from studies.filters import circle_world
from studies.filters.circle_world import MOTION, CircleLog, Mistake, circle_log


@pytest.mark.parametrize("by_names", [True, False])
@pytest.mark.parametrize("mistake", get_args(Mistake))
def test_a_mistake_is_named_alone(mistake: Mistake, by_names: bool) -> None:
    """Each mistake is named in three of three logs, and nothing else; a right log gets no word."""
    for seed in range(500, 503):
        log = circle_log(mistake, seed)
        found = diagnose(log.odometry, log.measurements, log.identities if by_names else None, motion=MOTION)
        assert [cause.name for cause in found] == ([] if mistake == "none" else [mistake])
        assert all(cause.text and "{" not in cause.text for cause in found)
        assert {cause.name for cause in found} <= CAUSES.keys()


@given(st.integers(0, 2**31))
@settings(max_examples=20)
def test_turns_without_rhyme_tell_of_no_axis(seed: int) -> None:
    """Turns that agree with the sightings in neither sense, as degrees modulo full turns, blame no axis or scale."""
    log, turns = circle_log("none", 500), np.random.default_rng(seed).uniform(-np.pi, np.pi, 300)
    changed = np.column_stack([log.odometry[:, :2], turns[: len(log.odometry)]])
    found = {cause.name for cause in diagnose(changed, log.measurements, log.identities, motion=MOTION)}
    assert found <= {"odometry noise", "odometry in degrees"}


@pytest.mark.parametrize("mistake", get_args(Mistake))
def test_a_filter_names_the_mistakes_in_its_own_readings(mistake: Mistake) -> None:
    """With identities a filter says of its readings what is said of the log, in a team too."""
    log = circle_log(mistake, 500)
    assert said_by_filters(log, log.measurements, log.identities) == ([] if mistake == "none" else [mistake])


def said_by_filters(log: CircleLog, frames: list[Measurements], identities: list[Any] | None = None) -> list[str]:
    """Return what a filter says of its readings; the team of a robot with them, and one without, says the same."""
    slam, team = FastSlam(motion=MOTION, seed=0), TeamSlam(2, seed=0, motion=MOTION)
    for step, (odometry, frame) in enumerate(zip(log.odometry, frames, strict=True)):
        names = None if identities is None else identities[step]
        slam.step([odometry], [frame], [names])
        team.step([None, odometry], [None, frame], identities=[None, names])
    assert team.diagnose(0) == ()
    said = [cause.name for cause in slam.diagnose()]
    assert [cause.name for cause in team.diagnose(1)] == said
    return said


def test_filters_say_that_look_alikes_do_not_tell_where_a_robot_is() -> None:
    """That is said of landmarks that all look alike and have no identities, not of a few, nor of different ones."""
    log = circle_log("none", 500)
    alike = [Measurements(frame.points, np.ones_like(frame.descriptors)) for frame in log.measurements]
    assert said_by_filters(log, alike) == [LOOK_ALIKES]
    assert said_by_filters(log, alike, log.identities) == []
    assert said_by_filters(log, log.measurements) == []
    for count in (0, 1):
        few = [Measurements(frame.points[:count], frame.descriptors[:count]) for frame in alike]
        assert LOOK_ALIKES not in said_by_filters(log, few)


@given(st.integers(0, 20), st.integers(0, 20), st.booleans())
def test_look_alikes_are_many_and_seen_together(alike: int, distinct: int, together: bool) -> None:
    """Landmarks of one frame that look like more than six others are look-alikes; copies of one are never together."""
    count = alike + distinct
    looks = np.eye(21, dtype=np.float32)[np.r_[np.zeros(alike, np.int64), 1 : distinct + 1]]
    known = LandmarkTable(np.arange(count), np.zeros((count, 3)), np.zeros((count, 6)), np.ones(count, np.int32), looks)
    frames = min(count, 1) if together else count
    log = LogArrays(
        steps=np.arange(frames), kinds=np.full(frames, ODOMETRY, np.int8), motions=np.zeros((frames, 3)),
        given=np.zeros(frames, np.bool_), starts=np.linspace(0, count, frames + 1).astype(np.int64),
        points=np.zeros((count, 3)), ids=np.arange(count), covariances=None,
    )  # fmt: skip
    said = [(cause.name, cause.ratio) for cause in find_look_alikes(log, known, descriptor_gate=0.45)]
    expected = together and count >= 10 and alike > 7 and distinct < 5
    assert said == ([(LOOK_ALIKES, distinct / count)] if expected else [])


def test_a_filter_with_exact_poses_or_no_step_says_nothing() -> None:
    """There is no odometry to judge."""
    slam = FastSlam()
    assert slam.diagnose() == ()
    log = circle_log("sign of turns", 500)
    for step in range(60):
        slam.step([None], [log.measurements[step]], [log.identities[step]], poses=[np.zeros(3)])
    assert slam.diagnose() == ()
    with pytest.raises(ValueError, match="robot: expected"):
        slam.diagnose(1)


@settings(max_examples=20, deadline=None)
@given(st.floats(0.5, 2.0), st.integers(0, 1000))
def test_scales_are_measured(scale: float, seed: int) -> None:
    """The ratio of distances is that by which the odometry is wrong, to 3 %; below 15 % it is no mistake."""
    log = circle_log("none", seed)
    odometry = log.odometry * [1.0 / scale, 1.0 / scale, 1.0]
    found = diagnose(odometry, log.measurements, log.identities, motion=MOTION)
    true = scale / 1.02  # the log's odometry is 2 % too long
    if abs(true - 1.0) > 0.19:
        assert [cause.name for cause in found] == ["scale"]
        assert found[0].ratio == pytest.approx(true, rel=0.03)
    elif abs(true - 1.0) < 0.11:
        assert found == ()


@pytest.mark.parametrize("late", [-4, -2, 3])
def test_a_delay_of_the_odometry_is_named_in_steps(late: int) -> None:
    """Where turns change, odometry that is some steps late or early is named, with the number of steps."""
    rng, log = np.random.default_rng(late + 10), circle_log("none", 1)
    turns = np.where(np.arange(len(log.odometry)) // 15 % 2, 0.15, -0.05)
    path, frames = np.zeros((len(turns), 3)), []
    marks, looks = rng.uniform(-12.0, 12.0, (150, 2)), rng.normal(size=(150, 64)).astype(np.float32) / 8.0
    for step in range(len(turns)):
        if step:
            path[step] = compose(path[step - 1], np.array([0.1, 0.0, turns[step]]))
        local = transform_points(inverse(path[step]), marks)
        near = np.flatnonzero((local[:, 0] > 0.5) & (np.abs(local[:, 1]) < local[:, 0]) & (local[:, 0] < 6.0))
        points = np.column_stack([-local[near, 1], np.zeros(len(near)), local[near, 0]])
        noise = np.tile(1e-4 * np.eye(3), (len(near), 1, 1))
        frames.append(Measurements(points + rng.normal(0.0, 0.01, points.shape), looks[near], noise))
    odometry = np.column_stack([np.full(len(turns), 0.1), np.zeros(len(turns)), turns])
    assert diagnose(odometry, frames, motion=MOTION) == ()
    (cause,) = diagnose(np.roll(odometry, late, axis=0), frames, motion=MOTION)
    assert (cause.name, cause.ratio) == ("delay", late)


def test_motions_are_those_of_the_robot(monkeypatch: pytest.MonkeyPatch) -> None:
    """With hardly any noise the sightings tell the motion over each window, and their points fit as assumed."""
    monkeypatch.setattr(circle_world, "POINT_NOISE", 1e-6)
    log = circle_log("none", 3)
    found = find_motions(log.odometry, log.measurements, log.identities, StereoCamera(), MOTION)
    assert len(found.turns) == 30
    steps = np.round(found.sighted[:, 2] / circle_world.MOVE[2])
    assert ((steps >= 9.0) & (steps <= 10.0)).all()
    np.testing.assert_allclose(found.sighted[:, 2], steps * circle_world.MOVE[2], atol=1e-5)
    chords = 2.0 * 4.0 * np.sin(0.5 * found.sighted[:, 2])
    np.testing.assert_allclose(np.hypot(*found.sighted[:, :2].T), chords, rtol=1e-3)  # the circle is a polygon
    assert found.fits.max() < 0.1  # the smallest variance of the fit adds to such small ones


def test_logs_that_tell_nothing_get_no_word() -> None:
    """Empty frames, single landmarks, look-alikes without identities, and short logs are not judged."""
    log = circle_log("sign of turns", 1)
    alike = [Measurements(frame.points, np.ones((len(frame), 1), np.float32)) for frame in log.measurements]
    one = [Measurements(frame.points[:1], frame.descriptors[:1]) for frame in log.measurements]
    empty = [Measurements(frame.points[:0], frame.descriptors[:0]) for frame in log.measurements]
    for frames in (alike, one, empty, [None] * len(log.odometry)):
        assert diagnose(log.odometry, frames, motion=MOTION) == ()
    assert diagnose(log.odometry[:30], log.measurements[:30], motion=MOTION) == ()


def test_bad_arguments_are_refused() -> None:
    """Lengths that disagree are named."""
    log = circle_log("none", 1)
    with pytest.raises(ValueError, match="measurements: expected a list of 300 entries, one for each step, got a list"):
        diagnose(log.odometry, log.measurements[:-1])
    with pytest.raises(ValueError, match="identities: expected a list of 300 entries"):
        diagnose(log.odometry, log.measurements, log.identities[:-1])
    with pytest.raises(ValueError, match="odometry: expected"):
        diagnose(log.odometry[:, :2], log.measurements)
