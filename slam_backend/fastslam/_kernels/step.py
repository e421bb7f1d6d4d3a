"""One step of the filter: robot by robot motion, data association and update; then a summary and a log entry."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, stack_array
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.fastslam1 import update_fastslam1
from slam_backend.fastslam._kernels.fastslam2 import update_fastslam2
from slam_backend.fastslam._kernels.layout import WORK_SIZE
from slam_backend.fastslam._kernels.motion.motion_model import propagate, set_exact
from slam_backend.fastslam._kernels.motion.odometry_bias import prepare_bias, set_draw_gain
from slam_backend.fastslam._kernels.particles.map_storage import register_new
from slam_backend.fastslam._kernels.particles.pose_estimates import add_gauge_covariance, mixture
from slam_backend.fastslam._kernels.particles.weights import weigh
from slam_backend.fastslam._kernels.records import (
    Frame,
    InputArrays,
    MapArrays,
    MeasurementCounts,
    Motion,
    Outcome,
    Poses,
    RobotArrays,
    StepPart,
    StepResults,
)


@device
@in_place
def log_step(inputs: InputArrays, means: FloatArray, results: StepResults, first: int) -> None:
    """Write the entries of a step into the run log.

    Args:
        inputs: Input of the step.
        means: (K, 3) [m, m, rad] poses over all particles.
        results: Associations; `noted` is written, and `measured` from row `first` on.
        first: Number of measurements that were noted before.
    """
    for robot in range(len(inputs.rows)):
        row, note = inputs.rows[robot], results.noted[robot]
        note[:] = 0.0
        if row < 0:
            continue
        entry, has_covariances = inputs.table[row], inputs.table[row, L.COVARIANCES_GIVEN] > 0
        note[L.LOGGED] = 1.0 if entry[L.MOTION_KIND] != L.NO_READING or entry[L.COUNT] > 0 else 0.0
        note[L.HAS_COVARIANCES] = 1.0 if has_covariances and entry[L.COUNT] > 0 else 0.0
        note[L.LOGGED_KIND], note[L.USED] = entry[L.MOTION_KIND], entry[L.END] - entry[L.BEGIN]
        for axis in range(3):
            note[L.MOTION + axis], note[L.ESTIMATE + axis] = inputs.moves[row, axis], means[robot, axis]
        for b in range(entry[L.BEGIN], entry[L.END]):
            for c in range(L.NAME if has_covariances else 3):
                results.measured[first, c] = inputs.measurements[b, c]
            results.measured[first, L.NAME] = results.associations[L.ASSOCIATED, b]
            first += 1


@device
@in_place
def write_sigmas(noise: FloatArray, move: FloatArray, sigmas: FloatArray) -> None:
    """Write the standard deviations (3,) [m, m, rad] of an odometry reading (3,), as `OdometryModel.sigmas` says."""
    distance = math.hypot(move[0], move[1])
    sigmas[0] = math.hypot(noise[0] * distance, noise[4])
    sigmas[1] = math.hypot(noise[1] * distance, noise[4])
    sigmas[2] = math.hypot(math.hypot(noise[2] * distance, noise[3] * move[2]), noise[5])


@device
@in_place
def summarise(
    inputs: InputArrays, results: StepResults, best: int, table: IntArray, now: int, long: float
) -> MeasurementCounts:
    """Count what became of the robots' measurements.

    Args:
        inputs: Robots and their inputs; measurements of other robots are passed over.
        results: Outcome of the particles. `associations` is written: id of the landmark with which
            the most probable particle associated each measurement, -1 = rejected; and id of the landmark that it
            created in any particle, -1 = none. The latter row holds the slots of these landmarks before.
        best: The most probable particle.
        table: (6, slots), see `SlotRows`; `last_seen` is written.
        now: Number of the step.
        long: Number of steps after which a landmark was not seen for long.
    """
    found, distances = results.found, results.distances
    associated, created = results.associations[L.ASSOCIATED], results.associations[L.CREATED]
    ids, last_seen = table[L.IDS], table[L.LAST_SEEN]
    num_measurements, num_created, num_new, num_matched, num_long_unseen, squares, judged = 0, 0, 0, 0, 0, 0.0, 0
    for row in inputs.rows:
        if row < 0:
            continue
        num_measurements += max(inputs.table[row, L.COUNT], 0)
        for b in range(inputs.table[row, L.BEGIN], inputs.table[row, L.END]):
            slot, new = found[b, best], created[b]
            associated[b] = ids[slot] if slot >= 0 else L.REJECTED
            created[b] = ids[new] if new >= 0 else L.REJECTED
            if new >= 0:
                num_created += 1
                last_seen[new] = 0
            if slot < 0:
                continue
            num_long_unseen += 0 < last_seen[slot] < now - long
            last_seen[slot] = now
            if slot == new:
                num_new += 1
            else:
                num_matched += 1
                if distances[b, best] < np.inf:
                    squares += distances[b, best]
                    judged += 1
    num_rejected = num_measurements - num_new - num_matched
    nis = squares / judged if judged > 0 else np.nan
    return MeasurementCounts(num_long_unseen, num_created, num_new, num_matched, num_rejected, nis)


@in_place
def step_robots(
    part: Any, options: Any, robots: Any, maps: Any, inputs: Any, results: Any
) -> tuple[int, int, int, int, int, int, float, float, bool]:
    """Predict, associate, weigh and update: some robots in all particles (Algorithm 1, l. 6-9).

    All robots done, the weights are normalised and the step is summarised and logged; the caller resamples. Arguments
    are plain tuples with the fields of the records below: converted from Python in half the time of named ones.

    Args:
        part: `StepPart`.
        options: (1,) `kernel_options` of the filter.
        robots: `RobotArrays`.
        maps: `MapArrays`. n + 1 rows and n slots are free.
        inputs: `InputArrays`.
        results: `StepResults`, written.

    Returns:
        The fields of `StepSummary`, zeros before the end.
    """
    step, rules, of, landmarks = StepPart(*part), options[0], RobotArrays(*robots), MapArrays(*maps)
    read, written = InputArrays(*inputs), StepResults(*results)
    num_robots, num_particles = len(read.rows), read.normals.shape[1]
    poses, means = of.parts[L.POSES], of.parts[L.MEANS]
    covariances = of.parts[L.COVARIANCES :].reshape((num_robots, 6, of.parts.shape[3]))
    points, noises = read.measurements[:, :3], read.measurements[:, 3:]
    work, move, sigmas, drawn = stack_array(WORK_SIZE), stack_array(3), stack_array(3), -1
    jacobian, factor = stack_array(9).reshape(3, 3), stack_array(9).reshape(3, 3)
    gain, spread, information = stack_array(9).reshape(3, 3), stack_array(6), stack_array(6)
    bias = rules.bias_sigmas
    biased = bias[0] > 0.0 or bias[1] > 0.0 or bias[2] > 0.0
    if step.low == 0:
        of.weights[L.LOG_LIKELIHOOD][:] = 0.0
    for robot in range(step.high):
        row = read.rows[robot]
        kind = read.table[row, L.MOTION_KIND] if row >= 0 else L.NO_READING
        drawn += kind != L.NO_READING
        if robot < step.low or kind == L.NO_READING:
            continue
        a, b = read.table[row, L.BEGIN], read.table[row, L.END]
        exact = kind == L.EXACT_POSE
        move[:] = 0.0
        sigmas[:] = 0.0
        if kind == L.MOVED:
            move[0], move[1], move[2] = read.moves[row, 0], read.moves[row, 1], read.moves[row, 2]
            write_sigmas(rules.noise, move, sigmas)
        own = Poses(poses[robot], means[robot], covariances[robot], of.parts[L.BIASES, robot])
        motion = Motion(
            move, sigmas, read.normals[drawn], exact, biased and not exact, jacobian, spread, factor, gain, information
        )
        frame = Frame(
            points[a:b], noises[a:b], read.table[row, L.COVARIANCES_GIVEN] > 0, rules.camera, read.descriptors[a:b],
            read.names[a:b], read.table[row, L.HAS_IDS] > 0,
        )  # fmt: skip
        outcome = Outcome(
            written.found[a:b], written.distances[a:b], written.associations[L.CREATED, a:b],
            of.weights[L.LOG_LIKELIHOOD],
        )  # fmt: skip
        was_propagated_only = of.propagated_only[robot] > 0 and not exact
        if not was_propagated_only:
            of.biases[1, robot] = 0.0
        if motion.biased:
            prepare_bias(motion, of.biases[0, robot], of.biases[1, robot])
        if rules.is_fastslam1:
            if motion.biased:
                set_draw_gain(motion, of.biases[0, robot])
                of.biases[1, robot] = 0.0
            update_fastslam1(own, not exact, motion, landmarks, frame, rules, work, outcome)
            register_new(outcome.new_slots, frame, landmarks)
        elif b > a:
            biases = of.biases[:, robot]
            update_fastslam2(own, was_propagated_only, motion, biases, landmarks, frame, rules, work, outcome)
            register_new(outcome.new_slots, frame, landmarks)
            was_propagated_only = False
        elif exact:
            set_exact(own)
        else:
            propagate(own, motion, was_propagated_only, work)
            was_propagated_only = True
        of.propagated_only[robot] = was_propagated_only
    if not step.is_over:
        return 0, 0, 0, 0, 0, 0, 0.0, 0.0, False
    weights, path_log_weights = of.weights[L.WEIGHTS][:num_particles], of.weights[L.PATH_LOG_WEIGHTS][:num_particles]
    ess, used = weigh(of.weights, num_particles), 0
    for robot in range(num_robots):
        row = read.rows[robot]
        mixture(means[robot], covariances[robot], weights, of.means[robot], of.covariances[robot])
        used += read.table[row, L.END] - read.table[row, L.BEGIN] if row >= 0 else 0
    if of.gauge[0, 0] != 0.0 or of.gauge[2, 2] != 0.0:
        add_gauge_covariance(of.gauge, of.means, of.covariances)
    best = int(path_log_weights.argmax())
    said = summarise(read, written, best, landmarks.table, step.now, rules.closure_after)
    log_step(read, of.means, written, step.num_measured)
    least = rules.resample_threshold * num_particles * (1.0 + 1e-9)  # rounding must not decide
    needs_resampling = used > 0 and ess <= least
    return (
        best, said.long_unseen, said.created, said.new, said.matched, said.rejected, said.nis, ess, needs_resampling
    )  # fmt: skip
