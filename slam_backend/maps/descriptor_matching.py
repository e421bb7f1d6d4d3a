"""Matching of landmarks by looks: all descriptors (n, d) of a map with all (m, d) of another, some rows at a time.

Products are summed by `np.einsum`, not by BLAS: its threads stall for milliseconds where another process holds a core,
and its rounding depends on the machine.
"""

from collections.abc import Iterator

import numpy as np

from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray

BLOCK = 2**20  # squared distances that are held at once


def squared_distances(a: Float32Array, b: Float32Array) -> Iterator[tuple[int, Float32Array]]:
    """Yield the squared L2 distances (<= n, m) float32 [-] of some rows of a to all of b, after the first row."""
    lengths_a, lengths_b = (np.einsum("id,id->i", each, each) for each in (a, b))
    rows = max(BLOCK // max(len(b), 1), 1)
    for first in range(0, len(a), rows):
        products = np.einsum("id,jd->ij", a[first : first + rows], b)
        squares = lengths_a[first : first + rows, None] + lengths_b - 2 * products
        yield first, np.maximum(squares, np.float32(0.0))


def count_similar(a: Float32Array, b: Float32Array, gate: float) -> int:
    """Return the number of pairs of descriptors (n, d) and (m, d) within `gate`."""
    return sum(int(np.count_nonzero(squares <= gate * gate)) for _, squares in squared_distances(a, b))


def similar_to_any(a: Float32Array, b: Float32Array, gate: float) -> BoolArray:
    """Return the mask (n,) of descriptors (n, d) within `gate` of at least one of others (m, d)."""
    near = np.zeros(len(a), np.bool_)
    for first, squares in squared_distances(a, b):
        near[first : first + len(squares)] = (squares <= gate * gate).any(axis=1)
    return near


def similar_pairs(a: Float32Array, b: Float32Array, gate: float, most: int) -> IntArray:
    """Pair all descriptors within `gate`, except those with more than `most` partners.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].
        most: Maximum number of partners of a descriptor.

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a, then in b; k <= n `most`.
    """
    partners, pairs = np.zeros(len(b), np.int64), [np.empty((0, 2), np.int64)]
    for first, squares in squared_distances(a, b):
        near = squares <= gate * gate
        partners += near.sum(axis=0)
        rows, columns = np.nonzero(near & (near.sum(axis=1) <= most)[:, None])
        pairs.append(np.column_stack([first + rows, columns]))
    found = np.concatenate(pairs)
    return found[partners[found[:, 1]] <= most]


def mutual_nearest(a: Float32Array, b: Float32Array, gate: float) -> IntArray:
    """Pair descriptors that are mutual nearest neighbours within `gate`; of equally near ones the first counts.

    Args:
        a: (n, d) float32 [-].
        b: (m, d) float32 [-].
        gate: Largest L2 distance of a pair [-].

    Returns:
        (k, 2) int64 rows (index in a, index in b), by rising index in a; no index appears twice.
    """
    nearest_a, least = np.zeros(len(b), np.int64), np.full(len(b), np.inf, np.float32)
    pairs = [np.empty((0, 2), np.int64)]
    for first, squares in squared_distances(a, b) if len(b) else ():
        rows, columns = np.arange(len(squares)), squares.argmin(axis=1)
        near = squares[rows, columns] <= gate * gate
        pairs.append(np.column_stack([first + rows, columns])[near])
        closer = squares.min(axis=0) < least
        nearest_a[closer] = first + squares.argmin(axis=0)[closer]
        least = np.minimum(least, squares.min(axis=0))
    found = np.concatenate(pairs)
    return np.asarray(found[nearest_a[found[:, 1]] == found[:, 0]])


def passes_ratio_test(
    descriptors: Float32Array, partners: IntArray, others: Float32Array, positions: FloatArray, same_place: float,
    ratio: float,
) -> BoolArray:  # fmt: skip
    """Return the mask of matches that pass the ratio test against landmarks at other places.

    Args:
        descriptors: (k, d) float32 [-]. Descriptors of the matched landmarks in one map.
        partners: (k,) int64. Matched rows in the other map.
        others: (m, d) float32 [-]. All descriptors of the other map.
        positions: (m, 3) float64 [m]. All positions in the other map.
        same_place: Distance [m] from the partner within which landmarks may be duplicates and do not compete.
        ratio: Largest distance of a match over that of the best competitor [-].

    Returns:
        Mask (k,) of the matches that pass; a match without competitors passes.
    """
    passed = np.ones(len(partners), np.bool_)
    for first, squares in squared_distances(descriptors, others):
        own = squares[np.arange(len(squares)), partners[first : first + len(squares)]]
        match, rival = np.nonzero(squares <= (own / (ratio * ratio))[:, None])
        apart = ((positions[rival] - positions[partners[first + match]]) ** 2).sum(axis=1)
        passed[first + match[apart > same_place * same_place]] = False
    return passed
