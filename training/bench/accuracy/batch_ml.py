"""Batch maximum likelihood (bundle adjustment with odometry): paths, landmarks and their covariances.

Levenberg-Marquardt on the sum of squared whitened residuals. In the normal equations

    [ A   B  ] [dp]   [a]        A: poses, block-tridiagonal by odometry, one chain per robot
    [ B^T C  ] [dl] = [c]        C: landmarks, block-diagonal; B: one block per measurement

the poses are eliminated by a banded Cholesky factor: (C - B^T A^-1 B) dl = c - B^T A^-1 a is dense, but its size is
that of the map, so that the cost grows linearly with the length of the run.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse

from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_float
from slam_backend.geometry import wrap_angle
from training.bench.accuracy.batch_problem import BatchProblem, Estimate, Moves, Sights

BAND = 5  # super-diagonals of a block-tridiagonal matrix with blocks of 3
MAX_ITERATIONS = 100
FIRST_DAMPING = 1e-3
MAX_DAMPING = 1e12
LEAST_DECREASE = 1e-12  # relative decrease of the cost at convergence


@dataclass(frozen=True, slots=True, eq=False)
class BatchEstimate:
    """Maximum likelihood estimate with its first-order covariance."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad], world frame; the first poses are known
    landmarks: FloatArray  # (L, 3) float64 [m], world frame
    names: IntArray  # (L,) int64. Indices of the landmarks in the run.
    path_covariances: FloatArray  # (K, T, 3, 3) float64; 0 at the first poses
    landmark_covariances: FloatArray  # (L, 3, 3) float64 [m^2]
    cost: float  # Sum of squared whitened residuals (chi-square), or of the robust loss with a kernel
    freedom: int  # Degrees of freedom: residuals minus unknowns
    # Largest remaining gradient of the cost in units of the unknown's own curvature: the number of standard deviations
    # that a single unknown would still move
    gradient: float
    iterations: int  # Number of iterations


def batch_ml(problem: BatchProblem, start: Estimate | None = None, robust: float | None = None) -> BatchEstimate:
    """Compute the maximum likelihood paths and landmarks.

    Args:
        problem: Odometry and measurements; K >= 1, T >= 2.
        start: Initial estimate. None: dead reckoning, optimised first with errors in metres, then in pixels.
        robust: Scale c of a Cauchy kernel on the measurements, c^2 log(1 + d^2 / c^2) for a squared distance d^2; None:
            least squares.

    Raises:
        ValueError: If there is nothing to estimate.
    """
    if problem.num_steps < 2 or not len(problem.points):
        raise argument_error("problem", "two steps and a measurement", "a run without them", "Give a longer run.")
    if robust is not None:
        check_float("robust", robust, "Give it in standard deviations.", above=0.0)
    iterations = 0
    if start is None:
        start, iterations = _descend(problem, problem.dead_reckoning(), robust, metric=True)
    best, more = _descend(problem, start, robust, metric=False)
    system = _System(problem, problem.sights(best), problem.moves(best), robust)
    path_covariances, landmark_covariances = system.covariances()
    residuals = 3 * len(problem.points) + problem.odometry.size
    return BatchEstimate(
        paths=best.paths, landmarks=best.landmarks, names=problem.names, path_covariances=path_covariances,
        landmark_covariances=landmark_covariances, cost=system.cost,
        freedom=residuals - problem.odometry.size - best.landmarks.size, gradient=system.largest_slope(),
        iterations=iterations + more,
    )  # fmt: skip


