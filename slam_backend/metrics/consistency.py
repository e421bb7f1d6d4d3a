"""Consistency metrics: errors and innovations in units of their covariances."""

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.validation import FloatArray, argument_error, check_array


def nees(errors: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """Return the normalised estimation error squared, e^T P^-1 e, of each error.

    Args:
        errors: (n, d) float64. Estimate minus truth; wrap angles to [-pi, pi) first.
        covariances: (n, d, d) float64, symmetric positive definite. Covariances stated by the estimator (P).

    Returns:
        (n,) float64 [-], chi-square with d degrees of freedom for a consistent estimator.

    Raises:
        ValueError: If shapes disagree, a number is not finite or a covariance is singular.

    >>> nees([[3.0, 4.0]], [[[1.0, 0.0], [0.0, 4.0]]]).tolist()
    [13.0]
    """
    e = check_array("errors", errors, (None, None), "Give one row per error.")
    n, d = e.shape
    p = check_array("covariances", covariances, (n, d, d), "Give one matrix per error.")
    try:
        solved = np.linalg.solve(p, e[..., None])[..., 0]
    except np.linalg.LinAlgError as error:
        hint = "Drop directions that are known exactly."
        raise argument_error("covariances", "positive definite matrices", "a singular one", hint) from error
    return np.asarray(np.einsum("nd,nd->n", e, solved))


def anees(errors: ArrayLike, covariances: ArrayLike) -> float:
    """Return the mean of `nees` divided by the dimension: 1 is consistent, more is over-confident.

    Args:
        errors: (n, d) float64, n >= 1. Estimate minus truth.
        covariances: (n, d, d) float64. Covariances stated by the estimator.

    Raises:
        ValueError: Same errors as `nees`, or if there are no errors to average.
    """
    values = nees(errors, covariances)
    if not len(values):
        raise argument_error("errors", "at least one error", "an array of none", "There is nothing to average.")
    return float(values.mean() / np.shape(errors)[1])


def nis(innovations: ArrayLike, covariances: ArrayLike) -> FloatArray:
    """Return the normalised innovation squared, v^T S^-1 v (n,), of innovations (n, d) with covariances S (n, d, d).

    Raises:
        ValueError: Same errors as `nees`.
    """
    return nees(innovations, covariances)
