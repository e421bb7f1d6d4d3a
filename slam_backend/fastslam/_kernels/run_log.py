"""The compiled part of logs: what robots did and measured in many steps is written into a robot's columns."""

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import in_place
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam._kernels.layout import (
    ESTIMATE,
    EXACT_POSE,
    HAS_COVARIANCES,
    LOGGED,
    LOGGED_KIND,
    MOTION,
    MOVED,
    NAME,
    USED,
)
from slam_backend.smoother.log_arrays import EXACT, ODOMETRY, STATIONARY


@in_place
def write_rows(
    robot: int, first: int, numbers: IntArray, noted: FloatArray, measured: FloatArray, most: int, t: int, n: int,
    steps: IntArray, kinds: NDArray[np.int8], motions: FloatArray, given: BoolArray, starts: IntArray,
    points: FloatArray, ids: IntArray,
) -> tuple[int, int, int]:  # fmt: skip
    """Write the steps of one of K robots in which it did or measured anything, up to one that cannot stand there.

    That is one for which there is no room in the columns, or whose measurements come with covariances.

    Args:
        robot: Which.
        first: Of the steps to be written.
        numbers: (T,) of the steps.
        noted, measured: (T, K, 10), (>= n, 10). Of all steps, as in a `Journal`.
        most: So many measurements may stand there.
        t, n: Rows and measurements that the columns hold.
        steps, kinds, motions, given, starts, points, ids: Columns of `LogArrays`, with room; written.

    Returns:
        The first step that was not written, T if there is none, and how many rows and measurements they hold then.
    """
    begin = 0
    for k in range(len(numbers)):
        for other in range(noted.shape[1]):
            note = noted[k, other]
            end = begin + int(note[USED])
            if other == robot and k >= first and note[LOGGED] > 0.0:
                if t == len(steps) or n + end - begin > most or note[HAS_COVARIANCES] > 0.0:
                    return k, t, n
                steps[t], given[t] = numbers[k], False
                kinds[t] = (
                    EXACT if note[LOGGED_KIND] == EXACT_POSE else ODOMETRY if note[LOGGED_KIND] == MOVED else STATIONARY
                )
                for axis in range(3):
                    motions[t, axis] = note[MOTION + axis]
                for b in range(begin, end):
                    for axis in range(3):
                        points[n, axis] = measured[b, axis]
                    ids[n] = int(measured[b, NAME])
                    n += 1
                t += 1
                starts[t] = n
            begin = end
    return len(numbers), t, n


@in_place
def write_initial_poses(
    robot: int, numbers: IntArray, noted: FloatArray, steps: IntArray, poses: FloatArray
) -> tuple[int, bool]:
    """Write in which steps one of K robots did or measured anything, and where it was thought to be then.

    Args:
        robot: Which.
        numbers, noted: As of `write_rows`.
        steps, poses: (T,), (T, 3), results, of which the first rows are written.

    Returns:
        How many steps there are, and whether it was told where it is in any.
    """
    num, is_placed = 0, False
    for k in range(len(numbers)):
        note = noted[k, robot]
        if note[LOGGED] > 0.0:
            steps[num] = numbers[k]
            for axis in range(3):
                poses[num, axis] = note[ESTIMATE + axis]
            is_placed |= note[LOGGED_KIND] == EXACT_POSE
            num += 1
    return num, is_placed
