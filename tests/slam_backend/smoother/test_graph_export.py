"""`FastSlam.graph`: optimum, marginal covariances and paths of the smoothed graph, by dense least squares and GTSAM."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from slam_backend import FastSlam, Measurements, OdometryModel, SmoothingOptions, StereoCamera, TeamSlam
from slam_backend.core.validation import FloatArray
from slam_backend.geometry import between, compose, inverse, rotation, transform_points, wrap_angle
from slam_backend.models.camera import ROBOT_FROM_CAMERA
from slam_backend.pose_graph import PoseGraph
from slam_backend.readers.pose_graphs import write_graph

MOTION = OdometryModel(
    sigma_along=0.05, sigma_across=0.03, sigma_heading=0.03, floor_position=0.005, floor_heading=0.004
)
CAMERA = StereoCamera(mount=(0.2, 0.05, 0.4), sigma_px=1.0, sigma_disparity_px=0.5)
STEPS, LANDMARKS = 31, 11


def driven(stereo: bool, robots: int = 1, every: int = 2, landmarks: int = LANDMARKS, **options: Any) -> FastSlam:
    """Return a filter of robots that drive circles among landmarks with known identities, all readings with noise.

    Args:
        stereo: Whether the camera model applies; otherwise a planar sensor gives covariances.
        robots: Number of robots.
        every: Steps between measurements.
        landmarks: Number of landmarks.
        options: Further options of the filter.
    """
    rng = np.random.default_rng(5)
    angles = rng.uniform(0.0, 2.0 * np.pi, landmarks)
    world = np.column_stack([4.5 * np.cos(angles), 4.5 * np.sin(angles) + 2.0, rng.uniform(0.2, 1.4, landmarks)])
    starts = np.array([[0.0, 0.0, 0.0], [0.5, 0.4, 0.6], [-0.3, 0.2, -0.5]])[:robots]
    options = {"motion": MOTION, "position_gate": 1e3, "new_landmark_gate": 1e5, **options}
    slam = FastSlam(robots, num_particles=7, camera=CAMERA, initial_poses=starts, seed=3, **options)
    true = starts.copy()
    for step in range(STEPS):
        moves, frames, names = [], [], []
        for robot in range(robots):
            move = np.array([0.35, 0.0, 0.16 + 0.02 * robot])
            if step:
                true[robot] = compose(true[robot], move)
            moves.append(move + rng.standard_normal(3) * MOTION.sigmas(move) if step else None)
            points = np.column_stack([transform_points(inverse(true[robot]), world[:, :2]), world[:, 2]]) - CAMERA.mount
            ahead = np.flatnonzero((points[:, 0] > 0.5) & (np.abs(points[:, 1]) < points[:, 0]))
            if step % every:
                frames.append(None)
                names.append(None)
                continue
            at, names_seen = points[ahead], ahead
            if stereo:
                u, d = at[:, 1:] / at[:, :1] * CAMERA.focal_px, CAMERA.focal_px * CAMERA.baseline / at[:, 0]
                u, d = u + rng.standard_normal(u.shape), d + 0.5 * rng.standard_normal(d.shape)
                x = CAMERA.focal_px * CAMERA.baseline / d
                at = np.column_stack([x, u * x[:, None] / CAMERA.focal_px])
                covariances = None
            else:
                at = at + 0.08 * rng.standard_normal(at.shape)
                spread = np.diag([0.0064, 0.01, 0.0025])
                spread[0, 1] = spread[1, 0] = 0.003
                covariances = np.tile(ROBOT_FROM_CAMERA.T @ spread @ ROBOT_FROM_CAMERA, (len(at), 1, 1))
            frames.append(Measurements(at @ ROBOT_FROM_CAMERA, np.ones((len(at), 1)), covariances))
            names.append(names_seen)
        slam.step(moves, frames, names)
    return slam


def residuals(graph: PoseGraph, poses: FloatArray, landmarks: FloatArray) -> FloatArray:
    """Return all whitened errors of a graph at poses (n, 3) and landmarks (l, 2), as g2o defines them."""
    parts = []
    for (a, b), value, covariance in zip(*graph.motions, strict=True):
        error = between(value, between(poses[a], poses[b]))
        parts.append((error, covariance))
    for (p, row), value, covariance in zip(*graph.sightings, strict=True):
        parts.append((rotation(poses[p, 2]).T @ (landmarks[row] - poses[p, :2]) - value, covariance))
    for p, value, covariance in zip(*graph.pose_priors, strict=True):
        parts.append((between(value, poses[p]), covariance))
    errors = []
    for error, covariance in parts:
        if len(error) == 3:
            error[2] = wrap_angle(error[2])
        errors.append(np.linalg.solve(np.linalg.cholesky(covariance), error))
    return np.concatenate(errors)


def optimised(graph: PoseGraph, steps: int = 3) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return poses, landmarks and the joint covariance by dense Gauss-Newton with central differences."""
    free = np.flatnonzero(~graph.fixed)
    size = 3 * len(free)

    def parted(x: FloatArray) -> tuple[FloatArray, FloatArray]:
        poses = graph.poses.copy()
        poses[free] = x[:size].reshape(-1, 3)
        return poses, x[size:].reshape(-1, 2)

    x = np.concatenate([graph.poses[free].ravel(), graph.landmarks.ravel()])
    for _ in range(steps):
        jacobian = np.empty((len(residuals(graph, *parted(x))), len(x)))
        for i in range(len(x)):
            step = np.zeros(len(x))
            step[i] = 1e-6
            jacobian[:, i] = (residuals(graph, *parted(x + step)) - residuals(graph, *parted(x - step))) / 2e-6
        x = x - np.linalg.lstsq(jacobian, residuals(graph, *parted(x)), rcond=None)[0]
    return *parted(x), np.linalg.inv(jacobian.T @ jacobian)


