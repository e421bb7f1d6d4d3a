"""One robot's frame as in Algorithm 1 (corrected), for all particles."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, jit_fma, stack_array
from slam_backend.core.simd_math import sine_cosine
from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.association.candidates import (
    create_once,
    find_candidates,
    mark_assigned,
    mask_of,
    write_associations,
)
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.measurement.measurement_model import (
    clear_likelihood,
    innovate,
    total_log_likelihood,
)
from slam_backend.fastslam._kernels.motion.motion_model import load_rows, sample_motion, set_exact
from slam_backend.fastslam._kernels.motion.odometry_bias import correct_bias_by_draws
from slam_backend.fastslam._kernels.particles.map_storage import tile_of
from slam_backend.fastslam._kernels.particles.resampling import apply_resampling
from slam_backend.fastslam._kernels.records import Frame, MapArrays, Motion, Outcome, Poses, Space
from slam_backend.fastslam._kernels.update.landmark_ekf import gate_and_update, new_landmark


@device
@jit_fma
def update_fastslam1(
    robot: Poses, moved: bool, motion: Motion, maps: MapArrays, frame: Frame, rules: Any, work: FloatArray,
    outcome: Outcome,
) -> None:  # fmt: skip
    """Sample one robot's motion and integrate its frame as in Algorithm 1 (corrected).

    Args:
        robot: Poses, written: the samples, which are replaced if `moved`, as their own means, and zeros.
        moved: Whether the robot moved.
        motion: Motion of the robot.
        maps: Landmarks. B + 1 rows and B slots are free.
        frame: Measurements of the robot.
        rules: `kernel_options`.
        work: Working space.
        outcome: Results, written.
    """
    num, padded, new_slots = len(frame.points), robot.samples.shape[1], outcome.new_slots
    candidates, unique = find_candidates(frame, maps, rules)
    apply_resampling(unique, maps)
    starts, slots, row_of = candidates.starts, candidates.slots, maps.table[L.ROW_OF]
    match, mask = np.empty((num, LANES)), stack_array(LANES)
    space = Space(work, np.empty((len(slots), L.CANDIDATE_ROWS * LANES)), match, mask)
    gate = np.inf if frame.identified else rules.position_gate
    new_slots[:] = L.REJECTED
    for block in range(padded // LANES):
        first = block * LANES
        real = min(LANES, len(motion.normals) - first)
        if moved:
            sample_motion(work, robot.samples, robot.biases, motion, first)
            if motion.biased:
                correct_bias_by_draws(work, robot.biases, motion, first)
        load_rows(work, L.X, robot.samples, first)
        for i in range(LANES):
            work[L.SIN + i], work[L.COS + i] = sine_cosine(work[L.T + i])
        clear_likelihood(work)
        for b in range(num):
            chosen = match[b]
            for i in range(LANES):
                chosen[i] = L.NEW_LANDMARK if i < real else L.NO_MATCH
            for q in range(starts[b], starts[b + 1]):  # l. 15-24: the nearest descriptor inside the gate
                row, record = row_of[slots[q]], space.records[q]
                tile, seen = maps.values[tile_of(padded, row, block)], maps.counts[row, first : first + LANES]
                mark_assigned(work, match, candidates, q, rules.one_to_one)
                innovate(work, tile, frame, b)
                gate_and_update(work, tile, record, chosen, seen, float(q), gate, rules.landmark_walk)  # l. 33-37, 39
            log_clutter = rules.log_density + (0.0 if frame.given else 4.0 * math.log(frame.points[b, 0]))
            unmatched = mask_of(chosen, L.NEW_LANDMARK, mask)
            for i in range(LANES):
                work[L.CLUTTER + i] += log_clutter if mask[i] > 0.0 else 0.0
            if frame.identified:
                create_once(match, b, first, maps, candidates, frame.identities)
                unmatched = mask_of(chosen, L.NEW_LANDMARK, mask)
            if unmatched > 0:  # l. 28-32
                new_landmark(space, block, maps, frame, b, new_slots, rules.landmark_walk)
        write_associations(outcome, first, match, candidates, space.records, L.Q_D)
        for i in range(LANES):
            outcome.log_likelihood[first + i] += total_log_likelihood(work, i)
    set_exact(robot)
