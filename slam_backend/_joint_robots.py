"""The robots of two filters in one: their poses, logs and smoothers, without a map."""

from dataclasses import replace

import numpy as np

from slam_backend._packed import UNPACK, UPPER
from slam_backend.consistency import ConsistencyTest
from slam_backend.errors import FloatArray, IntArray
from slam_backend.filter import FastSlam
from slam_backend.geometry import compose, rotation


def joined_robots(
    a: FastSlam, from_a: IntArray, b: FastSlam, from_b: IntArray, motion: FloatArray, rng: np.random.Generator
) -> FastSlam:
    """Return a filter of both groups' robots, a's first, without a map.

    Args:
        a, b: The filters of either group.
        from_a, from_b: (M,) which particle of either each joint particle pairs.
        motion: (M, 3) by which each joint particle moves what stems from b into a's map frame.
        rng: From which the joint filter's own stream is seeded.
    """
    same = a.options.num_particles == len(motion)
    options = a.options if same else replace(a.options, num_particles=len(motion))
    stream = np.random.default_rng(rng.integers(2**63, size=4))
    joint = FastSlam.from_options(a.num_robots + b.num_robots, options, stream)
    _join_poses(joint, a, from_a, b, from_b, motion)
    joint._blind[:] = np.concatenate([a._blind, b._blind])
    joint._frame[:] = a._frame
    return joint


def _join_poses(
    joint: FastSlam, a: FastSlam, from_a: IntArray, b: FastSlam, from_b: IntArray, motion: FloatArray
) -> None:
    """Write the poses of both groups, those of b moved by each particle's `motion` (M, 3)."""
    k, count = a.num_robots, len(motion)
    for name in ("_poses", "_starts", "_means"):
        target, of_a, of_b = getattr(joint, name), getattr(a, name), getattr(b, name)
        target[:k, :, :count] = of_a[:, :, from_a]
        target[k:, :, :count] = compose(motion, of_b[:, :, from_b].transpose(0, 2, 1)).transpose(0, 2, 1)
    joint._look_at_starts()
    turn = np.zeros((count, 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = rotation(motion[:, 2]), 1.0
    spread_b = b._covariances[:, :, from_b].transpose(0, 2, 1)[..., UNPACK]
    moved = turn @ spread_b @ turn.transpose(0, 2, 1)
    joint._covariances[:k, :, :count] = a._covariances[:, :, from_a]
    joint._covariances[k:, :, :count] = moved[..., *UPPER].transpose(0, 2, 1)


def finish(joint: FastSlam, a: FastSlam, b: FastSlam, renamed: IntArray) -> None:
    """Give a joint filter, whose map is loaded, its step count, warnings, estimates and logs.

    `renamed` is that of `merge_filters`.
    """
    joint._look_at_weights()
    joint._steps = max(a._steps, b._steps)
    joint._consistency = ConsistencyTest.joined(a._consistency, b._consistency)
    joint._estimates = joint._mixtures()
    joint._widen()
    joint._robot_logs = [log.copy() for log in a._logs] + [log.renamed(renamed[:, 0], renamed[:, 1]) for log in b._logs]
    if joint._rejuvenation is not None and a._rejuvenation is not None and b._rejuvenation is not None:
        starts = [slam._starts[:, :, : slam.num_particles] for slam in (a, b, joint)]
        joint._rejuvenation.join(a._rejuvenation, b._rejuvenation, starts, (a._frame, b._frame), renamed, joint._camera)