def worst_shift(graph: PoseGraph, poses: FloatArray, landmarks: FloatArray) -> float:
    """Return the largest distance of estimates from those of the graph, in standard deviations of the graph."""
    free = ~graph.fixed
    assert graph.pose_covariances is not None
    assert graph.landmark_covariances is not None
    off = poses - graph.poses
    off[:, 2] = wrap_angle(off[:, 2])
    sigmas = np.sqrt(np.diagonal(graph.pose_covariances[free], axis1=1, axis2=2))
    points = np.sqrt(np.diagonal(graph.landmark_covariances, axis1=1, axis2=2))
    return max(np.abs(off[free] / sigmas).max(), np.abs((landmarks - graph.landmarks) / points).max(initial=0.0))


VARIANTS = [
    pytest.param({"stereo": False}, id="planar"),
    pytest.param({"stereo": True}, id="stereo"),
    pytest.param({"stereo": False, "robots": 3, "every": 3}, id="team"),
    pytest.param({"stereo": True, "rejuvenate_every": None}, id="no smoother"),
    pytest.param({"stereo": False, "landmarks": 0}, id="no landmarks"),
    pytest.param({"stereo": False, "smoothing": SmoothingOptions(kernel=2.0)}, id="robust"),
]


@pytest.mark.parametrize("variant", VARIANTS)
def test_the_estimate_is_the_optimum_of_the_exported_graph(variant: dict[str, Any]) -> None:
    """Dense Gauss-Newton on the exported graph moves no pose and no landmark by a thousandth of its sigma."""
    graph = driven(**variant).graph()
    poses, landmarks, _ = optimised(graph)
    assert worst_shift(graph, poses, landmarks) < 1e-3


