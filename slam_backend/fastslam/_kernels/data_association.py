"""Data association of one robot's measurements, for all particles at once.

The first pass of FastSLAM 2.0 matches, at the predicted pose, what is unambiguous; the second matches at the refined
pose, rejects, or starts new landmarks. Between them lost particles are detected, where measurements contradict the
pose, and re-localised with a wide prior.
"""

import math

import numpy as np

from slam_backend.core.jit import device, simd
from slam_backend.core.simd_math import log_of
from slam_backend.core.validation import FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.candidates import (
    begin_choice,
    clear_assigned,
    consider_candidate,
    decide,
    decide_single_candidate,
    mark_assigned,
    mark_present,
    mask_of,
)
from slam_backend.fastslam._kernels.layout import (
    BEST,
    C00,
    C01,
    C10,
    C11,
    C20,
    C21,
    C22,
    CHOSEN,
    CONTRADICT,
    COS,
    KEPT00,
    KEPT01,
    KEPT10,
    KEPT11,
    KEPT20,
    KEPT21,
    KEPT22,
    KEPT_WIDE,
    LANES,
    LOST,
    MAX_DISTANCE,
    Q_D,
    Q_DEPTH,
    Q_DET_POSE,
    Q_FIRST_D,
    Q_HELD,
    REJECTED,
    SECOND,
    SIN,
    SURE,
    WIDE,
)
from slam_backend.fastslam._kernels.map_storage import tile_of
from slam_backend.fastslam._kernels.measurement_model import add_likelihood, evaluate, innovate, match_terms
from slam_backend.fastslam._kernels.pose_posterior import (
    add_terms,
    clear_sums,
    gauss_newton_step,
    robust_weights,
    set_linearisation_point,
    sum_matches,
)

MORE_STEPS = 3  # a wide prior is a long way for one iteration


@device
@simd
def try_inflated_prior(
    work: FloatArray, records: FloatArray, values: FloatArray, counts: Int32Array, row_of: IntArray, block: int,
    points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray, starts: IntArray, slots: IntArray,
    same: IntArray, position_gate: float, one_to_one: bool, recovery: FloatArray,
) -> None:  # fmt: skip
    """Give suspects of one block a wide prior, and keep it where it explains what the stated uncertainty does not."""
    padded, first = counts.shape[1], block * LANES
    inflate_prior(work, recovery)
    reset_counters(work)
    for b in range(len(starts) - 1):
        for q in range(starts[b], starts[b + 1]):
            row = row_of[slots[q]]
            tile = values[tile_of(padded, row, block)]
            if starts[b + 1] - starts[b] > 1 or not (same[q] < 0 or not one_to_one):
                keep_distance(records[q])
            mark_present(records[q], counts[row, first : first + LANES])
            innovate(work, tile, points, noises, b, given, camera)
            evaluate(work, tile, records[q], False)
            update_minimum(work, records[q], q == starts[b])
        if starts[b] < starts[b + 1]:
            count_explained(work, position_gate)
    restore_prior(work)


@device
@simd
def iterate_inflated(
    work: FloatArray, records: FloatArray, match: FloatArray, mask: FloatArray, values: FloatArray, counts: Int32Array,
    row_of: IntArray, block: int, points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray,
    starts: IntArray, slots: IntArray, position_gate: float,
) -> None:  # fmt: skip
    """Take more steps of Gauss-Newton in the lanes of one block whose prior is wide, with the matches as they are."""
    padded = counts.shape[1]
    for _ in range(MORE_STEPS):
        set_linearisation_point(work)
        clear_sums(work)
        for b in range(len(starts) - 1):
            for q in range(starts[b], starts[b + 1]):
                if mask_of(match[b], float(q), mask) > 0:
                    tile = values[tile_of(padded, row_of[slots[q]], block)]
                    innovate(work, tile, points, noises, b, given, camera)
                    evaluate(work, tile, records[q], True)
                    robust_weights(records[q], match[b], float(q), position_gate, mask)
                    sum_matches(work, records[q], mask)
        gauss_newton_step(work, True)


MIN_CONTRADICTIONS = 3.0  # three points fix a pose with one to spare


@device
@simd
def reset_counters(work: FloatArray) -> None:
    for i in range(LANES):
        work[SURE + i] = 0.0
        work[CONTRADICT + i] = 0.0


