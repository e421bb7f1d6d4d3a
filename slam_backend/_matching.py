"""Which landmarks of two maps look alike: mutual nearest descriptors that no other place resembles.

The matrix product of all descriptors with all others is made block by block and never held as a whole. It is compiled
here and not left to BLAS, whose threads stall for milliseconds when another process holds a core, and whose rounding
depends on the machine.
"""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import jit
from slam_backend.errors import BoolArray, FloatArray, IntArray

Float32Array = NDArray[np.float32]
Scalar = TypeVar("Scalar", bound=np.generic)

BLOCK = 256  # columns whose products are held at once: with 64 numbers each they fit a core's own cache


@jit
def _squared_lengths(columns: Float32Array) -> Float32Array:
    """Return the squared length (m,) of each column of `columns` (d, m)."""
    result = np.zeros(columns.shape[1], np.float32)
    for k in range(columns.shape[0]):
        for j in range(columns.shape[1]):
            result[j] += columns[k, j] * columns[k, j]
    return result


@jit
def _squared_distances(
    row: Float32Array, b_columns: Float32Array, lengths_b: Float32Array, start: int, stop: int, out: Float32Array
) -> None:
    """Write |row|^2 + |b|^2 - 2 row . b for the columns b from `start` to `stop` of `b_columns` (d, m) to `out`."""
    out[:] = np.float32(0.0)
    length, size = np.float32(0.0), len(row)
    for k in range(size):
        length += row[k] * row[k]
    for k in range(0, size - size % 4, 4):  # four at a time: fewer trips to memory
        a0, a1, a2, a3 = row[k], row[k + 1], row[k + 2], row[k + 3]
        b0, b1 = b_columns[k, start:stop], b_columns[k + 1, start:stop]
        b2, b3 = b_columns[k + 2, start:stop], b_columns[k + 3, start:stop]
        for j in range(len(b0)):
            out[j] += (a0 * b0[j] + a1 * b1[j]) + (a2 * b2[j] + a3 * b3[j])
    for k in range(size - size % 4, size):
        a0, b0 = row[k], b_columns[k, start:stop]
        for j in range(len(b0)):
            out[j] += a0 * b0[j]
    for j in range(stop - start):
        out[j] = length + lengths_b[start + j] - np.float32(2.0) * out[j]


@jit
def _nearest(a: Float32Array, b_columns: Float32Array) -> tuple[IntArray, Float32Array, IntArray]:
    """Return each a's nearest b (n,), its squared distance (n,), and each b's nearest a (m,); the first if equal."""
    n, m = len(a), b_columns.shape[1]
    nearest_b, nearest_a = np.zeros(n, np.int64), np.zeros(m, np.int64)
    least_a, least_b = np.full(n, np.float32(np.inf)), np.full(m, np.float32(np.inf))
    lengths_b = _squared_lengths(b_columns)
    squares = np.empty(BLOCK, np.float32)
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        least, nearest = least_b[start:stop], nearest_a[start:stop]
        for i in range(n):
            _squared_distances(a[i], b_columns, lengths_b, start, stop, squares)
            for j in range(stop - start):
                square = squares[j]
                if square < least_a[i]:
                    least_a[i], nearest_b[i] = square, start + j
                if square < least[j]:
                    least[j], nearest[j] = square, i
    return nearest_b, least_a, nearest_a


@jit
def _mutual(a: Float32Array, b_columns: Float32Array, limit: float) -> IntArray:
    """Compute `mutual_nearest`; `limit` is a squared distance."""
    nearest_b, squares, nearest_a = _nearest(a, b_columns)
    pairs = np.empty((len(a), 2), np.int64)
    k = 0
    for i in range(len(a)):
        if nearest_a[nearest_b[i]] == i and squares[i] <= np.float32(limit):
            pairs[k, 0], pairs[k, 1] = i, nearest_b[i]
            k += 1
    return pairs[:k]


