"""The filter beside GTSAM: factors against finite differences, and estimates of readings without noise."""

from typing import Any

import numpy as np
import pytest

from slam_backend.geometry import between, compose
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from studies.bounds.episodes import record_episode
from studies.filters.beside_gtsam import Config, Graph, Used, batch, filtered_episode, isam2, play, scores, trials
from training.bench.exploration.players import parted
from vslam_env import preset_config, vslam_v1

gtsam = pytest.importorskip("gtsam", reason="gtsam, an optional peer, is not installed: pip install gtsam")
BIASED = OdometryModel(bias_scale=0.05, bias_heading=0.02)
STARTS = np.array([[0.0, 0.0, 0.0], [0.5, -0.4, 0.2], [-0.3, 0.6, -0.1], [0.2, 0.3, 0.3]])


def exact_readings(motion: OdometryModel, robots: int = 1, merges: Any = ()) -> tuple[Used, np.ndarray]:
    """Return readings without noise of robots that drive a curve past eight landmarks, and the path of each."""
    camera, rng = StereoCamera(), np.random.default_rng(1)
    landmarks = np.column_stack([rng.uniform(3.0, 6.0, 8), rng.uniform(-1.5, 1.5, 8), rng.uniform(-0.3, 0.6, 8)])
    odometry = np.tile([0.1, 0.0, 0.02], (12, 1))
    path = np.zeros((12, 3))
    for step in range(1, 12):
        path[step] = compose(path[step - 1], odometry[step])
    frames: list[list[Measurements]] = []
    for step in range(12):
        frames.append([])
        for x, y, theta in compose(STARTS[:robots], path[step]):
            cos, sin = np.cos(theta), np.sin(theta)
            turn = np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
            points = camera.camera_from_robot((landmarks - [x, y, 0.0]) @ turn.T)
            frames[-1].append(Measurements(points, np.ones((8, 1), np.float32)))
    return Used(np.stack([odometry] * robots), frames, [[np.arange(8)] * robots] * 12, motion, camera, merges), path


@pytest.mark.parametrize("motion", [OdometryModel(), BIASED])
def test_exact_readings_give_the_path(motion: OdometryModel) -> None:
    """Both solvers return the path without noise, and the last covariances agree."""
    readings, path = exact_readings(motion)
    online, factors, values = isam2(readings)
    found = batch(readings, factors, values)
    for estimate in (online, found):
        np.testing.assert_allclose(estimate.paths, path[None], atol=1e-5)
    np.testing.assert_allclose(online.covariances[:, -1], found.covariances[:, -1], rtol=0.05, atol=1e-9)


def test_robots_that_merge_keep_their_paths() -> None:
    """Pairs merge, and then the two groups, with no errors; their shared landmarks make all of them more certain."""
    merges = [(3, (0,), (1,)), (4, (2,), (3,)), (6, (0, 1), (2, 3))]
    readings, path = exact_readings(OdometryModel(), 4, merges)
    online, factors, values = isam2(readings)
    found = batch(readings, factors, values)
    for estimate in (online, found):
        np.testing.assert_allclose(estimate.paths, np.stack([path] * 4), atol=1e-5)
    np.testing.assert_allclose(online.covariances[:, -1], found.covariances[:, -1], rtol=0.05, atol=1e-9)
    graph = Graph(readings)
    for robot, above in ((1, 0), (3, 2), (2, 0)):
        pose = values.atPose2(graph.start(robot))
        start = between(STARTS[above], STARTS[robot])
        np.testing.assert_allclose([pose.x(), pose.y(), pose.theta()], start, atol=1e-3)
    alone, _, _ = isam2(exact_readings(OdometryModel(), 4)[0])
    spreads = [np.trace(each.covariances[:, -1], axis1=1, axis2=2) for each in (online, alone)]
    assert (spreads[0] < spreads[1]).all()


def test_a_robot_is_alone_until_it_merges() -> None:
    """Before the merge its estimates are those without the other robot, and afterwards they are not."""
    team, _ = exact_readings(BIASED, 2, [(7, (0,), (1,))])
    rng = np.random.default_rng(3)
    team.odometry[:, 1:] += rng.normal(0.0, 0.01, (2, 11, 3))
    found, _, _ = isam2(team)
    for robot in range(2):
        frames = [tick[robot : robot + 1] for tick in team.frames]
        labels = [tick[robot : robot + 1] for tick in team.labels]
        alone, _, _ = isam2(Used(team.odometry[[robot]], frames, labels, team.motion, team.camera))
        np.testing.assert_allclose(found.paths[robot, :7], alone.paths[0, :7], atol=1e-9)
        np.testing.assert_allclose(found.covariances[robot, :7], alone.covariances[0, :7], rtol=1e-6, atol=1e-12)
        assert np.abs(found.paths[robot, 8:] - alone.paths[0, 8:]).max() > 1e-5


