"""Scores of a team under one alignment."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.metrics import ate, match_times, rpe, score_team
from slam_backend.trajectory import Trajectory


def path(seed: int, count: int = 40, begin: float = 0.0) -> Trajectory:
    """Return a random path with a pose each tenth of a second."""
    rng = np.random.default_rng(seed)
    poses = np.cumsum(rng.normal(0.0, 0.2, (count, 3)), axis=0)
    poses[:, 2] = (poses[:, 2] + math.pi) % (2.0 * math.pi) - math.pi
    return Trajectory(begin + 0.1 * np.arange(count), poses)


def moved(paths: list[Trajectory], motion: np.ndarray) -> list[Trajectory]:
    """Return paths in another frame."""
    return [Trajectory(each.times, compose(motion, each.poses)) for each in paths]


@given(st.floats(-3.0, 3.0), st.floats(-50.0, 50.0), st.floats(-50.0, 50.0))
def test_a_common_frame_costs_nothing(theta: float, x: float, y: float) -> None:
    """Paths and landmarks that are right but for one motion have no error, and the motion is found."""
    truth, motion = [path(0), path(1, 25)], np.array([x, y, theta])
    landmarks = np.random.default_rng(2).uniform(-9.0, 9.0, (12, 3))
    score = score_team(
        moved(truth, inverse(motion)), truth, transform_points(inverse(motion), landmarks), landmarks
    )  # fmt: skip
    assert score.ate < 1e-9
    np.testing.assert_allclose(score.transform[:2], motion[:2], atol=1e-9)
    assert score.map is not None
    assert (score.map.recall, score.map.precision) == (1.0, 1.0)
    assert score.map.rmse < 1e-9


def test_frames_of_their_own_cost_what_one_alignment_leaves() -> None:
    """Two right paths in frames that disagree have an error under one alignment, and none each alone."""
    truth = [path(0), path(1)]
    score = score_team([truth[0], *moved([truth[1]], np.array([2.0, 0.0, 0.0]))], truth)
    assert score.ate > 0.5
    assert all(robot.own_ate < 1e-9 < robot.ate for robot in score.robots)
    assert all(robot.rpe is not None and robot.rpe.translation < 1e-9 for robot in score.robots)
    together = [np.concatenate([each.poses for each in side]) for side in (truth, truth)]
    together[0] = together[0] + np.r_[np.zeros((40, 3)), np.tile([2.0, 0.0, 0.0], (40, 1))]
    assert score.ate == pytest.approx(ate(*together).aligned)


def test_one_robot_has_the_scores_of_its_path() -> None:
    """With one robot the score is `ate` and `rpe`."""
    guess, true = path(3), path(4)
    score = score_team([guess], [true], delta=3)
    assert score.ate == score.robots[0].ate == pytest.approx(ate(guess.poses, true.poses).aligned)
    assert score.robots[0].rpe is not None
    assert score.robots[0].rpe.rotation == pytest.approx(rpe(guess.poses, true.poses, 3).rotation)
    assert score_team([path(3, 2)], [path(4)], delta=2).robots[0].rpe is None


@given(st.lists(st.floats(0.0, 9.0), min_size=1, max_size=30, unique=True),
       st.lists(st.floats(0.0, 9.0), min_size=1, max_size=30, unique=True), st.floats(0.0, 0.5))  # fmt: skip
def test_times_are_matched_with_the_nearest(first: list[float], second: list[float], gap: float) -> None:
    """Each pose of the shorter path has the nearest one of the other within the gap, and none otherwise."""
    a, b = np.sort(first), np.sort(second)
    rows = match_times(a, b, gap)
    short, long = (a, b) if len(a) <= len(b) else (b, a)
    own, other = (rows[:, 0], rows[:, 1]) if len(a) <= len(b) else (rows[:, 1], rows[:, 0])
    nearest = np.abs(long[None] - short[:, None]).min(axis=1)
    np.testing.assert_array_equal(own, np.flatnonzero(nearest <= gap))
    np.testing.assert_allclose(np.abs(long[other] - short[own]), nearest[own])


def test_heights_that_one_side_lacks_do_not_count() -> None:
    """A planar map is compared with true landmarks in the plane."""
    truth = [path(0)]
    landmarks = np.random.default_rng(5).uniform(-9.0, 9.0, (8, 3))
    score = score_team(truth, truth, landmarks[:6, :2], landmarks)
    assert score.map is not None
    assert (score.map.recall, score.map.precision) == (0.75, 1.0)


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (([], []), "estimated: expected at least one path, got no path"),
        (([path(0)], [path(0), path(1)]), "truth: expected as many paths as estimated ones, 1, got 2"),
        (([path(0)], [path(0, begin=100.0)]), "estimated: expected paths that overlap in time"),
        (([path(0)], [path(0)], np.zeros((3, 3))), "true_landmarks: expected positions, got no positions"),
        (([path(0)], [path(0)], np.zeros((3, 4)), np.zeros((3, 3))), "landmarks: expected an array of shape"),
    ],
)
def test_bad_input_is_named(arguments: tuple[object, ...], says: str) -> None:
    """Numbers of paths, clocks, and kinds of landmarks."""
    with pytest.raises(ValueError, match=says):
        score_team(*arguments)  # type: ignore[arg-type]
