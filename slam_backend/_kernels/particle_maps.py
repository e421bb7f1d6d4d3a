"""The map of one particle, gathered whole or as an outline: an environment asks for it at every step."""

import numpy as np

from slam_backend._jit import in_place, inlined, jit
from slam_backend._kernels.layout import BLOCK, IDS, LANES, MAP_OF, ROW_OF, TILE
from slam_backend.errors import FloatArray, Int32Array, IntArray


@inlined
def _place_in(maps: Int32Array, ancestors: int, m: int) -> int:
    """Return where particle m's share of a landmark lies, whose `map_of` this is."""
    return int(maps[ancestors, m]) if ancestors > 0 else m


@inlined
def _values_at(padded: int, row: int, place: int) -> int:
    """Return where the values of a landmark's row begin that lie at a place; the next is a number of lanes on."""
    own = np.uint32(place)
    return row * 9 * padded + int(own // BLOCK) * TILE + int(own % BLOCK)


@jit
def hold(table: IntArray, maps: Int32Array, counts: Int32Array, m: int, min_count: int) -> tuple[IntArray, bool]:
    """Return the slots that particle m holds with at least so many measurements, and whether their ids ascend.

    Args:
        table, maps, counts: Of `ParticleMaps`.
        m: The particle.
        min_count: What it measured fewer times is left out, as is what it does not hold.
    """
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    slots, least = np.empty(len(ids), np.int64), max(min_count, 1)
    n, last, ascending = 0, -1, True
    for slot in range(len(ids)):
        if ids[slot] >= 0 and counts[row_of[slot], _place_in(maps, map_of[slot], m)] >= least:
            ascending &= ids[slot] > last
            last = ids[slot]
            slots[n] = slot
            n += 1
    return slots[:n], ascending


@jit
def gather(
    slots: IntArray, table: IntArray, maps: Int32Array, values: FloatArray, counts: Int32Array, m: int
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Return means (n, 3), covariances (n, 3, 3), counts (n,) and ids (n,) of slots of particle m."""
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    n = len(slots)
    means, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
    times, names = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        slot = slots[i]
        row, place = row_of[slot], _place_in(maps, map_of[slot], m)
        at = _values_at(counts.shape[1], row, place)
        for axis in range(3):
            means[i, axis] = values[at + axis * LANES]
        entry = 3
        for j in range(3):
            for k in range(j, 3):
                covariances[i, j, k] = covariances[i, k, j] = values[at + entry * LANES]
                entry += 1
        times[i], names[i] = counts[row, place], ids[slot]
    return means, covariances, times, names


@in_place
def outline(
    table: IntArray, maps: Int32Array, values: FloatArray, counts: Int32Array, m: int, min_count: int,
    places: FloatArray, names: IntArray, first: int,
) -> tuple[int, bool]:  # fmt: skip
    """Write what `hold` returns as rows of an outline, from the first on and as far as there are rows.

    Args:
        table, maps, values, counts, m, min_count: As above.
        places, names: Of `OutlineRows`; written to.
        first: Where to begin.

    Returns:
        The row after the last, be it there or not, and whether ids ascend.
    """
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    least, n, last, ascending = max(min_count, 1), first, -1, True
    for slot in range(len(ids)):
        if ids[slot] < 0:
            continue
        row, place = row_of[slot], _place_in(maps, map_of[slot], m)
        count = counts[row, place]
        if count < least:
            continue
        ascending &= ids[slot] > last
        last = ids[slot]
        if n < len(names):
            at = _values_at(counts.shape[1], row, place)
            for axis in range(3):
                places[n, axis] = values[at + axis * LANES]
            places[n, 3] = values[at + 3 * LANES] + values[at + 6 * LANES] + values[at + 8 * LANES]
            names[n, 0], names[n, 1] = count, ids[slot]
        n += 1
    return n, ascending
