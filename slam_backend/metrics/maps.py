"""Error metrics of landmark maps, including missed, false and duplicate landmarks."""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.jit import jit
from slam_backend.core.read_only import as_read_only
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_float

FALSE, UNCOUNTED = -1, -2


@dataclass(frozen=True, slots=True, eq=False)
class GospaResult:
    """The generalised optimal sub-pattern assignment between estimates and truths.

    Attributes:
        distance: GOSPA metric [m].
        error: GOSPA metric with the number of truths (at least 1) as divisor inside the root, as in `map_error` [m].
        localisation: Sum of d^p over the pairs closer than the cutoff [m^p].
        missed: Truths without an estimate closer than the cutoff.
        false: Estimates without a truth closer than the cutoff.
    """

    distance: float
    error: float
    localisation: float
    missed: int
    false: int


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class MapScore:
    """Error of matched landmarks, with recall and precision.

    Attributes:
        rmse: Root mean square distance of the matched landmarks [m]; NaN if none is matched.
        recall: Number of matched over true landmarks; 0 if there are none.
        precision: Number of matched over estimated landmarks; 0 if there are none.
        matched: (k, 2) int64 rows (index of the estimate, index of the truth), one-to-one.
    """

    rmse: float
    recall: float
    precision: float
    matched: IntArray


class MapErrorParts(NamedTuple):
    """Parts of E^2 [m^2], which add up to it, see `map_error`.

    Attributes:
        misplaced: Part from the distances of matched landmarks.
        missed: Part from true landmarks without an estimate.
        duplicate: Part from further estimates of the same true landmark.
        false: Part from estimates of no true landmark.
    """

    misplaced: float
    missed: float
    duplicate: float
    false: float


@jit
def _nearest_claimants(
    means: FloatArray, claims: IntArray, truths: FloatArray, cutoff: float
) -> tuple[IntArray, float, int]:
    """Return the nearest claimant of each truth, and the error of the map.

    Per truth the index of the nearest claimant (-1: none); the sum under the root of the map error E, in which false
    and duplicate estimates count as surplus; and the first row that is not finite or claims an index out of range
    (-1: none).
    """
    least, holder = np.full(len(truths), np.inf), np.full(len(truths), -1)
    surplus = 0
    for i in range(len(means)):
        claim = claims[i]
        finite = math.isfinite(means[i, 0]) and math.isfinite(means[i, 1]) and math.isfinite(means[i, 2])
        if not finite or claim >= len(truths) or claim < UNCOUNTED:
            return holder, np.nan, i
        if claim == FALSE:
            surplus += 1
        elif claim >= 0:
            distance = 0.0
            for axis in range(3):
                distance += (means[i, axis] - truths[claim, axis]) ** 2
            if holder[claim] >= 0:
                surplus += 1
            if distance < least[claim]:
                least[claim], holder[claim] = distance, i
    squared = cutoff * cutoff
    total = 0.5 * squared * surplus
    for square in least:
        total += 0.5 * squared if square == np.inf else min(square, squared)
    return holder, total, -1


def map_error(means: FloatArray, claims: IntArray, true_positions: FloatArray, cutoff: float = 1.0) -> float:
    """Return the map error E of landmarks with known association, fast enough for every step of a simulation.

    E = sqrt((1/N) (sum over matched landmarks of min(d^2, c^2) + c^2/2 (missed + false + duplicate))). The nearest
    claimant of a true landmark is its match, further claimants are duplicates, and true landmarks without claimants are
    missed. E equals `gospa(...).error` if true landmarks are more than 2 c apart and estimates are closer than c to
    their true landmark.

    Args:
        means: (n, 3) float64 [m], world frame. Estimated positions.
        claims: (n,) int64. Index of the true landmark of each estimate; -1: a false landmark; -2: a true landmark that
            does not count, neither matched nor false.
        true_positions: (N, 3) float64 [m], world frame, N >= 1.
        cutoff: c [m].

    Raises:
        ValueError: If shapes disagree, a claim is out of range, a mean is not finite, or N = 0.

    >>> map_error(np.array([[0.0, 0.6, 0.0]]), np.array([0]), np.array([[0.0, 0.0, 0.0]]))
    0.6
    """
    holder, total = _scored(means, claims, true_positions, cutoff)
    return math.sqrt(total / len(holder))