def _descend(problem: BatchProblem, at: Estimate, robust: float | None, metric: bool) -> tuple[Estimate, int]:
    """Return the nearest minimum and the number of iterations (Levenberg-Marquardt, Nocedal and Wright, ch. 10)."""
    damping = FIRST_DAMPING
    system = _System(problem, problem.sights(at, metric), problem.moves(at), robust)
    for iteration in range(MAX_ITERATIONS):
        trial = _moved(at, *system.solve(damping))
        sights = problem.sights(trial, metric)
        changed = _System(problem, sights, problem.moves(trial), robust)
        if changed.cost <= system.cost and (metric or sights.in_front):
            decrease = system.cost - changed.cost
            at, system, damping = trial, changed, damping / 10.0
            if decrease <= LEAST_DECREASE * (1.0 + system.cost):
                return at, iteration + 1
        else:
            damping = max(10.0 * damping, 1e-9)
            if damping > MAX_DAMPING:
                break
    return at, iteration + 1


def _moved(at: Estimate, poses: FloatArray, landmarks: FloatArray) -> Estimate:
    """Add changes to the poses after the first (K, T - 1, 3) and to the landmarks (L, 3)."""
    paths = at.paths.copy()
    paths[:, 1:] += poses
    paths[..., 2] = wrap_angle(paths[..., 2])
    return Estimate(paths, at.landmarks + landmarks)


