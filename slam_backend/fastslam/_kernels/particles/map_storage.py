"""Storage of the particles' landmarks: allocated, freed, gathered for the map of one particle."""

import numpy as np

from slam_backend.core.jit import device, in_place, inline, simd, simd_inline
from slam_backend.core.validation import FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES, TILE
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
    row_of, map_of, ids = table[L.ROW_OF], table[L.MAP_OF], table[L.IDS]
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
            at = row * 9 * counts.shape[1] + int(own // L.BLOCK) * TILE + int(own % L.BLOCK)
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
def register_new(new_slots: IntArray, frame: Frame, maps: MapArrays) -> None:
    """Give the landmarks that a frame has started their lasting names, in the order of measurements.

    A landmark takes the descriptor of its first measurement.

    Args:
        new_slots: (B,) slot of the landmark that each measurement started, -1 = none.
        frame: Measurements of the robot.
        maps: Landmarks; the next name is `tops[2]`.
    """
    ids, identities, heads = maps.table[L.IDS], maps.table[L.IDENTITIES], maps.heads
    for b in range(len(new_slots)):
        slot = new_slots[b]
        if slot < 0:
            continue
        ids[slot] = maps.tops[2]
        maps.tops[2] += 1
        identities[slot] = frame.identities[b] if frame.identified else -1
        size = frame.descriptors.shape[1]
        for j in range(size):
            maps.descriptors[slot, j] = frame.descriptors[b, j]
        for k in range(heads.shape[0]):
            heads[k, slot] = frame.descriptors[b, k * (size // heads.shape[0])]


@in_place
def release(slots: IntArray, maps: MapArrays) -> None:
    """Free slots, up to date, that no particle holds, and their rows."""
    for k in range(len(slots)):
        free_slot(slots[k], maps)


@inline
def free_slot(slot: int, maps: MapArrays) -> None:
    """Free a slot, up to date, and its row."""
    maps.table[L.IDS, slot] = -1
    for k in range(maps.heads.shape[0]):
        maps.heads[k, slot] = L.FAR
    maps.free_rows[maps.tops[0]] = maps.table[L.ROW_OF, slot]
    maps.table[L.FREE_SLOTS, maps.tops[1]] = slot
    maps.tops[0] += 1
    maps.tops[1] += 1
