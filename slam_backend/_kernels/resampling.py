"""Particles become copies of their ancestors, their landmarks lazily."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import device, in_place
from slam_backend._kernels.layout import FAR, FREE_SLOTS, IDS, LOG_WEIGHTS, MAP_OF, PATH_LOG_WEIGHTS, ROW_OF
from slam_backend.errors import Float32Array, FloatArray, Int32Array, IntArray


@device
@in_place
def settle(ancestors: IntArray, moved: Any) -> int:
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
        robots: (5, K, 3, P) as in `take_turns`; columns are copied.
        weights: (4, P); those along paths are copied, those since the last resampling begin anew.
        counts, ..., heads: The store, see `ParticleMaps`. At least one map is free.
        moved: Room for what `settle` writes.

    Returns:
        How many maps are still free, and the particle of the largest weight along paths.
    """
    count, moves = len(ancestors), settle(ancestors, moved)
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
