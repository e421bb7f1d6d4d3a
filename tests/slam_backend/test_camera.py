from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera

CAMERA = StereoCamera(
    focal_px=300.0, baseline=0.15, width=400, height=200, max_range=7.0, mount=(0.2, -0.1, 0.6), sigma_px=0.3
)
points = st.tuples(st.floats(-4.0, 4.0), st.floats(-3.0, 3.0), st.floats(0.3, 20.0)).map(np.array)


@given(point=points)
def test_triangulation_undoes_projection(point: np.ndarray) -> None:
    """A point survives the way to (u, v, disparity) and back."""
    np.testing.assert_allclose(CAMERA.triangulate(CAMERA.project(point)), point, rtol=1e-12, atol=1e-12)


@given(point=points)
def test_covariance_propagates_pixel_noise_through_triangulation(point: np.ndarray) -> None:
    """The covariance is J R J^T with J the Jacobian of triangulation, here by finite differences."""
    pixels, step = CAMERA.project(point), 1e-4
    jacobian = np.column_stack(
        [(CAMERA.triangulate(pixels + d) - CAMERA.triangulate(pixels - d)) / (2 * step) for d in step * np.eye(3)]
    )
    noise = np.diag([CAMERA.sigma_px**2, CAMERA.sigma_px**2, CAMERA.sigma_disparity_px**2])
    expected = jacobian @ noise @ jacobian.T
    np.testing.assert_allclose(CAMERA.covariance(point), expected, rtol=1e-5, atol=1e-7 * np.trace(expected))


def test_depth_error_grows_with_the_square_of_depth() -> None:
    """On the axis sigma_Z = Z^2 sigma_d / (f b): 6.5 cm at 5 m for the default camera."""
    camera = StereoCamera()
    covariances = camera.covariance(np.array([[0.0, 0.0, 2.5], [0.0, 0.0, 5.0]]))
    sigmas = np.sqrt(covariances[:, 2, 2])
    assert sigmas[1] == pytest.approx(25.0 * 0.1 / (320.0 * 0.12))
    assert sigmas[1] / sigmas[0] == pytest.approx(4.0)
    np.testing.assert_allclose(np.sqrt(covariances[1, 0, 0]), 5.0 * 0.2 / 320.0)


def test_camera_axes_are_those_of_the_robot_turned() -> None:
    """Z looks along robot x, X to the robot's right, Y down; the mount is the camera's place on the robot."""
    np.testing.assert_array_equal(CAMERA.robot_from_camera(np.array([0.0, 0.0, 2.0])), [2.2, -0.1, 0.6])
    np.testing.assert_allclose(CAMERA.robot_from_camera(np.array([1.0, 0.0, 0.0])), [0.2, -1.1, 0.6])
    np.testing.assert_allclose(CAMERA.robot_from_camera(np.array([0.0, 0.5, 0.0])), [0.2, -0.1, 0.1])
    assert np.linalg.det(ROBOT_FROM_CAMERA) == 1.0


@given(point=points)
def test_camera_and_robot_frame_are_inverse(point: np.ndarray) -> None:
    """`camera_from_robot` undoes `robot_from_camera`."""
    np.testing.assert_allclose(CAMERA.camera_from_robot(CAMERA.robot_from_camera(point)), point, atol=1e-12)


def test_what_the_camera_sees() -> None:
    """A point is seen if it is ahead, inside the image in both directions, and near enough."""
    edge = 200.0 / 300.0
    cases = {
        (0.0, 0.0, 5.0): True,
        (0.0, 0.0, -5.0): False,
        (0.0, 0.0, 7.1): False,
        (3.0 * edge * 0.99, 0.0, 3.0): True,
        (3.0 * edge * 1.01, 0.0, 3.0): False,
        (0.0, 1.5 * edge * 0.99, 3.0): True,
        (0.0, 1.5 * edge * 1.01, 3.0): False,
    }
    np.testing.assert_array_equal(CAMERA.sees(np.array(list(cases))), list(cases.values()))
    assert CAMERA.half_fov == pytest.approx(np.arctan(edge))
    assert CAMERA.half_vertical_fov == pytest.approx(np.arctan(edge / 2))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"focal_px": 0.0}, r"camera.focal_px: expected a finite number .*, got 0.0"),
        ({"baseline": -0.1}, r"camera.baseline: expected a finite number .*, got -0.1"),
        ({"max_range": np.nan}, r"camera.max_range: expected a finite number .*, got nan"),
        ({"sigma_px": "a lot"}, r"camera.sigma_px: expected a finite number .*, got"),
        ({"width": 0}, r"camera.width: expected an int >= 1, got 0"),
        ({"height": 2.5}, r"camera.height: expected an int >= 1, got 2.5"),
        ({"mount": (0.0, 0.0)}, r"camera.mount: expected an array of shape \(3,\), got shape \(2,\)"),
    ],
)
def test_a_camera_that_cannot_be_is_refused(change: dict[str, Any], message: str) -> None:
    """The error names the field, what it should be and what it was."""
    with pytest.raises(ValueError, match=message):
        StereoCamera(**change)


def test_points_at_infinity_are_refused() -> None:
    """Triangulation needs a positive disparity."""
    with pytest.raises(ValueError, match=r"pixels: expected disparities > 0 px, got 0.0"):
        CAMERA.triangulate(np.array([[1.0, 2.0, 3.0], [1.0, 2.0, 0.0]]))
