"""One step of the filter: robot by robot motion, data association and update; then a summary and a log entry."""

import math

import numpy as np

from slam_backend.core.jit import device, in_place, stack_array
from slam_backend.core.validation import Float32Array, FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.fastslam1 import update_fastslam1
from slam_backend.fastslam._kernels.fastslam2 import update_fastslam2
from slam_backend.fastslam._kernels.layout import (
    AMBIGUITY_MARGIN,
    ASSOCIATED,
    BEGIN,
    BIAS,
    BIASES,
    CAMERA,
    COUNT,
    COVARIANCES,
    COVARIANCES_GIVEN,
    CREATED,
    DESCRIPTOR_GATE,
    DESCRIPTOR_VARIANCE,
    END,
    ESTIMATE,
    EXACT_POSE,
    HAS_COVARIANCES,
    HAS_IDS,
    IDS,
    IS_ONE_TO_ONE,
    LAST_SEEN,
    LOG_LIKELIHOOD,
    LOG_P0,
    LOGGED,
    LOGGED_KIND,
    LONG,
    MEANS,
    MOTION,
    MOTION_KIND,
    MOVED,
    NAME,
    NEW_LANDMARK_GATE,
    NEW_LANDMARK_RADIUS,
    NO_READING,
    NOISE,
    PATH_LOG_WEIGHTS,
    POSES,
    POSITION_GATE,
    RECOVERY,
    REJECTED,
    RESAMPLE_THRESHOLD,
    USED,
    WALK,
    WEIGHTS,
    WORK_SIZE,
)
from slam_backend.fastslam._kernels.motion.motion_model import propagate, set_exact
from slam_backend.fastslam._kernels.motion.odometry_bias import prepare_bias, set_draw_gain
from slam_backend.fastslam._kernels.particles.map_storage import register_new
from slam_backend.fastslam._kernels.particles.pose_estimates import add_gauge_covariance, mixture
from slam_backend.fastslam._kernels.particles.weights import weigh
from slam_backend.fastslam._kernels.records import Frame, MapArrays, Motion, Outcome, Poses, Rules


@device
@in_place
def log_step(
    rows: IntArray, inputs_table: IntArray, moves: FloatArray, measurements: FloatArray, associations: IntArray,
    means: FloatArray, noted: FloatArray, measured: FloatArray, first: int,
) -> None:  # fmt: skip
    """Write the entries of a step into the run log.

    Args:
        rows, inputs_table, moves, measurements: See `step_robots`.
        associations: (2, n) results of the measurements, see `Associations`.
        means: (K, 3) [m, m, rad] poses over all particles.
        noted: (K, 10) notes of the step, see `layout`, written.
        measured: (>= first + used, 10) measurements and their landmarks, written from `first` on.
        first: Number of measurements that were noted before.
    """
    for robot in range(len(rows)):
        row, note = rows[robot], noted[robot]
        note[:] = 0.0
        if row < 0:
            continue
        entry = inputs_table[row]
        note[LOGGED] = 1.0 if entry[MOTION_KIND] != NO_READING or entry[COUNT] > 0 else 0.0
        note[HAS_COVARIANCES] = 1.0 if entry[COVARIANCES_GIVEN] > 0 and entry[COUNT] > 0 else 0.0
        note[LOGGED_KIND], note[USED] = entry[MOTION_KIND], entry[END] - entry[BEGIN]
        for axis in range(3):
            note[MOTION + axis], note[ESTIMATE + axis] = moves[row, axis], means[robot, axis]
        for b in range(entry[BEGIN], entry[END]):
            for c in range(NAME if entry[COVARIANCES_GIVEN] > 0 else 3):
                measured[first, c] = measurements[b, c]
            measured[first, NAME] = associations[ASSOCIATED, b]
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
    rows: IntArray, inputs_table: IntArray, found: Int32Array, distances: FloatArray, associations: IntArray, best: int,
    table: IntArray, now: int, long: float,
) -> tuple[int, int, int, int, int, float]:  # fmt: skip
    """Count what became of the robots' measurements.

    Args:
        rows, inputs_table: Robots and their inputs, see `step_robots`; measurements of other robots are passed over.
        found: (n, P) slots to which the particles gave the measurements, -1 = rejected.
        distances: (n, P) squared distances of matches.
        associations: (2, n), written: id of the landmark with which the most probable particle associated each
            measurement, -1 = rejected; and id of the landmark that it created in any particle, -1 = none. The latter
            row holds the slots of these landmarks before.
        best: The most probable particle.
        table: (7, slots), see `layout`; `LAST_SEEN` is written.
        now: Number of the step.
        long: Number of steps after which a landmark was not seen for long.

    Returns:
        The number of landmarks not seen for long that the most probable particle matched; the number of measurements
        that started a landmark in any particle; the numbers of those that the most probable particle started, matched,
        and rejected, unused ones included; and the mean of its squared distances, without what it predicted
        behind the camera, NaN if there is none.
    """
    associated, created, ids, last_seen = associations[ASSOCIATED], associations[CREATED], table[IDS], table[LAST_SEEN]
    num_measurements, num_created, num_new, num_matched, num_long_unseen, squares, judged = 0, 0, 0, 0, 0, 0.0, 0
    for row in rows:
        if row < 0:
            continue
        num_measurements += max(inputs_table[row, COUNT], 0)
        for b in range(inputs_table[row, BEGIN], inputs_table[row, END]):
            slot, new = found[b, best], created[b]
            associated[b] = ids[slot] if slot >= 0 else REJECTED
            created[b] = ids[new] if new >= 0 else REJECTED
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
    return num_long_unseen, num_created, num_new, num_matched, num_rejected, squares / judged if judged > 0 else np.nan