def map_error_parts(
    means: FloatArray, claims: IntArray, true_positions: FloatArray, cutoff: float = 1.0
) -> MapErrorParts:
    """Return what the square of the map error E consists of; arguments and errors as in `map_error`.

    >>> map_error_parts(np.array([[0.0, 0.6, 0.0], [9.0, 0.0, 0.0]]), np.array([0, -1]), np.zeros((1, 3)))
    MapErrorParts(misplaced=0.36, missed=0.0, duplicate=0.0, false=0.5)
    """
    holder, _ = _scored(means, claims, true_positions, cutoff)
    held = np.flatnonzero(holder >= 0)
    squares = ((np.asarray(means)[holder[held]] - np.asarray(true_positions)[held]) ** 2).sum(axis=1)
    count, half = len(holder), 0.5 * cutoff**2
    return MapErrorParts(
        misplaced=float(np.minimum(squares, cutoff**2).sum() / count),
        missed=half * (count - len(held)) / count,
        duplicate=half * (int(np.count_nonzero(np.asarray(claims) >= 0)) - len(held)) / count,
        false=half * int(np.count_nonzero(np.asarray(claims) == FALSE)) / count,
    )


def _scored(means: FloatArray, claims: IntArray, truths: FloatArray, cutoff: float) -> tuple[IntArray, float]:
    """Check all arguments of `map_error` and return the nearest claimants and the sum from `_nearest_claimants`."""
    holder, total = _claimed(means, claims, truths, float(cutoff))
    if not cutoff > 0.0:
        raise argument_error("cutoff", "a number > 0", cutoff, "Give the cutoff distance in metres.")
    if not len(holder):
        raise argument_error(
            "true_positions", "at least one landmark", "an array of none", "Use a world with landmarks."
        )
    return holder, total


def _claimed(means: FloatArray, claims: IntArray, truths: FloatArray, cutoff: float) -> tuple[IntArray, float]:
    """Check the arrays and return the nearest claimants and the sum from `_nearest_claimants`."""
    means, truths = np.ascontiguousarray(means, np.float64), np.ascontiguousarray(truths, np.float64)
    claims = np.ascontiguousarray(claims, np.int64)
    if means.shape != (len(claims), 3):
        raise argument_error("means", f"an array of shape ({len(claims)}, 3)", f"shape {means.shape}", "One per claim.")
    if truths.ndim != 2 or truths.shape[1] != 3:
        raise argument_error("true_positions", "an array of shape (N, 3)", f"shape {truths.shape}", "One row each.")
    holder, total, bad = _nearest_claimants(as_read_only(means), as_read_only(claims), as_read_only(truths), cutoff)
    if bad >= 0:
        if not np.isfinite(means[bad]).all():
            hint = "Drop landmarks that are not finite."
            raise argument_error("means", "finite numbers", f"NaN or infinity in row {bad}", hint)
        expected = f"indices below {len(truths)}, -1 for false or -2 for uncounted ones"
        raise argument_error("claims", expected, int(claims[bad]), "Give indices of true landmarks.")
    return holder, total


def gospa(
    estimates: ArrayLike, truths: ArrayLike, cutoff: float = 1.0, order: float = 2.0, alpha: float = 2.0
) -> GospaResult:
    """Return the GOSPA metric between two point sets, by optimal assignment.

    d = (min over assignments of sum min(d_ij, c)^p + c^p / alpha | n - N |)^(1/p), the smaller set fully assigned.
    With alpha = 2, d^p is the sum of `localisation` and of c^p / 2 for each missed and each false landmark.

    Args:
        estimates: (n, 3) or (n, 2) float64 [m].
        truths: (N, 3) or (N, 2) float64 [m], same frame and width.
        cutoff: c [m].
        order: p >= 1.
        alpha: Cardinality parameter in (0, 2].

    Raises:
        ValueError: If shapes disagree, a number is not finite or a parameter lies outside its range.

    >>> gospa([[0.0, 0.0, 0.0]], [[0.0, 0.0, 0.6], [9.0, 0.0, 0.0]]).missed
    1
    """
    check_float("order", order, "The metric needs p >= 1.", at_least=1.0)
    check_float("alpha", alpha, "Use 2 to weight missed and false landmarks equally.", above=0.0, at_most=2.0)
    costs, rows, columns = _assigned(estimates, truths, cutoff, order)
    n, count = costs.shape
    paired = costs[rows, columns]
    far = int(np.count_nonzero(paired >= cutoff**order))
    total = float(paired.sum()) + cutoff**order / alpha * abs(n - count)
    return GospaResult(
        distance=total ** (1.0 / order),
        error=(total / max(count, 1)) ** (1.0 / order),
        localisation=float(paired[paired < cutoff**order].sum()),
        missed=max(count - n, 0) + far,
        false=max(n - count, 0) + far,
    )


