"""The linearised measurement model against finite differences, in the plain and in the compiled formulation."""

from collections.abc import Callable

import numpy as np
import pytest
from builders.filters import plain_filter
from hypothesis import given
from hypothesis import strategies as st

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.reference.measurement_model import Frame
from slam_backend.reference.pose_gaussian import turn_about_vertical

CAMERA = StereoCamera(mount=(0.3, -0.2, 0.5))
NOISES = np.diag([CAMERA.sigma_px**2, CAMERA.sigma_px**2, CAMERA.sigma_disparity_px**2])
LOOK = np.eye(1, 3, dtype=np.float32)

poses = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.1, 3.1)).map(np.array)
moves = st.tuples(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(-0.2, 0.2)).map(np.array)
points = st.tuples(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0), st.floats(1.0, 6.0)).map(np.array)
errors = st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array)
HOW = pytest.mark.parametrize("is_given", [False, True], ids=["camera model", "given covariances"])


def derivative(function: Callable[[FloatArray], FloatArray], at: FloatArray, step: float = 1e-6) -> FloatArray:
    """Return the Jacobian (m, n) of a function of (n,) by central differences."""
    return np.column_stack([(function(at + d) - function(at - d)) / (2.0 * step) for d in step * np.eye(len(at))])


def seen_from(pose: FloatArray, mean: FloatArray, is_given: bool) -> FloatArray:
    """Return the ideal measurement (3,) of a point in the map: in the camera frame, or (u, v, disparity)."""
    point = CAMERA.camera_from_robot(transform_points(inverse(pose), mean))
    return point if is_given else CAMERA.project(point)


@HOW
@given(pose=poses, point=points)
def test_jacobians_of_the_plain_model(is_given: bool, pose: FloatArray, point: FloatArray) -> None:
    """G and H are the derivatives of the prediction by landmark and by pose (Eq. 6)."""
    frame = Frame(Measurements(point[None], LOOK, np.eye(3)[None] if is_given else None), [0], None, CAMERA)
    mean = transform_points(pose, CAMERA.robot_from_camera(point))
    prediction = frame.predict(pose, mean)
    assert prediction is not None
    z_hat, g, h = prediction
    np.testing.assert_allclose(z_hat, frame.z[0], atol=1e-9)
    np.testing.assert_allclose(g, derivative(lambda m: seen_from(pose, m, is_given), mean), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(h, derivative(lambda p: seen_from(p, mean, is_given), pose), rtol=1e-6, atol=1e-5)


def mapped(pose: FloatArray, point: FloatArray, is_given: bool, motion: OdometryModel) -> tuple[FastSlam, FloatArray]:
    """Return a filter that knows one landmark, measured once without error from a known pose, and its covariance."""
    covariance = 0.01 * np.eye(3) if is_given else CAMERA.covariance(point)
    slam = plain_filter(1, num_particles=1, camera=CAMERA, motion=motion)
    slam.step([None], [Measurements(point[None], LOOK, covariance[None] if is_given else None)], [[0]], [pose])
    to_map = turn_about_vertical(pose[2]) @ ROBOT_FROM_CAMERA
    return slam, to_map @ covariance @ to_map.T


@HOW
@given(pose=poses, point=points, move=moves)
def test_jacobians_of_the_compiled_model(is_given: bool, pose: FloatArray, point: FloatArray, move: FloatArray) -> None:
    """A measurement as predicted leaves the pose, with the covariance (P0^-1 + H^T S^-1 H)^-1, H by differences."""
    motion = OdometryModel(floor_position=0.05, floor_heading=0.02)
    slam, landmark = mapped(pose, point, is_given, motion)
    mean = transform_points(pose, CAMERA.robot_from_camera(point))
    after = compose(pose, move)
    z = seen_from(after, mean, is_given)
    seen = z if is_given else CAMERA.triangulate(z)
    slam.step([move], [Measurements(seen[None], LOOK, 0.02 * np.eye(3)[None] if is_given else None)], [[0]])
    g = derivative(lambda m: seen_from(after, m, is_given), mean)
    h = derivative(lambda p: seen_from(p, mean, is_given), after)
    s = g @ landmark @ g.T + (0.02 * np.eye(3) if is_given else NOISES)
    turn = turn_about_vertical(pose[2])
    prior = turn @ np.diag(motion.sigmas(move) ** 2) @ turn.T
    expected = np.linalg.inv(np.linalg.inv(prior) + h.T @ np.linalg.solve(s, h))
    np.testing.assert_allclose(slam.pose().covariance, expected, rtol=1e-5, atol=1e-9)
    np.testing.assert_allclose(seen_from(slam.pose().mean, mean, True), seen_from(after, mean, True), atol=1e-9)


@given(pose=poses, point=points, error=errors)
def test_innovation_is_that_of_the_image_coordinates(pose: FloatArray, point: FloatArray, error: FloatArray) -> None:
    """What the compiled filter, which works in metres, calls NIS is that of (u, v, disparity)."""
    slam, landmark = mapped(pose, point, False, OdometryModel())
    mean = transform_points(pose, CAMERA.robot_from_camera(point))
    seen = CAMERA.triangulate(CAMERA.project(point) + error)
    report = slam.step([None], [Measurements(seen[None], LOOK)], [[0]], [pose])
    g = derivative(lambda m: seen_from(pose, m, False), mean)
    s = g @ landmark @ g.T + NOISES
    assert report.nis == pytest.approx(error @ np.linalg.solve(s, error), rel=1e-5, abs=1e-9)
