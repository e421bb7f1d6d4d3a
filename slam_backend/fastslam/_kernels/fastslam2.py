"""One robot's frame with the proposal of FastSLAM 2.0, for all particles."""

import numpy as np

from slam_backend.core.jit import device, jit_fma, stack_array
from slam_backend.core.validation import Float32Array, FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.candidates import (
    create_once,
    find_candidates,
    mask_of,
    mask_padding,
    write_associations,
)
from slam_backend.fastslam._kernels.data_association import (
    associate_final,
    associate_initial,
    count_lost,
    iterate_inflated,
    try_inflated_prior,
)
from slam_backend.fastslam._kernels.landmark_ekf import new_landmark, update_matched
from slam_backend.fastslam._kernels.layout import CANDIDATE_ROWS, LANES, Q_FIRST_D, REJECTED, SPREAD00, X0, X
from slam_backend.fastslam._kernels.map_storage import allocate_landmark, apply_resampling, gather_odds, register_new
from slam_backend.fastslam._kernels.measurement_model import clear_likelihood
from slam_backend.fastslam._kernels.motion_model import predict, prior, store_rows, take_draws
from slam_backend.fastslam._kernels.pose_posterior import (
    any_wide,
    begin_pose,
    gauss_newton_step,
    posterior,
    set_linearisation_point,
)


@device
@jit_fma
def update_fastslam2(
    poses: FloatArray, means: FloatArray, covariances: FloatArray, blind: bool,
    odometry: FloatArray, sigmas: FloatArray, normals: FloatArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, free_slots: IntArray, tops: IntArray, ids: IntArray, identities: IntArray,
    stored: Float32Array, heads: Float32Array,
    points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray, descriptors: Float32Array, names: IntArray,
    named: bool, descriptor_gate: float, descriptor_variance: float, position_gate: float, new_landmark_gate: float,
    new_landmark_radius: float, ambiguity: float,
    recovery: FloatArray, log_p0: float, walk: float, one_to_one: bool,
    work: FloatArray, found: Int32Array, distances: FloatArray, new_slots: IntArray, log_likelihood: FloatArray,
) -> None:  # fmt: skip
    """Integrate one robot's motion and frame, the measurements shaping the sampled pose (FastSLAM 2.0, Laplace form).

    Association takes two passes: unambiguous candidates first refine the pose robustly, then all decisions are taken at
    the refined pose. A particle filter forgets how wrong its pose may be; where a wide prior explains three or more
    measurements, and most of all it can explain, that the stated uncertainty does not, this is not believed, and the
    wide prior takes its place. Written out, step by step, in `slam_backend.reference`.

    Args:
        poses: (3, P), the samples before the motion; replaced by the sampled ones.
        means, covariances: (3, P), (6, P), written: N(x^, P^) of each particle before sampling; read if `blind`.
        blind: Whether the robot has not been sampled at a sighting since N(x^, P^) was propagated.
        descriptor_variance: What squared distances between descriptors are divided by, to be weighed against D.
        new_landmark_gate: Between `position_gate` and this D a measurement is neither matched nor new.
        new_landmark_radius: Nor is it new this near to a landmark that looks like it [m].
        ambiguity: A runner-up within this cost makes a measurement ambiguous: it is held back.
        recovery: (3,) standard deviations of the pose [m, m, rad] where most matches contradict it; zeros: never.
        The others are as in `update_fastslam1`; rejected measurements are found at -1.
    """
    num_particles, num = normals.shape[0], len(points)
    starts, slots, looks, owners, same, unique = find_candidates(
        descriptors, stored, heads, ids, names, identities, named, descriptor_gate
    )
    for q in range(len(looks)):
        looks[q] /= descriptor_variance
    if len(odds) > 0:
        gather_odds(unique, odds, map_of, maps)
    apply_resampling(unique, values, counts, row_of, map_of, maps, users, free_rows, tops)
    records, match = np.empty((len(slots), CANDIDATE_ROWS * LANES)), np.empty((num, LANES))
    mask, new_rows = stack_array(LANES), np.empty(num, dtype=np.int64)
    for b in range(num):
        new_slots[b] = REJECTED
    for block in range(poses.shape[1] // LANES):
        first = block * LANES
        prior(work, poses, means, covariances, blind, first)
        predict(work, odometry, sigmas)
        begin_pose(work)
        clear_likelihood(work)

        # Pass A: refine the pose with what is beyond doubt.
        associate_initial(
            work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
            starts, slots, looks, owners, same, named, position_gate, ambiguity, one_to_one,
        )  # fmt: skip
        if recovery[0] > 0.0 and count_lost(work) > 0:
            try_inflated_prior(
                work, records, values, counts, row_of, block, points, noises, given, camera,
                starts, slots, same, position_gate, one_to_one, recovery,
            )  # fmt: skip
            associate_initial(
                work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
                starts, slots, looks, owners, same, named, position_gate, ambiguity, one_to_one,
            )  # fmt: skip
        gauss_newton_step(work, False)
        if any_wide(work) > 0:
            iterate_inflated(
                work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
                starts, slots, position_gate,
            )  # fmt: skip
        set_linearisation_point(work)

        # Pass B: decide at the refined pose.
        associate_final(
            work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
            starts, slots, looks, owners, same, named,
            position_gate, new_landmark_gate, new_landmark_radius, ambiguity, log_p0, one_to_one,
        )  # fmt: skip
        mask_padding(match, num_particles - first)
        if named:
            for b in range(num):
                create_once(match, b, first, counts, row_of, starts, slots, names)

        # The pose: N(x^, P^) from all matches; weigh by the predictive likelihood; sample once.
        take_draws(work, normals, first)
        posterior(work, log_likelihood, first)
        store_rows(work, X0, means, first)
        store_rows(work, SPREAD00, covariances, first)
        store_rows(work, X, poses, first)

        # The landmarks, at the sampled pose.
        update_matched(
            work, match, mask, values, counts, row_of, block, points, noises, given, camera, starts, slots, walk
        )
        for b in range(num):
            if mask_of(match[b], -2.0, mask) > 0:
                if new_slots[b] == REJECTED:
                    allocate_landmark(
                        b, new_slots, new_rows, row_of, map_of, values, counts, free_rows, free_slots, tops
                    )
                new_landmark(
                    work, values, counts, new_rows[b], block, points, noises, b, given, camera, mask, walk
                )  # fmt: skip
        write_associations(found, distances, first, match, starts, slots, records, Q_FIRST_D, new_slots)
    register_new(new_slots, descriptors, names, named, ids, identities, stored, heads, tops)