@pytest.mark.parametrize("variant", VARIANTS)
def test_marginals_are_blocks_of_the_dense_inverse(variant: dict[str, Any]) -> None:
    """Marginals equal those of the graph for a planar sensor, and are no larger for a stereo camera, with heights."""
    graph = driven(**variant).graph()
    _, _, joint = optimised(graph, steps=1)
    free = np.flatnonzero(~graph.fixed)
    size = 3 * len(free)
    assert graph.pose_covariances is not None
    assert graph.landmark_covariances is not None
    pairs = [(graph.pose_covariances[p], joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3]) for i, p in enumerate(free)]
    for i, marginal in enumerate(graph.landmark_covariances):
        at = slice(size + 2 * i, size + 2 * i + 2)
        pairs.append((marginal, joint[at, at]))
    for marginal, block in pairs:
        if variant["stereo"]:
            assert np.linalg.eigvalsh(block - marginal).min() > -1e-4 * np.trace(block)
        else:
            np.testing.assert_allclose(marginal, block, rtol=1e-3, atol=1e-4 * np.abs(block).max())
    assert not graph.pose_covariances[graph.fixed].any()


def test_odometry_bias_is_taken_out_of_the_motions() -> None:
    """With an estimated bias the optimum of the exported graph is the estimate, too; edges leave the bias out."""
    motion = OdometryModel(sigma_along=0.05, sigma_across=0.03, sigma_heading=0.03, bias_scale=0.1, bias_heading=0.05)
    graph, plain = driven(stereo=False, motion=motion).graph(), driven(stereo=False).graph()
    poses, landmarks, _ = optimised(graph)
    assert worst_shift(graph, poses, landmarks) < 1e-3
    assert np.abs(graph.motions.values - plain.motions.values).max() > 1e-3


def test_export_does_not_change_the_filter() -> None:
    """A filter whose graph was exported continues bit for bit as one whose graph was not."""
    slam, other = driven(stereo=True, rejuvenate_every=10), driven(stereo=True, rejuvenate_every=10)
    slam.graph()
    for each in (slam, other):
        each.step([[0.3, 0.0, 0.1]], [None])
    assert np.array_equal(slam.poses, other.poses)
    assert slam.rng.bit_generator.state == other.rng.bit_generator.state


def test_path_of_each_robot_over_time() -> None:
    """`trajectory` has the start and the steps that measured something, in order, at the times of the steps."""
    graph = driven(stereo=False, robots=3, every=3).graph(covariances=False)
    assert graph.pose_covariances is None
    for robot in range(3):
        path = graph.trajectory(robot)
        assert path.times.tolist() == list(range(0, STEPS, 3))
        assert np.array_equal(path.poses, graph.poses[graph.robots == robot])
        timed = graph.trajectory(robot, 10.0 + 0.5 * np.arange(STEPS))
        assert np.array_equal(timed.times, 10.0 + 0.5 * path.times)
    with pytest.raises(ValueError, match=r"step_times: expected at least 31 times, got 30\. Give one for each step."):
        graph.trajectory(0, np.arange(30.0))
    with pytest.raises(ValueError, match=r"robot: expected an index from 0 to 2, got 3\."):
        graph.trajectory(3)


def test_smoothed_path_is_nearer_the_truth_than_odometry() -> None:
    """The smoothed end of a circle lies nearer the true end than chained odometry."""
    slam = driven(stereo=False, every=1)
    true = np.zeros(3)
    for _ in range(STEPS - 1):
        true = compose(true, [0.35, 0.0, 0.16])
    graph, reckoned = slam.graph(), np.zeros(3)
    for step in slam.log():
        reckoned = compose(reckoned, step.motion)
    assert np.hypot(*(graph.poses[-1] - true)[:2]) < np.hypot(*(reckoned - true)[:2])


def test_team_exports_the_graph_of_a_robots_group() -> None:
    """The graph of a robot of a team is that of its filter."""
    team = TeamSlam(2, num_particles=5, seed=1)
    frame = Measurements([[0.0, 0.0, 2.0]], np.ones((1, 1)))
    team.step([None, None], [frame, frame])
    team.step([[0.2, 0.0, 0.1], [0.1, 0.0, 0.0]], [frame, None])
    graphs = [team.graph(robot) for robot in range(2)]
    assert [len(graph.poses) for graph in graphs] == [2, 2]
    assert np.allclose(graphs[1].poses[-1], [0.1, 0.0, 0.0])