@in_place
def step_robots(
    low: int, high: int, is_over: bool, now: int, assumed: FloatArray,
    rows: IntArray, inputs_table: IntArray, moves: FloatArray, normals: FloatArray,
    robots: FloatArray, biases: FloatArray, propagated_only: IntArray, weights: FloatArray, gauge: FloatArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, table: IntArray, ancestors: Int32Array, users: IntArray,
    free_rows: IntArray, tops: IntArray, stored: Float32Array, heads: Float32Array,
    measurements: FloatArray, descriptors: Float32Array, names: IntArray,
    found: Int32Array, distances: FloatArray, associations: IntArray,
    mean: FloatArray, covariance: FloatArray, noted: FloatArray, measured: FloatArray, num_measured: int,
    fastslam1: int | None,
) -> tuple[int, int, int, int, int, int, float, float, bool]:  # fmt: skip
    """Move robots `low` to `high` - 1 in all particles, match, weigh and update landmarks (Algorithm 1, l. 6-9).

    What belongs together comes in one array, whose rows `layout` names: a call from Python pays for each array.

    Args:
        low, high: Range of the robots to process; the step begins with the first robot.
        is_over: Whether these are the last robots, and the step is concluded.
        now: Number of the step; 0 if there is no smoother, which alone needs when landmarks were last seen.
        assumed: (30,) noise of the odometry, camera, and the rest, see `layout`.
        rows: (K,) row of each robot in `inputs_table`; -1: it did nothing at all.
        inputs_table: (N, 6) int64, see `layout`: kind of motion, first and last row of the measurements among all n,
            whether these have covariances and names, and the number given. Exact poses are already in `robots`.
        moves: (N, 3) odometry [m, m, rad] of those that moved.
        normals: (k, M, 3) standard normal draws, for the k robots that are not idle.
        robots: (6, K, 3, P) samples, starts, N(x^, P^) before sampling, and means of the odometry bias.
        biases: (2, K, 3, 3) covariance of each robot's bias given its path; and, where N(x^, P^) was propagated, that
            of its pose (rows, robot axes) and bias.
        propagated_only: (K,) 1 where that was propagated since the last sighting, else 0.
        weights: (4, P), see `layout`, read and written up to M.
        gauge: (3, 3) covariance of a motion of the whole map that particles do not show, or zeros.
        values, ..., heads: Landmarks, see `MapArrays`. n + 1 rows and n slots are free.
        measurements: (n, 9) [m, m^2] points and, of the robots that have them, covariances, as in `to_robot_axes`.
        descriptors: (n, d).
        names: (n,) the caller's names, of the robots that have them; or (0,).
        found, distances: (n, P), written, see `Outcome`.
        associations: (2, n), written: slots of new landmarks, -1 = none; at the end as in `summarise`.
        mean, covariance: (K, 3), (K, 3, 3), written in the end: each robot's pose over all particles.
        noted, measured, num_measured: Entries of the run log, written in the end, see `log_step`.
        fastslam1: None: the proposal of FastSLAM 2.0; a filter that has it never compiles the other one. Any number:
            that of FastSLAM 1.0.

    Returns:
        The most probable particle; the first five that `summarise` returns of it; the effective sample size; the last
        one; and whether the particles are to be resampled, now that something was measured. Zeros before the end.
    """
    num_robots, num_particles = len(rows), normals.shape[1]
    poses, means = robots[POSES], robots[MEANS]
    covariances = robots[COVARIANCES:].reshape((num_robots, 6, robots.shape[3]))
    maps = MapArrays(values, counts, odds, table, ancestors, users, free_rows, tops, stored, heads)
    camera, recovery = assumed[CAMERA : CAMERA + 7], assumed[RECOVERY : RECOVERY + 3]
    points, noises = measurements[:, :3], measurements[:, 3:]
    work, still, move, sigmas, drawn = stack_array(WORK_SIZE), stack_array(3), stack_array(3), stack_array(3), -1
    still[:] = 0.0
    jacobian, factor = stack_array(9).reshape(3, 3), stack_array(9).reshape(3, 3)
    gain, spread, information = stack_array(9).reshape(3, 3), stack_array(6), stack_array(6)
    biased = assumed[BIAS] > 0.0 or assumed[BIAS + 1] > 0.0 or assumed[BIAS + 2] > 0.0
    if low == 0:
        weights[LOG_LIKELIHOOD][:] = 0.0
    for robot in range(high):
        row = rows[robot]
        kind = inputs_table[row, MOTION_KIND] if row >= 0 else NO_READING
        drawn += kind != NO_READING
        if robot < low or kind == NO_READING:
            continue
        a, b = inputs_table[row, BEGIN], inputs_table[row, END]
        placed = kind == EXACT_POSE
        move[:] = 0.0
        sigmas[:] = 0.0
        if kind == MOVED:
            move[0], move[1], move[2] = moves[row, 0], moves[row, 1], moves[row, 2]
            write_sigmas(assumed[NOISE : NOISE + 6], move, sigmas)
        own = Poses(poses[robot], means[robot], covariances[robot], robots[BIASES, robot])
        motion = Motion(
            move, sigmas, normals[drawn], biased and not placed, jacobian, spread, factor, gain, information
        )
        frame = Frame(
            points[a:b],
            noises[a:b],
            inputs_table[row, COVARIANCES_GIVEN] > 0,
            camera,
            descriptors[a:b],
            names[a:b],
            inputs_table[row, HAS_IDS] > 0,
        )
        rules = Rules(
            assumed[DESCRIPTOR_GATE], assumed[DESCRIPTOR_VARIANCE], assumed[POSITION_GATE], assumed[NEW_LANDMARK_GATE],
            assumed[NEW_LANDMARK_RADIUS], assumed[AMBIGUITY_MARGIN],
            still if placed else recovery, assumed[LOG_P0], assumed[WALK],
            assumed[IS_ONE_TO_ONE] > 0.0,
        )  # fmt: skip
        outcome = Outcome(found[a:b], distances[a:b], associations[CREATED, a:b], weights[LOG_LIKELIHOOD])
        was_propagated_only = propagated_only[robot] > 0 and not placed
        if not was_propagated_only:
            biases[1, robot] = 0.0
        if motion.biased:
            prepare_bias(motion, biases[0, robot], biases[1, robot])
        if fastslam1 is not None:
            if motion.biased:
                set_draw_gain(motion, biases[0, robot])
                biases[1, robot] = 0.0
            update_fastslam1(own, not placed, motion, maps, frame, rules, work, outcome)
            register_new(outcome.new_slots, frame, maps)
        elif b > a:
            update_fastslam2(own, was_propagated_only, motion, biases[:, robot], maps, frame, rules, work, outcome)
            register_new(outcome.new_slots, frame, maps)
            was_propagated_only = False
        elif placed:
            set_exact(own)
        else:
            propagate(own, motion, was_propagated_only, work)
            was_propagated_only = True
        propagated_only[robot] = was_propagated_only
    if not is_over:
        return 0, 0, 0, 0, 0, 0, 0.0, 0.0, False
    own_weights, path_log_weights = weights[WEIGHTS][:num_particles], weights[PATH_LOG_WEIGHTS][:num_particles]
    ess, used = weigh(weights, num_particles), 0
    for robot in range(num_robots):
        mixture(means[robot], covariances[robot], own_weights, mean[robot], covariance[robot])
        used += inputs_table[rows[robot], END] - inputs_table[rows[robot], BEGIN] if rows[robot] >= 0 else 0
    if gauge[0, 0] != 0.0 or gauge[2, 2] != 0.0:
        add_gauge_covariance(gauge, mean, covariance)
    best = int(path_log_weights.argmax())
    long_unseen, created, new, matched, rejected, nis = summarise(
        rows, inputs_table, found, distances, associations, best, table, now, assumed[LONG]
    )
    log_step(rows, inputs_table, moves, measurements, associations, mean, noted, measured, num_measured)
    least = assumed[RESAMPLE_THRESHOLD] * num_particles * (1.0 + 1e-9)  # rounding must not decide
    needs_resampling = used > 0 and ess <= least
    return best, long_unseen, created, new, matched, rejected, ess, nis, needs_resampling
