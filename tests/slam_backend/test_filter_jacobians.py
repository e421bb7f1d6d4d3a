"""The linearised measurement model against finite differences, in the plain and in the compiled formulation."""

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from slam_backend import _kernels
from slam_backend.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.errors import FloatArray
from slam_backend.geometry import transform_points
from slam_backend.measurements import Measurements
from slam_backend.plain.frame import Frame, turn_about_vertical

CAMERA = StereoCamera(mount=(0.3, -0.2, 0.5))
PARAMETERS = np.array([320.0, 0.12, 0.2, 0.1, *CAMERA.mount])
LOOK = np.eye(1, 3, dtype=np.float32)

poses = st.tuples(st.floats(-3.0, 3.0), st.floats(-3.0, 3.0), st.floats(-3.1, 3.1)).map(np.array)
points = st.tuples(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0), st.floats(1.0, 6.0)).map(np.array)
HOW = pytest.mark.parametrize("is_given", [False, True], ids=["camera model", "given covariances"])


def derivative(function: Callable[[FloatArray], FloatArray], at: FloatArray, step: float = 1e-6) -> FloatArray:
    """Return the Jacobian (m, n) of a function of (n,) by central differences."""
    return np.column_stack([(function(at + d) - function(at - d)) / (2.0 * step) for d in step * np.eye(len(at))])


def compiled_innovation(pose: FloatArray, mean: FloatArray, point: FloatArray, is_given: bool) -> FloatArray:
    """Return what the kernels make of one measured point: r (3,), R (6,), depth."""
    in_robot_axes = (ROBOT_FROM_CAMERA @ point)[None]
    c, s = np.cos(pose[2]), np.sin(pose[2])
    return np.array(
        _kernels._innovation(
            pose[0], pose[1], c, s, *mean, in_robot_axes, np.zeros((1, 6)), 0, is_given, PARAMETERS
        )
    )


@HOW
@given(pose=poses, point=points)
def test_jacobians_of_the_plain_model(is_given: bool, pose: FloatArray, point: FloatArray) -> None:
    """G and H are the derivatives of the prediction by landmark and by pose (Eq. 6)."""
    frame = Frame(Measurements(point[None], LOOK, np.eye(3)[None] if is_given else None), [0], None, CAMERA)
    mean = transform_points(pose, CAMERA.robot_from_camera(point))

    def predict(pose: FloatArray, mean: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        prediction = frame.predict(pose, mean)
        assert prediction is not None
        return prediction

    z_hat, g, h = predict(pose, mean)
    np.testing.assert_allclose(z_hat, frame.z[0], atol=1e-9)
    np.testing.assert_allclose(g, derivative(lambda m: predict(pose, m)[0], mean), rtol=1e-6, atol=1e-5)
    np.testing.assert_allclose(h, derivative(lambda p: predict(p, mean)[0], pose), rtol=1e-6, atol=1e-5)


@HOW
@given(pose=poses, point=points)
def test_jacobian_of_the_compiled_model(is_given: bool, pose: FloatArray, point: FloatArray) -> None:
    """The kernels' innovation in metres moves with the pose as their H says, and with the landmark as minus one."""
    mean = transform_points(pose, CAMERA.robot_from_camera(point))
    np.testing.assert_allclose(compiled_innovation(pose, mean, point, is_given)[:3], 0.0, atol=1e-12)
    by_pose = derivative(lambda p: compiled_innovation(p, mean, point, is_given)[:3], pose)
    rows = np.array(_kernels._whitened(mean[0], mean[1], pose[0], pose[1], np.eye(3))).reshape(2, 3)
    np.testing.assert_allclose(np.vstack([rows, np.zeros(3)]), by_pose, atol=1e-7)
    by_landmark = derivative(lambda m: compiled_innovation(pose, m, point, is_given)[:3], mean)
    np.testing.assert_allclose(by_landmark, -np.eye(3), atol=1e-7)


@given(pose=poses, point=points, noise=st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array))
def test_innovation_is_that_of_the_image_coordinates(pose: FloatArray, point: FloatArray, noise: FloatArray) -> None:
    """The kernels' innovation is triangulation's Jacobian at the predicted point times that of (u, v, disparity)."""
    pixels = CAMERA.project(point)
    mean = transform_points(pose, CAMERA.robot_from_camera(point))
    values = compiled_innovation(pose, mean, CAMERA.triangulate(pixels + noise), is_given=False)
    to_map = turn_about_vertical(pose[2]) @ ROBOT_FROM_CAMERA
    jacobian = to_map @ derivative(CAMERA.triangulate, pixels, 1e-4)
    np.testing.assert_allclose(values[:3], jacobian @ noise, rtol=1e-5, atol=1e-7)
    noises = to_map @ CAMERA.covariance(point) @ to_map.T
    np.testing.assert_allclose(values[3:9], noises[np.triu_indices(3)], atol=1e-9)
    assert values[9] == pytest.approx(point[2])
