"""Batch maximum likelihood (bundle adjustment with odometry): paths, landmarks and their covariances.

Levenberg-Marquardt on the sum of squared whitened residuals. In the normal equations

    [ A   B  ] [dp]   [a]        A: poses, block-tridiagonal by odometry, one chain per robot
    [ B^T C  ] [dl] = [c]        C: landmarks, then unknown path frames and odometry biases

the poses are eliminated by a banded Cholesky factor: (C - B^T A^-1 B) dl = c - B^T A^-1 a is dense, but its size is
that of the map, so that the cost grows linearly with the length of the run.
"""

from dataclasses import dataclass

import numpy as np
import scipy.linalg
import scipy.sparse

from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_float
from slam_backend.geometry import wrap_angle
from training.stereo_runs.batch_problem import START_SIGMAS, BatchProblem, Estimate, Sights

BAND = 5  # super-diagonals of a block-tridiagonal matrix with blocks of 3
MAX_ITERATIONS = 100
FIRST_DAMPING = 1e-3  # from dead reckoning
GIVEN_DAMPING = 1e-6  # from a given initial estimate
LEAST_DAMPING, MAX_DAMPING = 1e-9, 1e12
LEAST_DECREASE = 1e-8  # relative decrease of the cost at convergence


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
    """Compute the maximum likelihood paths and landmarks, with their covariances.

    Args:
        problem: Odometry and measurements; K >= 1, T >= 2.
        start: Initial estimate. None: dead reckoning, optimised first with errors in metres, then in pixels.
        robust: Scale c of a Cauchy kernel on the measurements, c^2 log(1 + d^2 / c^2) for a squared distance d^2; None:
            least squares.

    Raises:
        ValueError: If there is nothing to estimate.
    """
    best, system, iterations = _optimise(problem, start, robust)
    path_covariances, landmark_covariances = system.covariances()
    unknowns = problem.odometry.size + best.landmarks.size + system.num_shared
    return BatchEstimate(
        paths=best.paths, landmarks=best.landmarks, names=problem.names, path_covariances=path_covariances,
        landmark_covariances=landmark_covariances, cost=system.cost, freedom=len(system.residuals) - unknowns,
        gradient=system.largest_slope(), iterations=iterations,
    )  # fmt: skip


def most_likely(problem: BatchProblem, start: Estimate | None = None, robust: float | None = None) -> Estimate:
    """Return the estimate of `batch_ml`, path frames and biases included, without covariances, which cost the most.

    Without measurements that is dead reckoning.
    """
    return _optimise(problem, start, robust)[0] if len(problem.points) else problem.dead_reckoning()


def _optimise(
    problem: BatchProblem, start: Estimate | None, robust: float | None
) -> tuple[Estimate, "_System", int]:  # fmt: skip
    """Return the estimate, its normal equations and the number of iterations."""
    if problem.num_steps < 2 or not len(problem.points):
        raise argument_error("problem", "two steps and a measurement", "a run without them", "Give a longer run.")
    if robust is not None:
        check_float("robust", robust, "Give it in standard deviations.", above=0.0)
    if start is not None:
        return _descend(problem, start, robust, metric=False, damping=GIVEN_DAMPING)
    near, _, iterations = _descend(problem, problem.dead_reckoning(), robust, metric=True, damping=FIRST_DAMPING)
    best, system, more = _descend(problem, near, robust, metric=False, damping=FIRST_DAMPING)
    return best, system, iterations + more


def _descend(
    problem: BatchProblem, at: Estimate, robust: float | None, metric: bool, damping: float
) -> tuple[Estimate, "_System", int]:
    """Return the nearest minimum, its normal equations and the number of iterations.

    Levenberg-Marquardt, Nocedal and Wright, chapter 10.
    """
    system = _System(problem, at, problem.sights(at, metric), robust)
    for iteration in range(MAX_ITERATIONS):
        try:
            trial = system.moved(at, *system.solve(damping))
        except np.linalg.LinAlgError:  # outliers alone: the robust kernel leaves something without information
            if not damping:
                return at, system, iteration + 1
            damping = max(10.0 * damping, LEAST_DAMPING)
            continue
        changed = _System(problem, trial, problem.sights(trial, metric), robust)
        if changed.cost <= system.cost:
            decrease = system.cost - changed.cost
            at, system = trial, changed
            if decrease > LEAST_DECREASE * (1.0 + system.cost):
                damping /= 10.0
            elif damping:  # damped steps in directions with little information are short: the last ones are undamped
                damping = 0.0
            else:
                return at, system, iteration + 1
        elif not damping:
            return at, system, iteration + 1  # at the minimum but for directions with hardly any information
        else:
            damping = max(10.0 * damping, LEAST_DAMPING)
            if damping > MAX_DAMPING:
                break
    return at, system, iteration + 1


