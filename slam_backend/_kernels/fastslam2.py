"""One robot's frame with the proposal of FastSLAM 2.0, for all particles."""

import math

import numpy as np

from slam_backend._jit import fused, room
from slam_backend._kernels.candidates import find_candidates
from slam_backend._kernels.choices import (
    begin_choice,
    clear_taken,
    consider_again,
    decide,
    decide_alone,
    mark_held,
    mark_taken,
    mask_of,
    write_found,
)
from slam_backend._kernels.first_pass import keep_distance, match_first
from slam_backend._kernels.innovations import evaluate, innovate
from slam_backend._kernels.landmark_updates import count_matches, find_young, new_landmark, relinearise, update
from slam_backend._kernels.layout import (
    CANDIDATE_ROWS,
    FARTHEST,
    LANES,
    Q_FIRST_D,
    REJECTED,
    SPREAD00,
    TILE,
    X0,
    X,
)
from slam_backend._kernels.likelihoods import add_likelihood, clear_likelihood
from slam_backend._kernels.motion import predict, prior, store_rows, take_draws
from slam_backend._kernels.places import carry_odds, name_new, open_slot, refresh, tile_of
from slam_backend._kernels.pose_system import (
    any_wide,
    begin_pose,
    clear_sums,
    place,
    posterior,
    robust_weights,
    step_pose,
    sum_matches,
)
from slam_backend._kernels.recovery import acquit, any_suspect, begin_judging, count_explained, nearest, widen_suspects
from slam_backend.errors import Float32Array, FloatArray, Int32Array, IntArray


