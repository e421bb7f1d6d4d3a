"""Poses, frames and the stereo camera."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.geometry import between, compose, inverse, rotate_covariances, rotation, transform_points, wrap_angle
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera

coordinates = st.floats(-50.0, 50.0)
angles = st.floats(-np.pi, np.pi, exclude_max=True)
poses = st.tuples(coordinates, coordinates, angles).map(np.array)


def assert_same_pose(a: np.ndarray, b: np.ndarray) -> None:
    """Compare positions, and headings on the circle."""
    np.testing.assert_allclose(a[..., :2], b[..., :2], atol=1e-10)
    np.testing.assert_allclose(wrap_angle(a[..., 2] - b[..., 2]), 0.0, atol=1e-10)


@given(a=poses, b=poses, c=poses)
def test_motions_are_a_group(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> None:
    """Composition is associative, has the origin as its unit, and `inverse` undoes on both sides."""
    assert_same_pose(compose(compose(a, b), c), compose(a, compose(b, c)))
    unit = np.zeros(3)
    assert_same_pose(compose(a, unit), a)
    assert_same_pose(compose(unit, a), a)
    assert_same_pose(compose(a, inverse(a)), unit)
    assert_same_pose(compose(inverse(a), a), unit)


@given(a=poses, b=poses)
def test_between_is_the_motion_from_one_pose_to_the_other(a: np.ndarray, b: np.ndarray) -> None:
    """Pose a followed by `between(a, b)` is pose b."""
    assert_same_pose(compose(a, between(a, b)), b)


@given(a=poses, b=poses, point=st.tuples(coordinates, coordinates, coordinates).map(np.array))
def test_points_follow_the_same_group(a: np.ndarray, b: np.ndarray, point: np.ndarray) -> None:
    """Moving a point by b and then by a is moving it by their composition; its height stays."""
    moved = transform_points(a, transform_points(b, point))
    np.testing.assert_allclose(moved, transform_points(compose(a, b), point), atol=1e-9)
    assert moved[2] == point[2]
    np.testing.assert_allclose(transform_points(a, point[:2]), rotation(a[2]) @ point[:2] + a[:2], atol=1e-9)


@given(angle=st.floats(-1e3, 1e3))
def test_wrapped_angles_lie_in_their_interval_and_point_the_same_way(angle: float) -> None:
    """The result lies in [-pi, pi) and differs by whole turns."""
    wrapped = float(wrap_angle(angle))
    assert -np.pi <= wrapped < np.pi
    np.testing.assert_allclose(np.exp(1j * wrapped), np.exp(1j * angle), atol=1e-9)


def test_many_motions_at_once_are_the_motions_one_by_one() -> None:
    """Shapes broadcast: (5, 1, 3) with (7, 3) gives (5, 7, 3)."""
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(5, 1, 3)), rng.normal(size=(7, 3))
    together = compose(a, b)
    assert together.shape == (5, 7, 3)
    for i in range(5):
        for j in range(7):
            np.testing.assert_allclose(together[i, j], compose(a[i, 0], b[j]), rtol=0.0, atol=1e-13)
            np.testing.assert_allclose(inverse(together)[i, j], inverse(together[i, j]), rtol=0.0, atol=1e-13)
    for other in (b[::-1], b.T.copy().T, np.broadcast_to(b[0], b.shape)):  # whatever their layout, and not written to
        kept = other.copy()
        np.testing.assert_array_equal(compose(other, b), compose(kept, b))
        np.testing.assert_array_equal(inverse(other), inverse(kept))
        np.testing.assert_array_equal(other, kept)


def test_points_are_copied() -> None:
    """`transform_points` leaves its argument alone."""
    points = np.ones((4, 3))
    transform_points([1.0, 2.0, 0.5], points)
    np.testing.assert_array_equal(points, 1.0)


def test_a_rotated_covariance_is_that_of_rotated_points() -> None:
    """Cov(R p) = R Cov(p) R^T (Eq. 16 with R on the left; the printed R^T Sigma R is another matrix)."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(400, 3)) @ np.diag([3.0, 1.0, 0.5]) + [1.0, 2.0, 3.0]
    theta = 0.7
    before, after = np.cov(points.T), np.cov(transform_points([4.0, 5.0, theta], points).T)
    np.testing.assert_allclose(rotate_covariances(theta, before), after, atol=1e-12)
    assert not np.allclose(rotate_covariances(-theta, before), after, atol=0.1)


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
