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
    read, written, drawn = InputArrays(*inputs), StepResults(*results), -1
    if step.low == 0:
        of.weights[L.LOG_LIKELIHOOD][:] = 0.0
    for robot in range(step.high):
        row = read.rows[robot]
        if row < 0 or read.table[row, L.MOTION_KIND] == L.NO_READING:
            continue
        drawn += 1
        if robot >= step.low:
            update_robot(robot, read, read.normals[drawn], rules, of, landmarks, written)
    if not step.is_over:
        return 0, 0, 0, 0, 0, 0, 0.0, 0.0, False
    ess = weigh(of.weights, read.normals.shape[1])  # l. 9
    return conclude(step, read, ess, rules, of, landmarks, written)


@device
@in_place
def update_robot(
    robot: int, inputs: InputArrays, normals: FloatArray, rules: Any, robots: RobotArrays, maps: MapArrays,
    results: StepResults,
) -> None:  # fmt: skip
    """Predict, associate, weigh and update: one robot that is not idle, in all particles (Algorithm 1, l. 6-8).

    Args:
        robot: Index of the robot.
        inputs, rules, robots, maps, results: Arguments of `step_robots`.
        normals: (M, 3) standard normal draws.
    """
    row, num_robots = inputs.rows[robot], len(inputs.rows)
    a, b, kind = inputs.table[row, L.BEGIN], inputs.table[row, L.END], inputs.table[row, L.MOTION_KIND]
    work, move, sigmas = stack_array(WORK_SIZE), stack_array(3), stack_array(3)
    move[:] = 0.0
    sigmas[:] = 0.0
    if kind == L.MOVED:
        move[0], move[1], move[2] = inputs.moves[row, 0], inputs.moves[row, 1], inputs.moves[row, 2]
        write_sigmas(rules.noise, move, sigmas)
    bias, is_exact = rules.bias_sigmas, kind == L.EXACT_POSE
    motion = Motion(
        move, sigmas, normals, is_exact, (bias[0] > 0.0 or bias[1] > 0.0 or bias[2] > 0.0) and not is_exact,
        stack_array(9).reshape(3, 3), stack_array(6), stack_array(9).reshape(3, 3), stack_array(9).reshape(3, 3),
        stack_array(6),
    )  # fmt: skip
    covariances = robots.parts[L.COVARIANCES :].reshape((num_robots, 6, robots.parts.shape[3]))[robot]
    own = Poses(robots.parts[L.POSES, robot], robots.parts[L.MEANS, robot], covariances, robots.parts[L.BIASES, robot])
    frame = Frame(
        inputs.measurements[a:b, :3], inputs.measurements[a:b, 3:], inputs.table[row, L.COVARIANCES_GIVEN] > 0,
        rules.camera, inputs.descriptors[a:b], inputs.names[a:b], inputs.table[row, L.HAS_IDS] > 0,
    )  # fmt: skip
    outcome = Outcome(
        results.found[a:b], results.distances[a:b], results.associations[L.CREATED, a:b],
        robots.weights[L.LOG_LIKELIHOOD],
    )  # fmt: skip
    was_propagated_only = robots.propagated_only[robot] > 0 and not is_exact
    if not was_propagated_only:
        robots.biases[1, robot] = 0.0
    if motion.biased:
        prepare_bias(motion, robots.biases[0, robot], robots.biases[1, robot])
    robots.propagated_only[robot] = False
    if rules.is_fastslam1:
        if motion.biased:
            set_draw_gain(motion, robots.biases[0, robot])
            robots.biases[1, robot] = 0.0
        update_fastslam1(own, not is_exact, motion, maps, frame, rules, work, outcome)
        register_new(outcome.new_slots, frame, maps)
        robots.propagated_only[robot] = was_propagated_only
    elif b > a:
        biases = robots.biases[:, robot]
        update_fastslam2(own, was_propagated_only, motion, biases, maps, frame, rules, work, outcome)
        register_new(outcome.new_slots, frame, maps)
    elif is_exact:
        set_exact(own)
    else:
        propagate(own, motion, was_propagated_only, work)
        robots.propagated_only[robot] = True


@device
@in_place
def conclude(
    part: StepPart, inputs: InputArrays, ess: float, rules: Any, robots: RobotArrays, maps: MapArrays,
    results: StepResults,
) -> tuple[int, int, int, int, int, int, float, float, bool]:  # fmt: skip
    """Estimate poses and associations over all particles, log the step, and return the fields of `StepSummary`."""
    num_robots, num_particles = len(inputs.rows), inputs.normals.shape[1]
    means, weights = robots.parts[L.MEANS], robots.weights[L.WEIGHTS][:num_particles]
    covariances = robots.parts[L.COVARIANCES :].reshape((num_robots, 6, robots.parts.shape[3]))
    used = 0
    for robot in range(num_robots):
        row = inputs.rows[robot]
        mixture(means[robot], covariances[robot], weights, robots.means[robot], robots.covariances[robot])
        used += inputs.table[row, L.END] - inputs.table[row, L.BEGIN] if row >= 0 else 0
    if robots.gauge[0, 0] != 0.0 or robots.gauge[2, 2] != 0.0:
        add_gauge_covariance(robots.gauge, robots.means, robots.covariances)
    best = int(robots.weights[L.PATH_LOG_WEIGHTS][:num_particles].argmax())
    said = summarise(inputs, results, best, maps.table, part.now, rules.closure_after)
    log_step(inputs, robots.means, results, part.num_measured)
    least = rules.resample_threshold * num_particles * (1.0 + 1e-9)  # rounding must not decide
    needs_resampling = used > 0 and ess <= least
    return (
        best, said.long_unseen, said.created, said.new, said.matched, said.rejected, said.nis, ess, needs_resampling
    )  # fmt: skip