def ospa(estimates: ArrayLike, truths: ArrayLike, cutoff: float = 1.0, order: float = 2.0) -> float:
    """Return the OSPA metric [m], ((sum min(d_ij, c)^p + c^p | n - N |) / max(n, N))^(1/p), in [0, c].

    Args:
        estimates: (n, 3) or (n, 2) float64 [m].
        truths: (N, 3) or (N, 2) float64 [m], same frame and width.
        cutoff: c [m].
        order: p >= 1.

    Raises:
        ValueError: Same errors as `gospa`.

    >>> ospa([[0.0, 0.0]], [[0.0, 0.5]], cutoff=2.0)
    0.5
    """
    check_float("order", order, "The metric needs p >= 1.", at_least=1.0)
    costs, rows, columns = _assigned(estimates, truths, cutoff, order)
    total = float(costs[rows, columns].sum()) + cutoff**order * abs(costs.shape[0] - costs.shape[1])
    return float((total / max(*costs.shape, 1)) ** (1.0 / order))


def map_rmse(estimates: ArrayLike, truths: ArrayLike, claims: ArrayLike | None = None, gate: float = 0.5) -> MapScore:
    """Return the RMS error of matched landmarks with recall and precision.

    Args:
        estimates: (n, 3) float64 [m], world frame.
        truths: (N, 3) float64 [m], world frame.
        claims: (n,) int64 as in `map_error`: the nearest claimant of each true landmark is its match, at any distance;
            claims of -2 are not counted. None: optimal assignment of pairs closer than `gate`.
        gate: Upper limit of the distance of a pair [m].

    Raises:
        ValueError: If shapes disagree, a number is not finite or a claim is out of range.

    >>> map_rmse([[0.0, 0.3, 0.0], [5.0, 5.0, 0.0]], [[0.0, 0.0, 0.0]]).precision
    0.5
    """
    hint = "Give one position (x, y, z) per landmark."
    means, true = (check_array(n, v, (None, 3), hint) for n, v in (("estimates", estimates), ("truths", truths)))
    uncounted = 0
    if claims is None:
        costs, rows, columns = _assigned(means, true, gate, 2.0)
        near = costs[rows, columns] < gate**2
        matched = np.column_stack([rows[near], columns[near]]).astype(np.int64)
    else:
        checked = check_array("claims", claims, (len(means),), "Give one claim per estimate.", dtype=np.int64)
        holder = _claimed(means, checked, true, float(gate))[0]
        held = np.flatnonzero(holder >= 0)
        matched = np.column_stack([holder[held], held])
        uncounted = int(np.count_nonzero(checked == UNCOUNTED))
    squares = ((means[matched[:, 0]] - true[matched[:, 1]]) ** 2).sum(axis=1)
    return MapScore(
        rmse=float(np.sqrt(squares.mean())) if len(matched) else float("nan"),
        recall=len(matched) / max(len(true), 1),
        precision=len(matched) / max(len(means) - uncounted, 1),
        matched=matched,
    )


def _assigned(
    estimates: ArrayLike, truths: ArrayLike, cutoff: float, order: float
) -> tuple[FloatArray, IntArray, IntArray]:
    """Return costs (n, N) min(d, cutoff)^order, and rows and columns of the optimal assignment."""
    from scipy.optimize import linear_sum_assignment  # slow to import, and not always needed

    cutoff = check_float("cutoff", cutoff, "Give a distance in metres.", above=0.0)
    width = np.shape(estimates)[1] if np.ndim(estimates) == 2 and np.shape(estimates)[1] == 2 else 3
    a = check_array("estimates", estimates, (None, width), "Give one position per row.")
    b = check_array("truths", truths, (None, width), "Give one position per row, as wide as the estimates.")
    distances = np.sqrt(((a[:, None] - b[None]) ** 2).sum(axis=2))
    costs = np.minimum(distances, cutoff) ** order
    rows, columns = linear_sum_assignment(costs)
    return costs, rows, columns
