"""Storage of the particles' landmarks: allocated, resampled lazily, gathered for the map of one particle."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline, simd, simd_inline
from slam_backend.core.validation import FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.layout import (
    BLOCK,
    CHANGED,
    FAR,
    FREE_SLOTS,
    IDENTITIES,
    IDS,
    LANES,
    LOG_WEIGHTS,
    MAP_OF,
    PATH_LOG_WEIGHTS,
    ROW_OF,
    TILE,
)
from slam_backend.fastslam._kernels.records import Frame, MapArrays


@in_place
def map_summary(
    table: IntArray, maps: Int32Array, values: FloatArray, counts: Int32Array, m: int, min_count: int,
    places: FloatArray, names: IntArray, first: int,
) -> tuple[int, bool]:  # fmt: skip
    """Write the landmarks of one particle as rows of an outline, as far as there are rows.

    Args:
        table, maps, values, counts: Landmarks, see `MapArrays`.
        m: The particle.
        min_count: Least count of the landmarks written; what the particle does not hold is left out anyway.
        places, names: Columns of `MapSummaryRows`, written.
        first: First row.

    Returns:
        The row after the last, be it there or not, and whether ids ascend.
    """
    row_of, map_of, ids = table[ROW_OF], table[MAP_OF], table[IDS]
    least, n, last, ascending = max(min_count, 1), first, -1, True
    for slot in range(len(ids)):
        if ids[slot] < 0:
            continue
        row, place = row_of[slot], int(maps[map_of[slot], m]) if map_of[slot] > 0 else m
        count = counts[row, place]
        if count < least:
            continue
        ascending &= ids[slot] > last
        last = ids[slot]
        if n < len(names):
            own = np.uint32(place)
            at = row * 9 * counts.shape[1] + int(own // BLOCK) * TILE + int(own % BLOCK)
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
    the row is copied as it lies, then what moved.
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
def apply_resampling(slots: IntArray, maps: MapArrays) -> None:
    """Bring landmarks up to date: copy each particle's values from where its ancestor left them to its own place.

    One free row is needed: the row that a landmark leaves is taken by the next, while it is still in the cache. The
    landmarks are marked as changed, for only those that were brought up to date are written.
    """
    row_of, map_of, tops = maps.table[ROW_OF], maps.table[MAP_OF], maps.tops
    padded = maps.counts.shape[1]
    size = 9 * padded
    for k in range(len(slots)):
        slot = slots[k]
        maps.table[CHANGED, slot] = 1
        e = map_of[slot]
        if e == 0:
            continue
        row, ancestors = row_of[slot], maps.maps[e]
        tops[0] -= 1
        free = maps.free_rows[tops[0]]
        source, target = maps.values[row * size : (row + 1) * size], maps.values[free * size : (free + 1) * size]
        if len(maps.odds) > 0:  # by way of the row that is about to be written
            odds = maps.odds[slot]
            for m in range(padded):
                target[m] = odds[ancestors[m]]
            for m in range(padded):
                odds[m] = target[m]
        _copy_row(source, target, maps.counts[row], maps.counts[free], ancestors)
        maps.free_rows[tops[0]] = row
        tops[0] += 1
        row_of[slot] = free
        maps.users[e] -= 1
        map_of[slot] = 0


@device
@simd
def register_new(new_slots: IntArray, frame: Frame, maps: MapArrays) -> None:
    """Give the landmarks that a frame has started their lasting names, in the order of measurements.

    A landmark takes the descriptor of its first measurement.

    Args:
        new_slots: (B,) slot of the landmark that each measurement started, -1 = none.
        frame: Measurements of the robot.
        maps: Landmarks; the next name is `tops[2]`.
    """
    ids, identities, heads = maps.table[IDS], maps.table[IDENTITIES], maps.heads
    for b in range(len(new_slots)):
        slot = new_slots[b]
        if slot < 0:
            continue
        ids[slot] = maps.tops[2]
        maps.table[CHANGED, slot] = 1
        maps.tops[2] += 1
        identities[slot] = frame.identities[b] if frame.identified else -1
        size = frame.descriptors.shape[1]
        for j in range(size):
            maps.descriptors[slot, j] = frame.descriptors[b, j]
        for k in range(heads.shape[0]):
            heads[k, slot] = frame.descriptors[b, k * (size // heads.shape[0])]


@in_place
def resample(
    ancestors: IntArray, robots: FloatArray, weights: FloatArray, maps: MapArrays, moved: Any
) -> tuple[int, int]:
    """Let particles become copies of their ancestors, their landmarks lazily, and free what no survivor holds.

    They are weighed alike then. A particle with at least one copy keeps its place; surplus copies fill the places of
    the dead, in ascending order. Landmarks that were up to date get one new ancestor map; the others' maps are composed
    with it.

    Args:
        ancestors: (M,) index of each new particle's parent, ascending.
        robots: (5, K, 3, P) as in `step_robots`; columns are copied.
        weights: (4, P); those along paths are copied, those since the last resampling become alike.
        maps: Landmarks. At least one map is free.
        moved: (3, M) uint32. Working space.

    Returns:
        The number of maps that are still free, and the particle of the largest weight along paths.
    """
    count, moves, place = len(ancestors), 0, 0
    targets, sources, copies = moved[0], moved[1], moved[2]  # unsigned: none counts from the end
    copies[:] = 0
    for parent in ancestors:
        copies[parent] += 1
    for parent in range(count):
        for _ in range(int(copies[parent]) - 1):
            while copies[place] > 0:
                place += 1
            targets[moves] = place
            sources[moves] = parent
            moves += 1
            place += 1
    path_log_weights, rows = weights[PATH_LOG_WEIGHTS], robots.reshape((-1, robots.shape[3]))
    for i in range(moves):
        path_log_weights[targets[i]] = path_log_weights[sources[i]]
    weights[LOG_WEIGHTS, :count] = -math.log(count)
    best = int(np.argmax(path_log_weights[:count]))
    for c in range(len(rows)):
        row = rows[c]
        for i in range(moves):
            row[targets[i]] = row[sources[i]]
    row_of, map_of, ids, users = maps.table[ROW_OF], maps.table[MAP_OF], maps.table[IDS], maps.users
    fresh, free = 0, 0
    for e in range(1, len(users)):
        if users[e] > 0:
            own = maps.maps[e]
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
                own = maps.maps[fresh]
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
            if maps.counts[row, maps.maps[e, m] if e > 0 else m] > 0:
                alive = True
                break
        if not alive:
            if e > 0:
                users[e] -= 1
                map_of[slot] = 0
            free_slot(slot, maps)
    return free, best


@in_place
def release(slots: IntArray, maps: MapArrays) -> None:
    """Free slots, up to date, that no particle holds, and their rows."""
    for k in range(len(slots)):
        free_slot(slots[k], maps)


@inline
def free_slot(slot: int, maps: MapArrays) -> None:
    """Free a slot, up to date, and its row."""
    maps.table[IDS, slot] = -1
    for k in range(maps.heads.shape[0]):
        maps.heads[k, slot] = FAR
    maps.free_rows[maps.tops[0]] = maps.table[ROW_OF, slot]
    maps.table[FREE_SLOTS, maps.tops[1]] = slot
    maps.tops[0] += 1
    maps.tops[1] += 1
