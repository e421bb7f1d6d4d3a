"""Where landmarks lie: brought up to date, opened, named."""

import numpy as np

from slam_backend._jit import device, fused, lanes, lanes_inlined
from slam_backend._kernels.layout import BLOCK, LANES, TILE
from slam_backend.errors import Float32Array, FloatArray, Int32Array, IntArray


@lanes_inlined
def tile_of(padded: int, row: int, block: int) -> slice:
    """Return where a block of a landmark that is up to date lies in the values."""
    start = row * 9 * padded + block * TILE
    return slice(start, start + TILE)


@device
@lanes
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


@lanes
def refresh(
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


@fused
def carry_odds(slots: IntArray, odds: FloatArray, map_of: IntArray, maps: Int32Array) -> None:
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
@lanes
def open_slot(
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
@lanes
def name_new(
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