@device
@simd
def update_minimum(work: FloatArray, record: FloatArray, begin: bool) -> None:
    """Fold candidate after candidate: BEST = least D at hand of those held, SECOND = least of the D kept before."""
    for i in range(LANES):
        held = record[Q_HELD + i] > 0.0
        now, before = record[Q_D + i] if held else np.inf, record[Q_FIRST_D + i] if held else np.inf
        work[BEST + i] = now if begin or now < work[BEST + i] else work[BEST + i]
        work[SECOND + i] = before if begin or before < work[SECOND + i] else work[SECOND + i]
        work[CHOSEN + i] = 1.0 if held else (0.0 if begin else work[CHOSEN + i])


@device
@simd
def count_unexplained(work: FloatArray, gate: float) -> None:
    """Count a measurement that has candidates, none of which explains it at the predicted pose."""
    for i in range(LANES):
        work[CONTRADICT + i] += 1.0 if work[CHOSEN + i] > 0.0 and not work[BEST + i] <= gate else 0.0


@device
@simd
def count_explained(work: FloatArray, gate: float) -> None:
    """Count a measurement that the wide prior explains, and whether the narrow one did not."""
    for i in range(LANES):
        sure = work[BEST + i] <= gate
        work[SURE + i] += 1.0 if sure else 0.0
        work[CONTRADICT + i] += 1.0 if sure and not work[SECOND + i] <= gate else 0.0


@device
@simd
def count_lost(work: FloatArray) -> int:
    """Return in how many lanes enough is unexplained."""
    count = 0
    for i in range(LANES):
        count += 1 if work[CONTRADICT + i] >= MIN_CONTRADICTIONS else 0
    return count


@device
@simd
def inflate_prior(work: FloatArray, recovery: FloatArray) -> None:
    """Keep the factor C, and where enough is unexplained try T diag(recovery), T the turn by the predicted heading."""
    for i in range(LANES):
        work[KEPT00 + i], work[KEPT01 + i] = work[C00 + i], work[C01 + i]
        work[KEPT10 + i], work[KEPT11 + i] = work[C10 + i], work[C11 + i]
        work[KEPT20 + i], work[KEPT21 + i], work[KEPT22 + i] = work[C20 + i], work[C21 + i], work[C22 + i]
        work[KEPT_WIDE + i] = work[WIDE + i]
        suspect = work[CONTRADICT + i] >= MIN_CONTRADICTIONS
        c, s = work[COS + i], work[SIN + i]
        work[LOST + i] = 1.0 if suspect else 0.0
        work[WIDE + i] = 1.0 if suspect else work[WIDE + i]
        work[C00 + i] = c * recovery[0] if suspect else work[C00 + i]
        work[C01 + i] = -s * recovery[1] if suspect else work[C01 + i]
        work[C10 + i] = s * recovery[0] if suspect else work[C10 + i]
        work[C11 + i] = c * recovery[1] if suspect else work[C11 + i]
        work[C20 + i] = 0.0 if suspect else work[C20 + i]
        work[C21 + i] = 0.0 if suspect else work[C21 + i]
        work[C22 + i] = recovery[2] if suspect else work[C22 + i]


@device
@simd
def restore_prior(work: FloatArray) -> int:
    """Give the kept factor back to suspects that are not lost after all; return how many those are."""
    count = 0
    for i in range(LANES):
        lost = work[CONTRADICT + i] >= MIN_CONTRADICTIONS and 2.0 * work[CONTRADICT + i] > work[SURE + i]
        back = work[LOST + i] > 0.0 and not lost
        work[C00 + i] = work[KEPT00 + i] if back else work[C00 + i]
        work[C01 + i] = work[KEPT01 + i] if back else work[C01 + i]
        work[C10 + i] = work[KEPT10 + i] if back else work[C10 + i]
        work[C11 + i] = work[KEPT11 + i] if back else work[C11 + i]
        work[C20 + i] = work[KEPT20 + i] if back else work[C20 + i]
        work[C21 + i] = work[KEPT21 + i] if back else work[C21 + i]
        work[C22 + i] = work[KEPT22 + i] if back else work[C22 + i]
        work[WIDE + i] = work[KEPT_WIDE + i] if back else work[WIDE + i]
        count += 1 if back else 0
    return count