@fused
def update_fastslam2(
    poses: FloatArray, means: FloatArray, covariances: FloatArray, blind: bool,
    odometry: FloatArray, sigmas: FloatArray, normals: FloatArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, free_slots: IntArray, tops: IntArray, ids: IntArray, identities: IntArray,
    stored: Float32Array, heads: Float32Array,
    points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray, descriptors: Float32Array, names: IntArray,
    named: bool, descriptor_gate: float, descriptor_variance: float, position_gate: float, dead_zone: float,
    dead_radius: float, ambiguity: float,
    recovery: FloatArray, log_p0: float, walk: float, one_to_one: bool,
    work: FloatArray, found: Int32Array, distances: FloatArray, new_slots: IntArray, log_likelihood: FloatArray,
) -> None:  # fmt: skip
    """Integrate one robot's motion and frame, the measurements shaping the sampled pose (FastSLAM 2.0, Laplace form).

    Association takes two passes: unambiguous candidates first refine the pose robustly, then all decisions are taken at
    the refined pose. A particle filter forgets how wrong its pose may be; where a wide prior explains three or more
    measurements, and most of all it can explain, that the stated uncertainty does not, this is not believed, and the
    wide prior takes its place. Written out, step by step, in `slam_backend.plain`.

    Args:
        poses: (3, P), the samples before the motion; replaced by the sampled ones.
        means, covariances: (3, P), (6, P), written: N(x^, P^) of each particle before sampling; read if `blind`.
        blind: Whether the robot has not been sampled at a sighting since N(x^, P^) was propagated.
        descriptor_variance: What squared distances between descriptors are divided by, to be weighed against D.
        dead_zone: Between `position_gate` and this D a measurement is neither matched nor new.
        dead_radius: Nor is it new this near to a landmark that looks like it [m].
        ambiguity: A runner-up within this cost makes a measurement ambiguous: it is held back.
        recovery: (3,) standard deviations of the pose [m, m, rad] where most matches contradict it; zeros: never.
        The others are as in `update_fastslam1`; rejected measurements are found at -1.
    """
    num_particles, padded = normals.shape[0], poses.shape[1]
    num = points.shape[0]
    starts, slots, looks, owners, same, unique = find_candidates(
        descriptors, stored, heads, ids, names, identities, named, descriptor_gate
    )
    for q in range(len(looks)):
        looks[q] /= descriptor_variance
    if len(odds) > 0:
        carry_odds(unique, odds, map_of, maps)
    refresh(unique, values, counts, row_of, map_of, maps, users, free_rows, tops)
    records = np.empty((len(slots), CANDIDATE_ROWS * LANES))
    new_rows = np.empty(num, dtype=np.int64)
    log_clutter = np.empty(num)
    match = np.empty((num, LANES))
    mask, young, before = room(LANES), room(LANES), room(TILE)
    reach, cap = (FARTHEST, position_gate) if named else (position_gate, FARTHEST)
    for b in range(num):
        new_slots[b] = REJECTED
        log_clutter[b] = log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))
    for block in range(padded // LANES):
        first = block * LANES
        real = min(LANES, num_particles - first)
        prior(work, poses, means, covariances, blind, first)
        predict(work, odometry, sigmas)
        begin_pose(work)
        clear_likelihood(work)

        # Pass A: refine the pose with what is beyond doubt.
        match_first(
            work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
            starts, slots, looks, owners, same, named, position_gate, ambiguity, one_to_one,
        )  # fmt: skip
        if recovery[0] > 0.0 and any_suspect(work) > 0:
            widen_suspects(work, recovery)
            begin_judging(work)
            for b in range(num):
                for q in range(starts[b], starts[b + 1]):
                    row = row_of[slots[q]]
                    tile = values[tile_of(padded, row, block)]
                    if starts[b + 1] - starts[b] > 1 or not (same[q] < 0 or not one_to_one):
                        keep_distance(records[q])
                    mark_held(records[q], counts[row, first : first + LANES])
                    innovate(work, tile, points, noises, b, given, camera)
                    evaluate(work, tile, records[q], False)
                    nearest(work, records[q], q == starts[b])
                if starts[b] < starts[b + 1]:
                    count_explained(work, position_gate)
            acquit(work)
            match_first(
                work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
                starts, slots, looks, owners, same, named, position_gate, ambiguity, one_to_one,
            )  # fmt: skip
        step_pose(work, False)
        if any_wide(work) > 0:  # a wide prior is a long way for one iteration
            for _ in range(3):
                place(work)
                clear_sums(work)
                for b in range(num):
                    for q in range(starts[b], starts[b + 1]):
                        if mask_of(match[b], float(q), mask) > 0:
                            tile = values[tile_of(padded, row_of[slots[q]], block)]
                            innovate(work, tile, points, noises, b, given, camera)
                            evaluate(work, tile, records[q], True)
                            robust_weights(records[q], match[b], float(q), position_gate, mask)
                            sum_matches(work, records[q], mask)
                step_pose(work, True)
        place(work)

        # Pass B: decide at the refined pose.
        clear_sums(work)
        for b in range(num):
            low, high = starts[b], starts[b + 1]
            if high - low == 1:
                row = row_of[slots[low]]
                tile = values[tile_of(padded, row, block)]
                p = same[low] if one_to_one else REJECTED
                clear_taken(work)
                while p >= 0:
                    mark_taken(work, match[owners[p]], float(p))
                    p = same[p]
                innovate(work, tile, points, noises, b, given, camera)
                decide_alone(
                    work, tile, counts[row, first : first + LANES], match[b], float(low), reach,
                    FARTHEST if named else dead_zone, dead_radius, log_clutter[b],
                )  # fmt: skip
            else:
                begin_choice(work)
                for q in range(low, high):
                    clear_taken(work)
                    p = same[q] if one_to_one else REJECTED
                    while p >= 0:
                        mark_taken(work, match[owners[p]], float(p))
                        p = same[p]
                    tile = values[tile_of(padded, row_of[slots[q]], block)]
                    innovate(work, tile, points, noises, b, given, camera)
                    evaluate(work, tile, records[q], True)
                    consider_again(work, records[q], float(q), looks[q], cap, position_gate, dead_zone, dead_radius)
                decide(work, match[b], ambiguity, log_clutter[b])
                for q in range(low, high):
                    if mask_of(match[b], float(q), mask) > 0:
                        sum_matches(work, records[q], mask)
                        add_likelihood(work, records[q], mask)
            for i in range(real, LANES):  # surplus lanes of the last block start no landmark
                match[b, i] = -1.0

        # The pose: N(x^, P^) from all matches; weigh by the predictive likelihood; sample once.
        take_draws(work, normals, first)
        posterior(work, log_likelihood[first : first + LANES])
        store_rows(work, X0, means, first)
        store_rows(work, SPREAD00, covariances, first)
        store_rows(work, X, poses, first)

        # The landmarks, at the sampled pose.
        for b in range(num):
            for q in range(starts[b], starts[b + 1]):
                if mask_of(match[b], float(q), mask) > 0:
                    row = row_of[slots[q]]
                    tile = values[tile_of(padded, row, block)]
                    seen = counts[row, first : first + LANES]
                    num_young = find_young(seen, mask, young)
                    count_matches(seen, mask)
                    innovate(work, tile, points, noises, b, given, camera)
                    if num_young > 0:
                        before[:] = tile
                        update(work, tile, young, 0.0)
                        innovate(work, tile, points, noises, b, given, camera)
                        relinearise(work, tile, before)
                    update(work, tile, mask, walk)
            if mask_of(match[b], -2.0, mask) > 0:
                if new_slots[b] == REJECTED:
                    open_slot(b, new_slots, new_rows, row_of, map_of, values, counts, free_rows, free_slots, tops)
                new_landmark(
                    work, values[tile_of(padded, new_rows[b], block)], points, noises, b, given, camera, mask,
                    counts[new_rows[b], first : first + LANES], walk,
                )  # fmt: skip
            write_found(
                found[b, first : first + LANES], distances[b, first : first + LANES], match[b], starts[b],
                starts[b + 1], slots, records, Q_FIRST_D, new_slots[b],
            )  # fmt: skip
    name_new(new_slots, descriptors, names, named, ids, identities, stored, heads, tops)
