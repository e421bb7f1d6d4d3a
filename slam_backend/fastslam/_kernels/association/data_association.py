"""Data association of one robot's measurements with FastSLAM 2.0, for all particles at once.

The first pass, `associate_unambiguous`, matches at the predicted pose what is unambiguous, which refines the pose. The
second, `associate_all`, matches, rejects or starts a landmark at the refined pose. In between, particles whose
measurements contradict their pose are re-localised with a wide prior, and get their own prior back where the pose
found with it is not confirmed (`undo_unconfirmed`). The same in plain Python, which is the oracle of
`tests/slam_backend/fastslam/test_filter_reference.py`: `slam_backend.reference.fastslam2`.
"""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, simd, simd_inline
from slam_backend.core.validation import FloatArray, Int32Array
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.association.candidates import begin_choice, consider, mark_assigned, mask_of
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.measurement.measurement_model import (
    accumulate_likelihood,
    clear_likelihood,
    evaluate,
    innovate,
    match_terms,
)
from slam_backend.fastslam._kernels.measurement.pose_posterior import (
    add_terms,
    gauss_newton_step,
    set_linearisation_point,
    sum_matches,
)
from slam_backend.fastslam._kernels.particles.map_storage import tile_of
from slam_backend.fastslam._kernels.records import Candidates, Frame, MapArrays, Space

MORE_STEPS = 3  # further Gauss-Newton iterations where the prior is wide
MIN_CONTRADICTIONS = 3.0  # three points fix a pose with one to spare


@device
@simd
def _judge_nearest(work: FloatArray, record: FloatArray, begin: bool) -> None:
    """Fold in one candidate: LEAST_D = least D of landmarks held, LEAST_FIRST_D = least D of the evaluation before."""
    for i in range(LANES):
        held = record[L.Q_HELD + i] > 0.0
        now, before = record[L.Q_D + i] if held else np.inf, record[L.Q_FIRST_D + i] if held else np.inf
        work[L.LEAST_D + i] = now if begin or now < work[L.LEAST_D + i] else work[L.LEAST_D + i]
        work[L.LEAST_FIRST_D + i] = before if begin or before < work[L.LEAST_FIRST_D + i] else work[L.LEAST_FIRST_D + i]
        work[L.ANY_HELD + i] = 1.0 if held else (0.0 if begin else work[L.ANY_HELD + i])


@device
@simd
def associate_unambiguous(
    space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, rules: Any
) -> int:
    """Match unambiguous measurements of one block at the predicted pose, and sum their information (first pass).

    A measurement is matched to its candidate of least cost (`candidates.consider`) within the gate if the second best
    costs at least `ambiguity_margin` more and no earlier measurement of the frame has taken the landmark. A match has
    Cauchy's weight 1 / (1 + D / gate). Where the caller identifies landmarks, any D may match. A measurement that has
    candidates, none of which explains it at the predicted pose, contradicts the pose.

    Returns:
        The number of suspects: lanes in which enough contradicts the pose.
    """
    work, records, match = space.work, space.records, space.match
    starts, slots, same, row_of = candidates.starts, candidates.slots, candidates.same, maps.table[L.ROW_OF]
    padded, first, gate = maps.counts.shape[1], block * LANES, rules.position_gate
    reach = L.MAX_DISTANCE if frame.identified else gate
    for i in range(LANES):
        work[L.CONTRADICT + i] = 0.0
    for b in range(len(starts) - 1):
        low, high, chosen = starts[b], starts[b + 1], match[b]
        if high - low == 1 and (same[low] < 0 or not rules.one_to_one):
            row = row_of[slots[low]]
            tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
            innovate(work, tile, frame, b)
            _match_alone(work, tile, records[low], seen, chosen, float(low), reach, gate)
            continue
        begin_choice(work)
        for q in range(low, high):
            row = row_of[slots[q]]
            tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
            innovate(work, tile, frame, b)
            evaluate(work, tile, records[q], seen, False)
            consider(work, records[q], float(q), candidates.descriptor_costs[q], L.MAX_DISTANCE, reach, 0.0, 0.0)
        for i in range(LANES):  # the best candidate, if no other comes near
            second = work[L.SECOND_COST + i]
            clear = second == np.inf or second - work[L.BEST_COST + i] >= rules.ambiguity_margin
            chosen[i] = work[L.CHOSEN + i] if clear else L.NO_MATCH
        for q in range(low, high):
            record, code = records[q], float(q)
            if rules.one_to_one and same[q] >= 0:
                mark_assigned(work, match, candidates, q, True)
                for i in range(LANES):
                    chosen[i] = L.NO_MATCH if chosen[i] == code and work[L.TAKEN + i] > 0.0 else chosen[i]
            sum_matches(work, record, chosen, code, gate)
            for i in range(LANES):  # D at the predicted pose is the NIS
                record[L.Q_FIRST_D + i] = record[L.Q_D + i]
        for q in range(low, high):
            _judge_nearest(work, records[q], q == low)
        if low < high:
            for i in range(LANES):
                work[L.CONTRADICT + i] += 1.0 if work[L.ANY_HELD + i] > 0.0 and not work[L.LEAST_D + i] <= gate else 0.0
    suspects = 0
    for i in range(LANES):
        suspects += 1 if work[L.CONTRADICT + i] >= MIN_CONTRADICTIONS else 0
    return suspects


