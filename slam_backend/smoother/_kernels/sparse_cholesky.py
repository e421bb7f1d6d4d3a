"""Sparse Cholesky factorisation by blocks of 3 x 3: ordering, symbolic pattern, factor, solutions, inverse blocks.

`SymbolicFactor` says where blocks are kept, `Factor` what they hold.
"""

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, inline, jit, jit_fma, simd
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.smoother._kernels.records import CholeskyFactor, EquationBlocks, LandmarkFactors, SymbolicFactor

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


@device
@jit
def minimum_degree(near: Bits, order: IntArray) -> int:
    """Eliminate always a node that shares blocks with fewest others, the first of them.

    Exact degrees: each node's neighbours are bits, so that the cost of a neighbour is that of a few words.

    Args:
        near: (N, W) bits; set where two nodes share a block; overwritten: those that follow each node when it goes.
        order: (N,), result: the nodes in the order of elimination.

    Returns:
        Number of off-diagonal blocks of the factor.
    """
    num, words = near.shape
    degrees, times = np.empty(num, dtype=np.int64), np.zeros(num + 1, dtype=np.int64)  # how often each degree occurs
    for v in range(num):
        degree = 0
        for w in range(words):
            degree += _num_bits(near[v, w])
        degrees[v] = degree
        times[degree] += 1
    left, places = np.arange(num), np.arange(num)
    filled, least, sought, begin = 0, 0, -1, 0  # before `begin` no node that is left has the degree sought last
    for turn in range(num):
        least = max(least - 1, 0)  # no degree falls by more than one when a node goes
        while times[least] == 0:
            least += 1
        at = max(begin, turn) if least == sought else turn
        while degrees[left[at]] != least:
            at += 1
        sought, begin = least, at + 1
        v = left[at]
        left[at] = left[turn]
        places[left[at]] = at
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
                near[u, mine] &= own
                degree = degrees[u] - 1
                if least > 1:  # a single neighbour gets no new ones
                    for i in range(words):
                        near[u, i] |= near[v, i]
                    near[u, u >> 6] &= ~(ONE << np.uint64(u & 63))
                    near[u, mine] &= own
                    degree = 0
                    for i in range(words):
                        degree += _num_bits(near[u, i])
                times[degrees[u]] -= 1
                times[degree] += 1
                degrees[u] = degree
                if degree == sought:
                    begin = min(begin, places[u])
    return filled


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


@inline
def _sees_again(columns: IntArray, keys: IntArray, first: int, q: int) -> bool:
    """Return whether a sighting is of a given pose, or of the same one as that before it; `first` is the landmark's."""
    return columns[keys[q]] < 0 or (q > first and keys[q] == keys[q - 1])


