"""Which landmarks of two maps look alike: mutual nearest descriptors that no other place resembles."""

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.errors import BoolArray, FloatArray, IntArray

MAX_PRODUCT = 4_000_000  # entries of the distance matrix held at once: 16 MB


def _squared_distances(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
    """Return (n, m) squared distances between the rows of `a` (n, d) and `b` (m, d)."""
    squares = np.einsum("nd,nd->n", a, a)[:, None] + np.einsum("md,md->m", b, b)
    squares -= 2.0 * (a @ b.T)
    return np.asarray(np.maximum(squares, 0.0, out=squares))


def _chunks(rows: int, columns: int) -> Iterator[slice]:
    """Cut `rows` so that each part times `columns` stays within `MAX_PRODUCT`."""
    size = max(1, MAX_PRODUCT // max(columns, 1))
    return (slice(start, min(start + size, rows)) for start in range(0, rows, size))


def mutual_nearest(a: NDArray[np.float32], b: NDArray[np.float32], gate: float) -> IntArray:
    """Pair descriptors that are each other's nearest and closer than `gate`.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a; no index appears twice.
    """
    if not len(a) or not len(b):
        return np.empty((0, 2), np.int64)
    nearest_b, nearest_a = np.empty(len(a), np.int64), np.zeros(len(b), np.int64)
    least_a, least_b = np.empty(len(a)), np.full(len(b), np.inf)
    columns = np.arange(len(b))
    for part in _chunks(len(a), len(b)):
        squares = _squared_distances(a[part], b)
        nearest_b[part] = squares.argmin(axis=1)
        least_a[part] = squares[np.arange(len(squares)), nearest_b[part]]
        rows = squares.argmin(axis=0)
        closer = squares[rows, columns] < least_b
        nearest_a[closer] = rows[closer] + part.start
        least_b[closer] = squares[rows, columns][closer]
    mutual = (nearest_a[nearest_b] == np.arange(len(a))) & (least_a <= gate * gate)
    rows_a = np.flatnonzero(mutual)
    return np.column_stack([rows_a, nearest_b[rows_a]])


def unlike_other_places(
    descriptors: NDArray[np.float32],
    matches: IntArray,
    others: NDArray[np.float32],
    positions: FloatArray,
    same_place: float,
    ratio: float,
) -> BoolArray:
    """Tell which matches stand out from all landmarks that lie elsewhere (the ratio test).

    Args:
        descriptors: (k, d) float32 [-]. Of the matched landmarks in the one map.
        matches: (k,) int64. Their partners in the other map.
        others: (m, d) float32 [-]. All descriptors of the other map.
        positions: (m, 3) float64 [m]. All positions in the other map.
        same_place: Landmarks within this distance [m] of the partner do not compete: they may be its duplicates.
        ratio: A match must be closer than this times the best competitor [-].

    Returns:
        (k,) mask of the matches that pass. Without any competitor a match passes.
    """
    passed = np.ones(len(matches), np.bool_)
    for part in _chunks(len(matches), len(others)):
        squares = _squared_distances(descriptors[part], others)
        partners = matches[part]
        own = squares[np.arange(len(partners)), partners]
        squares[_squared_distances(positions[partners], positions) <= same_place**2] = np.inf
        passed[part] = own < ratio**2 * squares.min(axis=1)
    return passed
