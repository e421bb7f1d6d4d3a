"""Batch problem in gtsam: an independent implementation with its own factors and optimiser."""

from types import ModuleType
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from studies.filters.beside_gtsam import one_thread
from training.stereo_runs.batch_problem import BatchProblem, Estimate


@one_thread()
def solve_with_gtsam(gtsam: ModuleType, problem: BatchProblem, start: Estimate) -> tuple[Estimate, list[FloatArray]]:
    """Return gtsam's estimate, and its marginal covariances of the last pose of each robot.

    Poses are `Pose2`, landmarks `Point3`; residuals use gtsam's own pose algebra and camera parameters, with numerical
    derivatives, so that only the data of `batch_problem` is used.
    """
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()

    def pose_key(robot: int, step: int) -> int:
        return int(gtsam.symbol(chr(ord("a") + robot), step))

    def landmark_key(row: int) -> int:
        return int(gtsam.symbol("l", row))

    for robot, path in enumerate(start.paths):
        for step, pose in enumerate(path):
            values.insert(pose_key(robot, step), gtsam.Pose2(*pose))
        exact = gtsam.noiseModel.Constrained.All(3)
        graph.add(gtsam.PriorFactorPose2(pose_key(robot, 0), gtsam.Pose2(*problem.starts[robot]), exact))
        for step in range(1, problem.num_steps):
            keys = [pose_key(robot, step - 1), pose_key(robot, step)]
            noise = gtsam.noiseModel.Gaussian.Covariance(problem.odometry_covariances[robot, step - 1])
            graph.add(gtsam.CustomFactor(noise, keys, _odometry_error(gtsam, problem.odometry[robot, step - 1])))
    for row, landmark in enumerate(start.landmarks):
        values.insert(landmark_key(row), landmark)
    camera = problem.camera
    stereo = gtsam.noiseModel.Diagonal.Sigmas(np.array([camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px]))
    for n, point in enumerate(problem.points):
        keys = [pose_key(problem.robots[n], problem.steps[n]), landmark_key(problem.landmarks[n])]
        graph.add(gtsam.CustomFactor(stereo, keys, _stereo_error(gtsam, camera, point)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-14)
    parameters.setAbsoluteErrorTol(1e-12)
    result = gtsam.LevenbergMarquardtOptimizer(graph, values, parameters).optimize()
    marginals = gtsam.Marginals(graph, result)
    last = problem.num_steps - 1
    covariances = []
    for robot in range(len(problem.starts)):
        pose = result.atPose2(pose_key(robot, last))
        turn = np.eye(3)
        turn[:2, :2] = pose.rotation().matrix()  # gtsam's tangent is in the robot's own frame
        covariances.append(turn @ marginals.marginalCovariance(pose_key(robot, last)) @ turn.T)
    paths = [
        [[pose.x(), pose.y(), pose.theta()] for pose in (result.atPose2(pose_key(robot, s)) for s in range(last + 1))]
        for robot in range(len(problem.starts))
    ]
    landmarks = [result.atPoint3(landmark_key(row)) for row in range(len(problem.names))]
    return Estimate(np.array(paths), np.array(landmarks)), covariances


def _numerical(error: Any, arguments: list[Any], moves: list[Any], jacobians: Any) -> FloatArray:
    """Return the error, and fill gtsam's Jacobians by central differences along its own retractions."""
    if jacobians is not None:
        for i, move in enumerate(moves):
            columns = []
            for axis in range(3):
                step = np.zeros(3)
                step[axis] = 1e-6
                ahead, behind = ([*arguments[:i], move(arguments[i], s), *arguments[i + 1 :]] for s in (step, -step))
                columns.append((error(*ahead) - error(*behind)) / 2e-6)
            jacobians[i] = np.column_stack(columns)
    return np.asarray(error(*arguments))


def _odometry_error(gtsam: ModuleType, reading: FloatArray) -> Any:
    def error(first: Any, second: Any) -> FloatArray:
        motion = first.between(second)
        turn = motion.rotation().compose(gtsam.Rot2(-reading[2])).theta()
        return np.array([motion.x() - reading[0], motion.y() - reading[1], turn])

    def factor(this: Any, values: Any, jacobians: Any) -> FloatArray:
        poses = [values.atPose2(this.keys()[i]) for i in range(2)]
        return _numerical(error, poses, [lambda pose, step: pose.retract(step)] * 2, jacobians)

    return factor


def _stereo_error(gtsam: ModuleType, camera: Any, point: FloatArray) -> Any:
    focal, baseline = camera.focal_px, camera.baseline
    lens = gtsam.Cal3_S2Stereo(focal, focal, 0.0, 0.0, 0.0, baseline)
    optical = gtsam.Rot3(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]))
    mounted = gtsam.Pose3(optical, np.array(camera.mount))

    def pixels(eye: Any, seen: FloatArray) -> FloatArray:
        projected = gtsam.StereoCamera(eye, lens).project(seen)
        return np.array([projected.uL(), projected.v(), projected.uL() - projected.uR()])

    measured = pixels(gtsam.Pose3(), point)

    def error(pose: Any, landmark: FloatArray) -> FloatArray:
        return pixels(gtsam.Pose3(pose).compose(mounted), landmark) - measured

    def factor(this: Any, values: Any, jacobians: Any) -> FloatArray:
        pose_key, landmark_key = this.keys()
        arguments = [values.atPose2(pose_key), values.atPoint3(landmark_key)]
        moves = [lambda pose, step: pose.retract(step), lambda landmark, step: landmark + step]
        return _numerical(error, arguments, moves, jacobians)

    return factor
