"""Candidate landmarks of a measurement, by descriptor or identity, for all particles; how they compete for it."""

import numpy as np

from slam_backend.core.jit import device, jit_fma, simd, simd_inline, stack_array
from slam_backend.core.simd_math import WIDE, added_up, log_of
from slam_backend.core.validation import Float32Array, FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.layout import (
    BEST,
    CHOSEN,
    CLUTTER,
    DEAD,
    LANES,
    LOG_2PI,
    LOG_BEST,
    Q_D,
    Q_DEPTH,
    Q_DET_POSE,
    Q_HELD,
    Q_METRES2,
    REJECTED,
    SECOND,
    TAKEN,
)
from slam_backend.fastslam._kernels.measurement_model import accumulate_likelihood, match_terms
from slam_backend.fastslam._kernels.pose_posterior import add_terms

RUN = 64  # descriptors looked at together


@device
@simd
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
@simd
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
@jit_fma
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


@device
@simd
def decide_single_candidate(
    work: FloatArray, tile: FloatArray, seen: Int32Array, match: FloatArray, q: float,
    reach: float, new_landmark_gate: float, new_landmark_radius: float, log_clutter: float,
) -> None:  # fmt: skip
    """Pass B for a measurement with one candidate: match, reject or start, and sum.

    Row TAKEN says where an earlier measurement has taken the landmark; for `reach` see `_match_alone`.
    """
    radius2 = new_landmark_radius * new_landmark_radius
    for i in range(LANES):
        j00, j01, j02, j11, j12, j22, g0, g1, g2, square, det, _, depth, metres2, distance = match_terms(
            work, tile, i, True
        )
        front = (seen[i] > 0) & (distance < np.inf)  # "and" would make a branch of it, and of all that follows
        near = front & ((distance <= new_landmark_gate) | (metres2 <= radius2))
        ok = front & (distance <= reach) & (work[TAKEN + i] == 0.0)
        match[i] = q if ok else (-1.0 if near else -2.0)
        work[CLUTTER + i] += 0.0 if ok else log_clutter
        add_terms(work, i, ok, 1.0, j00, j01, j02, j11, j12, j22, g0, g1, g2)
        accumulate_likelihood(work, i, ok, square, det, depth)


@device
@simd
def begin_choice(work: FloatArray) -> None:
    for i in range(LANES):
        work[BEST + i] = np.inf
        work[SECOND + i] = np.inf
        work[CHOSEN + i] = -1.0
        work[DEAD + i] = 0.0
        work[LOG_BEST + i] = 0.0


@device
@simd
def mark_assigned(work: FloatArray, earlier: FloatArray, p: float) -> None:
    for i in range(len(earlier)):
        work[TAKEN + i] = 1.0 if earlier[i] == p else work[TAKEN + i]


@device
@simd
def clear_assigned(work: FloatArray) -> None:
    for i in range(LANES):
        work[TAKEN + i] = 0.0


@device
@simd
def consider_candidate(
    work: FloatArray, record: FloatArray, q: float, look: float, cap: float, gate: float, new_landmark_gate: float,
    new_landmark_radius: float,
) -> None:  # fmt: skip
    """Let candidate q compete for the measurement in pass B, unless row TAKEN says that its landmark is taken.

    D counts no more than `cap`: the gate where the caller names the landmarks.
    """
    radius2 = new_landmark_radius * new_landmark_radius
    for i in range(LANES):
        distance = record[Q_D + i]
        front = (record[Q_HELD + i] > 0.0) & (distance < np.inf)
        distance = cap if distance > cap else distance
        near = front & ((distance <= new_landmark_gate) | (record[Q_METRES2 + i] <= radius2))
        ok = front & (distance <= gate) & (work[TAKEN + i] == 0.0)
        work[DEAD + i] = 1.0 if near else work[DEAD + i]
        depth = record[Q_DEPTH + i]
        log_det = log_of(record[Q_DET_POSE + i] if ok else 1.0) - 8.0 * log_of(depth if ok else 1.0)
        cost = distance + log_det + look if ok else np.inf
        best, second = work[BEST + i], work[SECOND + i]
        better = cost < best
        work[SECOND + i] = best if better else (cost if cost < second else second)
        work[BEST + i] = cost if better else best
        work[CHOSEN + i] = q if better else work[CHOSEN + i]
        work[LOG_BEST + i] = -0.5 * (distance + log_det + 3.0 * LOG_2PI) if better else work[LOG_BEST + i]


