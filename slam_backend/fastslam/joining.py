"""Joining of two filters into one; `team.filter_merging` draws the motions between their maps and fuses the maps."""

from dataclasses import replace

import numpy as np

from slam_backend.core.packed_symmetric import UNPACK_INDEX, UPPER
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.geometry import compose, rotation


def joined_filter(
    a: FastSlam, from_a: IntArray, b: FastSlam, from_b: IntArray, motion: FloatArray, evidence: FloatArray,
    rng: np.random.Generator,
) -> FastSlam:  # fmt: skip
    """Return a filter of both groups' robots, a's first, in a's map frame, without landmarks yet.

    Args:
        a, b: Filter of each group.
        from_a, from_b: (M,) particles of each group that form the joint particles.
        motion: (M, 3) [m, m, rad], frame a from frame b, of each joint particle.
        evidence: (M,) log-weight of each pair.
        rng: Generator that seeds the joint filter's own stream.
    """
    count, k = len(motion), a.num_robots
    same = a.options.num_particles == count
    options = a.options if same else replace(a.options, num_particles=count)
    joint = FastSlam.from_options(k + b.num_robots, options, np.random.default_rng(rng.integers(2**63, size=4)))
    for target, of_a, of_b in zip(joint.pose_arrays[:3], a.pose_arrays, b.pose_arrays, strict=False):
        target[:k, :, :count] = of_a[:, :, from_a]
        target[k:, :, :count] = compose(motion, of_b[:, :, from_b].transpose(0, 2, 1)).transpose(0, 2, 1)
    turn = np.zeros((count, 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = rotation(motion[:, 2]), 1.0
    spread_b = b.covariances[:, :, from_b].transpose(0, 2, 1)[..., UNPACK_INDEX]
    moved = turn @ spread_b @ turn.transpose(0, 2, 1)
    joint.covariances[:k, :, :count] = a.covariances[:, :, from_a]
    joint.covariances[k:, :, :count] = moved[..., *UPPER].transpose(0, 2, 1)
    joint.biases[:k, :, :count], joint.biases[k:, :, :count] = a.biases[:, :, from_a], b.biases[:, :, from_b]
    joint.bias_covariances[:] = np.concatenate([a.bias_covariances, b.bias_covariances], axis=1)
    joint.propagated_only[:] = np.concatenate([a.propagated_only, b.propagated_only])
    joint.gauge_covariance[:] = a.gauge_covariance
    joint.start_covariances[:] = np.concatenate([a.start_covariances, b.start_covariances])
    joint.path_log_weights[:] = a.path_log_weights[from_a] + b.path_log_weights[from_b] + evidence
    return joint
