"""The study of robots that exchange maps: its map error, and one short episode."""

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from slam_backend import LandmarkMap
from slam_backend.geometry import inverse, transform_points
from studies.merging.robots import Config, map_error, play, trials

TRUE = np.array([[0.0, 0.0, 0.0], [5.0, 0.0, 0.0], [0.0, 5.0, 1.0], [5.0, 5.0, 0.0]])
START = np.array([1.0, 2.0, 0.7])


def error_of(means: Any, observable: tuple[int, ...] = (0, 1, 2, 3)) -> tuple[float, float]:
    """Return error and recall of a map with these landmarks (n, 3), world frame."""
    own = transform_points(inverse(START), np.asarray(means, np.float64))
    landmarks = LandmarkMap(own, np.tile(np.eye(3), (len(own), 1, 1)), np.ones((len(own), 2)))
    episode: Any = SimpleNamespace(landmarks=TRUE, observable=np.array(observable))
    return map_error(landmarks, START, episode)


def test_a_map_of_the_truth_has_no_error() -> None:
    """The truth, seen from any start, has error 0 and recall 1; half of it misses half."""
    assert error_of(TRUE) == (pytest.approx(0.0, abs=1e-12), 1.0)
    assert error_of(TRUE[:2]) == (pytest.approx(0.5), 0.5)


def test_false_and_unobservable_landmarks() -> None:
    """A false landmark costs as much as a missed one; one that cannot be observed costs nothing, present or not."""
    assert error_of([*TRUE, (50.0, 0.0, 0.0)])[0] == pytest.approx(error_of(TRUE[:3])[0])
    assert error_of(TRUE, (0, 1)) == error_of(TRUE[:2], (0, 1)) == (pytest.approx(0.0, abs=1e-12), 1.0)


@pytest.mark.slow
def test_an_episode_compares_robots_with_a_team() -> None:
    """In a hall robots and the team find the same, and nearly so where messages are lost."""
    config = Config(worlds=("hall",), presets=("standard",), seeds=1, duration=40.0, particles=(30,), lost=(0.0, 0.3))
    for trial in trials(config):
        row = play(config, trial)
        assert row["links"] > 0
        assert row["false_links"] == 0
        assert abs(row["more"]) < (0.3 if trial.lost else 0.1)
        assert row["recall"] > 0.5 * row["team_recall"]
        assert row["maps_bytes"] > 0.0
