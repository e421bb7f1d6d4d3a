"""Which landmark a measurement is of, lane by lane: candidates compete, and what is taken or ambiguous falls out."""

import numpy as np

from slam_backend._jit import device, lanes
from slam_backend._kernels.innovations import match_terms
from slam_backend._kernels.lane_math import log_of
from slam_backend._kernels.layout import (
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
from slam_backend._kernels.likelihoods import count_likelihood
from slam_backend._kernels.pose_system import add_terms
from slam_backend.errors import FloatArray, Int32Array, IntArray


@device
@lanes
def decide_alone(
    work: FloatArray, tile: FloatArray, seen: Int32Array, match: FloatArray, q: float,
    reach: float, dead_zone: float, dead_radius: float, log_clutter: float,
) -> None:  # fmt: skip
    """Pass B for a measurement with one candidate: match, reject or start, and sum.

    Row TAKEN says where an earlier measurement has taken the landmark; for `reach` see `_match_alone`.
    """
    radius2 = dead_radius * dead_radius
    for i in range(LANES):
        j00, j01, j02, j11, j12, j22, g0, g1, g2, square, det, _, depth, metres2, distance = match_terms(
            work, tile, i, True
        )
        front = (seen[i] > 0) & (distance < np.inf)  # "and" would make a branch of it, and of all that follows
        near = front & ((distance <= dead_zone) | (metres2 <= radius2))
        ok = front & (distance <= reach) & (work[TAKEN + i] == 0.0)
        match[i] = q if ok else (-1.0 if near else -2.0)
        work[CLUTTER + i] += 0.0 if ok else log_clutter
        add_terms(work, i, ok, 1.0, j00, j01, j02, j11, j12, j22, g0, g1, g2)
        count_likelihood(work, i, ok, square, det, depth)


@device
@lanes
def begin_choice(work: FloatArray) -> None:
    for i in range(LANES):
        work[BEST + i] = np.inf
        work[SECOND + i] = np.inf
        work[CHOSEN + i] = -1.0
        work[DEAD + i] = 0.0
        work[LOG_BEST + i] = 0.0


@device
@lanes
def mark_taken(work: FloatArray, earlier: FloatArray, p: float) -> None:
    for i in range(len(earlier)):
        work[TAKEN + i] = 1.0 if earlier[i] == p else work[TAKEN + i]


@device
@lanes
def clear_taken(work: FloatArray) -> None:
    for i in range(LANES):
        work[TAKEN + i] = 0.0


@device
@lanes
def consider_again(
    work: FloatArray, record: FloatArray, q: float, look: float, cap: float, gate: float, dead_zone: float,
    dead_radius: float,
) -> None:  # fmt: skip
    """Let candidate q compete for the measurement in pass B, unless row TAKEN says that its landmark is taken.

    D counts no more than `cap`: the gate where the caller names the landmarks.
    """
    radius2 = dead_radius * dead_radius
    for i in range(LANES):
        distance = record[Q_D + i]
        front = (record[Q_HELD + i] > 0.0) & (distance < np.inf)
        distance = cap if distance > cap else distance
        near = front & ((distance <= dead_zone) | (record[Q_METRES2 + i] <= radius2))
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
@lanes
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
@lanes
def mask_of(match: FloatArray, code: float, mask: FloatArray) -> int:
    """Write 1 where `match` equals `code`, else 0; return how many."""
    count = 0
    for i in range(len(match)):
        on = match[i] == code
        mask[i] = 1.0 if on else 0.0
        count += 1 if on else 0
    return count


@device
@lanes
def mark_held(record: FloatArray, seen: Int32Array) -> None:
    for i in range(len(seen)):
        record[Q_HELD + i] = 1.0 if seen[i] > 0 else 0.0


@device
@lanes
def admit(chosen: FloatArray, seen: Int32Array, mask: FloatArray) -> None:
    """Write 1 where the measurement is still without a match and the particle holds the candidate."""
    for i in range(len(chosen)):
        mask[i] = 1.0 if chosen[i] == -2.0 and seen[i] > 0 else 0.0


@device
@lanes
def bar_taken(earlier: FloatArray, p: float, mask: FloatArray) -> None:
    for i in range(len(earlier)):
        mask[i] = 0.0 if earlier[i] == p else mask[i]


@device
@lanes
def start_none_beyond(match: FloatArray, real: int) -> None:
    """Let the surplus lanes of the last block start no landmark."""
    for b in range(len(match)):
        for i in range(real, LANES):
            match[b, i] = -1.0


@device
@lanes
def start_none_held(match: FloatArray, seen: Int32Array) -> None:
    """Let a named measurement start no landmark in lanes that hold the one of its name, wherever they predict it."""
    for i in range(len(match)):
        match[i] = -1.0 if match[i] == -2.0 and seen[i] > 0 else match[i]


@lanes
def start_none_again(match: FloatArray, earlier: FloatArray) -> None:
    """Let a named measurement start no landmark in lanes in which an earlier one of its name and frame starts it."""
    for i in range(len(match)):
        match[i] = -1.0 if match[i] == -2.0 and earlier[i] == -2.0 else match[i]


@lanes
def start_once(
    match: FloatArray, b: int, first: int, counts: Int32Array, row_of: IntArray, starts: IntArray, slots: IntArray,
    names: IntArray,
) -> None:  # fmt: skip
    """Let no lane of a block, of particles from `first` on, hold two landmarks of the name of measurement b."""
    for q in range(starts[b], starts[b + 1]):
        start_none_held(match[b], counts[row_of[slots[q]], first : first + LANES])
    for a in range(b):
        if names[a] == names[b]:
            start_none_again(match[b], match[a])


@lanes
def write_found(
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
