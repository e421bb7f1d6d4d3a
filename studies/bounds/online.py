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
from training.stereo_runs.batch_ml import BatchEstimate, prior_terms
from training.stereo_runs.batch_problem import BatchProblem, Estimate

EQUAL = 1e-6  # [m]; standard deviation of the difference of two landmarks that are fused


@dataclass(frozen=True, slots=True, eq=False)
class OnlineEstimate:
    """Estimate of each pose from the readings up to its own step."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame; the first poses are known
    covariances: FloatArray  # (K, T, 3, 3) float64; 0 at the first poses
    landmarks: FloatArray  # (L, 3) float64 [m], world frame, from all readings, ordered as `BatchProblem.names`
    landmark_covariances: FloatArray  # (L, 3, 3) float64 [m^2]
    bases: FloatArray | None = None  # (K, 3) float64 [m, m, rad], world frame. Path frames, from all readings.


@dataclass(frozen=True, slots=True, eq=False)
class Fusions:
    """Landmarks that are unknown to be the same until two maps are merged.

    Each landmark may have several copies, each estimated from its own measurements until it is fused with another.
    """

    copies: IntArray  # (n,) int64. Copy of the landmark that each measurement saw, numbered by first measurement.
    pairs: IntArray  # (m, 3) int64. Rows (step, copy, other copy), ascending: equal from the end of this step on.


def ideal_online(
    problem: BatchProblem, batch: Estimate | BatchEstimate, weights: FloatArray | None = None,
    fusions: Fusions | None = None,
) -> OnlineEstimate:  # fmt: skip
    """Filter a run with its readings linearised at the batch estimate.

    Args:
        weights: (n,) float64. Weights of the measurements, those of a robust kernel at the batch estimate; None: 1.
        fusions: Landmarks that are fused later; None: all measurements of a landmark are known to be of the same.
    """
    at = batch if isinstance(batch, Estimate) else Estimate(batch.paths, batch.landmarks)
    sights, moves = problem.sights(at), problem.moves(at)
    root = np.ones(len(problem.points)) if weights is None else np.sqrt(weights)
    residuals = root[:, None] * sights.residuals
    by_pose, by_landmark = root[:, None, None] * sights.by_pose, root[:, None, None] * sights.by_landmark
    by_base = root[:, None, None] * sights.by_base
    copies = problem.landmarks if fusions is None else fusions.copies
    pairs = np.empty((0, 3), dtype=np.int64) if fusions is None else fusions.pairs
    num_robots, num_steps = len(problem.starts), problem.num_steps
    # The state holds deviations from `at`: poses of all robots, path frames, biases, then landmarks in the order of
    # first measurement.
    loose, biased = problem.loose_robots, problem.biased
    first_base = 3 * num_robots
    first_bias = first_base + 3 * len(loose)
    first_landmark = first_bias + num_robots * len(biased)
    size = first_landmark + 3 * (int(copies.max(initial=-1)) + 1)
    mean, covariance = np.zeros(size), np.zeros((size, size))
    priors, prior_residuals = prior_terms(problem, at)
    shared = np.arange(first_base, first_landmark)
    mean[shared], covariance[shared, shared] = -prior_residuals / priors, priors**-2.0
    bases_of = {int(robot): first_base + 3 * i for i, robot in enumerate(loose)}
    inner = np.arange(3)
    known = first_landmark  # size of the state so far
    deviations = np.zeros((num_robots, num_steps, 3))
    spreads = np.zeros((num_robots, num_steps, 3, 3))
    ends = np.searchsorted(problem.steps, np.arange(num_steps), side="right")
    fused = np.searchsorted(pairs[:, 0], np.arange(num_steps + 1))
    for step in range(num_steps):
        if step:
            for robot in range(num_robots):
                own = slice(3 * robot, 3 * robot + 3)
                bias = first_bias + len(biased) * robot + np.arange(len(biased))
                cause = np.concatenate([np.arange(own.start, own.stop), bias])
                by_cause = np.hstack([moves.by_first[robot, step - 1], moves.by_bias[robot, step - 1][:, biased]])
                _predict(
                    mean, covariance, own, cause, known, moves.residuals[robot, step - 1], by_cause,
                    moves.by_second[robot, step - 1],
                )  # fmt: skip
        rows = np.arange(0 if step == 0 else ends[step - 1], ends[step])
        columns = first_landmark + 3 * copies[rows]
        _, first = np.unique(columns, return_index=True)
        new = np.isin(np.arange(len(rows)), first) & (columns >= known)
        jacobians = []
        for row, column in zip(rows, columns, strict=True):
            robot = int(problem.robots[row])
            base = bases_of.get(robot)
            places = [3 * robot + inner, column + inner] + ([] if base is None else [base + inner])
            blocks = [by_pose[row], by_landmark[row]] + ([] if base is None else [by_base[row]])
            jacobians.append((np.concatenate(places), np.hstack(blocks), residuals[row]))
        for row in np.flatnonzero(new):  # by first measurement, as in the state
            _append(mean, covariance, known, *jacobians[row])
            known += 3
        old = [jacobians[row] for row in np.flatnonzero(~new)]
        old += [_equal(first_landmark, *pair) for pair in pairs[fused[step] : fused[step + 1], 1:].tolist()]
        if old:
            _update(mean[:known], covariance[:known, :known], old)
        for robot in range(num_robots):
            own = slice(3 * robot, 3 * robot + 3)
            deviations[robot, step], spreads[robot, step] = mean[own], covariance[own, own]
    paths = batch.paths + deviations
    paths[..., 2] = wrap_angle(paths[..., 2])
    rows = np.zeros(len(problem.names), dtype=np.int64)
    rows[problem.landmarks[::-1]] = copies[::-1]  # the first copy, which later ones are fused with
    last = first_landmark + 3 * rows[:, None] + inner
    bases = at.bases
    if bases is not None and len(loose):
        bases = bases.copy()
        bases[loose] += mean[first_base:first_bias].reshape(-1, 3)
    return OnlineEstimate(
        paths, spreads, batch.landmarks + mean[last], covariance[last[:, :, None], last[:, None, :]], bases
    )


Row = tuple[IntArray, FloatArray, FloatArray]  # columns (c,), Jacobian (3, c) and residual (3,) of a whitened reading


def _equal(first_landmark: int, copy: int, other: int) -> Row:
    """Return the reading that two copies of a landmark, with the same linearisation point, are equal."""
    columns = first_landmark + np.concatenate([3 * copy + np.arange(3), 3 * other + np.arange(3)])
    return columns, np.hstack([np.eye(3), -np.eye(3)]) / EQUAL, np.zeros(3)


def _predict(
    mean: FloatArray, covariance: FloatArray, own: slice, cause: IntArray, known: int, residual: FloatArray,
    by_cause: FloatArray, by_second: FloatArray,
) -> None:  # fmt: skip
    """Propagate one pose in place: residual + F d_cause + G d_after is standard normal, so d_after = -G^-1 (...).

    The causes are the pose before and the bias.
    """
    mean[own] = -np.linalg.solve(by_second, residual + by_cause @ mean[cause])
    change = -np.linalg.solve(by_second, by_cause)
    noise = np.linalg.inv(by_second)
    block = change @ covariance[np.ix_(cause, cause)] @ change.T + noise @ noise.T
    covariance[own, :known] = change @ covariance[cause, :known]
    covariance[:known, own] = covariance[own, :known].T
    covariance[own, own] = block


def _append(
    mean: FloatArray, covariance: FloatArray, known: int, columns: IntArray, jacobian: FloatArray, residual: FloatArray
) -> None:
    """Add a landmark in place, with its first measurement as the only information."""
    new = slice(known, known + 3)
    others = columns[columns < known]
    by_others, by_landmark = jacobian[:, columns < known], jacobian[:, columns >= known]
    mean[new] = -np.linalg.solve(by_landmark, residual + by_others @ mean[others])
    change = -np.linalg.solve(by_landmark, by_others)
    noise = np.linalg.inv(by_landmark)
    covariance[new, :known] = change @ covariance[others, :known]
    covariance[:known, new] = covariance[new, :known].T
    covariance[new, new] = change @ covariance[np.ix_(others, others)] @ change.T + noise @ noise.T


def _update(mean: FloatArray, covariance: FloatArray, readings: list[Row]) -> None:
    """Update mean and covariance in place with whitened readings."""
    columns = np.unique(np.concatenate([own for own, _, _ in readings]))
    jacobian = np.zeros((3 * len(readings), len(columns)))
    for row, (own, by, _) in enumerate(readings):
        jacobian[3 * row : 3 * row + 3, np.searchsorted(columns, own)] = by
    gain = covariance[:, columns] @ jacobian.T
    innovation = jacobian @ gain[columns]
    innovation[np.diag_indices(len(innovation))] += 1.0
    lower = np.linalg.cholesky(innovation)
    half = scipy.linalg.solve_triangular(lower, gain.T, lower=True, check_finite=False)
    expected = -(np.concatenate([residual for _, _, residual in readings]) + jacobian @ mean[columns])
    mean += half.T @ scipy.linalg.solve_triangular(lower, expected, lower=True, check_finite=False)
    covariance -= half.T @ half
