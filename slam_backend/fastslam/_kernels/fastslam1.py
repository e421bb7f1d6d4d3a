"""One robot's frame as in Algorithm 1 (corrected), for all particles."""

import math

import numpy as np

from slam_backend.core.jit import device, jit_fma, stack_array
from slam_backend.core.validation import Float32Array, FloatArray, Int32Array, IntArray
from slam_backend.fastslam._kernels.candidates import (
    create_once,
    exclude_assigned,
    find_candidates,
    mark_eligible,
    mask_of,
    write_associations,
)
from slam_backend.fastslam._kernels.landmark_ekf import gate_and_update, new_landmark
from slam_backend.fastslam._kernels.layout import CANDIDATE_ROWS, CLUTTER, LANES, Q_D, REJECTED
from slam_backend.fastslam._kernels.map_storage import (
    allocate_landmark,
    apply_resampling,
    gather_odds,
    register_new,
    tile_of,
)
from slam_backend.fastslam._kernels.measurement_model import clear_likelihood, innovate, total_log_likelihood
from slam_backend.fastslam._kernels.motion_model import load_pose, sample_motion, set_exact


@device
@jit_fma
def update_fastslam1(
    poses: FloatArray, means: FloatArray, covariances: FloatArray, moved: bool, odometry: FloatArray,
    sigmas: FloatArray, normals: FloatArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, free_slots: IntArray, tops: IntArray, ids: IntArray, identities: IntArray,
    stored: Float32Array, heads: Float32Array,
    points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray, descriptors: Float32Array, names: IntArray,
    named: bool, descriptor_gate: float, position_gate: float, log_p0: float, walk: float, one_to_one: bool,
    work: FloatArray, found: Int32Array, distances: FloatArray, new_slots: IntArray, log_likelihood: FloatArray,
) -> None:  # fmt: skip
    """Sample one robot's motion and integrate its frame as in Algorithm 1 (corrected).

    Args:
        poses: (3, P) rows x, y, theta of the particles, padded to P; replaced by the sampled ones if `moved`.
        means, covariances: (3, P), (6, P), written: the samples themselves, and zeros.
        odometry: (3,) u, previous robot frame.
        sigmas: (3,) standard deviations of u.
        normals: (M, 3) standard normal draws.
        values, counts, odds, ..., heads: The store, see `ParticleMaps`. B + 1 rows and B slots are free.
        points: (B, 3) measured points relative to the camera centre, robot axes.
        noises: (B, 6) their covariances in robot axes if `given`.
        given: Whether the covariances come with the measurements.
        camera: (7,) focal, baseline, sigma_px, sigma_disparity, mount.
        descriptors: (B, d).
        names: (B,) the caller's names of the landmarks measured, if `named`; gates then play no part.
        descriptor_gate: Largest admitted squared distance E0.
        position_gate: D0.
        log_p0: Log-density of a measurement that starts a new landmark.
        walk: Variance [m^2] along each axis by which a landmark may have moved between two sightings.
        one_to_one: Whether a landmark is matched at most once in a frame.
        work: Working space.
        found: (B, P), written: the slot, new ones included.
        distances: (B, P), written: D of matches, NaN otherwise.
        new_slots: (B,), written: the slot of the landmark that a measurement started in some particle, else -1.
        log_likelihood: (P,), the frame's is added.
    """
    num_particles, padded = normals.shape[0], poses.shape[1]
    num = points.shape[0]
    starts, slots, _, owners, same, unique = find_candidates(
        descriptors, stored, heads, ids, names, identities, named, descriptor_gate
    )
    if len(odds) > 0:
        gather_odds(unique, odds, map_of, maps)
    apply_resampling(unique, values, counts, row_of, map_of, maps, users, free_rows, tops)
    records = np.empty((len(slots), CANDIDATE_ROWS * LANES))
    new_rows = np.empty(num, dtype=np.int64)
    match = np.empty((num, LANES))
    mask = stack_array(LANES)
    gate = np.inf if named else position_gate
    for b in range(num):
        new_slots[b] = REJECTED
    for block in range(padded // LANES):
        first = block * LANES
        real = min(LANES, num_particles - first)
        if moved:
            sample_motion(work, poses, first, odometry, sigmas, normals)
        load_pose(work, poses, first)
        clear_likelihood(work)
        for b in range(num):
            chosen = match[b]
            for i in range(LANES):
                chosen[i] = -2.0 if i < real else -1.0
            for q in range(starts[b], starts[b + 1]):  # l. 15-24: the nearest descriptor inside the gate
                row = row_of[slots[q]]
                tile, record, seen = values[tile_of(padded, row, block)], records[q], counts[row, first : first + LANES]
                mark_eligible(chosen, seen, mask)
                p = same[q] if one_to_one else REJECTED
                while p >= 0:
                    exclude_assigned(match[owners[p]], float(p), mask)
                    p = same[p]
                innovate(work, tile, points, noises, b, given, camera)
                gate_and_update(work, tile, record, chosen, seen, float(q), mask, gate, walk)  # l. 33-37, 39
            log_clutter = log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))
            unmatched = mask_of(chosen, -2.0, mask)
            for i in range(LANES):
                work[CLUTTER + i] += log_clutter if mask[i] > 0.0 else 0.0
            if named:
                create_once(match, b, first, counts, row_of, starts, slots, names)
                unmatched = mask_of(chosen, -2.0, mask)
            if unmatched > 0:  # l. 28-32
                if new_slots[b] == REJECTED:
                    allocate_landmark(
                        b, new_slots, new_rows, row_of, map_of, values, counts, free_rows, free_slots, tops
                    )
                new_landmark(
                    work, values, counts, new_rows[b], block, points, noises, b, given, camera, mask, walk
                )  # fmt: skip
        write_associations(found, distances, first, match, starts, slots, records, Q_D, new_slots)
        for i in range(LANES):
            log_likelihood[first + i] += total_log_likelihood(work, i)
    set_exact(poses, means, covariances)
    register_new(new_slots, descriptors, names, named, ids, identities, stored, heads, tops)