def test_graphs_that_cannot_be_smoothed_are_refused() -> None:
    """Without a step, without motion, with exact poses or noiseless odometry the error says so and what helps."""
    frame = Measurements([[0.0, 0.0, 2.0]], np.ones((1, 1)))
    slam = FastSlam(num_particles=3)
    with pytest.raises(ValueError, match=r"graph: expected a filter after its first step, got no step\. Call step\(\)"):
        slam.graph()
    slam.step([None], [frame])
    with pytest.raises(ValueError, match="graph: expected a robot that has moved, got no motion"):
        slam.graph()
    slam.step([None], [frame], poses=[[0.1, 0.0, 0.0]])
    with pytest.raises(ValueError, match="graph: expected odometry, got a pose that was given as exact"):
        slam.graph()
    noiseless = dict.fromkeys(MOTION.__slots__, 0.0)
    slam = FastSlam(num_particles=3, motion=OdometryModel(**noiseless))
    slam.step([[0.1, 0.0, 0.0]], [frame])
    with pytest.raises(ValueError, match="graph: expected odometry with noise, got no noise"):
        slam.graph()


@pytest.mark.parametrize("stereo", [False, True])
def test_gtsam_finds_the_same_optimum(stereo: bool, tmp_path: Path) -> None:
    """GTSAM reads vertices and motions of the g2o file; with the points as factors its optimum is the estimate."""
    gtsam = pytest.importorskip("gtsam", reason="gtsam, an optional peer, is not installed: pip install gtsam")
    graph = driven(stereo, robots=2).graph()
    factors, values = gtsam.readG2o(str(write_graph(graph, tmp_path / "graph.g2o")), False)
    assert factors.size() == len(graph.motions.rows)
    first = int(graph.landmark_ids.max()) + 1  # ids of g2o: poses after the landmarks, where they clash
    for row in np.flatnonzero(graph.fixed).tolist():
        exact = gtsam.noiseModel.Constrained.All(3)
        factors.add(gtsam.PriorFactorPose2(first + row, gtsam.Pose2(*graph.poses[row]), exact))
    for (pose, landmark), point, covariance in zip(*graph.sightings, strict=True):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        key = gtsam.symbol("l", int(graph.landmark_ids[landmark]))

        def error(this: Any, given: Any, jacobians: Any, measured: FloatArray = point) -> FloatArray:
            pose, place = given.atPose2(this.keys()[0]), given.atPoint2(this.keys()[1])
            of_pose, of_point = np.zeros((2, 3), order="F"), np.zeros((2, 2), order="F")
            predicted = pose.transformTo(place, of_pose, of_point)
            if jacobians is not None:
                jacobians[0], jacobians[1] = of_pose, of_point
            return np.asarray(predicted - measured)

        factors.add(gtsam.CustomFactor(noise, [first + int(pose), key], error))
    keys = [gtsam.symbol("l", int(i)) for i in graph.landmark_ids]
    for key, place in zip(keys, graph.landmarks, strict=True):
        np.testing.assert_array_equal(values.atPoint2(key), place)
    optimum = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    poses = np.array([[p.x(), p.y(), p.theta()] for p in map(optimum.atPose2, range(first, first + len(graph.poses)))])
    landmarks = np.array([optimum.atPoint2(key) for key in keys])
    assert worst_shift(graph, poses, landmarks) < 0.01
    if not stereo:
        marginals = gtsam.Marginals(factors, optimum)
        assert graph.landmark_covariances is not None
        for key, covariance in zip(keys, graph.landmark_covariances, strict=True):
            np.testing.assert_allclose(marginals.marginalCovariance(key), covariance, rtol=0.02, atol=1e-6)