@jit
def lay_out(
    columns: IntArray, previous: IntArray, biases: IntArray, seen: LandmarkFactors, num: int, few: int
) -> SymbolicFactor:  # fmt: skip
    """Choose the order in which `num` poses and landmarks are eliminated, and lay out the blocks of the factor.

    Landmarks of few poses may go first, in any order, since none shares a block with another; where there are many, the
    order of all others is then found much faster. The blocks are a few per cent more or fewer.

    Args:
        columns, previous: (k,) first column of each pose, and its previous key.
        biases: (k,) key of the bias of the odometry from the previous key, `NONE` if it has none; (0,) without biases.
        seen: Sightings.
        num: Poses that are sought, and landmarks.
        few: Landmarks seen from at most so many poses go first; 0: all in the order of `minimum_degree`.
    """
    keys, starts = seen.keys, seen.starts
    first_landmark = num - (len(starts) - 1)
    order, ranks = np.empty(num, np.int64), np.empty(num, np.int64)
    places = np.arange(num)  # of the poses, and of the landmarks that do not go first, among these
    early, first_filled, later = 0, 0, first_landmark
    for landmark in range(len(starts) - 1):
        count, node = 0, first_landmark + landmark
        for q in range(starts[landmark], starts[landmark + 1]):
            count += not _sees_again(columns, keys, starts[landmark], q)
        if count <= few and few > 0:
            order[early], ranks[node], places[node] = node, early, -1
            early, first_filled = early + 1, first_filled + count
        else:
            places[node] = later
            later += 1
    nodes = np.empty(later, np.int64)
    for node in range(num):
        if places[node] >= 0:
            nodes[places[node]] = node
    words = -(-later // WORD)
    near = np.zeros((later, words), np.uint64)  # bits of the nodes that share a block
    for b in range(len(columns)):
        a = previous[b]
        if a >= 0 and columns[a] >= 0 and columns[b] >= 0:
            one, two = columns[a] // 3, columns[b] // 3
            near[one, two >> 6] |= ONE << np.uint64(two & 63)
            near[two, one >> 6] |= ONE << np.uint64(one & 63)
    for b in range(len(biases)):
        if biases[b] >= 0:
            two = columns[biases[b]] // 3
            for key in (previous[b], b):
                if columns[key] >= 0:
                    one = columns[key] // 3
                    near[one, two >> 6] |= ONE << np.uint64(two & 63)
                    near[two, one >> 6] |= ONE << np.uint64(one & 63)
    for landmark in range(len(starts) - 1):
        two = places[first_landmark + landmark]
        for q in range(starts[landmark], starts[landmark + 1]):
            if columns[keys[q]] < 0:
                continue
            one = columns[keys[q]] // 3
            if two >= 0:
                near[one, two >> 6] |= ONE << np.uint64(two & 63)
                near[two, one >> 6] |= ONE << np.uint64(one & 63)
                continue
            for r in range(starts[landmark], q):  # gone: its poses share blocks
                if columns[keys[r]] >= 0 and keys[r] != keys[q]:
                    other = columns[keys[r]] // 3
                    near[one, other >> 6] |= ONE << np.uint64(other & 63)
                    near[other, one >> 6] |= ONE << np.uint64(one & 63)
    filled = first_filled + minimum_degree(near, order[early:])
    tops, row_tops = np.empty(num + 1, np.int64), np.zeros(num + 1, np.int64)
    rows, row_columns, row_places = np.empty(filled, np.int64), np.empty(filled, np.int64), np.empty(filled, np.int64)
    link_places, cross_places = np.zeros(len(columns), np.int64), np.zeros(len(keys), np.int64)
    for j in range(early, num):
        order[j] = nodes[order[j]]
        ranks[order[j]] = j
    top = 0
    for j in range(num):  # rows are not yet ascending
        tops[j] = top
        place = places[order[j]]
        if place < 0:
            landmark = order[j] - first_landmark
            for q in range(starts[landmark], starts[landmark + 1]):
                if not _sees_again(columns, keys, starts[landmark], q):
                    rows[top] = ranks[columns[keys[q]] // 3]
                    row_tops[rows[top] + 1] += 1
                    top += 1
            continue
        for w in range(words):
            rest = near[place, w]
            while rest != np.uint64(0):
                low = rest & (~rest + ONE)
                rest ^= low
                rows[top] = ranks[nodes[w * WORD + _num_bits(low - ONE)]]
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
    done = tops.copy()
    for row in range(num):
        for n in range(row_tops[row], row_tops[row + 1]):
            p = done[row_columns[n]]
            rows[p], row_places[n] = row, p
            done[row_columns[n]] += 1
    for b in range(len(columns)):
        a = previous[b]
        if a >= 0 and columns[a] >= 0 and columns[b] >= 0:
            link_places[b] = _place(tops, rows, ranks[columns[b] // 3], ranks[columns[a] // 3])
    bias_places = np.zeros(len(biases), np.int64)
    for b in range(len(biases)):
        if biases[b] >= 0:
            for key in (previous[b], b):
                if columns[key] >= 0:
                    bias_places[key] = _place(tops, rows, ranks[columns[key] // 3], ranks[columns[biases[b]] // 3])
    for landmark in range(len(starts) - 1):
        for q in range(starts[landmark], starts[landmark + 1]):
            own = columns[keys[q]]
            if own >= 0:
                cross_places[q] = _place(tops, rows, ranks[own // 3], ranks[first_landmark + landmark])
    drawn = 0
    for j in range(num):
        drawn += order[j] < first_landmark or row_tops[j] < row_tops[j + 1]
    return SymbolicFactor(
        order,
        ranks,
        tops,
        rows,
        link_places,
        cross_places,
        bias_places,
        row_tops,
        row_columns,
        row_places,
        drawn,
    )


@simd
def factorise(
    equations: EquationBlocks, pattern: SymbolicFactor, damping: float, num_poses: int, factor: CholeskyFactor
) -> bool:
    """Write the factor of the normal equations, column by column from those to the left; False if there is none.

    Args:
        equations, pattern: The equations, and where the blocks of their factor lie.
        damping: The diagonal of each pose is enlarged by this share.
        num_poses: The nodes before this one are poses.
        factor: Result.
    """
    blocks, order, tops, rows = equations.blocks, pattern.order, pattern.tops, pattern.rows
    row_tops, row_columns, row_places = pattern.row_tops, pattern.row_columns, pattern.row_places
    pivots, values, where = factor
    num = len(order)
    values[:] = 0.0
    for places, parts in (
        (pattern.link_places, equations.links), (pattern.cross_places, equations.cross),
        (pattern.bias_places, equations.bias_links),
    ):  # fmt: skip
        for n in range(len(places)):
            if places[n] == 0:
                continue
            out = values[abs(places[n]) - 1]
            for i in range(3):
                for j in range(3):
                    out[3 * i + j if places[n] > 0 else 3 * j + i] += parts[n, i, j]
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


@jit_fma
def covariance(factor: CholeskyFactor, pattern: SymbolicFactor, nodes: IntArray) -> FloatArray:
    """Return the blocks (3 r, 3 r) of the inverse that belong to r nodes (r,), the mean of either half of it.

    Only columns take part to which the first blocks lead from the nodes' own columns: all other elements are zero in
    the forward sweep, and do not matter in the backward one.
    """
    ranks, tops, rows = pattern.ranks, pattern.tops, pattern.rows
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
            sweep(factor, pattern, columns, x)
            for m in range(len(nodes)):
                for i in range(3):
                    result[3 * m + i, 3 * n + axis] = x[ranks[nodes[m]], i]
    for i in range(len(result)):
        for j in range(i):
            result[i, j] = result[j, i] = 0.5 * (result[i, j] + result[j, i])
    return result


@device
@jit_fma
def sweep(factor: CholeskyFactor, pattern: SymbolicFactor, columns: IntArray, x: FloatArray) -> None:
    """Solve for x (N, 3) by rank, in place; all but these columns (n,), ascending, are left out."""
    pivots, values, tops, rows = factor.pivots, factor.values, pattern.tops, pattern.rows
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
