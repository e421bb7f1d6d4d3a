"""One robot's frame with the proposal of FastSLAM 2.0, for all particles."""

from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit_fma, stack_array
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
from slam_backend.fastslam._kernels.records import Candidates, Frame, MapArrays, Motion, Outcome, Poses, Space
from slam_backend.fastslam._kernels.update.landmark_ekf import correct_matched, new_landmark


@device
@jit_fma
def update_fastslam2(
    robot: Poses, propagated_only: bool, motion: Motion, bias: FloatArray, maps: MapArrays, frame: Frame, rules: Any,
    work: FloatArray, outcome: Outcome,
) -> None:  # fmt: skip
    """Integrate one robot's motion and frame, the measurements shaping the sampled pose (FastSLAM 2.0, Laplace form).

    `slam_backend.reference.fastslam2` is the same in plain Python, step by step.

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
    candidates, unique = find_candidates(frame, maps, rules)
    for q in range(len(candidates.descriptor_costs)):
        candidates.descriptor_costs[q] /= rules.descriptor_variance
    apply_resampling(unique, maps)
    records = np.empty((len(candidates.slots), L.CANDIDATE_ROWS * LANES))
    space = Space(work, records, np.empty((len(frame.points), LANES)), stack_array(LANES))
    outcome.new_slots[:] = L.REJECTED
    for block in range(robot.samples.shape[1] // LANES):
        first = block * LANES
        predict(work, robot, motion, propagated_only, first)
        if motion.biased and first == 0:
            set_bias_gain(work, motion, bias[0], bias[1])
        set_linearisation_point(work)
        refine(space, block, maps, frame, candidates, rules, not motion.exact)
        associate(space, block, maps, frame, candidates, rules, len(motion.normals))
        weigh_and_sample(work, robot, motion, outcome, first)
        update_landmarks(space, block, maps, frame, candidates, rules, outcome)


@device
@in_place
def refine(
    space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, rules: Any, can_recover: bool
) -> None:
    """Approach the mode of p(pose, matched measurements) with unambiguous matches, robustly.

    If a wide prior explains at least three measurements that the particle's own covariance does not, and these are most
    of those it explains, the particle is lost and the wide prior replaces its covariance, unless fewer than three
    matches hold at the pose found with it.
    """
    suspects = associate_unambiguous(space, block, maps, frame, candidates, rules)
    recovers = can_recover and suspects > 0 and rules.recovery_position > 0.0
    if recovers:
        try_wide_prior(space, block, maps, frame, candidates, rules)
        set_linearisation_point(space.work)
        associate_unambiguous(space, block, maps, frame, candidates, rules)
    iterate(space, block, maps, frame, candidates, rules.position_gate)
    if recovers and undo_unconfirmed(space, block, maps, frame, candidates, rules.position_gate) > 0:
        set_linearisation_point(space.work)
        associate_unambiguous(space, block, maps, frame, candidates, rules)
        iterate(space, block, maps, frame, candidates, rules.position_gate)


@device
@in_place
def iterate(
    space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, position_gate: float
) -> None:
    """Move each pose by Gauss-Newton steps, more of them where its heading is uncertain."""
    gauss_newton_step(space.work, False)
    iterate_wide(space, block, maps, frame, candidates, position_gate)
    set_linearisation_point(space.work)


@device
@in_place
def associate(
    space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, rules: Any, num_particles: int
) -> None:
    """Match, reject or start a landmark, measurement by measurement, at the refined pose."""
    first = block * LANES
    associate_all(space, block, maps, frame, candidates, rules)
    space.match[:, num_particles - first :] = L.NO_MATCH  # surplus lanes start no landmark
    if frame.identified:
        for b in range(len(frame.points)):
            create_once(space.match, b, first, maps, candidates, frame.identities)


@device
@in_place
def weigh_and_sample(work: FloatArray, robot: Poses, motion: Motion, outcome: Outcome, first: int) -> None:
    """Find N(x^, P^) given all matches, weigh by their predictive likelihood, and sample the pose once."""
    take_draws(work, motion.normals, first)
    posterior(work, outcome.log_likelihood, first)
    store_rows(work, L.X0, robot.means, first)
    store_rows(work, L.COV_XI00, robot.covariances, first)
    store_rows(work, L.X, robot.samples, first)
    if motion.biased:
        correct_bias(work, robot.biases, motion, first)


@device
@in_place
def update_landmarks(
    space: Space, block: int, maps: MapArrays, frame: Frame, candidates: Candidates, rules: Any, outcome: Outcome
) -> None:
    """Update matched landmarks at the sampled pose, start new ones, and write the associations."""
    correct_matched(space, block, maps, frame, candidates, rules.landmark_walk)
    for b in range(len(frame.points)):
        if mask_of(space.match[b], L.NEW_LANDMARK, space.mask) > 0:
            new_landmark(space, block, maps, frame, b, outcome.new_slots, rules.landmark_walk)
    write_associations(outcome, block * LANES, space.match, candidates, space.records, L.Q_FIRST_D)
