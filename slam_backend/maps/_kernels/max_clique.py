"""The largest set of candidate matches that agree pairwise: a maximum clique, by branch and bound over sets of bits.

Two matches agree if the distance between their landmarks is the same in both maps (Mangelson, Dominic, Eustice and
Vasudevan 2018, "Pairwise consistent measurement set maximization"; the translation-invariant measurements of TEASER,
Yang, Shi and Carlone 2021). The search is that of San Segundo, Rodriguez-Losada and Jimenez (2011), BBMC: a greedy
colouring of the vertices left bounds the clique that they can add.
"""

import math

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, jit
from slam_backend.core.validation import BoolArray, FloatArray, IntArray

Bits = NDArray[np.uint64]

WORD = 64
ONE = np.uint64(1)
# Multiplied with a power of two, its upper six bits tell which one: a de Bruijn sequence, read in `POSITION`.
_DE_BRUIJN = 0x03F79D71B4CB0A89
DE_BRUIJN = np.uint64(_DE_BRUIJN)
SHIFT = np.uint64(58)
POSITION = np.zeros(WORD, np.int64)
POSITION[[((_DE_BRUIJN << i) % 2**WORD) >> 58 for i in range(WORD)]] = np.arange(WORD)


@jit
def agreement(table: FloatArray, matches: IntArray, floor: float, gate: float) -> BoolArray:
    """Tell which candidates agree pairwise.

    Args:
        table: (k, 18), see `match_table`.
        matches: (k, 2) rows (a, b): two matches of the same landmark never agree.
        floor: Variance added in each map [m^2].
        gate: Largest squared difference of the two planar distances over its variance [-].

    Returns:
        (k, k), symmetric, nothing agrees with itself.
    """
    n = len(table)
    agrees = np.zeros((n, n), np.bool_)
    for i in range(n):
        for j in range(i):
            if matches[i, 0] == matches[j, 0] or matches[i, 1] == matches[j, 1]:
                continue
            ax, ay = table[j, 0] - table[i, 0], table[j, 1] - table[i, 1]
            bx, by = table[j, 3] - table[i, 3], table[j, 4] - table[i, 4]
            length_a, length_b = math.hypot(ax, ay), math.hypot(bx, by)
            variance = 2.0 * floor
            for m in (i, j):  # along either direction at most the larger axis, so coincident points need no direction
                if min(length_a, length_b) > 1e-9:
                    ux, uy, vx, vy = ax / length_a, ay / length_a, bx / length_b, by / length_b
                    variance += ux * ux * table[m, 6] + 2.0 * ux * uy * table[m, 7] + uy * uy * table[m, 9]
                    variance += vx * vx * table[m, 12] + 2.0 * vx * vy * table[m, 13] + vy * vy * table[m, 15]
                else:
                    variance += table[m, 6] + table[m, 9] + table[m, 12] + table[m, 15]
            if (length_a - length_b) ** 2 <= gate * variance:
                agrees[i, j] = agrees[j, i] = True
    return agrees


@jit
def largest_clique(agrees: BoolArray, max_nodes: int) -> IntArray:
    """Return the rows (c,) of a largest set that agrees pairwise, or of the largest met within `max_nodes` branchings.

    Args:
        agrees: (k, k) symmetric, False on the diagonal.
        max_nodes: Bound on the work; without it the time may grow exponentially.
    """
    n = len(agrees)
    if n == 0:
        return np.zeros(0, np.int64)
    names = np.argsort(-agrees.sum(axis=0), kind="mergesort")  # friends of many first: they are coloured first
    words = (n + WORD - 1) // WORD
    friends = np.zeros((n, words), np.uint64)
    for i in range(n):
        for j in range(n):
            if agrees[names[i], names[j]]:
                friends[i, j // WORD] |= ONE << np.uint64(j % WORD)
    left = np.zeros((n + 1, words), np.uint64)  # per depth: vertices that may still be added
    order, colours = np.zeros((n + 1, n), np.int32), np.zeros((n + 1, n), np.int32)
    place = np.zeros(n + 1, np.int64)
    chosen, best = np.zeros(n, np.int64), np.zeros(n, np.int64)
    rest, free = np.zeros(words, np.uint64), np.zeros(words, np.uint64)
    for i in range(n):
        left[0, i // WORD] |= ONE << np.uint64(i % WORD)
    size, depth, nodes = 0, 0, 0
    place[0] = _colour(left[0], friends, 0, order[0], colours[0], rest, free) - 1
    while depth >= 0:
        at = place[depth]
        if at < 0 or depth + colours[depth, at] <= size or nodes >= max_nodes:
            depth -= 1
            continue
        nodes += 1
        vertex = order[depth, at]
        place[depth] -= 1
        left[depth, vertex // WORD] &= ~(ONE << np.uint64(vertex % WORD))
        chosen[depth] = vertex
        some = np.uint64(0)
        for w in range(words):
            left[depth + 1, w] = left[depth, w] & friends[vertex, w]
            some |= left[depth + 1, w]
        depth += 1
        if some == np.uint64(0):
            if depth > size:
                size = depth
                best[:size] = chosen[:size]
            depth -= 1
        else:
            found = _colour(left[depth], friends, size - depth, order[depth], colours[depth], rest, free)
            place[depth] = found - 1
    return np.sort(names[best[:size]])


@device
@jit
def _colour(
    vertices: Bits, friends: Bits, least: int, order: IntArray, colours: IntArray, rest: Bits, free: Bits
) -> int:
    """Colour vertices so that friends differ; write those with a colour above `least`, by rising colour.

    A clique among the vertices up to one in `order` is no larger than that one's colour. `rest` and `free` are room
    to work in.

    Returns:
        Number of entries written.
    """
    words = len(vertices)
    found, colour = 0, 0
    some = np.uint64(0)
    for w in range(words):
        rest[w] = vertices[w]
        some |= rest[w]
    while some != np.uint64(0):
        colour += 1
        free[:] = rest
        for w in range(words):
            while free[w] != np.uint64(0):
                bit = free[w] & (~free[w] + ONE)
                vertex = w * WORD + POSITION[np.int64((bit * DE_BRUIJN) >> SHIFT)]
                rest[w] &= ~bit
                free[w] &= ~bit
                for v in range(w, words):
                    free[v] &= ~friends[vertex, v]
                if colour > least:
                    order[found], colours[found] = vertex, colour
                    found += 1
        some = np.uint64(0)
        for w in range(words):
            some |= rest[w]
    return found
