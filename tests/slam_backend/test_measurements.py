import copy
import pickle
from typing import Any

import numpy as np
import pytest

from slam_backend.models.measurements import Measurements, TeamMeasurements

POINTS = [[0.0, 0.1, 2.0], [1.0, 0.0, 3.0]]
LOOKS = np.eye(2, 5, dtype=np.float32)


def test_frames_share_no_memory_and_cannot_be_written() -> None:
    """The arrays are copies and read-only, so a caller cannot change what a filter has accepted."""
    points = np.array(POINTS)
    frame = Measurements(points, LOOKS, np.tile(np.eye(3), (2, 1, 1)))
    points[:] = 9.0
    np.testing.assert_array_equal(frame.points, POINTS)
    for array in (frame.points, frame.descriptors, frame.covariances):
        assert array is not None
        with pytest.raises(ValueError, match="read-only"):
            array[0] = 0.0
    assert (len(frame), frame.points.dtype, frame.descriptors.dtype) == (2, np.float64, np.float32)


def test_copies_cannot_be_written_either() -> None:
    """Be they deep or from a file, of a frame or of one cut out of a team's: what was found of them stays so."""
    frame = Measurements(POINTS, LOOKS, np.tile(np.eye(3), (2, 1, 1)))
    team = TeamMeasurements(np.array(POINTS), LOOKS.copy(), np.array([1, 2]))
    for one in (frame, team.of_each()[1]):
        for other in (copy.copy(one), copy.deepcopy(one), pickle.loads(pickle.dumps(one))):
            assert getattr(other, "extent", None) == getattr(one, "extent", None)
            for name in ("points", "descriptors", "covariances"):
                array, own = getattr(one, name, None), getattr(other, name, None)
                np.testing.assert_array_equal(own, array)
                assert own is None or not own.flags.writeable


def test_nothing_seen_is_a_frame_too() -> None:
    """An empty frame has no rows and its descriptor size."""
    frame = Measurements.empty(11)
    assert (len(frame), frame.points.shape, frame.descriptors.shape) == (0, (0, 3), (0, 11))


def test_an_extent_bounds_all_points() -> None:
    """It is tight, of frames that were cut out of a team's as well; an empty one bounds nothing."""
    rng = np.random.default_rng(100)
    points, looks = rng.normal(0.0, 3.0, (7, 3)), np.zeros((7, 5), np.float32)
    frame = Measurements(points, looks)
    assert frame.extent == (points[:, 2].min(), np.abs(points).max())
    assert copy.deepcopy(frame).extent == frame.extent
    assert Measurements.empty().extent == (np.inf, 0.0)
    for part in TeamMeasurements(points, looks, np.array([3, 3, 7])).of_each():
        assert part.extent == (part.points[:, 2].min(initial=np.inf), np.abs(part.points).max(initial=0.0))


INDEFINITE = np.array([[[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [0.0, 0.0, 1.0]]] * 2)
ASYMMETRIC = np.array([[[1.0, 0.1, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]] * 2)
FLAT = np.array([np.eye(3), np.diag([1.0, 1.0, 5e-9])])


@pytest.mark.parametrize(
    ("points", "descriptors", "covariances", "message"),
    [
        ([[0.0, 1.0]], LOOKS[:1], None, r"points: expected an array of shape \(n, 3\), got shape \(1, 2\)"),
        ([0.0, 1.0, 2.0], LOOKS[:1], None, r"points: expected an array of shape \(n, 3\), got shape \(3,\)"),
        ([[0.0, np.nan, 1.0]], LOOKS[:1], None, r"points: expected finite numbers, got NaN .* at index \(0, 1\)"),
        ("far", LOOKS, None, r"points: expected an array of shape \(n, 3\) of real numbers, got"),
        (POINTS, LOOKS.astype(np.float64) * 1e39, None, "descriptors: expected numbers that float32 can hold, got 1e"),
        (POINTS, LOOKS[:1], None, r"descriptors: expected an array of shape \(2, n\), got shape \(1, 5\)"),
        (POINTS, LOOKS + np.inf, None, r"descriptors: expected finite numbers, got NaN or infinity"),
        (POINTS, LOOKS, np.eye(3), r"covariances: expected an array of shape \(2, 3, 3\), got shape \(3, 3\)"),
        (POINTS, LOOKS, INDEFINITE, r"covariances: expected positive definite matrices, got a smallest eigenvalue"),
        (POINTS, LOOKS, ASYMMETRIC, r"covariances: expected symmetric matrices, got a different transpose"),
        (POINTS, LOOKS, 1e-13 * ASYMMETRIC, r"covariances: expected symmetric matrices, got a different transpose"),
        (POINTS, LOOKS, np.zeros((2, 3, 3)), r"covariances: expected positive definite matrices"),
        (POINTS, LOOKS, FLAT * [[1.0], [1.0], [0.0]], r"covariances: expected positive definite matrices"),
        (POINTS, LOOKS, -FLAT, r"covariances: expected positive definite matrices"),
        (POINTS, LOOKS, FLAT, r"covariances: expected ratios of eigenvalues up to 1e\+08, got 2\d+\.\d+\. Raise"),
        (POINTS, LOOKS, [1e-30 * np.eye(3)] * 2, r"covariances: expected eigenvalues from 1e-14 .* got .*e-3[01]\."),
        (POINTS, LOOKS, [1e30 * np.eye(3)] * 2, r"covariances: expected eigenvalues .* to 1e\+12 m\^2, got"),
        (POINTS, LOOKS, [np.nan * np.eye(3)] * 2, r"covariances: expected finite numbers, got NaN"),
        (POINTS, 1e30 * LOOKS, None, r"descriptors: expected numbers within \+-1e\+06, got 1.*e\+30\. Scale them"),
    ],
)
def test_frames_that_make_no_sense_are_refused(points: Any, descriptors: Any, covariances: Any, message: str) -> None:
    """The error names the argument, what it should be and what it was."""
    with pytest.raises(ValueError, match=message):
        Measurements(points, descriptors, covariances)


def test_covariances_within_the_limits_are_taken_as_they_are() -> None:
    """A micrometre beside a centimetre in any direction is no reason for an error, nor is a frame without points."""
    root = np.linalg.qr(np.random.default_rng(3).normal(size=(3, 3)))[0]
    covariance = root @ np.diag([2e-12, 1e-4, 3e-7]) @ root.T
    covariance = 0.5 * (covariance + covariance.T)
    frame = Measurements(POINTS, LOOKS, [covariance] * 2)
    np.testing.assert_array_equal(frame.covariances, [covariance] * 2)
    assert len(Measurements(np.empty((0, 3)), np.empty((0, 5)), np.empty((0, 3, 3)))) == 0
