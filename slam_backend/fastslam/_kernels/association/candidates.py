"""Candidate landmarks of a measurement, by descriptor or identity, for all particles; how they compete for it."""

from typing import Any

import numpy as np

from slam_backend.core.jit import device, jit_fma, simd, simd_inline, stack_array
from slam_backend.core.simd_math import WIDE, added_up, log_of
from slam_backend.core.validation import Float32Array, FloatArray, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.records import Candidates, Frame, MapArrays, Outcome

RUN = 64  # descriptors compared in one run


@device
@simd
def _near_heads(
    measured: Float32Array, b: int, heads: Float32Array, stride: int, limit: float, partial: Float32Array,
    hits: IntArray,
) -> int:  # fmt: skip
    """Find stored descriptors near a measured one, by every `stride`-th component; return their number.

    Args:
        measured, b: Descriptors of the frame, and the row of the measured one.
        heads: (h, slots) components of the stored descriptors.
        stride: Step between the components compared.
        limit: Largest squared distance.
        partial: (n,), written: the squared distances of the first n slots.
        hits: (> n,), written: the slots up to the limit, ascending. Runs without one are skipped.
    """
    n, count = len(partial), 0
    for slot in range(n):
        partial[slot] = np.float32(0.0)
    whole = heads.shape[0] // 4 * 4
    for k in range(0, whole, 4):
        v0, v1 = measured[b, k * stride], measured[b, (k + 1) * stride]
        v2, v3 = measured[b, (k + 2) * stride], measured[b, (k + 3) * stride]
        row0, row1 = heads[k, :n], heads[k + 1, :n]
        row2, row3 = heads[k + 2, :n], heads[k + 3, :n]
        for slot in range(n):
            d0, d1, d2, d3 = v0 - row0[slot], v1 - row1[slot], v2 - row2[slot], v3 - row3[slot]
            partial[slot] += (d0 * d0 + d1 * d1) + (d2 * d2 + d3 * d3)
    for k in range(whole, heads.shape[0]):
        value = measured[b, k * stride]
        row = heads[k, :n]
        for slot in range(n):
            difference = value - row[slot]
            partial[slot] += difference * difference
    most = np.float32(limit)
    for begin in range(0, n, RUN):
        run = partial[begin : min(begin + RUN, n)]
        inside = 0
        for i in range(len(run)):
            inside += 1 if run[i] <= most else 0
        if inside > 0:  # without branches, for none could be foreseen
            for i in range(len(run)):
                hits[count] = begin + i
                count += 1 if run[i] <= most else 0
    return count


@device
@simd_inline
def _squared_distance(measured: Float32Array, b: int, stored: Float32Array, slot: int) -> float:
    """Return the squared distance of two descriptors, in double precision and in a fixed order."""
    sums, size = stack_array(WIDE), measured.shape[1]
    rest = size - size % WIDE
    for i in range(WIDE):
        sums[i] = 0.0
    for j in range(0, rest, WIDE):
        for i in range(WIDE):
            difference = np.float64(measured[b, j + i]) - np.float64(stored[slot, j + i])
            sums[i] += difference * difference
    total = added_up(sums)
    for j in range(rest, size):
        difference = np.float64(measured[b, j]) - np.float64(stored[slot, j])
        total += difference * difference
    return total


@device
@jit_fma
def find_candidates(frame: Frame, maps: MapArrays, rules: Any) -> tuple[Candidates, IntArray]:
    """List for each measurement the landmarks that may have caused it, nearest descriptor first.

    Some components alone rule most landmarks out, for all particles at once; the others are compared in full. Equal
    distances are ordered by the ids of the landmarks.

    Args:
        frame: Measurements of the robot.
        maps: Landmarks.
        rules: `kernel_options`, of which E0 is the largest admitted squared distance of descriptors.

    Returns:
        The candidates, and the slots among them, each once.
    """
    measured, measured_ids, identities, ids = (
        frame.descriptors,
        frame.identities,
        maps.table[L.IDENTITIES],
        maps.table[L.IDS],
    )
    num, n, gate = measured.shape[0], len(ids), rules.descriptor_gate_squared
    while n > 0 and ids[n - 1] < 0:
        n -= 1
    stride = measured.shape[1] // max(maps.heads.shape[0], 1)
    limit = 1.0001 * gate + 1e-4  # rounding of single precision decides nothing
    most = num * n
    starts = np.zeros(num + 1, dtype=np.int64)
    listed, squares = np.empty((4, most), dtype=np.int64), np.empty(most)  # as far as they are written to
    slots, owners, same, unique = listed[0], listed[1], listed[2], listed[3]
    partial, hits = np.empty(n, dtype=np.float32), np.empty(n + 1, dtype=np.int64)
    last = np.empty(n, dtype=np.int64)
    total = 0
    for b in range(num):
        starts[b] = total
        if frame.identified:
            count = 0
            for slot in range(n):
                if identities[slot] == measured_ids[b] and ids[slot] >= 0:
                    hits[count] = slot
                    count += 1
        else:
            count = _near_heads(measured, b, maps.heads, stride, limit, partial, hits)
        for k in range(count):
            slot = hits[k]
            if ids[slot] < 0:
                continue
            e = _squared_distance(measured, b, maps.descriptors, slot)
            if e > gate and not frame.identified:
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
        last[slots[q]] = L.REJECTED
    count = 0
    for b in range(num):
        for q in range(starts[b], starts[b + 1]):
            owners[q] = b
            slot = slots[q]
            same[q] = last[slot]
            if last[slot] == L.REJECTED:
                unique[count] = slot
                count += 1
            last[slot] = q
    return Candidates(starts, slots[:total], squares[:total], owners[:total], same[:total]), unique[:count]


