"""The compiled gather of one particle's map: an environment asks for it at every step."""

from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend._kernels import LANES
from slam_backend._kernels.layout import IDS, MAP_OF, ROW_OF
from slam_backend._particle_maps import ParticleMaps
from slam_backend.errors import FloatArray, IntArray
from slam_backend.landmark_map import OutlineRows


@jit
def _held(table: Any, maps: Any, counts: Any, m: int, min_count: int) -> tuple[IntArray, bool]:
    """Return the slots that particle m holds with at least so many measurements, and whether their ids ascend."""
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    slots, least = np.empty(len(ids), np.int64), max(min_count, 1)
    n, last, ascending = 0, -1, True
    for slot in range(len(ids)):
        if ids[slot] >= 0:
            place = maps[map_of[slot], m] if map_of[slot] > 0 else m
            if counts[row_of[slot], place] >= least:
                ascending &= ids[slot] > last
                last = ids[slot]
                slots[n] = slot
                n += 1
    return slots[:n], ascending


@jit
def _gather(
    slots: Any, table: Any, maps: Any, values: Any, counts: Any, m: int, lanes: int
) -> tuple[FloatArray, FloatArray, IntArray, IntArray]:
    """Return means (n, 3), covariances (n, 3, 3), counts (n,) and ids (n,) of slots of particle m.

    The number of lanes is an argument, for a compiled kernel would not notice that it changed in another file.
    """
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    n, padded = len(slots), counts.shape[1]
    means, covariances = np.empty((n, 3)), np.empty((n, 3, 3))
    times, names = np.empty(n, np.int64), np.empty(n, np.int64)
    for i in range(n):
        slot = slots[i]
        row, place = row_of[slot], maps[map_of[slot], m] if map_of[slot] > 0 else m
        at = row * 9 * padded + place // lanes * 9 * lanes + place % lanes
        for axis in range(3):
            means[i, axis] = values[at + axis * lanes]
        entry = 3
        for j in range(3):
            for k in range(j, 3):
                covariances[i, j, k] = covariances[i, k, j] = values[at + entry * lanes]
                entry += 1
        times[i], names[i] = counts[row, place], ids[slot]
    return means, covariances, times, names


@jit
def _outline(
    table: Any, maps: Any, values: Any, counts: Any, m: int, min_count: int, lanes: int, places: Any, names: Any, n: int
) -> tuple[int, bool]:
    """Write from row n on, as far as there are rows, what particle m holds with at least so many measurements.

    Returns:
        The row after the last, be it there or not, and whether ids ascend.
    """
    row_of, map_of, ids, padded = table[ROW_OF], table[MAP_OF], table[IDS], counts.shape[1]
    slots, ascending = _held(table, maps, counts, m, min_count)
    for i in range(min(len(slots), len(names) - n)):
        slot = slots[i]
        row, place = row_of[slot], maps[map_of[slot], m] if map_of[slot] > 0 else m
        at = row * 9 * padded + place // lanes * 9 * lanes + place % lanes
        for axis in range(3):
            places[n + i, axis] = values[at + axis * lanes]
        places[n + i, 3] = values[at + 3 * lanes] + values[at + 6 * lanes] + values[at + 8 * lanes]
        names[n + i, 0], names[n + i, 1] = counts[row, place], ids[slot]
    return n + len(slots), ascending


def write_outline(maps: ParticleMaps, m: int, min_count: int, rows: OutlineRows, first: int) -> int:
    """Write the outline of `best_map`, which takes the same: the same landmarks in the same order.

    Args:
        maps: Of all particles.
        m: Which of them.
        min_count: What it measured fewer times is left out.
        rows: Written to, as far as there are rows.
        first: From this row on.

    Returns:
        The row after the last, be it there or not.
    """
    last, ascending = _outline(maps.table, maps.maps, maps.values, maps.counts, m, min_count, LANES, *rows, first)
    if not ascending:
        order = first + np.argsort(rows.names[first:last, 1])
        for column in rows:
            column[first:last] = column[order]
    return last


def slots_held(maps: ParticleMaps, m: int, min_count: int) -> IntArray:
    """Return the slots (n,) of `best_map`, which takes the same, by ascending id."""
    slots, ascending = _held(maps.table, maps.maps, maps.counts, m, min_count)
    return slots if ascending else slots[np.argsort(maps.ids[slots])]


def best_map(maps: ParticleMaps, m: int, min_count: int) -> tuple[FloatArray, FloatArray, Any, IntArray, IntArray]:
    """Return what one particle holds, by ascending id.

    Args:
        maps: Of all particles.
        m: Which of them.
        min_count: What it measured fewer times is left out.

    Returns:
        Means (n, 3) [m], covariances (n, 3, 3) [m^2], map frame, descriptors (n, d) float32, counts (n,) and ids (n,):
        all fresh.
    """
    slots = slots_held(maps, m, min_count)
    means, covariances, times, names = _gather(slots, maps.table, maps.maps, maps.values, maps.counts, m, LANES)
    return means, covariances, maps.descriptors[slots], times, names
