"""The compiled inner loops of matching by looks: descriptors a as rows (n, d), descriptors b as columns (d, m).

The product of all with all is made block by block and never held as a whole. It is compiled here and not left to BLAS,
whose threads stall for milliseconds when another process holds a core, and whose rounding depends on the machine.
"""

import numpy as np

from slam_backend.core.jit import device, jit
from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray

BLOCK = 256  # columns whose products are held at once: with 64 numbers each they fit a core's own cache
HEAD = 40  # numbers of a descriptor that are compared first, enough to rule out most pairs; a multiple of four
SLACK = np.float32(1e-5)  # of squared lengths, far more than sums of their products are rounded


@device
@jit
def _squared_lengths(columns: Float32Array) -> Float32Array:
    """Return the squared length (m,) of each column of `columns` (d, m)."""
    result = np.zeros(columns.shape[1], np.float32)
    for k in range(columns.shape[0]):
        for j in range(columns.shape[1]):
            result[j] += columns[k, j] * columns[k, j]
    return result


@device
@jit
def _add_products(
    row: Float32Array, first: int, last: int, b_columns: Float32Array, start: int, stop: int, out: Float32Array
) -> None:
    """Add to `out` row . b over the numbers from `first` to `last`, for the columns b from `start` to `stop`."""
    rest = (last - first) % 4
    for k in range(first, last - rest, 4):  # four at a time: fewer trips to memory
        a0, a1, a2, a3 = row[k], row[k + 1], row[k + 2], row[k + 3]
        b0, b1 = b_columns[k, start:stop], b_columns[k + 1, start:stop]
        b2, b3 = b_columns[k + 2, start:stop], b_columns[k + 3, start:stop]
        for j in range(len(b0)):
            out[j] += (a0 * b0[j] + a1 * b1[j]) + (a2 * b2[j] + a3 * b3[j])
    for k in range(last - rest, last):
        a0, b0 = row[k], b_columns[k, start:stop]
        for j in range(len(b0)):
            out[j] += a0 * b0[j]


@device
@jit
def _squared_distances(
    row: Float32Array, b_columns: Float32Array, lengths_b: Float32Array, start: int, stop: int, out: Float32Array
) -> None:
    """Write |row|^2 + |b|^2 - 2 row . b for the columns b from `start` to `stop` of `b_columns` (d, m) to `out`."""
    out[: stop - start] = np.float32(0.0)
    _add_products(row, 0, len(row), b_columns, start, stop, out)
    length = np.float32(0.0)
    for k in range(len(row)):
        length += row[k] * row[k]
    for j in range(stop - start):
        out[j] = length + lengths_b[start + j] - np.float32(2.0) * out[j]


@device
@jit
def _products_if_near(
    row: Float32Array, head: int, b_columns: Float32Array, lengths: Float32Array, tails: Float32Array, start: int,
    stop: int, limit: np.float32, out: Float32Array,
) -> np.float32:  # fmt: skip
    """Write row . b to `out` for the columns b from `start` to `stop`, unless all are farther than `limit`, squared.

    The heads alone rule out most pairs: a . b is at most that of the heads plus the product of the lengths of the
    tails, and the tails are not multiplied where no b can be near. `SLACK` of the squared lengths allows for rounding.

    Args:
        row: (d,).
        head: Length of the heads.
        b_columns: (d, m).
        lengths: (stop - start,) squared lengths of the columns.
        tails: (stop - start,) lengths of their tails.
        start, stop: Range of columns.
        limit: Largest squared distance.
        out: (>= stop - start,), written.

    Returns:
        Squared length of the row; -1 if no b is near, and `out` is not complete.
    """
    length, tail = np.float32(0.0), np.float32(0.0)
    for k in range(len(row)):
        length += row[k] * row[k]
    for k in range(head, len(row)):
        tail += row[k] * row[k]
    tail = np.sqrt(tail)
    out[: stop - start] = np.float32(0.0)
    _add_products(row, 0, head, b_columns, start, stop, out)
    near = 0
    for j in range(len(lengths)):
        whole = length + lengths[j]
        near += whole - np.float32(2.0) * (out[j] + tail * tails[j]) <= limit + SLACK * whole
    if near == 0:
        return np.float32(-1.0)
    _add_products(row, head, len(row), b_columns, start, stop, out)
    return length


