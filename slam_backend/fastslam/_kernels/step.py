"""One step of the filter: each robot in turn moves and matches its measurements; what happened is noted for its log."""

import math

from slam_backend.core.jit import device, in_place, stack_array
from slam_backend.core.validation import Float32Array, FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.fastslam1 import update_fastslam1
from slam_backend.fastslam._kernels.fastslam2 import update_fastslam2
from slam_backend.fastslam._kernels.layout import (
    AMBIGUITY_MARGIN,
    ASSOCIATED,
    BEGIN,
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
    FREE_SLOTS,
    HAS_COVARIANCES,
    HAS_IDS,
    IDENTITIES,
    IDS,
    IS_ONE_TO_ONE,
    LAST_SEEN,
    LOG_LIKELIHOOD,
    LOG_P0,
    LOGGED,
    LOGGED_KIND,
    LONG,
    MAP_OF,
    MEANS,
    MOTION,
    MOTION_KIND,
    MOVED,
    NAME,
    NEW_LANDMARK_GATE,
    NEW_LANDMARK_RADIUS,
    NO_READING,
    NOISE,
    POSES,
    POSITION_GATE,
    RECOVERY,
    RESAMPLE_THRESHOLD,
    ROW_OF,
    USED,
    WALK,
    WORK_SIZE,
)
from slam_backend.fastslam._kernels.motion_model import propagate, set_exact
from slam_backend.fastslam._kernels.weights import finish_step


@device
@in_place
def log_step(
    rows: IntArray, turns: IntArray, moves: FloatArray, sightings: FloatArray, told: IntArray, means: FloatArray,
    noted: FloatArray, measured: FloatArray, first: int,
) -> None:  # fmt: skip
    """Note the turns of a step.

    Args:
        rows, turns, moves, sightings: As of `step_robots`.
        told: (2, n) what became of the measurements, as in `Associations`.
        means: (K, 3) [m, m, rad] where the robots are thought to be now.
        noted: (K, 10) of the step, see `layout`; written.
        measured: (>= first + used, 10): sightings, and the landmarks that they were taken for; written from `first` on.
        first: Measurements that were noted before.
    """
    for robot in range(len(rows)):
        row, note = rows[robot], noted[robot]
        note[:] = 0.0
        if row < 0:
            continue
        turn = turns[row]
        note[LOGGED] = 1.0 if turn[MOTION_KIND] != NO_READING or turn[COUNT] > 0 else 0.0
        note[HAS_COVARIANCES] = 1.0 if turn[COVARIANCES_GIVEN] > 0 and turn[COUNT] > 0 else 0.0
        note[LOGGED_KIND], note[USED] = turn[MOTION_KIND], turn[END] - turn[BEGIN]
        for axis in range(3):
            note[MOTION + axis], note[ESTIMATE + axis] = moves[row, axis], means[robot, axis]
        for b in range(turn[BEGIN], turn[END]):
            for c in range(NAME if turn[COVARIANCES_GIVEN] > 0 else 3):
                measured[first, c] = sightings[b, c]
            measured[first, NAME] = told[ASSOCIATED, b]
            first += 1


@device
@in_place
def write_sigmas(noise: FloatArray, move: FloatArray, sigmas: FloatArray) -> None:
    """Write the standard deviations (3,) [m, m, rad] of an odometry reading (3,), as `OdometryModel.sigmas` says."""
    distance = math.hypot(move[0], move[1])
    sigmas[0] = math.hypot(noise[0] * distance, noise[4])
    sigmas[1] = math.hypot(noise[1] * distance, noise[4])
    sigmas[2] = math.hypot(math.hypot(noise[2] * distance, noise[3] * move[2]), noise[5])


