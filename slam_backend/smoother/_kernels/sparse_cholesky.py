"""Sparse Cholesky factorisation by blocks of 3 x 3: ordering, symbolic pattern, factor, solutions, inverse blocks.

Blocks are kept as `lay_out` says, each as nine numbers row by row. A pivot is a lower triangle, by rows, with the
reciprocals of its diagonal (6).
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, in_place, inline, jit, jit_fma, simd, simd_inline
from slam_backend.core.validation import FloatArray, IntArray

Bits = NDArray[np.uint64]

ONE = np.uint64(1)
WORD = 64


@inline
def _num_bits(word: Any) -> int:
    """Return how many bits are set in 64 (the compiler makes one instruction of it)."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@inline
def _connect(near: Bits, a: int, b: int) -> None:
    """Note that nodes a and b share a block."""
    near[a, b >> 6] |= ONE << np.uint64(b & 63)
    near[b, a >> 6] |= ONE << np.uint64(a & 63)


@jit
def minimum_degree(near: Bits, order: IntArray) -> int:
    """Eliminate always a node that shares blocks with fewest others, the first of them.

    Exact degrees: each node's neighbours are bits, so that the cost of a neighbour is that of a few words.

    Args:
        near: (N, W) bits; set where two nodes share a block; overwritten: those that follow each node when it goes.
        order: (N,), result: the nodes in the order of elimination.

    Returns:
        How many blocks off the diagonal the factor has.
    """
    num, words = near.shape
    degrees, times = np.empty(num, dtype=np.int64), np.zeros(num + 1, dtype=np.int64)  # how often each degree occurs
    for v in range(num):
        degree = 0
        for w in range(words):
            degree += _num_bits(near[v, w])
        degrees[v] = degree
        times[degree] += 1
    left = np.arange(num)
    filled, least = 0, 0
    for turn in range(num):
        least = max(least - 1, 0)  # no degree falls by more than one when a node goes
        while times[least] == 0:
            least += 1
        at = turn
        while degrees[left[at]] != least:
            at += 1
        v = left[at]
        left[at] = left[turn]
        left[turn] = v
        order[turn] = v
        times[least] -= 1
        filled += least
        mine, own = v >> 6, ~(ONE << np.uint64(v & 63))
        for w in range(words):
            rest = near[v, w]
            while rest != np.uint64(0):
                low = rest & (~rest + ONE)
                rest ^= low
                u = w * WORD + _num_bits(low - ONE)
                degree = 0
                for i in range(words):
                    near[u, i] |= near[v, i]
                near[u, u >> 6] &= ~(ONE << np.uint64(u & 63))
                near[u, mine] &= own
                for i in range(words):
                    degree += _num_bits(near[u, i])
                times[degrees[u]] -= 1
                times[degree] += 1
                degrees[u] = degree
    return filled