@device
@simd
def _match_alone(
    work: FloatArray, tile: FloatArray, record: FloatArray, seen: Int32Array, chosen: FloatArray, q: float,
    reach: float, gate: float,
) -> None:  # fmt: skip
    """Match a measurement whose only candidate is q (first pass): weigh, sum, and judge.

    The largest D that may match is `reach`.
    """
    for i in range(LANES):
        match = match_terms(work, tile, i, False)
        held = seen[i] > 0
        inside = match.distance <= gate
        ok = held and match.distance <= reach
        chosen[i] = q if ok else L.NO_MATCH
        add_terms(work, i, ok, gate / (gate + match.distance), match.terms)
        record[L.Q_FIRST_D + i] = match.distance
        work[L.CONTRADICT + i] += 1.0 if held and not inside else 0.0


@device
@simd
def try_wide_prior(space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, rules: Any) -> None:
    """Give suspects of one block a wide prior, and keep it where it explains what the stated uncertainty does not."""
    work, records, row_of = space.work, space.records, maps.table[L.ROW_OF]
    far, turned = rules.recovery_position, rules.recovery_heading
    starts, slots, gate = candidates.starts, candidates.slots, rules.position_gate
    padded, first = maps.counts.shape[1], block * LANES
    for i in range(LANES):  # T diag(far, far, turned), T the turn by the predicted heading
        work[L.KEPT00 + i], work[L.KEPT01 + i] = work[L.C00 + i], work[L.C01 + i]
        work[L.KEPT10 + i], work[L.KEPT11 + i] = work[L.C10 + i], work[L.C11 + i]
        work[L.KEPT20 + i], work[L.KEPT21 + i], work[L.KEPT22 + i] = work[L.C20 + i], work[L.C21 + i], work[L.C22 + i]
        work[L.KEPT_WIDE + i] = work[L.IS_WIDE + i]
        suspect = work[L.CONTRADICT + i] >= MIN_CONTRADICTIONS
        c, s = work[L.COS + i], work[L.SIN + i]
        work[L.LOST + i] = 1.0 if suspect else 0.0
        work[L.IS_WIDE + i] = 1.0 if suspect else work[L.IS_WIDE + i]
        work[L.C00 + i] = c * far if suspect else work[L.C00 + i]
        work[L.C01 + i] = -s * far if suspect else work[L.C01 + i]
        work[L.C10 + i] = s * far if suspect else work[L.C10 + i]
        work[L.C11 + i] = c * far if suspect else work[L.C11 + i]
        work[L.C20 + i] = 0.0 if suspect else work[L.C20 + i]
        work[L.C21 + i] = 0.0 if suspect else work[L.C21 + i]
        work[L.C22 + i] = turned if suspect else work[L.C22 + i]
        work[L.SURE + i] = 0.0
        work[L.CONTRADICT + i] = 0.0
    for b in range(len(starts) - 1):
        for q in range(starts[b], starts[b + 1]):
            row, record = row_of[slots[q]], records[q]
            tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
            if starts[b + 1] - starts[b] > 1 or not (candidates.same[q] < 0 or not rules.one_to_one):
                for i in range(LANES):
                    record[L.Q_FIRST_D + i] = record[L.Q_D + i]
            innovate(work, tile, frame, b)
            evaluate(work, tile, record, seen, False)
            _judge_nearest(work, record, q == starts[b])
        if starts[b] < starts[b + 1]:  # whether the wide prior explains the measurement, and the narrow one did not
            for i in range(LANES):
                sure = work[L.LEAST_D + i] <= gate
                work[L.SURE + i] += 1.0 if sure else 0.0
                work[L.CONTRADICT + i] += 1.0 if sure and not work[L.LEAST_FIRST_D + i] <= gate else 0.0
    for i in range(LANES):  # suspects that are not lost after all get back what they had
        lost = work[L.CONTRADICT + i] >= MIN_CONTRADICTIONS and 2.0 * work[L.CONTRADICT + i] > work[L.SURE + i]
        _give_back(work, i, work[L.LOST + i] > 0.0 and not lost)


