"""Which landmarks may have caused a measurement, by their descriptors or names, for all particles at once."""

import numpy as np

from slam_backend._jit import any_order, device, fused, lanes
from slam_backend._kernels.layout import REJECTED
from slam_backend.errors import Float32Array, FloatArray, IntArray

RUN = 64  # descriptors looked at together


@device
@lanes
def _head_distances(
    measured: Float32Array, b: int, heads: Float32Array, stride: int, n: int, out: Float32Array
) -> None:
    """Write the squared distances over every `stride`-th component between a measured and all stored descriptors."""
    for slot in range(n):
        out[slot] = np.float32(0.0)
    whole = heads.shape[0] // 4 * 4
    for k in range(0, whole, 4):
        v0, v1 = measured[b, k * stride], measured[b, (k + 1) * stride]
        v2, v3 = measured[b, (k + 2) * stride], measured[b, (k + 3) * stride]
        row0, row1, row2, row3 = heads[k], heads[k + 1], heads[k + 2], heads[k + 3]
        for slot in range(n):
            d0, d1, d2, d3 = v0 - row0[slot], v1 - row1[slot], v2 - row2[slot], v3 - row3[slot]
            out[slot] += (d0 * d0 + d1 * d1) + (d2 * d2 + d3 * d3)
    for k in range(whole, heads.shape[0]):
        value = measured[b, k * stride]
        row = heads[k]
        for slot in range(n):
            difference = value - row[slot]
            out[slot] += difference * difference


@any_order
def _squared_distance(measured: Float32Array, b: int, stored: Float32Array, slot: int) -> float:
    """Return the squared distance of two descriptors, in double precision."""
    total = 0.0
    for j in range(measured.shape[1]):
        difference = np.float64(measured[b, j]) - np.float64(stored[slot, j])
        total += difference * difference
    return total


@device
@lanes
def _hits(partial: Float32Array, limit: float, hits: IntArray) -> int:
    """Write the indices of the entries up to `limit`, ascending; return how many. Runs without one are skipped."""
    count, n = 0, len(partial)
    for first in range(0, n, RUN):
        last = min(first + RUN, n)
        run = partial[first:last]
        inside = 0
        for i in range(len(run)):
            inside += 1 if run[i] <= limit else 0
        if inside > 0:
            for i in range(len(run)):
                if run[i] <= limit:
                    hits[count] = first + i
                    count += 1
    return count


@device
@fused
def find_candidates(
    measured: Float32Array, stored: Float32Array, heads: Float32Array, ids: IntArray, names: IntArray,
    identities: IntArray, named: bool, gate: float,
) -> tuple[IntArray, IntArray, FloatArray, IntArray, IntArray, IntArray]:  # fmt: skip
    """List for each measurement the landmarks that may have caused it, nearest descriptor first.

    Some components alone rule most landmarks out, for all particles at once; the others are compared in full.

    Args:
        measured: (B, d) descriptors of the frame.
        stored: (n, d) descriptors of the landmarks.
        heads: (h, n) every (d / h)-th component of them; large where the slot is free.
        ids: (n,) stable names of the landmarks, -1 = free; equal distances are ordered by them.
        names: (B,) the caller's names of the measurements, if `named`.
        identities: (n,) the caller's names of the landmarks.
        named: Whether names decide instead of descriptors.
        gate: Largest admitted squared distance E0.

    Returns:
        starts (B + 1,) of each measurement's candidates; per candidate its slot, squared distance E, measurement, and
        the previous candidate with the same slot (-1: none); and all these slots, each once.
    """
    num, n = measured.shape[0], len(ids)
    while n > 0 and ids[n - 1] < 0:
        n -= 1
    starts = np.zeros(num + 1, dtype=np.int64)
    listed, squares = np.empty((4, num * n), dtype=np.int64), np.empty(num * n)  # as far as they are written to
    slots, owners, same, unique = listed[0], listed[1], listed[2], listed[3]
    partial, of_slots = np.empty(n, dtype=np.float32), np.empty((2, n), dtype=np.int64)
    hits, last = of_slots[0], of_slots[1]
    stride = measured.shape[1] // max(heads.shape[0], 1)
    limit = 1.0001 * gate + 1e-4  # rounding of single precision decides nothing
    total = 0
    for b in range(num):
        starts[b] = total
        if named:
            count = 0
            for slot in range(n):
                if identities[slot] == names[b] and ids[slot] >= 0:
                    hits[count] = slot
                    count += 1
        else:
            _head_distances(measured, b, heads, stride, n, partial)
            count = _hits(partial, limit, hits)
        for k in range(count):
            slot = hits[k]
            if ids[slot] < 0:
                continue
            e = _squared_distance(measured, b, stored, slot)
            if e > gate and not named:
                continue
            at = total
            while at > starts[b] and (squares[at - 1] > e or (squares[at - 1] == e and ids[slots[at - 1]] > ids[slot])):
                squares[at] = squares[at - 1]
                slots[at] = slots[at - 1]
                at -= 1
            squares[at] = e
            slots[at] = slot
            total += 1
    starts[num] = total
    for q in range(total):
        last[slots[q]] = REJECTED
    count = 0
    for b in range(num):
        for q in range(starts[b], starts[b + 1]):
            owners[q] = b
            slot = slots[q]
            same[q] = last[slot]
            if last[slot] == REJECTED:
                unique[count] = slot
                count += 1
            last[slot] = q
    return starts, slots[:total], squares[:total], owners[:total], same[:total], unique[:count]
