from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.readers import integrate_commands, range_bearing_steps
from slam_backend.trajectory import dead_reckoning

SIGMAS: dict[str, Any] = {"sigma_range": 0.1, "sigma_bearing": 0.02}
DRIVEN = np.array([[10.0, 0.5, 0.3], [11.0, 0.4, -0.2], [12.0, 0.0, 0.0]])


def _sighting(time: float, landmark: tuple[float, float]) -> tuple[float, float, float]:
    pose = integrate_commands(DRIVEN, [time])[0]
    x, y = transform_points(inverse(pose), np.array([landmark]))[0]
    return time, float(np.hypot(x, y)), float(np.arctan2(y, x))


def test_exact_readings_put_landmarks_where_they_stand() -> None:
    """From the steps' own dead reckoning every point leads to its landmark, at whatever time it was seen."""
    stand = {"left": (4.0, 3.0), "right": (5.0, -2.0)}
    names = ["right", "left", "left", "right"]
    seen = [_sighting(time, stand[name]) for time, name in zip((10.1, 10.7, 11.3, 12.2), names, strict=True)]
    steps = range_bearing_steps(DRIVEN, seen, names, **SIGMAS, dt=0.5)
    assert steps.times.tolist() == [10.0, 10.5, 11.0, 11.5, 12.0, 12.5]
    assert steps.names.tolist() == ["left", "right"]
    np.testing.assert_allclose(
        dead_reckoning(np.zeros(3), steps.odometry[1:]), integrate_commands(DRIVEN, steps.times), atol=1e-12
    )
    found = [k for k, frame in enumerate(steps.measurements) if frame is not None]
    assert found == [0, 1, 3, 4]
    path = dead_reckoning(np.zeros(3), steps.odometry[1:])
    for k, name in zip(found, names, strict=True):
        frame = steps.measurements[k]
        assert frame is not None
        assert frame.descriptors.tolist() == [[float(name == "left"), float(name == "right")]]
        place = compose(path[k], [frame.points[0, 2], -frame.points[0, 0], 0.0])[:2]
        np.testing.assert_allclose(place, stand[name], atol=1e-9)


def test_covariances_lie_along_and_across_the_ray() -> None:
    """Ahead, the range's variance is along Z, the bearing's across it, the height's along Y; each may be its own."""
    seen = [(10.0, 2.0, 0.0), (10.5, 4.0, 0.0)]
    standing = [[10.0, 0.0, 0.0], [11.0, 0.0, 0.0]]
    steps = range_bearing_steps(standing, seen, sigma_range=[0.1, 0.3], sigma_bearing=0.02, sigma_height=0.5, dt=0.5)
    for frame, spread, distance in zip(steps.measurements, (0.1, 0.3), (2.0, 4.0), strict=False):
        assert frame is not None
        assert frame.covariances is not None
        expected = np.diag([(distance * 0.02) ** 2, 0.25, spread**2])
        np.testing.assert_allclose(frame.covariances[0], expected, atol=1e-12)


def test_without_identities_all_look_alike() -> None:
    """Every sighting of a step is kept, under one descriptor."""
    seen = [(10.0, 2.0, 0.0), (10.0, 2.0, 0.1), (10.0, 3.0, 0.0)]
    steps = range_bearing_steps(DRIVEN, seen, **SIGMAS)
    assert steps.names.tolist() == []
    frame = steps.measurements[0]
    assert frame is not None
    assert frame.descriptors.tolist() == [[1.0]] * 3


def test_rows_a_little_back_in_time_are_sorted() -> None:
    """Rows out of order give the steps of rows in order; identities and deviations stay with their sightings."""
    names, seen = [3, 1, 2], [_sighting(t, (4.0, 1.0)) for t in (10.2, 10.6, 11.1)]
    usual = range_bearing_steps(DRIVEN, seen, names, sigma_range=[0.1, 0.2, 0.3], sigma_bearing=0.02, dt=0.2)
    swapped = range_bearing_steps(
        DRIVEN, [seen[1], seen[0], seen[2]], [1, 3, 2], sigma_range=[0.2, 0.1, 0.3], sigma_bearing=0.02, dt=0.2
    )
    assert swapped.notes == ("Sorted by time: sightings (1 row, up to 0.400 s back).",)
    assert usual.notes == ()
    for one, other in zip(usual.measurements, swapped.measurements, strict=True):
        assert (one is None) == (other is None)
        if one is not None and other is not None:
            for name in ("points", "descriptors", "covariances"):
                assert np.array_equal(getattr(one, name), getattr(other, name))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"velocities": np.empty((0, 3))}, "velocities: expected at least one row, got no row"),
        ({"sightings": np.empty((0, 3))}, "sightings: expected at least one row, got no row"),
        ({"velocities": [[1.0, 2.0]]}, r"velocities: expected an array of shape \(n, 3\), got shape \(1, 2\)"),
        ({"sightings": [[10.0, np.nan, 0.0]]}, r"sightings: .* got NaN or infinity at index \(0, 1\)"),
        ({"sightings": [[10.0, 0.0, 0.0]]}, r"sightings: expected ranges > 0 m, got 0\.0"),
        ({"sightings": [[12.0, 1.0, 0.0], [10.0, 1.0, 0.0]]}, "back by at most 1 s, got a time 10.000 s after 12"),
        ({"sightings": [[90.0, 1.0, 0.0]]}, "times among those of the velocities, 10.000 to 12.000 s, got a log"),
        ({"identities": [1, 2]}, r"identities: expected numbers or names of shape \(1,\), got an array of int"),
        ({"identities": [np.nan]}, "identities: expected whole numbers or names, got NaN or fractions"),
        ({"sigma_range": 0.0}, r"sigma_range: expected standard deviations > 0, got 0\.0"),
        ({"sigma_bearing": [0.1, 0.1]}, r"sigma_bearing: expected an array of shape \(1,\), got shape \(2,\)"),
        ({"dt": 0.0}, "dt: expected a finite number > 0"),
        ({"dt": 1e-9}, "dt: expected at most 1,000,000 steps, got .* Take longer steps, and give all times in seconds"),
        ({"hold": -1.0}, "hold: expected a finite number > 0"),
    ],
)  # fmt: skip
def test_impossible_logs_are_refused(changes: dict[str, Any], message: str) -> None:
    """The error names the argument, what is wrong with it and the cure."""
    arguments: dict[str, Any] = {"velocities": DRIVEN, "sightings": [[10.0, 1.0, 0.0]], **SIGMAS} | changes
    with pytest.raises(ValueError, match=message):
        range_bearing_steps(**arguments)