@simd_inline
def _give_back(work: FloatArray, i: int, back: bool) -> None:
    """Where `back`, give a suspect the prior back that it had; it is not lost."""
    work[L.C00 + i] = work[L.KEPT00 + i] if back else work[L.C00 + i]
    work[L.C01 + i] = work[L.KEPT01 + i] if back else work[L.C01 + i]
    work[L.C10 + i] = work[L.KEPT10 + i] if back else work[L.C10 + i]
    work[L.C11 + i] = work[L.KEPT11 + i] if back else work[L.C11 + i]
    work[L.C20 + i] = work[L.KEPT20 + i] if back else work[L.C20 + i]
    work[L.C21 + i] = work[L.KEPT21 + i] if back else work[L.C21 + i]
    work[L.C22 + i] = work[L.KEPT22 + i] if back else work[L.C22 + i]
    work[L.IS_WIDE + i] = work[L.KEPT_WIDE + i] if back else work[L.IS_WIDE + i]
    work[L.LOST + i] = 0.0 if back else work[L.LOST + i]


@device
@simd
def undo_unconfirmed(
    space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, gate: float
) -> int:
    """Give lost lanes of one block their own prior back if too few matches hold at the pose found with the wide one.

    The wide prior explains each measurement by itself, at poses that need not agree. A pose at which fewer than three
    of the unambiguous matches lie within the gate is not confirmed.

    Returns:
        The number of lanes that were given their prior back. Their pose has to be refined again; xi is then 0.
    """
    work, match, row_of = space.work, space.match, maps.table[L.ROW_OF]
    padded, first, num_lost, num_back = maps.counts.shape[1], block * LANES, 0, 0
    for i in range(LANES):
        work[L.SURE + i] = 0.0
        num_lost += 1 if work[L.LOST + i] > 0.0 else 0
    for b in range(len(match) if num_lost > 0 else 0):
        for q in range(candidates.starts[b], candidates.starts[b + 1]):
            if mask_of(match[b], float(q), space.mask) > 0:
                row, record, chosen = row_of[candidates.slots[q]], space.records[q], match[b]
                tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
                innovate(work, tile, frame, b)
                evaluate(work, tile, record, seen, True)
                for i in range(LANES):
                    work[L.SURE + i] += 1.0 if chosen[i] == float(q) and record[L.Q_D + i] <= gate else 0.0
    for i in range(LANES):
        back = work[L.LOST + i] > 0.0 and work[L.SURE + i] < MIN_CONTRADICTIONS
        _give_back(work, i, back)
        num_back += 1 if back else 0
    for i in range(LANES if num_back > 0 else 0):
        work[L.XI0 + i] = work[L.XI1 + i] = work[L.XI2 + i] = 0.0
    return num_back


@device
@simd
def iterate_wide(space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, gate: float) -> None:
    """Take more steps of Gauss-Newton in the lanes of one block whose prior is wide, with the matches as they are."""
    work, match, row_of = space.work, space.match, maps.table[L.ROW_OF]
    padded, first, num_wide = maps.counts.shape[1], block * LANES, 0
    for i in range(LANES):
        num_wide += 1 if work[L.IS_WIDE + i] > 0.0 else 0
    for _ in range(MORE_STEPS if num_wide > 0 else 0):
        set_linearisation_point(work)
        for b in range(len(match)):
            for q in range(candidates.starts[b], candidates.starts[b + 1]):
                if mask_of(match[b], float(q), space.mask) > 0:
                    row, record = row_of[candidates.slots[q]], space.records[q]
                    tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
                    innovate(work, tile, frame, b)
                    evaluate(work, tile, record, seen, True)
                    sum_matches(work, record, match[b], float(q), gate)
        gauss_newton_step(work, True)