class _System:
    """Normal equations at one estimate."""

    def __init__(self, problem: BatchProblem, sights: Sights, moves: Moves, robust: float | None) -> None:
        squares = np.einsum("ni,ni->n", sights.residuals, sights.residuals)
        weights = np.ones(len(squares)) if robust is None else 1.0 / (1.0 + squares / robust**2)
        loss = squares if robust is None else robust**2 * np.log1p(squares / robust**2)
        self.cost = float(loss.sum() + np.einsum("kti,kti->", moves.residuals, moves.residuals))
        self.shape = problem.odometry.shape
        num_poses, num_landmarks = self.shape[0] * self.shape[1], len(problem.names)
        # First poses are known: measurements from them give no information on unknown poses.
        pose = problem.robots * self.shape[1] + problem.steps - 1
        later = problem.steps > 0
        by_pose = sights.by_pose * weights[:, None, None]
        by_landmark = sights.by_landmark * weights[:, None, None]

        self.diagonal = np.zeros((num_poses, 3, 3))
        self.slope_poses = np.zeros((num_poses, 3))
        self.landmarks = np.zeros((num_landmarks, 3, 3))
        self.slope_landmarks = np.zeros((num_landmarks, 3))
        transposed = by_pose.transpose(0, 2, 1)
        np.add.at(self.diagonal, pose[later], transposed[later] @ sights.by_pose[later])
        np.add.at(self.slope_poses, pose[later], np.einsum("nij,nj->ni", transposed[later], sights.residuals[later]))
        transposed = by_landmark.transpose(0, 2, 1)
        np.add.at(self.landmarks, problem.landmarks, transposed @ sights.by_landmark)
        np.add.at(self.slope_landmarks, problem.landmarks, np.einsum("nij,nj->ni", transposed, sights.residuals))
        self.cross = _block_matrix(
            by_pose[later].transpose(0, 2, 1) @ sights.by_landmark[later],
            pose[later], problem.landmarks[later], (num_poses, num_landmarks),
        )  # fmt: skip

        first, second = moves.by_first[:, 1:], moves.by_second
        diagonal, slope = self.diagonal.reshape(*self.shape, 3), self.slope_poses.reshape(self.shape)
        diagonal += second.swapaxes(2, 3) @ second
        diagonal[:, :-1] += first.swapaxes(2, 3) @ first
        slope += np.einsum("ktji,ktj->kti", second, moves.residuals)
        slope[:, :-1] += np.einsum("ktji,ktj->kti", first, moves.residuals[:, 1:])
        self.upper = np.zeros((*self.shape, 3))
        self.upper[:, :-1] = first.swapaxes(2, 3) @ second[:, 1:]

    def _banded(self, damping: float) -> FloatArray:
        """Return the Cholesky factor of A with enlarged diagonal, in the format of `scipy.linalg.cholesky_banded`."""
        size = 3 * len(self.diagonal)
        bands = np.zeros((BAND + 1, size))
        upper = self.upper.reshape(-1, 3, 3)
        for i in range(3):
            for j in range(3):
                if j >= i:
                    bands[BAND + i - j, j::3] = self.diagonal[:, i, j]
                bands[BAND + i - j - 3, j + 3 :: 3] = upper[:-1, i, j]
        bands[BAND] *= 1.0 + damping
        return np.asarray(scipy.linalg.cholesky_banded(bands))

    def _reduced(self, factor: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return A^-1 B and the lower Cholesky factor of the Schur complement C - B^T A^-1 B."""
        solved = np.asarray(scipy.linalg.cho_solve_banded((factor, False), self.cross.toarray()))
        schur = -(self.cross.T @ solved)
        size = len(self.landmarks)
        blocks = schur.reshape(size, 3, size, 3)
        diagonal = self.landmarks.copy()
        diagonal[:, range(3), range(3)] *= 1.0 + damping
        blocks[np.arange(size), :, np.arange(size), :] += diagonal
        return solved, np.linalg.cholesky(0.5 * (schur + schur.T))

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return the solution: changes of the poses (K, T - 1, 3) and landmarks (L, 3)."""
        factor = self._banded(damping)
        solved, lower = self._reduced(factor, damping)
        slope = self.slope_poses.ravel()
        landmarks = scipy.linalg.cho_solve((lower, True), solved.T @ slope - self.slope_landmarks.ravel())
        poses = -scipy.linalg.cho_solve_banded((factor, False), slope) - solved @ landmarks
        return poses.reshape(self.shape), landmarks.reshape(-1, 3)

    def covariances(self) -> tuple[FloatArray, FloatArray]:
        """Return the marginal covariances of all poses (K, T, 3, 3) and of the landmarks (L, 3, 3).

        They are the diagonal blocks of the inverse; those of the poses are of A^-1 + (A^-1 B) S^-1 (A^-1 B)^T with the
        Schur complement S = C - B^T A^-1 B.
        """
        factor = self._banded(0.0)
        solved, lower = self._reduced(factor, 0.0)
        spread = scipy.linalg.solve_triangular(lower, solved.T, lower=True).reshape(len(lower), -1, 3)
        robots, steps, _ = self.shape
        paths = np.zeros((robots, steps + 1, 3, 3))
        paths[:, 1:] = np.einsum("lpi,lpj->pij", spread, spread).reshape(robots, steps, 3, 3)
        for robot in range(robots):
            chain = factor[:, 3 * steps * robot : 3 * steps * (robot + 1)]
            inverse = scipy.linalg.cho_solve_banded((chain, False), np.eye(3 * steps)).reshape(steps, 3, steps, 3)
            paths[robot, 1:] += inverse[np.arange(steps), :, np.arange(steps), :]
        halves = scipy.linalg.solve_triangular(lower, np.eye(len(lower)), lower=True).reshape(len(lower), -1, 3)
        return paths, np.einsum("kli,klj->lij", halves, halves)

    def largest_slope(self) -> float:
        """Return the largest gradient of half the cost over the square root of the unknown's own curvature."""
        poses = np.abs(self.slope_poses) / np.sqrt(np.diagonal(self.diagonal, axis1=1, axis2=2))
        landmarks = np.abs(self.slope_landmarks) / np.sqrt(np.diagonal(self.landmarks, axis1=1, axis2=2))
        return float(max(poses.max(), landmarks.max()))


def _block_matrix(
    blocks: FloatArray, rows: IntArray, columns: IntArray, size: tuple[int, int]
) -> scipy.sparse.csr_array:
    """Return the sparse block matrix of `size` blocks with the sums of `blocks` (n, 3, 3) at block rows and columns."""
    inner = np.arange(3)
    i = np.broadcast_to((3 * rows)[:, None, None] + inner[:, None], blocks.shape)
    j = np.broadcast_to((3 * columns)[:, None, None] + inner, blocks.shape)
    shape = 3 * size[0], 3 * size[1]
    return scipy.sparse.csr_array(scipy.sparse.coo_array((blocks.ravel(), (i.ravel(), j.ravel())), shape=shape))
