"""One robot's frame with the proposal of FastSLAM 2.0, for all particles."""

from typing import Any

import numpy as np

from slam_backend.core.jit import device, jit_fma, stack_array
from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.association.candidates import (
    create_once,
    find_candidates,
    mask_of,
    write_associations,
)
from slam_backend.fastslam._kernels.association.data_association import (
    associate_all,
    associate_unambiguous,
    iterate_wide,
    try_wide_prior,
    undo_unconfirmed,
)
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.measurement.pose_posterior import (
    gauss_newton_step,
    posterior,
    set_linearisation_point,
)
from slam_backend.fastslam._kernels.motion.motion_model import predict, store_rows, take_draws
from slam_backend.fastslam._kernels.motion.odometry_bias import correct_bias, set_bias_gain
from slam_backend.fastslam._kernels.particles.resampling import apply_resampling
from slam_backend.fastslam._kernels.records import Frame, MapArrays, Motion, Outcome, Poses, Space
from slam_backend.fastslam._kernels.update.landmark_ekf import new_landmark, update_matched


@device
@jit_fma
def update_fastslam2(
    robot: Poses, propagated_only: bool, motion: Motion, bias: FloatArray, maps: MapArrays, frame: Frame, rules: Any,
    work: FloatArray, outcome: Outcome,
) -> None:  # fmt: skip
    """Integrate one robot's motion and frame, the measurements shaping the sampled pose (FastSLAM 2.0, Laplace form).

    Data association takes two passes: unambiguous matches first refine the pose robustly, then all measurements are
    decided on at the refined pose. If a wide prior explains at least three measurements that the particle's own
    covariance does not, and these are most of those it explains, the particle is lost and the wide prior replaces its
    covariance, unless fewer than three matches hold at the pose found with it. `slam_backend.reference.fastslam2` is
    the same in plain Python, step by step.

    Args:
        robot: Poses before the motion, written: the new samples, and N(x^, P^) of each particle before sampling.
        propagated_only: Whether the robot has not been sampled at a sighting since N(x^, P^) was propagated.
        motion: Motion of the robot.
        bias: (2, 3, 3) covariance of the odometry bias and cross-covariance, see `step_robots`; changed.
        maps: Landmarks. B + 1 rows and B slots are free.
        frame: Measurements of the robot.
        rules: `kernel_options`.
        work: Working space.
        outcome: Results, written.
    """
    num, new_slots = len(frame.points), outcome.new_slots
    candidates, unique = find_candidates(frame, maps, rules)
    for q in range(len(candidates.descriptor_costs)):
        candidates.descriptor_costs[q] /= rules.descriptor_variance
    apply_resampling(unique, maps)
    match, mask = np.empty((num, LANES)), stack_array(LANES)
    space = Space(work, np.empty((len(candidates.slots), L.CANDIDATE_ROWS * LANES)), match, mask)
    new_slots[:] = L.REJECTED
    for block in range(robot.samples.shape[1] // LANES):
        first = block * LANES
        predict(work, robot, motion, propagated_only, first)
        if motion.biased and first == 0:
            set_bias_gain(work, motion, bias[0], bias[1])
        set_linearisation_point(work)

        # First pass: refine the pose with unambiguous matches.
        suspects = associate_unambiguous(space, block, maps, frame, candidates, rules)
        recovers = suspects > 0 and rules.recovery_position > 0.0 and not motion.exact
        if recovers:
            try_wide_prior(space, block, maps, frame, candidates, rules)
            set_linearisation_point(work)
            associate_unambiguous(space, block, maps, frame, candidates, rules)
        gauss_newton_step(work, False)
        iterate_wide(space, block, maps, frame, candidates, rules.position_gate)
        set_linearisation_point(work)
        if recovers and undo_unconfirmed(space, block, maps, frame, candidates, rules.position_gate) > 0:
            set_linearisation_point(work)
            associate_unambiguous(space, block, maps, frame, candidates, rules)
            gauss_newton_step(work, False)
            iterate_wide(space, block, maps, frame, candidates, rules.position_gate)
            set_linearisation_point(work)

        # Second pass: decide at the refined pose.
        associate_all(space, block, maps, frame, candidates, rules)
        match[:, len(motion.normals) - first :] = L.NO_MATCH  # surplus lanes start no landmark
        if frame.identified:
            for b in range(num):
                create_once(match, b, first, maps, candidates, frame.identities)

        # The pose: N(x^, P^) from all matches; weigh by the predictive likelihood; sample once.
        take_draws(work, motion.normals, first)
        posterior(work, outcome.log_likelihood, first)
        store_rows(work, L.X0, robot.means, first)
        store_rows(work, L.COV_XI00, robot.covariances, first)
        store_rows(work, L.X, robot.samples, first)
        if motion.biased:
            correct_bias(work, robot.biases, motion, first)

        # The landmarks, at the sampled pose.
        update_matched(space, block, maps, frame, candidates, rules.landmark_walk)
        for b in range(num):
            if mask_of(match[b], L.NEW_LANDMARK, mask) > 0:
                new_landmark(space, block, maps, frame, b, new_slots, rules.landmark_walk)
        write_associations(outcome, first, match, candidates, space.records, L.Q_FIRST_D)