@device
@simd
def associate_all(space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, rules: Any) -> None:
    """Match, reject or start a landmark for each measurement of one block at the refined pose (second pass).

    Measurements are decided in their order; a landmark that an earlier one of the frame has taken cannot be matched
    again (`one_to_one`). The free landmark of least cost (`candidates.consider`) with D <= `position_gate` is matched,
    unless the second best costs less than `ambiguity_margin` more: then the measurement is rejected. Without a match it
    is rejected as well if a candidate, taken or not, lies in the dead zone: D <= `new_landmark_gate`, or closer than
    `new_landmark_radius`. Otherwise it starts a landmark. Sums the information on the pose and its likelihood. The same
    in plain Python: `slam_backend.reference.fastslam2.decide`.
    """
    work, records, match = space.work, space.records, space.match
    starts, slots, row_of = candidates.starts, candidates.slots, maps.table[L.ROW_OF]
    padded, first, gate = maps.counts.shape[1], block * LANES, rules.position_gate
    # Of an identified landmark any D matches: an only candidate has no limit, among several D is capped at the gate.
    reach, cap = (L.MAX_DISTANCE, gate) if frame.identified else (gate, L.MAX_DISTANCE)
    new_landmark_gate = L.MAX_DISTANCE if frame.identified else rules.new_landmark_gate
    clear_likelihood(work)
    for b in range(len(starts) - 1):
        low, high, chosen = starts[b], starts[b + 1], match[b]
        # A density [1/m^3] becomes one of image coordinates by the factor depth^4, see `_kernels/__init__.py`.
        log_clutter = rules.log_density + (0.0 if frame.given else 4.0 * math.log(frame.points[b, 0]))
        if high - low == 1:
            row = row_of[slots[low]]
            tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
            mark_assigned(work, match, candidates, low, rules.one_to_one)
            innovate(work, tile, frame, b)
            _decide_alone(
                work, tile, seen, chosen, float(low), reach, new_landmark_gate, rules.new_landmark_radius, log_clutter
            )
            continue
        begin_choice(work)
        for q in range(low, high):
            row, record = row_of[slots[q]], records[q]
            tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
            mark_assigned(work, match, candidates, q, rules.one_to_one)
            innovate(work, tile, frame, b)
            evaluate(work, tile, record, seen, True)
            consider(
                work,
                record,
                float(q),
                candidates.descriptor_costs[q],
                cap,
                gate,
                rules.new_landmark_gate,
                rules.new_landmark_radius,
            )
        for i in range(LANES):
            best, second = work[L.BEST_COST + i], work[L.SECOND_COST + i]
            matched = work[L.CHOSEN + i] >= 0.0
            ambiguous = matched and second < np.inf and second - best < rules.ambiguity_margin
            new = L.NO_MATCH if work[L.DEAD_ZONE + i] > 0.0 else L.NEW_LANDMARK
            chosen[i] = (L.NO_MATCH if ambiguous else work[L.CHOSEN + i]) if matched else new
            work[L.CLUTTER + i] += (work[L.LOG_BEST + i] if ambiguous else 0.0) if matched else log_clutter
        for q in range(low, high):
            record = records[q]
            if sum_matches(work, record, chosen, float(q), np.inf) > 0:
                for i in range(LANES):
                    on = chosen[i] == float(q)
                    accumulate_likelihood(
                        work, i, on, record[L.Q_SQUARE + i], record[L.Q_DET + i], record[L.Q_DEPTH + i]
                    )


@device
@simd
def _decide_alone(
    work: FloatArray, tile: FloatArray, seen: Int32Array, chosen: FloatArray, q: float,
    reach: float, new_landmark_gate: float, new_landmark_radius: float, log_clutter: float,
) -> None:  # fmt: skip
    """Decide on a measurement whose only candidate is q (second pass), and sum.

    Row TAKEN says where an earlier measurement has taken the landmark; the largest D that may match is `reach`.
    """
    radius2 = new_landmark_radius * new_landmark_radius
    for i in range(LANES):
        match = match_terms(work, tile, i, True)
        front = (seen[i] > 0) & (match.distance < np.inf)  # "and" would make a branch of it, and of all that follows
        near = front & ((match.distance <= new_landmark_gate) | (match.metres2 <= radius2))
        ok = front & (match.distance <= reach) & (work[L.TAKEN + i] == 0.0)
        chosen[i] = q if ok else (L.NO_MATCH if near else L.NEW_LANDMARK)
        work[L.CLUTTER + i] += 0.0 if ok else log_clutter
        add_terms(work, i, ok, 1.0, match.terms)
        accumulate_likelihood(work, i, ok, match.square, match.det, match.depth)
