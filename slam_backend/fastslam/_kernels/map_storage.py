"""Storage of the particles' landmarks: allocated, resampled lazily, gathered for the map of one particle."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit, jit_fma, simd, simd_inline
from slam_backend.core.validation import Float32Array, FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.layout import (
    BLOCK,
    FAR,
    FREE_SLOTS,
    IDS,
    LANES,
    LOG_WEIGHTS,
    MAP_OF,
    PATH_LOG_WEIGHTS,
    ROW_OF,
    TILE,
)


@inline
def _place_in(maps: Int32Array, ancestors: int, m: int) -> int:
    """Return where particle m's share of a landmark lies, whose `map_of` this is."""
    return int(maps[ancestors, m]) if ancestors > 0 else m


@inline
def _values_at(padded: int, row: int, place: int) -> int:
    """Return where the values of a landmark's row begin that lie at a place; the next is a number of lanes on."""
    own = np.uint32(place)
    return row * 9 * padded + int(own // BLOCK) * TILE + int(own % BLOCK)


@jit
def present_slots(
    table: IntArray, maps: Int32Array, counts: Int32Array, m: int, min_count: int
) -> tuple[IntArray, bool]:
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
def map_summary(
    table: IntArray, maps: Int32Array, values: FloatArray, counts: Int32Array, m: int, min_count: int,
    places: FloatArray, names: IntArray, first: int,
) -> tuple[int, bool]:  # fmt: skip
    """Write what `hold` returns as rows of an outline, from the first on and as far as there are rows.

    Args:
        table, maps, values, counts, m, min_count: As above.
        places, names: Of `MapSummaryRows`; written to.
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


@simd_inline
def tile_of(padded: int, row: int, block: int) -> slice:
    """Return where a block of a landmark that is up to date lies in the values."""
    start = row * 9 * padded + block * TILE
    return slice(start, start + TILE)


@device
@simd
def _copy_row(
    source: FloatArray, target: FloatArray, before: Int32Array, seen: Int32Array, ancestors: Int32Array
) -> None:
    """Copy a row of values and counts, each particle's from its ancestor's place.

    Most particles are their own ancestors, and memory is fast where it is read and written in order: so first all of
    the row as it lies, then those that moved.
    """
    for j in range(len(target)):
        target[j] = source[j]
    for m in range(len(seen)):
        seen[m] = before[m]
    for m in range(len(ancestors)):
        ancestor = np.uint32(ancestors[m])  # unsigned: none counts from the end
        if ancestor != m:
            own = np.uint32(m)
            at = np.int64(ancestor // BLOCK) * TILE + np.int64(ancestor % BLOCK)
            to = np.int64(own // BLOCK) * TILE + np.int64(own % BLOCK)
            seen[m] = before[ancestor]
            for c in range(9):
                target[to + c * LANES] = source[at + c * LANES]


@simd
def apply_resampling(
    slots: IntArray, values: FloatArray, counts: Int32Array, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, tops: IntArray,
) -> None:  # fmt: skip
    """Bring landmarks up to date: copy each particle's values from where its ancestor left them to its own place.

    One free row is needed: the row that a landmark leaves is taken by the next, while it is still in the cache.
    """
    size = 9 * counts.shape[1]
    for k in range(len(slots)):
        slot = slots[k]
        e = map_of[slot]
        if e == 0:
            continue
        row = row_of[slot]
        tops[0] -= 1
        target = free_rows[tops[0]]
        source, copy = values[row * size : (row + 1) * size], values[target * size : (target + 1) * size]
        _copy_row(source, copy, counts[row], counts[target], maps[e])
        free_rows[tops[0]] = row
        tops[0] += 1
        row_of[slot] = target
        users[e] -= 1
        map_of[slot] = 0


@jit_fma
def gather_odds(slots: IntArray, odds: FloatArray, map_of: IntArray, maps: Int32Array) -> None:
    """Copy log-odds from where each particle's ancestor left them to its own place; `refresh` does the rest.

    Args:
        slots: Landmarks that are about to be brought up to date.
        odds: (slots, P), changed.
        map_of, maps: As yet of the old places, see `ParticleMaps`.
    """
    before = np.empty(odds.shape[1])
    for k in range(len(slots)):
        slot = slots[k]
        if map_of[slot] == 0:
            continue
        own = maps[map_of[slot]]
        for m in range(len(before)):
            before[m] = odds[slot, own[m]]
        for m in range(len(before)):
            odds[slot, m] = before[m]


@device
@simd
def allocate_landmark(
    b: int, new_slots: IntArray, new_rows: IntArray, row_of: IntArray, map_of: IntArray, values: FloatArray,
    counts: Int32Array, free_rows: IntArray, free_slots: IntArray, tops: IntArray,
) -> None:  # fmt: skip
    """Give measurement b a free slot and row for the landmark that it starts in some particles."""
    tops[0] -= 1
    tops[1] -= 1
    new_rows[b] = free_rows[tops[0]]
    new_slots[b] = free_slots[tops[1]]
    size = 9 * counts.shape[1]
    counts[new_rows[b], :] = 0
    values[new_rows[b] * size : (new_rows[b] + 1) * size] = 0.0
    row_of[new_slots[b]] = new_rows[b]
    map_of[new_slots[b]] = 0


@device
@simd
def register_new(
    new_slots: IntArray, measured: Float32Array, names: IntArray, named: bool, ids: IntArray,
    identities: IntArray, stored: Float32Array, heads: Float32Array, tops: IntArray,
) -> None:  # fmt: skip
    """Give the landmarks that a frame has started their lasting names `tops[2]`, ..., in the order of measurements.

    Args:
        new_slots: (B,) slot of the landmark that each measurement started, -1 = none.
        measured: (B, d) descriptors; a landmark takes that of its first measurement.
        names: (B,) the caller's names, if `named`.
        ids, identities, stored, heads, tops: The store, see `ParticleMaps`.
    """
    for b in range(len(new_slots)):
        slot = new_slots[b]
        if slot < 0:
            continue
        ids[slot] = tops[2]
        tops[2] += 1
        identities[slot] = names[b] if named else -1
        for j in range(measured.shape[1]):
            stored[slot, j] = measured[b, j]
        for k in range(heads.shape[0]):
            heads[k, slot] = measured[b, k * (measured.shape[1] // heads.shape[0])]


@device
@in_place
def keep_survivors_in_place(ancestors: IntArray, moved: Any) -> int:
    """Arrange resampled particles so that most stay in place.

    A particle with at least one copy keeps its place; surplus copies fill the places of the dead, in ascending order.

    Args:
        ancestors: (M,) index of each new particle's parent, ascending.
        moved: (3, M) uint32. Written to, as far as places change: these, below each the particle that is copied into
            it; and how many copies each particle has.

    Returns:
        How many places change.
    """
    targets, sources, copies = moved[0], moved[1], moved[2]
    copies[:] = 0
    for parent in ancestors:
        copies[parent] += 1
    moves, place = 0, 0
    for parent in range(len(ancestors)):
        for _ in range(int(copies[parent]) - 1):
            while copies[place] > 0:
                place += 1
            targets[moves] = place
            sources[moves] = parent
            moves += 1
            place += 1
    return moves


@in_place
def resample(
    ancestors: IntArray, robots: FloatArray, weights: FloatArray, counts: Int32Array, table: IntArray,
    maps: Int32Array, users: IntArray, free_rows: IntArray, tops: IntArray, heads: Float32Array, moved: Any,
) -> tuple[int, int]:  # fmt: skip
    """Let particles become copies of their ancestors, their landmarks lazily, and free what no survivor holds.

    They are weighed alike then. Landmarks that were up to date get one new ancestor map; the others' maps are composed
    with it.

    Args:
        ancestors: (M,) index of each new particle's parent, ascending; they are settled first.
        robots: (5, K, 3, P) as in `step_robots`; columns are copied.
        weights: (4, P); those along paths are copied, those since the last resampling begin anew.
        counts, ..., heads: The store, see `ParticleMaps`. At least one map is free.
        moved: Room for what `settle` writes.

    Returns:
        How many maps are still free, and the particle of the largest weight along paths.
    """
    count, moves = len(ancestors), keep_survivors_in_place(ancestors, moved)
    targets, sources = moved[0], moved[1]  # unsigned: none counts from the end
    path_log_weights, rows = weights[PATH_LOG_WEIGHTS], robots.reshape((-1, robots.shape[3]))
    for i in range(moves):
        path_log_weights[targets[i]] = path_log_weights[sources[i]]
    weights[LOG_WEIGHTS, :count] = -math.log(count)
    best = int(np.argmax(path_log_weights[:count]))
    for c in range(len(rows)):
        row = rows[c]
        for i in range(moves):
            row[targets[i]] = row[sources[i]]
    row_of, map_of, ids, free_slots = table[ROW_OF], table[MAP_OF], table[IDS], table[FREE_SLOTS]
    fresh, free = 0, 0
    for e in range(1, len(users)):
        if users[e] > 0:
            own = maps[e]
            for i in range(moves):
                own[targets[i]] = own[sources[i]]
        else:
            fresh = e
            free += 1
    used = False
    for slot in range(len(ids)):
        if ids[slot] < 0:
            continue
        if moves > 0 and map_of[slot] == 0:
            if not used:
                used = True
                free -= 1
                own = maps[fresh]
                for m in range(len(own)):
                    own[m] = m
                for i in range(moves):
                    own[targets[i]] = sources[i]
            map_of[slot] = fresh
            users[fresh] += 1
        e = map_of[slot]
        row = row_of[slot]
        alive = False
        for m in range(count):
            if counts[row, maps[e, m] if e > 0 else m] > 0:
                alive = True
                break
        if not alive:
            if e > 0:
                users[e] -= 1
                map_of[slot] = 0
            ids[slot] = -1
            for k in range(heads.shape[0]):
                heads[k, slot] = FAR
            free_rows[tops[0]] = row
            free_slots[tops[1]] = slot
            tops[0] += 1
            tops[1] += 1
    return free, best
