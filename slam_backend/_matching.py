"""Which landmarks of two maps look alike: mutual nearest descriptors that no other place resembles.

The matrix product of all descriptors with all others is made block by block and never held as a whole. It is compiled
here and not left to BLAS, whose threads stall for milliseconds when another process holds a core, and whose rounding
depends on the machine.
"""

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import jit
from slam_backend.errors import BoolArray, FloatArray, IntArray

Float32Array = NDArray[np.float32]

BLOCK = 256  # columns whose products are held at once: with 64 numbers each they fit a core's own cache


@jit
def _squared_lengths(vectors: Float32Array) -> Float32Array:
    """Return the squared length (n,) of each row of `vectors` (n, d)."""
    result = np.zeros(len(vectors), np.float32)
    for i in range(len(vectors)):
        for k in range(vectors.shape[1]):
            result[i] += vectors[i, k] * vectors[i, k]
    return result


@jit
def _products(a: Float32Array, i: int, b_columns: Float32Array, start: int, stop: int, out: Float32Array) -> None:
    """Write the scalar products of row `i` of `a` (n, d) and columns `start` to `stop` of `b_columns` (d, m)."""
    out[:] = np.float32(0.0)
    for k in range(a.shape[1]):
        factor = a[i, k]
        column_values = b_columns[k, start:stop]
        for j in range(len(column_values)):
            out[j] += factor * column_values[j]


@jit
def _nearest(
    a: Float32Array, b_columns: Float32Array
) -> tuple[IntArray, Float32Array, IntArray]:
    """Return each a's nearest b (n,), its squared distance (n,), and each b's nearest a (m,); the first if equal."""
    n, m = len(a), b_columns.shape[1]
    nearest_b, nearest_a = np.zeros(n, np.int64), np.zeros(m, np.int64)
    least_a, least_b = np.full(n, np.float32(np.inf)), np.full(m, np.float32(np.inf))
    lengths_a, lengths_b = _squared_lengths(a), _squared_lengths(b_columns.T)
    products = np.empty(BLOCK, np.float32)
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        for i in range(n):
            _products(a, i, b_columns, start, stop, products)
            for j in range(start, stop):
                square = lengths_a[i] + lengths_b[j] - np.float32(2.0) * products[j - start]
                if square < least_a[i]:
                    least_a[i], nearest_b[i] = square, j
                if square < least_b[j]:
                    least_b[j], nearest_a[j] = square, i
    return nearest_b, least_a, nearest_a


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
    lengths_a, lengths_b = _squared_lengths(a), _squared_lengths(b_columns.T)
    products = np.empty(BLOCK, np.float32)
    for i in range(len(a)):
        partner = partners[i]
        own = np.float32(0.0)
        for k in range(a.shape[1]):
            own += (a[i, k] - b_columns[k, partner]) ** 2
        for start in range(0, b_columns.shape[1], BLOCK):
            stop = min(start + BLOCK, b_columns.shape[1])
            _products(a, i, b_columns, start, stop, products)
            for j in range(start, stop):
                square = lengths_a[i] + lengths_b[j] - np.float32(2.0) * products[j - start]
                if own >= ratio * ratio * square:
                    apart = 0.0
                    for axis in range(3):
                        apart += (positions[j, axis] - positions[partner, axis]) ** 2
                    if apart > same_place * same_place:
                        passed[i] = False
    return passed


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
    nearest_b, squares, nearest_a = _nearest(a, np.ascontiguousarray(b.T))
    rows = np.flatnonzero((nearest_a[nearest_b] == np.arange(len(a))) & (squares <= gate * gate))
    return np.column_stack([rows, nearest_b[rows]])


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
    return _unlike(descriptors, partners, np.ascontiguousarray(others.T), positions, same_place, ratio)
