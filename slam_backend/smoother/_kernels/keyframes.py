"""Keyframes from a robot's new steps, and the landmarks that their measurements belong to."""

import math
from typing import TYPE_CHECKING

import numpy as np

from slam_backend.core.jit import jit
from slam_backend.core.validation import IntArray
from slam_backend.smoother._kernels.records import LEVER, Frames, Keys, Log, Points
from slam_backend.smoother.log_arrays import ODOMETRY, REJECTED

if TYPE_CHECKING:
    from slam_backend.smoother.graph_building import InitialPoses


@jit
def add_keyframes(
    log: Log, initial_poses: "InitialPoses", robot: int, rigid_within: float, tips: IntArray, ends: IntArray,
    keys: Keys, frames: Frames, raw: Points,
) -> bool:  # fmt: skip
    """Take in the steps of a robot's log: what becomes a key, and what was measured.

    Args:
        log: New steps.
        initial_poses: Poses of the robot after some of them; elsewhere odometry is chained.
        robot: Robot of the log.
        rigid_within: [m]. A step that measured something becomes a key unless odometry since the last key scatters
            less; see `SmoothingOptions`.
        tips: (K,) newest key of each robot, changed.
        ends: (3,) numbers of keys, frames and raw measurements, changed.
        keys, frames, raw: Columns of the graph with room for new rows, which are written, with names of landmarks in
            place of their rows. The rigid variance of the newest old key is changed where frames are attached to it.

    Returns:
        Whether there is a pose for the first step that measured something, or no such step.
    """
    starts, ids = log.starts, log.ids
    key, frame, num, tip, row_of_pose = ends[0], ends[1], ends[2], tips[robot], 0
    pose, chain, noise = keys.poses[tip].copy(), np.zeros(3), np.zeros((3, 3))
    jacobian, move, bias, biased = np.zeros((3, 3)), np.zeros(3), log.bias, len(log.jacobians) > 0
    moved, measured, is_guided = False, False, True
    for t in range(len(log.steps)):
        first = num
        for row in range(starts[t], starts[t + 1]):
            if ids[row] != REJECTED:
                raw.has_covariance[num], raw.point_frames[num], raw.point_landmarks[num] = log.given[t], frame, ids[row]
                for i in range(3):
                    raw.points[num, i] = log.points[row, i]
                for i in range(6):
                    raw.point_noises[num, i] = log.covariances[row, i] if len(log.covariances) > 0 else 0.0
                num += 1
        if log.kinds[t] == ODOMETRY:
            variances = log.variances[t]
            for axis in range(3):
                move[axis] = log.motions[t, axis]
            if biased:
                j = log.jacobians[t]
                for axis in range(3):
                    move[axis] -= j[axis, 0] * bias[0] + j[axis, 1] * bias[1] + j[axis, 2] * bias[2]
            c, s = math.cos(chain[2]), math.sin(chain[2])  # the covariance of the chain grows to first order
            dx, dy = c * move[0] - s * move[1], s * move[0] + c * move[1]
            n02, n12, n22 = noise[0, 2], noise[1, 2], noise[2, 2]
            noise[0, 0] += -2.0 * dy * n02 + dy * dy * n22 + c * c * variances[0] + s * s * variances[1]
            noise[0, 1] += dx * n02 - dy * n12 - dx * dy * n22 + c * s * (variances[0] - variances[1])
            noise[1, 1] += 2.0 * dx * n12 + dx * dx * n22 + s * s * variances[0] + c * c * variances[1]
            noise[0, 2] -= dy * n22
            noise[1, 2] += dx * n22
            noise[2, 2] += variances[2]
            noise[1, 0], noise[2, 0], noise[2, 1] = noise[0, 1], noise[0, 2], noise[1, 2]
            if biased:
                for axis in range(3):
                    turn = jacobian[2, axis]
                    jacobian[0, axis] += c * j[0, axis] - s * j[1, axis] - dy * turn
                    jacobian[1, axis] += s * j[0, axis] + c * j[1, axis] + dx * turn
                    jacobian[2, axis] += j[2, axis]
            chain[0] += dx
            chain[1] += dy
            chain[2] = (chain[2] + move[2] + math.pi) % (2.0 * math.pi) - math.pi
            c, s = math.cos(pose[2]), math.sin(pose[2])
            pose[0] += c * move[0] - s * move[1]
            pose[1] += s * move[0] + c * move[1]
            pose[2] = (pose[2] + move[2] + math.pi) % (2.0 * math.pi) - math.pi
            moved = True
        while row_of_pose < len(initial_poses.steps) and initial_poses.steps[row_of_pose] < log.steps[t]:
            row_of_pose += 1
        is_given = row_of_pose < len(initial_poses.steps) and initial_poses.steps[row_of_pose] == log.steps[t]
        if is_given and not math.isnan(initial_poses.poses[row_of_pose, 0]):
            for i in range(3):
                pose[i] = initial_poses.poses[row_of_pose, i]
        else:
            is_given = False
        if not measured and starts[t + 1] > 0:
            measured, is_guided = True, is_given
        scatter = noise[0, 0] + noise[1, 1] + LEVER * LEVER * noise[2, 2]
        far = num > first and scatter >= rigid_within * rigid_within
        if moved and (far or t == len(log.steps) - 1):
            keys.robots[key], keys.parents[key], keys.transition_variances[key] = robot, tip, scatter
            for i in range(3):
                keys.poses[key, i], keys.odometry[key, i] = pose[i], chain[i]
                for axis in range(3):
                    keys.odometry_covariances[key, i, axis] = noise[i, axis]
                    keys.bias_jacobians[key, i, axis] = jacobian[i, axis]
                if biased:
                    own = jacobian[i]
                    keys.odometry[key, i] += own[0] * bias[0] + own[1] * bias[1] + own[2] * bias[2]
            chain[:] = 0.0
            noise[:] = 0.0
            jacobian[:] = 0.0
            scatter, moved = 0.0, False
            tip, keys.rigid_variances[key] = key, 0.0
            key += 1
        if num > first:
            keys.rigid_variances[tip] = max(keys.rigid_variances[tip], scatter)
            frames.frame_keys[frame] = tip
            for i in range(3):
                frames.frame_offsets[frame, i] = chain[i]
            frame += 1
    tips[robot] = tip
    ends[0], ends[1], ends[2] = key, frame, num
    return is_guided
