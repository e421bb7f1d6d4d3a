"""Error metrics of estimated paths."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, argument_error, check_array, check_int
from slam_backend.geometry import between, rotation, transform_points


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class AteResult:
    """The absolute trajectory error: root mean square distance between estimated and true positions.

    Attributes:
        start: Error in the frame of the start pose, without alignment [m].
        aligned: Error after the best rigid motion of the estimate to the truth [m].
        transform: (3,) float64 [m, m, rad]. Motion truth_from_estimated of the alignment.
    """

    start: float
    aligned: float
    transform: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class RpeResult:
    """The relative pose error: root mean square errors of the motion over a fixed number of steps.

    Attributes:
        translation: Error of the translation [m].
        rotation: Error of the rotation [rad].
    """

    translation: float
    rotation: float


def align_se2(points_a: ArrayLike, points_b: ArrayLike, weights: ArrayLike | None = None) -> FloatArray:
    """Fit a rigid planar motion to matched points by (weighted) least squares, in closed form.

    Args:
        points_a: (n, 2) float64 [m], frame a, n >= 1.
        points_b: (n, 2) float64 [m], frame b. The same points in the same order.
        weights: (n,) float64 [-], >= 0 with a positive sum; None: equal weights.

    Returns:
        (3,) a_from_b [m, m, rad], which minimises sum w |a - (R b + t)|^2. The rotation is 0 if all points coincide.

    Raises:
        ValueError: If shapes disagree, there are no points, or the weights are negative or all zero.

    >>> align_se2([[1.0, 1.0], [1.0, 3.0]], [[0.0, 0.0], [2.0, 0.0]]).round(6).tolist()
    [1.0, 1.0, 1.570796]
    """
    a = check_array("points_a", points_a, (None, 2), "Give one planar point per row.")
    b = check_array("points_b", points_b, (len(a), 2), "Give as many points as in points_a.")
    hint = "Give weights >= 0, at least one of them positive."
    w = np.ones(len(a)) if weights is None else check_array("weights", weights, (len(a),), hint)
    if not len(a):
        raise argument_error("points_a", "at least one point", "an array of none", "There is nothing to align.")
    if w.min() < 0.0 or w.sum() <= 0.0:
        raise argument_error("weights", "weights >= 0 with a positive sum", w.tolist(), hint)
    w = w / w.sum()
    centre_a, centre_b = w @ a, w @ b
    a, b = a - centre_a, b - centre_b
    cosine = float(w @ (a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1]))
    sine = float(w @ (a[:, 1] * b[:, 0] - a[:, 0] * b[:, 1]))
    theta = np.arctan2(sine, cosine)
    theta = -np.pi if theta == np.pi else theta
    return np.array([*(centre_a - rotation(theta) @ centre_b), theta])


def ate(estimated: ArrayLike, truth: ArrayLike, align: bool = True) -> AteResult:
    """Return the position error of a path, before and after alignment.

    Args:
        estimated: (T, 2) positions [m] or (T, 3) poses [m, m, rad]; headings are ignored.
        truth: True positions or poses at the same times.
        align: Whether to align the paths; else `aligned` equals `start` and the transform is zero.

    Raises:
        ValueError: If shapes disagree, a number is not finite, or the path is empty.

    >>> ate([[1.0, 0.0], [2.0, 0.0]], [[0.0, 0.0], [1.0, 0.0]]).start
    1.0
    """
    guess, true = _paired(estimated, truth)
    transform = align_se2(true, guess) if align else np.zeros(3)
    return AteResult(_rms(guess - true), _rms(transform_points(transform, guess) - true), transform)


def rpe(estimated: ArrayLike, truth: ArrayLike, delta: int = 1) -> RpeResult:
    """Return the error of the motions over `delta` steps, which is independent of the frame.

    Args:
        estimated: (T, 3) poses [m, m, rad].
        truth: (T, 3) poses [m, m, rad] at the same times.
        delta: Length of the compared motions in steps, from 1 to T - 1.

    Raises:
        ValueError: If shapes disagree, a number is not finite, or the path is no longer than `delta`.
    """
    guess = check_array("estimated", estimated, (None, 3), "Give poses (x, y, theta).")
    true = check_array("truth", truth, guess.shape, "Give one true pose per estimated one.")
    check_int("delta", delta, 1, "Compare motions over at least one step.")
    if len(guess) <= delta:
        raise argument_error("estimated", f"more than delta = {delta} poses", len(guess), "Give a longer path.")
    error = between(between(true[:-delta], true[delta:]), between(guess[:-delta], guess[delta:]))
    return RpeResult(_rms(error[:, :2]), _rms(error[:, 2:]))


def _paired(estimated: ArrayLike, truth: ArrayLike) -> tuple[FloatArray, FloatArray]:
    """Return two (T, 2) arrays of positions, T >= 1, or raise."""
    columns = 2 if np.ndim(estimated) == 2 and np.shape(estimated)[1] == 2 else 3
    hint = "Give (T, 2) positions or (T, 3) poses at the same times."
    guess = check_array("estimated", estimated, (None, columns), hint)
    columns = 2 if np.ndim(truth) == 2 and np.shape(truth)[1] == 2 else 3
    true = check_array("truth", truth, (len(guess), columns), hint)
    if not len(guess):
        raise argument_error("estimated", "at least one pose", "an array of none", hint)
    return guess[:, :2], true[:, :2]


def _rms(errors: FloatArray) -> float:
    """Return the root mean square length of errors (n, d)."""
    return float(np.sqrt(np.einsum("nd,nd->", errors, errors) / len(errors)))
