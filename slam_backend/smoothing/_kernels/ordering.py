"""In which order nodes are eliminated, so that few blocks are filled in, and which are: symbolic factorisation."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import in_place, inlined, jit
from slam_backend.errors import IntArray

Bits = NDArray[np.uint64]

ONE = np.uint64(1)
WORD = 64


@inlined
def _num_bits(word: Any) -> int:
    """Return how many bits are set in 64 (the compiler makes one instruction of it)."""
    word = word - ((word >> np.uint64(1)) & np.uint64(0x5555555555555555))
    word = (word & np.uint64(0x3333333333333333)) + ((word >> np.uint64(2)) & np.uint64(0x3333333333333333))
    word = (word + (word >> np.uint64(4))) & np.uint64(0x0F0F0F0F0F0F0F0F)
    return int((word * np.uint64(0x0101010101010101)) >> np.uint64(56))


@inlined
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


@inlined
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