@in_place
def step_robots(
    low: int, high: int, is_over: bool, now: int, assumed: FloatArray,
    rows: IntArray, turns: IntArray, moves: FloatArray, normals: FloatArray,
    robots: FloatArray, blind: IntArray, weights: FloatArray, frame: FloatArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, table: IntArray, maps: Int32Array, users: IntArray,
    free_rows: IntArray, tops: IntArray, stored: Float32Array, heads: Float32Array,
    sightings: FloatArray, descriptors: Float32Array, names: IntArray,
    found: Int32Array, distances: FloatArray, told: IntArray,
    mean: FloatArray, covariance: FloatArray, noted: FloatArray, measured: FloatArray, num_measured: int,
    fastslam1: int | None,
) -> tuple[int, int, int, int, int, int, float, float, bool]:  # fmt: skip
    """Move robots `low` to `high` - 1 in all particles, match, weigh and update landmarks (Algorithm 1, l. 6-8).

    What belongs together comes in one array, whose rows `layout` names: it is the number of arrays that a call costs.

    Args:
        low, high: Whose turns are taken; the step begins with the first robot.
        is_over: Whether these were the last turns, and the step is concluded.
        now: Number of the step, above 0 if anyone asks when landmarks were seen last.
        assumed: (27,) noise of the odometry, camera, and the rest, see `layout`.
        rows: (K,) which of the N robots that `turns` tells of each is; -1: none, it did nothing at all.
        turns: (N, 6) int64. What each did: `NO_READING`, `STATIONARY`, `MOVED`, or `PLACED`, with the pose already
            written; where its measurements begin and end among all n; whether these come with covariances, and with
            names.
        moves: (N, 3) odometry [m, m, rad] of those that moved.
        normals: (k, M, 3) standard normal draws, for the k robots that are not idle.
        robots: (5, K, 3, P) samples, starts, and N(x^, P^) before sampling.
        blind: (K,) 1 where that was propagated since the last sighting, else 0.
        weights: (4, P), read and written up to M.
        frame: (3, 3) as in `finish_step`.
        values, ..., heads: The store, see `ParticleMaps`. n + 1 rows and n slots are free.
        sightings: (n, 9) [m, m^2] points and, of the robots that have them, covariances, as in `to_robot_axes`.
        descriptors: (n, d).
        names: (n,) the caller's names, of the robots that have them; or (0,).
        found, distances: (n, P), written as in `update_fastslam2`.
        told: (2, n), written: the slots of the landmarks that were started, -1 = none; in the end as in `summarise`.
        mean, covariance: (K, 3), (K, 3, 3), written in the end, as in `finish_step`.
        noted, measured, num_measured: Of a journal, likewise, see `log_step`.
        fastslam1: None: the proposal of FastSLAM 2.0; a filter that has it never compiles the other one. Any number:
            that of FastSLAM 1.0.

    Returns:
        What `finish_step` returns; zeros before that.
    """
    num_robots, num_particles = len(rows), normals.shape[1]
    camera, recovery = assumed[CAMERA : CAMERA + 7], assumed[RECOVERY : RECOVERY + 3]
    is_one_to_one = assumed[IS_ONE_TO_ONE] > 0.0
    poses, means = robots[POSES], robots[MEANS]
    covariances = robots[COVARIANCES:].reshape((num_robots, 6, robots.shape[3]))
    log_likelihood, new_slots = weights[LOG_LIKELIHOOD], told[CREATED]
    row_of, map_of, ids, identities = table[ROW_OF], table[MAP_OF], table[IDS], table[IDENTITIES]
    free_slots = table[FREE_SLOTS]
    points, noises = sightings[:, :3], sightings[:, 3:]
    work, still, move, sigmas, drawn = stack_array(WORK_SIZE), stack_array(3), stack_array(3), stack_array(3), -1
    still[:] = 0.0
    if low == 0:
        log_likelihood[:] = 0.0
    for robot in range(high):
        row = rows[robot]
        act = turns[row, MOTION_KIND] if row >= 0 else NO_READING
        drawn += act != NO_READING
        if robot < low or act == NO_READING:
            continue
        a, b = turns[row, BEGIN], turns[row, END]
        given, named = turns[row, COVARIANCES_GIVEN] > 0, turns[row, HAS_IDS] > 0
        placed = act == EXACT_POSE
        move[:] = 0.0
        sigmas[:] = 0.0
        if act == MOVED:
            move[0], move[1], move[2] = moves[row, 0], moves[row, 1], moves[row, 2]
            write_sigmas(assumed[NOISE : NOISE + 6], move, sigmas)
        own_poses, own_means, own_covariances = poses[robot], means[robot], covariances[robot]
        was_blind = blind[robot] > 0 and not placed
        lost = still if placed else recovery
        if fastslam1 is not None:
            update_fastslam1(
                own_poses, own_means, own_covariances, not placed, move, sigmas, normals[drawn],
                values, counts, odds, row_of, map_of, maps, users, free_rows, free_slots, tops, ids, identities, stored,
                heads, points[a:b], noises[a:b], given, camera, descriptors[a:b], names[a:b], named,
                assumed[DESCRIPTOR_GATE], assumed[POSITION_GATE], assumed[LOG_P0], assumed[WALK], is_one_to_one,
                work, found[a:b], distances[a:b], new_slots[a:b], log_likelihood,
            )  # fmt: skip
        elif b > a:
            update_fastslam2(
                own_poses, own_means, own_covariances, was_blind, move, sigmas, normals[drawn],
                values, counts, odds, row_of, map_of, maps, users, free_rows, free_slots, tops, ids, identities, stored,
                heads, points[a:b], noises[a:b], given, camera, descriptors[a:b], names[a:b], named,
                assumed[DESCRIPTOR_GATE], assumed[DESCRIPTOR_VARIANCE], assumed[POSITION_GATE],
                assumed[NEW_LANDMARK_GATE], assumed[NEW_LANDMARK_RADIUS], assumed[AMBIGUITY_MARGIN], lost,
                assumed[LOG_P0], assumed[WALK], is_one_to_one,
                work, found[a:b], distances[a:b], new_slots[a:b], log_likelihood,
            )  # fmt: skip
            was_blind = False
        elif placed:
            set_exact(own_poses, own_means, own_covariances)
        else:
            propagate(own_poses, own_means, own_covariances, was_blind, move, sigmas, normals[drawn], work)
            was_blind = True
        blind[robot] = was_blind
    if not is_over:
        return 0, 0, 0, 0, 0, 0, 0.0, 0.0, False
    summary = finish_step(
        weights, num_particles, means, covariances, frame, mean, covariance, rows, turns, found, distances, told, ids,
        table[LAST_SEEN], now, assumed[LONG], assumed[RESAMPLE_THRESHOLD],
    )  # fmt: skip
    log_step(rows, turns, moves, sightings, told, mean, noted, measured, num_measured)
    return summary