@jit
def mutual_pairs(a: Float32Array, b_columns: Float32Array, limit: float) -> IntArray:
    """Return the pairs (k, 2) that are each other's nearest, up to a squared distance `limit`, by rising a.

    Of several that are equally near the first one counts. Pairs beyond the limit do not: the heads alone rule most of
    them out, as in `alike`.
    """
    n, m, size = len(a), b_columns.shape[1], a.shape[1]
    head = min(HEAD, size)
    tails_b = np.sqrt(_squared_lengths(b_columns[head:]))
    bound = np.float32(limit)
    nearest_b, nearest_a = np.zeros(n, np.int64), np.zeros(m, np.int64)
    least_a, least_b = np.full(n, np.float32(np.inf)), np.full(m, np.float32(np.inf))
    lengths_b = _squared_lengths(b_columns)
    squares = np.empty(BLOCK, np.float32)
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        least, nearest = least_b[start:stop], nearest_a[start:stop]
        lengths, tails = lengths_b[start:stop], tails_b[start:stop]
        for i in range(n):
            length = _products_if_near(a[i], head, b_columns, lengths, tails, start, stop, bound, squares)
            if length < 0.0:
                continue
            for j in range(stop - start):
                square = length + lengths[j] - np.float32(2.0) * squares[j]
                if square < least_a[i]:
                    least_a[i], nearest_b[i] = square, start + j
                if square < least[j]:
                    least[j], nearest[j] = square, i
    pairs = np.empty((n, 2), np.int64)
    k = 0
    for i in range(n):
        if nearest_a[nearest_b[i]] == i and least_a[i] <= np.float32(limit):
            pairs[k, 0], pairs[k, 1] = i, nearest_b[i]
            k += 1
    return pairs[:k]


@jit
def ratio_test_mask(
    a: Float32Array,
    partners: IntArray,
    b_columns: Float32Array,
    positions: FloatArray,
    same_place: float,
    ratio: float,
) -> BoolArray:
    """Tell which matches (k,) stand out, see `correspondences.passes_ratio_test`."""
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
def alike(a: Float32Array, b_columns: Float32Array, limit: float, most: int, enough: int) -> tuple[IntArray, int]:
    """Pair descriptors within a squared distance `limit`, until `enough` pairs are found.

    Returns:
        The pairs (k, 2) of which neither has more than `most`, by rising a; and the number of all pairs.
    """
    n, m, size = len(a), b_columns.shape[1], a.shape[1]
    found = np.zeros((n, most), np.int64)
    of_a, of_b = np.zeros(n, np.int64), np.zeros(m, np.int64)
    head = min(HEAD, size)
    lengths_b, tails_b = _squared_lengths(b_columns), np.sqrt(_squared_lengths(b_columns[head:]))
    squares = np.empty(BLOCK, np.float32)
    bound, total = np.float32(limit), 0
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        lengths, tails = lengths_b[start:stop], tails_b[start:stop]
        for i in range(n):
            if total >= enough:
                break
            length = _products_if_near(a[i], head, b_columns, lengths, tails, start, stop, bound, squares)
            if length < 0.0:
                continue
            for j in range(stop - start):
                if length + lengths[j] - np.float32(2.0) * squares[j] <= limit:
                    if of_a[i] < most:
                        found[i, of_a[i]] = start + j
                    of_a[i] += 1
                    of_b[start + j] += 1
                    total += 1
    pairs = np.empty((found.size, 2), np.int64)
    k = 0
    for i in range(n):
        if of_a[i] <= most:
            for j in found[i, : of_a[i]]:
                if of_b[j] <= most:
                    pairs[k, 0], pairs[k, 1] = i, j
                    k += 1
    return pairs[:k], total


@jit
def near(a: Float32Array, b_columns: Float32Array, limit: float, most: int) -> tuple[IntArray, Float32Array]:
    """Return all pairs (k, 2) of descriptors within a squared distance `limit`, and their squared distances (k,).

    Pairs are not ordered. With more than `most` pairs the search ends early.
    """
    n, m, size = len(a), b_columns.shape[1], a.shape[1]
    head = min(HEAD, size)
    lengths_b, tails_b = _squared_lengths(b_columns), np.sqrt(_squared_lengths(b_columns[head:]))
    products, bound, count = np.empty(BLOCK, np.float32), np.float32(limit), 0
    pairs, squares = np.empty((n + m, 2), np.int64), np.empty(n + m, np.float32)
    for start in range(0, m, BLOCK):
        stop = min(start + BLOCK, m)
        lengths, tails = lengths_b[start:stop], tails_b[start:stop]
        for i in range(n):
            if count > most:
                break
            length = _products_if_near(a[i], head, b_columns, lengths, tails, start, stop, bound, products)
            if length < 0.0:
                continue
            if count + stop - start > len(squares):
                more_pairs = np.empty((2 * len(pairs) + BLOCK, 2), np.int64)
                more_pairs[:count] = pairs[:count]
                more = np.empty(len(more_pairs), np.float32)
                more[:count] = squares[:count]
                pairs, squares = more_pairs, more
            for j in range(stop - start):
                square = length + lengths[j] - np.float32(2.0) * products[j]
                if square <= bound:
                    pairs[count, 0], pairs[count, 1], squares[count] = i, start + j, square
                    count += 1
    return pairs[:count], squares[:count]