def robust_weights(squares: FloatArray, scale: float | None) -> FloatArray:
    """Return the weights (n,) of the Cauchy kernel for squared distances (n,); 1 without a kernel."""
    return np.ones(len(squares)) if scale is None else 1.0 / (1.0 + squares / scale**2)


class _System:
    """Normal equations at one estimate: poses after the first, then landmarks, path frames and biases."""

    def __init__(self, problem: BatchProblem, at: Estimate, sights: Sights, robust: float | None) -> None:
        self.problem = problem
        moves = problem.moves(at)
        squares = np.einsum("ni,ni->n", sights.residuals, sights.residuals)
        root = np.sqrt(robust_weights(squares, robust))
        loss = squares if robust is None else robust**2 * np.log1p(squares / robust**2)
        priors, prior_residuals = prior_terms(problem, at)
        self.cost = float(loss.sum() + np.einsum("kti,kti->", moves.residuals, moves.residuals))
        self.cost += float(prior_residuals @ prior_residuals)
        self.residuals = np.concatenate(
            [(root[:, None] * sights.residuals).ravel(), moves.residuals.ravel(), prior_residuals]
        )  # fmt: skip
        self.shape = problem.odometry.shape
        robots, steps, _ = self.shape
        num_sights, num_moves, self.num_landmarks = len(squares), robots * steps, 3 * len(problem.names)
        self.num_shared = len(prior_residuals)
        loose, biased = problem.loose_robots, problem.biased
        rows, row_blocks = 3 * num_sights, np.arange(num_sights)
        # First poses are known: measurements from them give no information on unknown poses.
        later = problem.steps > 0
        weight = root[:, None, None]
        pose = problem.robots * steps + problem.steps - 1
        moved = np.arange(num_moves)
        follows = moved % steps > 0
        self.by_poses = _stacked(
            (len(self.residuals), 3 * num_moves),
            (weight[later] * sights.by_pose[later], 3 * row_blocks[later], 3 * pose[later]),
            (moves.by_second.reshape(-1, 3, 3), rows + 3 * moved, 3 * moved),
            (moves.by_first.reshape(-1, 3, 3)[follows], rows + 3 * moved[follows], 3 * moved[follows] - 3),
        )
        columns = self.num_landmarks + 3 * np.searchsorted(loose, problem.robots)
        seen = np.isin(problem.robots, loose)
        first_bias = self.num_landmarks + 3 * len(loose)
        biases = first_bias + len(biased) * np.repeat(np.arange(robots), steps)
        shared = rows + 3 * num_moves + np.arange(self.num_shared)
        self.by_others = _stacked(
            (len(self.residuals), self.num_landmarks + self.num_shared),
            (weight * sights.by_landmark, 3 * row_blocks, 3 * problem.landmarks),
            (weight[seen] * sights.by_base[seen], 3 * row_blocks[seen], columns[seen]),
            (moves.by_bias.reshape(-1, 3, 3)[:, :, biased], rows + 3 * moved, biases),
            (priors[:, None, None], shared, self.num_landmarks + np.arange(self.num_shared)),
        )
        self.cross = self.by_poses.T @ self.by_others
        self.others = (self.by_others.T @ self.by_others).toarray()
        self.slope_poses = self.by_poses.T @ self.residuals
        self.slope_others = self.by_others.T @ self.residuals
        among = scipy.sparse.csr_array(self.by_poses.T @ self.by_poses)
        self.bands = np.zeros((BAND + 1, 3 * num_moves))
        for k in range(BAND + 1):
            self.bands[BAND - k, k:] = among.diagonal(k)

    def moved(self, at: Estimate, poses: FloatArray, others: FloatArray) -> Estimate:
        """Add changes to the poses after the first (K, T - 1, 3) and to all other unknowns."""
        problem, paths = self.problem, at.paths.copy()
        paths[:, 1:] += poses
        paths[..., 2] = wrap_angle(paths[..., 2])
        bases, biases, loose, biased = at.bases, at.biases, problem.loose_robots, problem.biased
        shared = others[self.num_landmarks :]
        if bases is not None and len(loose):
            bases = bases.copy()
            bases[loose] += shared[: 3 * len(loose)].reshape(-1, 3)
        if biases is not None and len(biased):
            biases = biases.copy()
            biases[:, biased] += shared[3 * len(loose) :].reshape(-1, len(biased))
        return Estimate(paths, at.landmarks + others[: self.num_landmarks].reshape(-1, 3), bases, biases)

    def _factor(self, damping: float) -> FloatArray:
        """Return the Cholesky factor of A with enlarged diagonal, in the format of `scipy.linalg.cholesky_banded`."""
        bands = self.bands.copy()
        bands[BAND] *= 1.0 + damping
        return np.asarray(scipy.linalg.cholesky_banded(bands, overwrite_ab=True, check_finite=False))

    def _reduced(self, factor: FloatArray, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return A^-1 B and the lower Cholesky factor of the Schur complement C - B^T A^-1 B."""
        solved = np.asarray(
            scipy.linalg.cho_solve_banded((factor, False), self.cross.toarray(order="F"), overwrite_b=True)
        )
        schur = self.others - self.cross.T @ solved
        schur[np.diag_indices(len(schur))] += damping * np.diagonal(self.others)
        return solved, np.linalg.cholesky(0.5 * (schur + schur.T))

    def solve(self, damping: float) -> tuple[FloatArray, FloatArray]:
        """Return the solution: changes of the poses (K, T - 1, 3) and of all other unknowns."""
        factor = self._factor(damping)
        solved, lower = self._reduced(factor, damping)
        others = scipy.linalg.cho_solve((lower, True), solved.T @ self.slope_poses - self.slope_others)
        poses = -scipy.linalg.cho_solve_banded((factor, False), self.slope_poses) - solved @ others
        return poses.reshape(self.shape), np.asarray(others)

    def covariances(self) -> tuple[FloatArray, FloatArray]:
        """Return the marginal covariances of all poses (K, T, 3, 3) and of the landmarks (L, 3, 3).

        They are the diagonal blocks of the inverse; those of the poses are of A^-1 + (A^-1 B) S^-1 (A^-1 B)^T with the
        Schur complement S = C - B^T A^-1 B.
        """
        factor = self._factor(0.0)
        solved, lower = self._reduced(factor, 0.0)
        spread = scipy.linalg.solve_triangular(lower, solved.T, lower=True).reshape(len(lower), -1, 3)
        robots, steps, _ = self.shape
        paths = np.zeros((robots, steps + 1, 3, 3))
        paths[:, 1:] = np.einsum("lpi,lpj->pij", spread, spread).reshape(robots, steps, 3, 3)
        for robot in range(robots):
            chain = factor[:, 3 * steps * robot : 3 * steps * (robot + 1)]
            inverse = scipy.linalg.cho_solve_banded((chain, False), np.eye(3 * steps)).reshape(steps, 3, steps, 3)
            paths[robot, 1:] += inverse[np.arange(steps), :, np.arange(steps), :]
        inverse_lower = scipy.linalg.solve_triangular(lower, np.eye(len(lower), self.num_landmarks), lower=True)
        halves = inverse_lower.reshape(len(lower), -1, 3)
        return paths, np.einsum("kli,klj->lij", halves, halves)

    def largest_slope(self) -> float:
        """Return the largest gradient of half the cost over the square root of the unknown's own curvature."""
        poses = np.abs(self.slope_poses) / np.sqrt(self.bands[BAND])
        others = np.abs(self.slope_others) / np.sqrt(np.diagonal(self.others))
        return float(max(poses.max(), others.max()))


def prior_terms(problem: BatchProblem, at: Estimate) -> tuple[FloatArray, FloatArray]:
    """Return the inverse standard deviations and residuals of the priors of unknown path frames and biases."""
    scales, residuals = [np.empty(0)], [np.empty(0)]
    loose, biased = problem.loose_robots, problem.biased
    if len(loose) and at.bases is not None and problem.bases is not None:
        away = at.bases[loose] - problem.bases[loose]
        away[:, 2] = wrap_angle(away[:, 2])
        scales.append(np.tile(1.0 / np.array(START_SIGMAS), len(loose)))
        residuals.append(scales[-1] * away.ravel())
    if len(biased) and at.biases is not None:
        scales.append(np.tile(1.0 / np.array(problem.bias_sigmas)[biased], len(at.paths)))
        residuals.append(scales[-1] * at.biases[:, biased].ravel())
    return np.concatenate(scales), np.concatenate(residuals)


def _stacked(shape: tuple[int, int], *parts: tuple[FloatArray, IntArray, IntArray]) -> scipy.sparse.csr_array:
    """Return the sparse matrix of `shape` with blocks (n, r, c), each at its first row (n,) and column (n,)."""
    values, rows, columns = [], [], []
    for blocks, first_rows, first_columns in parts:
        _, height, width = blocks.shape
        values.append(blocks.ravel())
        rows.append(np.broadcast_to((first_rows[:, None] + np.arange(height))[:, :, None], blocks.shape).ravel())
        columns.append(np.broadcast_to((first_columns[:, None] + np.arange(width))[:, None, :], blocks.shape).ravel())
    place = np.concatenate(rows), np.concatenate(columns)
    return scipy.sparse.csr_array(scipy.sparse.coo_array((np.concatenate(values), place), shape=shape))
