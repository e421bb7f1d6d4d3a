"""Pass A of FastSLAM 2.0: matched at the predicted pose is what is beyond doubt."""

import numpy as np

from slam_backend._jit import device, lanes
from slam_backend._kernels.choices import begin_choice, mark_held
from slam_backend._kernels.innovations import evaluate, innovate, match_terms
from slam_backend._kernels.lane_math import log_of
from slam_backend._kernels.layout import (
    BEST,
    CHOSEN,
    CONTRADICT,
    FARTHEST,
    LANES,
    Q_D,
    Q_DEPTH,
    Q_DET_POSE,
    Q_FIRST_D,
    Q_HELD,
    REJECTED,
    SECOND,
)
from slam_backend._kernels.places import tile_of
from slam_backend._kernels.pose_system import add_terms, clear_sums, robust_weights, sum_matches
from slam_backend._kernels.recovery import begin_judging, count_unexplained, nearest
from slam_backend.errors import FloatArray, Int32Array, IntArray


@device
@lanes
def match_first(
    work: FloatArray, records: FloatArray, match: FloatArray, mask: FloatArray, values: FloatArray, counts: Int32Array,
    row_of: IntArray, block: int, points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray,
    starts: IntArray, slots: IntArray, looks: FloatArray, owners: IntArray, same: IntArray, named: bool,
    position_gate: float, ambiguity: float, one_to_one: bool,
) -> None:  # fmt: skip
    """Pass A for one block: match at the predicted pose what is beyond doubt, sum it, and count what is unexplained."""
    padded, first = counts.shape[1], block * LANES
    reach = FARTHEST if named else position_gate
    clear_sums(work)
    begin_judging(work)
    for b in range(len(starts) - 1):
        low, high = starts[b], starts[b + 1]
        if high - low == 1 and (same[low] < 0 or not one_to_one):
            row = row_of[slots[low]]
            tile = values[tile_of(padded, row, block)]
            innovate(work, tile, points, noises, b, given, camera)
            _match_alone(
                work, tile, records[low], counts[row, first : first + LANES], match[b], float(low), reach, position_gate
            )
            continue
        begin_choice(work)
        for q in range(low, high):
            row = row_of[slots[q]]
            tile = values[tile_of(padded, row, block)]
            mark_held(records[q], counts[row, first : first + LANES])
            innovate(work, tile, points, noises, b, given, camera)
            evaluate(work, tile, records[q], False)
            _consider(work, records[q], float(q), looks[q], reach)
        _end_choice(work, match[b], ambiguity)
        for q in range(low, high):
            p = same[q] if one_to_one else REJECTED
            while p >= 0:
                _drop_taken(match[b], float(q), match[owners[p]], float(p))
                p = same[p]
            if robust_weights(records[q], match[b], float(q), position_gate, mask) > 0:
                sum_matches(work, records[q], mask)
            keep_distance(records[q])
        for q in range(low, high):  # the choice is made: rows BEST and CHOSEN are free
            nearest(work, records[q], q == low)
        if low < high:
            count_unexplained(work, position_gate)


@device
@lanes
def _match_alone(
    work: FloatArray, tile: FloatArray, record: FloatArray, seen: Int32Array, match: FloatArray, q: float,
    reach: float, gate: float,
) -> None:  # fmt: skip
    """Pass A for a measurement with one candidate: match, weigh by Cauchy's 1 / (1 + D / gate), sum, and judge.

    `reach` is the largest D that may match: the gate, or any where the caller names the landmarks.
    """
    for i in range(LANES):
        j00, j01, j02, j11, j12, j22, g0, g1, g2, _, _, _, _, _, distance = match_terms(work, tile, i, False)
        held = seen[i] > 0
        inside = distance <= gate
        ok = held and distance <= reach
        match[i] = q if ok else -1.0
        add_terms(work, i, ok, gate / (gate + distance), j00, j01, j02, j11, j12, j22, g0, g1, g2)
        record[Q_FIRST_D + i] = distance
        work[CONTRADICT + i] += 1.0 if held and not inside else 0.0


@device
@lanes
def _consider(work: FloatArray, record: FloatArray, q: float, look: float, reach: float) -> None:
    """Let candidate q compete for the measurement in pass A; `look` is what its descriptor costs."""
    for i in range(LANES):
        distance = record[Q_D + i]
        ok = record[Q_HELD + i] > 0.0 and distance <= reach
        depth = record[Q_DEPTH + i]
        log_det = log_of(record[Q_DET_POSE + i] if ok else 1.0) - 8.0 * log_of(depth if ok else 1.0)
        cost = distance + log_det + look if ok else np.inf
        best, second = work[BEST + i], work[SECOND + i]
        better = cost < best
        work[SECOND + i] = best if better else (cost if cost < second else second)
        work[BEST + i] = cost if better else best
        work[CHOSEN + i] = q if better else work[CHOSEN + i]


@device
@lanes
def _end_choice(work: FloatArray, chosen: FloatArray, ambiguity: float) -> None:
    """Write the tentative match of each lane: the best candidate, if no other comes near."""
    for i in range(len(chosen)):
        second = work[SECOND + i]
        clear = second == np.inf or second - work[BEST + i] >= ambiguity
        chosen[i] = work[CHOSEN + i] if clear else -1.0


@device
@lanes
def _drop_taken(chosen: FloatArray, q: float, earlier: FloatArray, p: float) -> None:
    """Unmatch lanes in which an earlier measurement took, as its candidate p, the landmark that is candidate q here."""
    for i in range(len(chosen)):
        chosen[i] = -1.0 if chosen[i] == q and earlier[i] == p else chosen[i]


@device
@lanes
def keep_distance(record: FloatArray) -> None:
    """Keep the squared distance at the predicted pose: it is the NIS."""
    for i in range(LANES):
        record[Q_FIRST_D + i] = record[Q_D + i]