@jit
def _unlike(
    a: Float32Array,
    partners: IntArray,
    b_columns: Float32Array,
    positions: FloatArray,
    same_place: float,
    ratio: float,
) -> BoolArray:
    """Compute `unlike_other_places`."""
    passed = np.ones(len(a), np.bool_)
    lengths_b = _squared_lengths(b_columns)
    squares = np.empty(BLOCK, np.float32)
    for i in range(len(a)):
        partner = partners[i]
        own = np.float32(0.0)
        for k in range(a.shape[1]):
            own += (a[i, k] - b_columns[k, partner]) ** 2
        limit = np.float32(own / (ratio * ratio))
        for start in range(0, b_columns.shape[1], BLOCK):
            stop = min(start + BLOCK, b_columns.shape[1])
            _squared_distances(a[i], b_columns, lengths_b, start, stop, squares)
            for j in range(stop - start):
                if squares[j] <= limit:
                    apart = 0.0
                    for axis in range(3):
                        apart += (positions[start + j, axis] - positions[partner, axis]) ** 2
                    if apart > same_place * same_place:
                        passed[i] = False
    return passed


@jit
def _alike(a: Float32Array, b_columns: Float32Array, limit: float, most: int) -> tuple[IntArray, IntArray, IntArray]:
    """Return the b within a squared distance `limit` of each a (n, most), and how many each a (n,) and b (m,) has."""
    n, m = len(a), b_columns.shape[1]
    found = np.zeros((n, most), np.int64)
    of_a, of_b = np.zeros(n, np.int64), np.zeros(m, np.int64)
    lengths_b = _squared_lengths(b_columns)
    squares = np.empty(BLOCK, np.float32)
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        for i in range(n):
            _squared_distances(a[i], b_columns, lengths_b, start, stop, squares)
            for j in range(stop - start):
                if squares[j] <= limit:
                    if of_a[i] < most:
                        found[i, of_a[i]] = start + j
                    of_a[i] += 1
                    of_b[start + j] += 1
    return found, of_a, of_b


@jit
def _look_alikes(a: Float32Array, b_columns: Float32Array, limit: float, most: int) -> IntArray:
    """Compute `look_alikes`; `limit` is a squared distance."""
    found, of_a, of_b = _alike(a, b_columns, limit, most)
    pairs = np.empty((found.size, 2), np.int64)
    k = 0
    for i in range(len(a)):
        if of_a[i] <= most:
            for j in found[i, : of_a[i]]:
                if of_b[j] <= most:
                    pairs[k, 0], pairs[k, 1] = i, j
                    k += 1
    return pairs[:k]


def look_alikes(a: Float32Array, b: Float32Array, gate: float, most: int) -> IntArray:
    """Pair all descriptors within `gate`, but none that so pairs with more than `most`: those tell nothing.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].
        most: Most partners of one.

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a, then in b; k <= n `most`.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    return _look_alikes(_fresh(a), _fresh(b.T), gate * gate, most)


def num_alike(a: Float32Array, b: Float32Array, gate: float) -> int:
    """Return how many pairs of descriptors (n, d) and (m, d) are no farther apart than `gate`."""
    return int(_alike(_fresh(a), _fresh(b.T), gate * gate, 0)[1].sum()) if len(a) and len(b) else 0


def mutual_nearest(a: Float32Array, b: Float32Array, gate: float) -> IntArray:
    """Pair descriptors that are each other's nearest and no farther apart than `gate`.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a; no index appears twice.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    return _mutual(_fresh(a), _fresh(b.T), gate * gate)


def unlike_other_places(
    descriptors: Float32Array,
    partners: IntArray,
    others: Float32Array,
    positions: FloatArray,
    same_place: float,
    ratio: float,
) -> BoolArray:
    """Tell which matches stand out from all landmarks that lie elsewhere (the ratio test).

    Args:
        descriptors: (k, d) float32 [-]. Of the matched landmarks in the one map.
        partners: (k,) int64. Their partners in the other map.
        others: (m, d) float32 [-]. All descriptors of the other map.
        positions: (m, 3) float64 [m]. All positions in the other map.
        same_place: Landmarks within this distance [m] of the partner do not compete: they may be its duplicates.
        ratio: A match must be closer than this times the best competitor [-].

    Returns:
        (k,) mask of the matches that pass. Without any competitor a match passes.
    """
    return _unlike(_fresh(descriptors), _fresh(partners), _fresh(others.T), _fresh(positions), same_place, ratio)


def _fresh(array: NDArray[Scalar]) -> NDArray[Scalar]:
    """Return a copy of one kind of memory, because numba compiles a kernel again for each other kind."""
    return np.array(array, order="C")