@device
@simd
def decide(work: FloatArray, match: FloatArray, ambiguity: float, log_clutter: float) -> None:
    """Write the candidate matched, -1 for rejected or -2 for new, and the log-likelihood of what is not matched."""
    for i in range(LANES):
        chosen, best, second = work[CHOSEN + i], work[BEST + i], work[SECOND + i]
        matched = chosen >= 0.0
        held_back = matched and second < np.inf and second - best < ambiguity
        dead = work[DEAD + i] > 0.0
        match[i] = (-1.0 if held_back else chosen) if matched else (-1.0 if dead else -2.0)
        work[CLUTTER + i] += (work[LOG_BEST + i] if held_back else 0.0) if matched else log_clutter


@device
@simd
def mask_of(match: FloatArray, code: float, mask: FloatArray) -> int:
    """Write 1 where `match` equals `code`, else 0; return how many."""
    count = 0
    for i in range(len(match)):
        on = match[i] == code
        mask[i] = 1.0 if on else 0.0
        count += 1 if on else 0
    return count


@device
@simd
def mark_present(record: FloatArray, seen: Int32Array) -> None:
    for i in range(len(seen)):
        record[Q_HELD + i] = 1.0 if seen[i] > 0 else 0.0


@device
@simd
def mark_eligible(chosen: FloatArray, seen: Int32Array, mask: FloatArray) -> None:
    """Write 1 where the measurement is still without a match and the particle holds the candidate."""
    for i in range(len(chosen)):
        mask[i] = 1.0 if chosen[i] == -2.0 and seen[i] > 0 else 0.0


@device
@simd
def exclude_assigned(earlier: FloatArray, p: float, mask: FloatArray) -> None:
    for i in range(len(earlier)):
        mask[i] = 0.0 if earlier[i] == p else mask[i]


@device
@simd
def mask_padding(match: FloatArray, real: int) -> None:
    """Let the surplus lanes of the last block start no landmark."""
    for b in range(len(match)):
        for i in range(real, LANES):
            match[b, i] = -1.0


@device
@simd
def start_none_held(match: FloatArray, seen: Int32Array) -> None:
    """Let a named measurement start no landmark in lanes that hold the one of its name, wherever they predict it."""
    for i in range(len(match)):
        match[i] = -1.0 if match[i] == -2.0 and seen[i] > 0 else match[i]


@simd
def start_none_again(match: FloatArray, earlier: FloatArray) -> None:
    """Let a named measurement start no landmark in lanes in which an earlier one of its name and frame starts it."""
    for i in range(len(match)):
        match[i] = -1.0 if match[i] == -2.0 and earlier[i] == -2.0 else match[i]


@simd
def create_once(
    match: FloatArray, b: int, first: int, counts: Int32Array, row_of: IntArray, starts: IntArray, slots: IntArray,
    names: IntArray,
) -> None:  # fmt: skip
    """Let no lane of a block, of particles from `first` on, hold two landmarks of the name of measurement b."""
    for q in range(starts[b], starts[b + 1]):
        start_none_held(match[b], counts[row_of[slots[q]], first : first + LANES])
    for a in range(b):
        if names[a] == names[b]:
            start_none_again(match[b], match[a])


@simd
def write_associations(
    found: Int32Array, distances: FloatArray, first: int, match: FloatArray, starts: IntArray, slots: IntArray,
    records: FloatArray, row: int, new_slots: IntArray,
) -> None:  # fmt: skip
    """Write a block's slots (or -1) and squared distances (or NaN): these are in that row of the records."""
    for b in range(len(match)):
        own, chosen, new_slot = found[b, first : first + LANES], match[b], new_slots[b]
        squares = distances[b, first : first + LANES]
        for i in range(LANES):
            own[i] = new_slot if chosen[i] == -2.0 else REJECTED
            squares[i] = np.nan
        for q in range(starts[b], starts[b + 1]):
            of_candidate, slot, code = records[q, row : row + LANES], slots[q], float(q)
            for i in range(LANES):
                on = chosen[i] == code
                own[i] = slot if on else own[i]
                squares[i] = of_candidate[i] if on else squares[i]
