"""The filter beside GTSAM: factors against finite differences, and estimates of readings without noise."""

from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import compose
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from studies.beside_gtsam import Config, Graph, Used, batch, isam2, play, trials

gtsam = pytest.importorskip("gtsam", reason="gtsam, an optional peer, is not installed: pip install gtsam")
BIASED = OdometryModel(bias_scale=0.05, bias_heading=0.02)


def exact_readings(motion: OdometryModel) -> tuple[Used, np.ndarray]:
    """Return readings without noise of a robot that drives a curve past eight landmarks, and its path."""
    camera, rng = StereoCamera(), np.random.default_rng(1)
    landmarks = np.column_stack([rng.uniform(3.0, 6.0, 8), rng.uniform(-1.5, 1.5, 8), rng.uniform(-0.3, 0.6, 8)])
    odometry = np.tile([0.1, 0.0, 0.02], (12, 1))
    path = np.zeros((12, 3))
    for step in range(1, 12):
        path[step] = compose(path[step - 1], odometry[step])
    frames = []
    for x, y, theta in path:
        cos, sin = np.cos(theta), np.sin(theta)
        turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
        points = camera.camera_from_robot((landmarks - [x, y, 0.0]) @ turn.T)
        frames.append(Measurements(points, np.ones((8, 1), np.float32)))
    return Used(odometry, frames, [np.arange(8)] * 12, motion, camera), path


@pytest.mark.parametrize("motion", [OdometryModel(), BIASED])
def test_exact_readings_give_the_path(motion: OdometryModel) -> None:
    """Both solvers return the path without noise, and the last covariances agree."""
    readings, path = exact_readings(motion)
    online, factors, values = isam2(readings)
    found = batch(readings, factors, values)
    for estimate in (online, found):
        np.testing.assert_allclose(estimate.path, path, atol=1e-5)
    np.testing.assert_allclose(online.covariances[-1], found.covariances[-1], rtol=0.05, atol=1e-9)


def test_points_in_the_plane_weigh_by_their_covariances() -> None:
    """For small errors the factor of bearing and range has the squared Mahalanobis distance of the point."""
    readings, _ = exact_readings(OdometryModel())
    graph, rng = Graph(readings), np.random.default_rng(0)
    for _ in range(5):
        root = rng.normal(0.0, 0.1, (3, 3))
        covariance, ahead = root @ root.T + 1e-3 * np.eye(3), rng.uniform([2.0, -2.0], [6.0, 2.0])
        off = rng.normal(0.0, 1e-4, 2)
        values = gtsam.Values()
        values.insert(graph.pose(3), gtsam.Pose2())
        values.insert(graph.landmark(5), ahead + off)
        factor = graph._planar_sight(3, 5, ahead, covariance)
        planar = (ROBOT_FROM_CAMERA @ covariance @ ROBOT_FROM_CAMERA.T)[:2, :2]
        assert 2.0 * factor.error(values) == pytest.approx(off @ np.linalg.solve(planar, off), rel=1e-3)


def test_jacobians_of_factors_match_central_differences() -> None:
    """Factors of odometry with a bias, and of points by their pixels, are linearised rightly."""
    readings, _ = exact_readings(BIASED)
    graph = Graph(readings)
    frame = readings.frames[3]
    assert frame is not None
    for factor, keys in (
        (graph._motion(3), {graph.pose(2): 3, graph.pose(3): 3, graph.bias: 3}),
        (graph._sight(3, 5, frame.points[5]), {graph.pose(3): 3, graph.landmark(5): 3}),
    ):
        values = gtsam.Values()
        for place, key in enumerate(keys):
            if key == graph.bias:
                values.insert(key, np.array([0.03, -0.01, 0.0]))
            elif key == graph.landmark(5):
                values.insert(key, np.array([4.0, 0.5, 0.2]))
            else:
                values.insert(key, gtsam.Pose2(0.1 * place, 0.05, 0.1 + 0.02 * place))
        linear = factor.linearize(values)
        jacobian, _ = linear.jacobian()
        order = list(linear.keys())
        for column, key in enumerate(order):
            for axis in range(3):
                whitened = []
                for sign in (1e-6, -1e-6):
                    delta = gtsam.VectorValues()
                    for each in order:
                        delta.insert(each, np.zeros(3))
                    step = np.zeros(3)
                    step[axis] = sign
                    delta.update(_one(key, step))
                    whitened.append(factor.noiseModel().whiten(factor.unwhitenedError(values.retract(delta))))
                slope = (whitened[0] - whitened[1]) / 2e-6
                np.testing.assert_allclose(jacobian[:, 3 * column + axis], slope, rtol=1e-4, atol=1e-3)


def _one(key: int, step: np.ndarray) -> Any:
    values = gtsam.VectorValues()
    values.insert(key, step)
    return values


def test_an_episode_is_estimated_by_all_methods() -> None:
    """All have the same measurements; errors are finite, and no method is lost."""
    config = Config(logs=("kitti",), presets=("standard",), worlds=("office",), seeds=1, seconds=4.0)
    rows = {trial.method: play(config, trial) for trial in trials(config) if trial.world}
    assert {row["measurements"] for row in rows.values()} == {rows["filter"]["measurements"]}
    assert rows["filter"]["measurements"] > 20
    assert all(0.0 < row["position_rms_m"] < 0.1 and row["nees_median"] > 0.0 for row in rows.values())