@device
@simd
def begin_choice(work: FloatArray) -> None:
    """Clear the rows by which candidates compete for one measurement."""
    for i in range(LANES):
        work[L.BEST_COST + i] = np.inf
        work[L.SECOND_COST + i] = np.inf
        work[L.CHOSEN + i] = L.NO_MATCH
        work[L.DEAD_ZONE + i] = 0.0
        work[L.LOG_BEST + i] = 0.0
        work[L.TAKEN + i] = 0.0


@device
@simd
def mark_assigned(work: FloatArray, match: FloatArray, candidates: Candidates, q: int, one_to_one: bool) -> None:
    """Write row TAKEN: 1 where an earlier measurement has taken the landmark that is candidate q."""
    for i in range(LANES):
        work[L.TAKEN + i] = 0.0
    p = candidates.same[q] if one_to_one else L.REJECTED
    while p >= 0:
        earlier, code = match[candidates.owners[p]], float(p)
        for i in range(len(earlier)):
            work[L.TAKEN + i] = 1.0 if earlier[i] == code else work[L.TAKEN + i]
        p = candidates.same[p]


@device
@simd
def consider(
    work: FloatArray, record: FloatArray, q: float, descriptor_cost: float, cap: float, reach: float,
    new_landmark_gate: float, new_landmark_radius: float,
) -> None:  # fmt: skip
    """Let candidate q compete for the measurement, unless row TAKEN says that its landmark is taken.

    Its cost is D + log |S + A P A^T| + descriptor cost, with the uncertainty P of the pose as in D: -2 times the
    log-likelihood of image coordinates and descriptor up to a constant. Of two that cost the same the first, whose
    descriptor is nearer, wins.

    Args:
        work, record: Rows of the block and of the candidate.
        q: Number of the candidate.
        descriptor_cost: Squared distance of its descriptor in units of the descriptor variance.
        cap: Largest D that is counted: the gate where the caller identifies the landmarks and identities decide.
        reach: Largest D that may match.
        new_landmark_gate, new_landmark_radius: See `FilterOptions`.
    """
    radius2 = new_landmark_radius * new_landmark_radius
    for i in range(LANES):
        distance = record[L.Q_D + i]
        front = (record[L.Q_HELD + i] > 0.0) & (distance < np.inf)
        distance = cap if distance > cap else distance
        near = front & ((distance <= new_landmark_gate) | (record[L.Q_METRES2 + i] <= radius2))
        ok = front & (distance <= reach) & (work[L.TAKEN + i] == 0.0)
        work[L.DEAD_ZONE + i] = 1.0 if near else work[L.DEAD_ZONE + i]
        depth = record[L.Q_DEPTH + i]
        # |S| of image coordinates: that of metres over Z^8, see the package docstring
        log_det = log_of(record[L.Q_DET_POSE + i] if ok else 1.0) - 8.0 * log_of(depth if ok else 1.0)
        cost = distance + log_det + descriptor_cost if ok else np.inf
        best, second = work[L.BEST_COST + i], work[L.SECOND_COST + i]
        better = cost < best
        work[L.SECOND_COST + i] = best if better else (cost if cost < second else second)
        work[L.BEST_COST + i] = cost if better else best
        work[L.CHOSEN + i] = q if better else work[L.CHOSEN + i]
        work[L.LOG_BEST + i] = -0.5 * (distance + log_det + 3.0 * L.LOG_2PI) if better else work[L.LOG_BEST + i]


@device
@simd
def mask_of(match: FloatArray, code: float, mask: FloatArray) -> int:
    """Write 1 where `match` equals `code`, else 0; return the number of ones."""
    count = 0
    for i in range(len(match)):
        on = match[i] == code
        mask[i] = 1.0 if on else 0.0
        count += 1 if on else 0
    return count


@device
@simd
def create_once(
    match: FloatArray, b: int, first: int, maps: MapArrays, candidates: Candidates, identities: IntArray
) -> None:
    """Keep the identity of measurement b unique in each lane of a block, of particles from `first` on.

    The measurement starts no landmark in lanes that hold the landmark of its identity, wherever they predict it, nor in
    lanes in which an earlier measurement of that identity starts one.
    """
    row_of, chosen = maps.table[L.ROW_OF], match[b]
    for q in range(candidates.starts[b], candidates.starts[b + 1]):
        seen = maps.counts[row_of[candidates.slots[q]], first : first + LANES]
        for i in range(len(chosen)):
            chosen[i] = L.NO_MATCH if chosen[i] == L.NEW_LANDMARK and seen[i] > 0 else chosen[i]
    for a in range(b):
        if identities[a] == identities[b]:
            earlier = match[a]
            for i in range(len(chosen)):
                chosen[i] = L.NO_MATCH if chosen[i] == L.NEW_LANDMARK and earlier[i] == L.NEW_LANDMARK else chosen[i]


@device
@simd
def write_associations(
    outcome: Outcome, first: int, match: FloatArray, candidates: Candidates, records: FloatArray, row: int
) -> None:
    """Write the slots and squared distances of a block, of particles from `first` on, into the outcome.

    The distances are in that row of the records.
    """
    for b in range(len(match)):
        own, chosen, new_slot = outcome.found[b, first : first + LANES], match[b], outcome.new_slots[b]
        squares = outcome.distances[b, first : first + LANES]
        for i in range(LANES):
            own[i] = new_slot if chosen[i] == L.NEW_LANDMARK else L.REJECTED
            squares[i] = np.nan
        for q in range(candidates.starts[b], candidates.starts[b + 1]):
            of_candidate, slot, code = records[q, row : row + LANES], candidates.slots[q], float(q)
            for i in range(LANES):
                on = chosen[i] == code
                own[i] = slot if on else own[i]
                squares[i] = of_candidate[i] if on else squares[i]