def test_points_in_the_plane_weigh_by_their_covariances() -> None:
    """For small errors the factor of bearing and range has the squared Mahalanobis distance of the point."""
    readings, _ = exact_readings(OdometryModel())
    graph, rng = Graph(readings), np.random.default_rng(0)
    for _ in range(5):
        root = rng.normal(0.0, 0.1, (3, 3))
        covariance, ahead = root @ root.T + 1e-3 * np.eye(3), rng.uniform([2.0, -2.0], [6.0, 2.0])
        off = rng.normal(0.0, 1e-4, 2)
        values = gtsam.Values()
        values.insert(graph.pose(0, 3), gtsam.Pose2())
        values.insert(graph.landmark(0, 5), ahead + off)
        factor = graph._planar_sight(0, 3, 5, ahead, covariance)
        planar = (ROBOT_FROM_CAMERA @ covariance @ ROBOT_FROM_CAMERA.T)[:2, :2]
        assert 2.0 * factor.error(values) == pytest.approx(off @ np.linalg.solve(planar, off), rel=1e-3)


def test_jacobians_of_factors_match_central_differences() -> None:
    """Factors of odometry with a bias, of points by their pixels, and of shared landmarks are linearised rightly."""
    readings, _ = exact_readings(BIASED, 4)
    graph = Graph(readings)
    graph.above = {1: 0, 2: 1, 3: 1}
    frame = readings.frames[3][0]
    assert frame is not None
    for factor, keys in (
        (graph._motion(0, 3), [graph.pose(0, 2), graph.pose(0, 3), graph.bias(0)]),
        (graph._sight(0, 3, 5, frame.points[5]), [graph.pose(0, 3), graph.landmark(0, 5)]),
        (graph._same(5, 2, 0), [graph.start(2), graph.start(1), graph.landmark(2, 5), graph.landmark(0, 5)]),
        (graph._same(5, 2, 3), [graph.start(2), graph.start(3), graph.landmark(2, 5), graph.landmark(3, 5)]),
    ):
        values = gtsam.Values()
        for place, key in enumerate(keys):
            if key == graph.bias(0):
                values.insert(key, np.array([0.03, -0.01, 0.0]))
            elif key in [graph.landmark(robot, 5) for robot in range(4)]:
                values.insert(key, np.array([4.0, 0.5, 0.2]))
            else:
                values.insert(key, gtsam.Pose2(0.1 * place, 0.05, 0.1 + 0.02 * place))
        linear = factor.linearize(values)
        jacobian, _ = linear.jacobian()
        order = list(linear.keys())
        assert sorted(order) == sorted(keys)
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
    config = Config(presets=("standard",), worlds=("office",), robots=(3,), seeds=1, seconds=4.0)
    rows = {trial.method: play(config, trial) for trial in trials(config)}
    assert {row["measurements"] for row in rows.values()} == {rows["filter"]["measurements"]}
    assert rows["filter"]["measurements"] > 60
    assert all(0.0 < row["position_rms_m"] < 0.1 and row["nees_median"] > 0.0 for row in rows.values())


def test_teams_are_estimated_by_all_methods() -> None:
    """With nearly exact readings two robots merge, and filter, iSAM2 and batch agree with the truth."""
    quiet = {
        "sigma_distance": 1e-4,
        "sigma_heading_per_metre": 1e-4,
        "bias_distance": 0.0,
        "bias_heading_per_metre": 0.0,
    }
    sensor = {"camera": {"sigma_px": 1e-2, "sigma_disparity_px": 1e-2}, "false_points": 0.0}
    config = preset_config("standard").replace(
        world="fig5", num_robots=2, max_seconds=20.0, odometry=quiet, landmark_sensor=sensor
    )
    env = vslam_v1.parallel_env(config=config)
    episode = record_episode(env, parted("frontier@continuous").make(env, 600.0), 70)
    env.close()
    readings, estimate = filtered_episode(episode)
    online, factors, values = isam2(readings)
    assert len(readings.merges) == 1
    for found in (estimate, online, batch(readings, factors, values)):
        position_rms, _ = scores(episode, found)
        assert position_rms < 5e-3
