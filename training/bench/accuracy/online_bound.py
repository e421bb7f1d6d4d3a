"""Ideal online estimate: each pose at its own time, from a filter without approximations.

The readings are linearised at the batch estimate, which uses the whole run, and then processed step by step by a
Kalman filter over the latest poses and all landmarks (EKF-SLAM with perfect linearisation points). After the last step
its map equals the batch estimate, to first order. No online filter can have a smaller mean error.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import wrap_angle
from training.bench.accuracy.batch_ml import BatchEstimate
from training.bench.accuracy.batch_problem import BatchProblem, Estimate


@dataclass(frozen=True, slots=True, eq=False)
class OnlineEstimate:
    """Estimate of each pose from the readings up to its own step."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame; the first poses are known
    covariances: FloatArray  # (K, T, 3, 3) float64; 0 at the first poses
    landmarks: FloatArray  # (L, 3) float64 [m], world frame, from all readings, ordered as `BatchProblem.names`
    landmark_covariances: FloatArray  # (L, 3, 3) float64 [m^2]


def ideal_online(problem: BatchProblem, batch: BatchEstimate) -> OnlineEstimate:
    """Filter a run with its readings linearised at the batch estimate."""
    at = Estimate(batch.paths, batch.landmarks)
    sights, moves = problem.sights(at), problem.moves(at)
    num_robots, num_steps = len(problem.starts), problem.num_steps
    # The state holds deviations from `at`: poses of all robots, then landmarks in the order of first measurement.
    size = 3 * (num_robots + len(problem.names))
    mean, covariance = np.zeros(size), np.zeros((size, size))
    known = 3 * num_robots  # size of the state so far
    deviations = np.zeros((num_robots, num_steps, 3))
    spreads = np.zeros((num_robots, num_steps, 3, 3))
    ends = np.searchsorted(problem.steps, np.arange(num_steps), side="right")
    for step in range(num_steps):
        if step:
            for robot in range(num_robots):
                own = slice(3 * robot, 3 * robot + 3)
                _predict(
                    mean, covariance, own, known,
                    moves.residuals[robot, step - 1], moves.by_first[robot, step - 1], moves.by_second[robot, step - 1],
                )  # fmt: skip
        rows = np.arange(0 if step == 0 else ends[step - 1], ends[step])
        columns = 3 * (num_robots + problem.landmarks[rows])
        _, first = np.unique(columns, return_index=True)
        new = np.isin(np.arange(len(rows)), first) & (columns >= known)
        for row in rows[new]:  # by first measurement, as in the state
            pose = slice(3 * problem.robots[row], 3 * problem.robots[row] + 3)
            _append(mean, covariance, pose, known, sights.residuals[row], sights.by_pose[row], sights.by_landmark[row])
            known += 3
        old = rows[~new]
        if len(old):
            jacobian = _rows(
                sights.by_pose[old], sights.by_landmark[old], 3 * problem.robots[old], columns[~new], known
            )
            _update(mean[:known], covariance[:known, :known], sights.residuals[old], jacobian)
        for robot in range(num_robots):
            own = slice(3 * robot, 3 * robot + 3)
            deviations[robot, step], spreads[robot, step] = mean[own], covariance[own, own]
    paths = batch.paths + deviations
    paths[..., 2] = wrap_angle(paths[..., 2])
    blocks = covariance[3 * num_robots :, 3 * num_robots :].reshape(len(problem.names), 3, len(problem.names), 3)
    each = np.arange(len(problem.names))
    return OnlineEstimate(
        paths, spreads, batch.landmarks + mean[3 * num_robots :].reshape(-1, 3), blocks[each, :, each, :]
    )


def _predict(
    mean: FloatArray, covariance: FloatArray, own: slice, known: int, residual: FloatArray, by_first: FloatArray,
    by_second: FloatArray,
) -> None:  # fmt: skip
    """Propagate one pose in place: residual + F d_before + G d_after is standard normal, so d_after = -G^-1 (...)."""
    mean[own] = -np.linalg.solve(by_second, residual + by_first @ mean[own])
    change = -np.linalg.solve(by_second, by_first)
    noise = np.linalg.inv(by_second)
    block = change @ covariance[own, own] @ change.T + noise @ noise.T
    covariance[own, :known] = change @ covariance[own, :known]
    covariance[:known, own] = covariance[own, :known].T
    covariance[own, own] = block


def _append(
    mean: FloatArray, covariance: FloatArray, pose: slice, known: int, residual: FloatArray, by_pose: FloatArray,
    by_landmark: FloatArray,
) -> None:  # fmt: skip
    """Add a landmark in place, with its first measurement as the only information."""
    new = slice(known, known + 3)
    mean[new] = -np.linalg.solve(by_landmark, residual + by_pose @ mean[pose])
    change = -np.linalg.solve(by_landmark, by_pose)
    noise = np.linalg.inv(by_landmark)
    covariance[new, :known] = change @ covariance[pose, :known]
    covariance[:known, new] = covariance[new, :known].T
    covariance[new, new] = change @ covariance[pose, pose] @ change.T + noise @ noise.T


def _update(mean: FloatArray, covariance: FloatArray, residuals: FloatArray, jacobian: FloatArray) -> None:
    """Update mean and covariance in place with whitened residuals (n, 3) and Jacobian (3 n, size)."""
    gain = covariance @ jacobian.T
    innovation = jacobian @ gain
    innovation[np.diag_indices(len(innovation))] += 1.0
    lower = np.linalg.cholesky(innovation)
    half = scipy.linalg.solve_triangular(lower, gain.T, lower=True, check_finite=False)
    expected = -(residuals.ravel() + jacobian @ mean)
    mean += half.T @ scipy.linalg.solve_triangular(lower, expected, lower=True, check_finite=False)
    covariance -= half.T @ half


def _rows(by_pose: FloatArray, by_landmark: FloatArray, poses: IntArray, landmarks: IntArray, size: int) -> FloatArray:
    """Return the Jacobian (3 n, size) with blocks (n, 3, 3) at the columns of pose and landmark of each measurement."""
    jacobian = np.zeros((len(by_pose), 3, size))
    each, inner = np.arange(len(by_pose)), np.arange(3)
    for blocks, columns in ((by_pose, poses), (by_landmark, landmarks)):
        jacobian[each[:, None, None], inner[:, None], (columns[:, None] + inner)[:, None, :]] = blocks
    return jacobian.reshape(-1, size)