@in_place
def neighbours(columns: IntArray, previous: IntArray, keys: IntArray, starts: IntArray, near: Bits) -> None:
    """Set the bits of the nodes that share a block of the normal equations.

    Args:
        columns, previous, keys, starts: As of `form`.
        near: (N, W) zeros; result.
    """
    first_landmark = len(near) - (len(starts) - 1)
    for b in range(len(columns)):
        a = previous[b]
        if a >= 0 and columns[a] >= 0 and columns[b] >= 0:
            _connect(near, columns[a] // 3, columns[b] // 3)
    for landmark in range(len(starts) - 1):
        for q in range(starts[landmark], starts[landmark + 1]):
            if columns[keys[q]] >= 0:
                _connect(near, columns[keys[q]] // 3, first_landmark + landmark)


@inline
def _place(tops: IntArray, rows: IntArray, a: int, b: int) -> int:
    """Return 1 + where the block of ranks (a, b) is, negative if it is kept as that of (b, a)."""
    low, high = (b, a) if a > b else (a, b)
    first: int = tops[low]
    last: int = tops[low + 1]
    while first < last:
        middle = (first + last) // 2
        if rows[middle] < high:
            first = middle + 1
        else:
            last = middle
    return first + 1 if a > b else -first - 1


@jit
def lay_out(
    near: Bits, order: IntArray, columns: IntArray, previous: IntArray, keys: IntArray, starts: IntArray,
    ranks: IntArray, tops: IntArray, rows: IntArray, link_places: IntArray, cross_places: IntArray,
    row_tops: IntArray, row_columns: IntArray, row_places: IntArray,
) -> tuple[int, int]:  # fmt: skip
    """Say where each block of the factor lies: column by column, in each by ascending rows.

    Args:
        near, order: As `minimum_degree` left them.
        columns, previous, keys, starts: As of `form`.
        ranks: (N,), result: when each node is eliminated.
        tops, rows: (N + 1,), (filled,), results: blocks of column j are tops[j] to tops[j + 1], and their rows.
        link_places, cross_places: (k,), (s,), results: 1 + place of each block of `links` and `cross`, negative if
            it is transposed there, 0 if there is none.
        row_tops, row_columns, row_places: (N + 1,), (filled,), (filled,), results: the same blocks row by row.

    Returns:
        How many nodes `draw` draws, and the sum of the squares of the columns' lengths.
    """
    num, words = near.shape
    for j in range(num):
        ranks[order[j]] = j
    row_tops[:] = 0
    top = 0
    for j in range(num):
        tops[j] = top
        v = order[j]
        for w in range(words):
            rest = near[v, w]
            while rest != np.uint64(0):
                low = rest & (~rest + ONE)
                rest ^= low
                rows[top] = ranks[w * WORD + _num_bits(low - ONE)]  # not yet ascending
                row_tops[rows[top] + 1] += 1
                top += 1
    tops[num] = top
    for j in range(num):
        row_tops[j + 1] += row_tops[j]
    done = row_tops.copy()
    for j in range(num):  # each row's columns ascend if columns come one after the other, and the other way round
        for p in range(tops[j], tops[j + 1]):
            row_columns[done[rows[p]]] = j
            done[rows[p]] += 1
    done[:] = tops
    for row in range(num):
        for n in range(row_tops[row], row_tops[row + 1]):
            p = done[row_columns[n]]
            rows[p], row_places[n] = row, p
            done[row_columns[n]] += 1
    first_landmark = num - (len(starts) - 1)
    for b in range(len(columns)):
        a = previous[b]
        link_places[b] = 0
        if a >= 0 and columns[a] >= 0 and columns[b] >= 0:
            link_places[b] = _place(tops, rows, ranks[columns[b] // 3], ranks[columns[a] // 3])
    for landmark in range(len(starts) - 1):
        for q in range(starts[landmark], starts[landmark + 1]):
            own = columns[keys[q]]
            cross_places[q] = 0
            if own >= 0:
                cross_places[q] = _place(tops, rows, ranks[own // 3], ranks[first_landmark + landmark])
    drawn, squares = 0, 0
    for j in range(num):
        drawn += order[j] < first_landmark or row_tops[j] < row_tops[j + 1]
        squares += (tops[j + 1] - tops[j]) * (tops[j + 1] - tops[j])
    return drawn, squares


@simd_inline
def _added(values: FloatArray, place: int, block: FloatArray) -> None:
    """Add a block (3, 3) where `lay_out` says."""
    if place == 0:
        return
    out = values[abs(place) - 1]
    for i in range(3):
        for j in range(3):
            if place > 0:
                out[3 * i + j] += block[i, j]
            else:
                out[3 * j + i] += block[i, j]


@simd
def factorise(
    blocks: FloatArray, links: FloatArray, cross: FloatArray, damping: float, num_poses: int, order: IntArray,
    tops: IntArray, rows: IntArray, link_places: IntArray, cross_places: IntArray, row_tops: IntArray,
    row_columns: IntArray, row_places: IntArray, where: IntArray, pivots: FloatArray, values: FloatArray,
) -> bool:  # fmt: skip
    """Write the factor of the normal equations, column by column from those to the left; False if there is none.

    Args:
        blocks, links, cross: As `form` wrote them.
        damping: The diagonal of each pose is enlarged by this share.
        num_poses: The nodes before this one are poses.
        order, tops, rows, link_places, cross_places, row_tops, row_columns, row_places: As of `lay_out`.
        where: (N,) room.
        pivots, values: (N, 6), (filled, 9), results.
    """
    num = len(order)
    values[:] = 0.0
    for b in range(len(link_places)):
        _added(values, link_places[b], links[b])
    for q in range(len(cross_places)):
        _added(values, cross_places[q], cross[q])
    for j in range(num):
        node = order[j]
        first, last = tops[j], tops[j + 1]
        for p in range(first, last):
            where[rows[p]] = p
        d00, d10, d20 = blocks[node, 0], blocks[node, 1], blocks[node, 2]
        d11, d21, d22 = blocks[node, 3], blocks[node, 4], blocks[node, 5]
        if node < num_poses:
            d00, d11, d22 = d00 + damping * d00, d11 + damping * d11, d22 + damping * d22
        for n in range(row_tops[j], row_tops[j + 1]):
            p = row_places[n]
            m = values[p]
            m0, m1, m2, m3, m4, m5, m6, m7, m8 = m[0], m[1], m[2], m[3], m[4], m[5], m[6], m[7], m[8]
            d00 -= m0 * m0 + m1 * m1 + m2 * m2
            d10 -= m3 * m0 + m4 * m1 + m5 * m2
            d20 -= m6 * m0 + m7 * m1 + m8 * m2
            d11 -= m3 * m3 + m4 * m4 + m5 * m5
            d21 -= m6 * m3 + m7 * m4 + m8 * m5
            d22 -= m6 * m6 + m7 * m7 + m8 * m8
            for o in range(p + 1, tops[row_columns[n] + 1]):
                v, out = values[o], values[where[rows[o]]]
                for i in range(0, 9, 3):
                    v0, v1, v2 = v[i], v[i + 1], v[i + 2]
                    out[i] -= v0 * m0 + v1 * m1 + v2 * m2
                    out[i + 1] -= v0 * m3 + v1 * m4 + v2 * m5
                    out[i + 2] -= v0 * m6 + v1 * m7 + v2 * m8
        if not d00 > 0.0:
            return False
        i0 = 1.0 / math.sqrt(d00)
        l10, l20 = d10 * i0, d20 * i0
        d11 -= l10 * l10
        if not d11 > 0.0:
            return False
        i1 = 1.0 / math.sqrt(d11)
        l21 = (d21 - l20 * l10) * i1
        d22 -= l20 * l20 + l21 * l21
        if not d22 > 0.0:
            return False
        i2 = 1.0 / math.sqrt(d22)
        pivot = pivots[j]
        pivot[0], pivot[1], pivot[2], pivot[3], pivot[4], pivot[5] = i0, l10, i1, l20, l21, i2
        for p in range(first, last):
            v = values[p]
            for i in range(0, 9, 3):
                v0 = v[i] * i0
                v1 = (v[i + 1] - v0 * l10) * i1
                v[i], v[i + 1] = v0, v1
                v[i + 2] = (v[i + 2] - v0 * l20 - v1 * l21) * i2
    return True


@device
@jit_fma
def solve(
    pivots: FloatArray, values: FloatArray, order: IntArray, tops: IntArray, rows: IntArray, vector: FloatArray
) -> FloatArray:
    """Return the x (N, 3) with (normal equations) x = vector (N, 3), both by node.

    Args:
        pivots, values: As `factorise` wrote them.
        order, tops, rows: As of `lay_out`.
        vector: (N, 3).
    """
    x, result = np.empty((len(order), 3)), np.empty((len(order), 3))
    for j in range(len(order)):
        x[j] = vector[order[j]]
    _sweep(pivots, values, tops, rows, np.arange(len(order)), x)
    for j in range(len(order)):
        result[order[j]] = x[j]
    return result


@jit_fma
def covariance(
    pivots: FloatArray, values: FloatArray, ranks: IntArray, tops: IntArray, rows: IntArray, nodes: IntArray
) -> FloatArray:
    """Return the blocks (3 r, 3 r) of the inverse that belong to r nodes, the mean of either half of it.

    Only columns to which the first blocks lead from these nodes' own take part: all other elements are zero on the way
    down, and not asked for on the way up.

    Args:
        pivots, values: As `factorise` wrote them.
        ranks, tops, rows: As of `lay_out`.
        nodes: (r,) int64.
    """
    needed = np.zeros(len(ranks), dtype=np.bool_)
    for node in nodes:
        j = ranks[node]
        while not needed[j]:
            needed[j] = True
            if tops[j] < tops[j + 1]:
                j = rows[tops[j]]
    columns = np.flatnonzero(needed)
    x, result = np.zeros((len(ranks), 3)), np.empty((3 * len(nodes), 3 * len(nodes)))
    for n in range(len(nodes)):
        for axis in range(3):
            for j in columns:
                x[j] = 0.0
            x[ranks[nodes[n]], axis] = 1.0
            _sweep(pivots, values, tops, rows, columns, x)
            for m in range(len(nodes)):
                for i in range(3):
                    result[3 * m + i, 3 * n + axis] = x[ranks[nodes[m]], i]
    for i in range(len(result)):
        for j in range(i):
            result[i, j] = result[j, i] = 0.5 * (result[i, j] + result[j, i])
    return result


@device
@jit_fma
def _sweep(
    pivots: FloatArray, values: FloatArray, tops: IntArray, rows: IntArray, columns: IntArray, x: FloatArray
) -> None:
    """Solve for x (N, 3) by rank, in place; all but these columns (n,), ascending, are left out."""
    for j in columns:
        pivot = pivots[j]
        x0 = x[j, 0] * pivot[0]
        x1 = (x[j, 1] - pivot[1] * x0) * pivot[2]
        x2 = (x[j, 2] - pivot[3] * x0 - pivot[4] * x1) * pivot[5]
        x[j, 0], x[j, 1], x[j, 2] = x0, x1, x2
        for p in range(tops[j], tops[j + 1]):
            v, out = values[p], x[rows[p]]
            out[0] -= v[0] * x0 + v[1] * x1 + v[2] * x2
            out[1] -= v[3] * x0 + v[4] * x1 + v[5] * x2
            out[2] -= v[6] * x0 + v[7] * x1 + v[8] * x2
    for j in columns[::-1]:
        x0, x1, x2 = x[j, 0], x[j, 1], x[j, 2]
        for p in range(tops[j], tops[j + 1]):
            v, y = values[p], x[rows[p]]
            x0 -= v[0] * y[0] + v[3] * y[1] + v[6] * y[2]
            x1 -= v[1] * y[0] + v[4] * y[1] + v[7] * y[2]
            x2 -= v[2] * y[0] + v[5] * y[1] + v[8] * y[2]
        pivot = pivots[j]
        x2 *= pivot[5]
        x1 = (x1 - pivot[4] * x2) * pivot[2]
        x0 = (x0 - pivot[1] * x1 - pivot[3] * x2) * pivot[0]
        x[j, 0], x[j, 1], x[j, 2] = x0, x1, x2
