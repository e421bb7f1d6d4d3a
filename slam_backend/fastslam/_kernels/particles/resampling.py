"""Resampling: particles become copies of their ancestors, and their landmarks follow lazily."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, simd
from slam_backend.core.validation import FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES, TILE
from slam_backend.fastslam._kernels.particles.map_storage import free_slot
from slam_backend.fastslam._kernels.records import MapArrays


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
    path_log_weights, rows = weights[L.PATH_LOG_WEIGHTS], robots.reshape((-1, robots.shape[3]))
    for i in range(moves):
        path_log_weights[targets[i]] = path_log_weights[sources[i]]
    weights[L.LOG_WEIGHTS, :count] = -math.log(count)
    best = int(np.argmax(path_log_weights[:count]))
    for c in range(len(rows)):
        row = rows[c]
        for i in range(moves):
            row[targets[i]] = row[sources[i]]
    row_of, map_of, ids, users = maps.table[L.ROW_OF], maps.table[L.MAP_OF], maps.table[L.IDS], maps.users
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
            at = np.int64(ancestor // L.BLOCK) * TILE + np.int64(ancestor % L.BLOCK)
            to = np.int64(own // L.BLOCK) * TILE + np.int64(own % L.BLOCK)
            seen[m] = before[ancestor]
            for c in range(9):
                target[to + c * LANES] = source[at + c * LANES]


@simd
def apply_resampling(slots: IntArray, maps: MapArrays) -> None:
    """Bring landmarks up to date: copy each particle's values from where its ancestor left them to its own place.

    One free row is needed: the row that a landmark leaves is taken by the next, while it is still in the cache.
    """
    row_of, map_of, tops = maps.table[L.ROW_OF], maps.table[L.MAP_OF], maps.tops
    padded = maps.counts.shape[1]
    size = 9 * padded
    for k in range(len(slots)):
        slot = slots[k]
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