@device
@simd
def associate_initial(
    work: FloatArray, records: FloatArray, match: FloatArray, mask: FloatArray, values: FloatArray, counts: Int32Array,
    row_of: IntArray, block: int, points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray,
    starts: IntArray, slots: IntArray, looks: FloatArray, owners: IntArray, same: IntArray, named: bool,
    position_gate: float, ambiguity: float, one_to_one: bool,
) -> None:  # fmt: skip
    """Pass A for one block: match at the predicted pose what is beyond doubt, sum it, and count what is unexplained."""
    padded, first = counts.shape[1], block * LANES
    reach = MAX_DISTANCE if named else position_gate
    clear_sums(work)
    reset_counters(work)
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
            mark_present(records[q], counts[row, first : first + LANES])
            innovate(work, tile, points, noises, b, given, camera)
            evaluate(work, tile, records[q], False)
            _consider(work, records[q], float(q), looks[q], reach)
        _end_choice(work, match[b], ambiguity)
        for q in range(low, high):
            p = same[q] if one_to_one else REJECTED
            while p >= 0:
                _exclude_assigned(match[b], float(q), match[owners[p]], float(p))
                p = same[p]
            if robust_weights(records[q], match[b], float(q), position_gate, mask) > 0:
                sum_matches(work, records[q], mask)
            keep_distance(records[q])
        for q in range(low, high):  # the choice is made: rows BEST and CHOSEN are free
            update_minimum(work, records[q], q == low)
        if low < high:
            count_unexplained(work, position_gate)


@device
@simd
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
@simd
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
@simd
def _end_choice(work: FloatArray, chosen: FloatArray, ambiguity: float) -> None:
    """Write the tentative match of each lane: the best candidate, if no other comes near."""
    for i in range(len(chosen)):
        second = work[SECOND + i]
        clear = second == np.inf or second - work[BEST + i] >= ambiguity
        chosen[i] = work[CHOSEN + i] if clear else -1.0


@device
@simd
def _exclude_assigned(chosen: FloatArray, q: float, earlier: FloatArray, p: float) -> None:
    """Unmatch lanes in which an earlier measurement took, as its candidate p, the landmark that is candidate q here."""
    for i in range(len(chosen)):
        chosen[i] = -1.0 if chosen[i] == q and earlier[i] == p else chosen[i]


@device
@simd
def keep_distance(record: FloatArray) -> None:
    """Keep the squared distance at the predicted pose: it is the NIS."""
    for i in range(LANES):
        record[Q_FIRST_D + i] = record[Q_D + i]


@device
@simd
def associate_final(
    work: FloatArray, records: FloatArray, match: FloatArray, mask: FloatArray, values: FloatArray, counts: Int32Array,
    row_of: IntArray, block: int, points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray,
    starts: IntArray, slots: IntArray, looks: FloatArray, owners: IntArray, same: IntArray, named: bool,
    position_gate: float, new_landmark_gate: float, new_landmark_radius: float, ambiguity: float, log_p0: float,
    one_to_one: bool,
) -> None:  # fmt: skip
    """Pass B for one block: decide on all measurements, and sum what they say of the pose and of its likelihood."""
    padded, first = counts.shape[1], block * LANES
    reach, cap = (MAX_DISTANCE, position_gate) if named else (position_gate, MAX_DISTANCE)
    clear_sums(work)
    for b in range(len(starts) - 1):
        low, high = starts[b], starts[b + 1]
        log_clutter = log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))
        if high - low == 1:
            row = row_of[slots[low]]
            tile = values[tile_of(padded, row, block)]
            _mark_all_assigned(work, match, owners, same, low, one_to_one)
            innovate(work, tile, points, noises, b, given, camera)
            decide_single_candidate(
                work, tile, counts[row, first : first + LANES], match[b], float(low), reach,
                MAX_DISTANCE if named else new_landmark_gate, new_landmark_radius, log_clutter,
            )  # fmt: skip
            continue
        begin_choice(work)
        for q in range(low, high):
            _mark_all_assigned(work, match, owners, same, q, one_to_one)
            tile = values[tile_of(padded, row_of[slots[q]], block)]
            innovate(work, tile, points, noises, b, given, camera)
            evaluate(work, tile, records[q], True)
            consider_candidate(
                work, records[q], float(q), looks[q], cap, position_gate, new_landmark_gate, new_landmark_radius
            )
        decide(work, match[b], ambiguity, log_clutter)
        for q in range(low, high):
            if mask_of(match[b], float(q), mask) > 0:
                sum_matches(work, records[q], mask)
                add_likelihood(work, records[q], mask)


@device
@simd
def _mark_all_assigned(
    work: FloatArray, match: FloatArray, owners: IntArray, same: IntArray, q: int, one_to_one: bool
) -> None:
    """Write row TAKEN: where an earlier measurement has taken the landmark that is candidate q."""
    clear_assigned(work)
    p = same[q] if one_to_one else REJECTED
    while p >= 0:
        mark_assigned(work, match[owners[p]], float(p))
        p = same[p]
