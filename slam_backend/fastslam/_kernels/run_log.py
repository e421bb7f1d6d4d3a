"""The compiled part of logs: what robots did and measured in many steps is written into a robot's columns."""

from typing import Any

import numpy as np

from slam_backend.core.jit import in_place
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.records import LogColumns
from slam_backend.smoother.log_arrays import EXACT, ODOMETRY, STATIONARY


@in_place
def write_rows(
    robot: int, first: int, numbers: IntArray, noted: FloatArray, measured: FloatArray, most: int, t: int, n: int,
    columns: LogColumns,
) -> tuple[int, int, int]:  # fmt: skip
    """Write the steps of one of K robots in which it did or measured anything, up to one that cannot stand there.

    That is one for which there is no room in the columns, or whose measurements come with covariances.

    Args:
        robot: Index of the robot.
        first: First of the steps to be written.
        numbers: (T,) numbers of the steps.
        noted, measured: (T, K, 10), (>= n, 10) journal of all steps, see `log_step`.
        most: Largest number of measurements that may stand there.
        t, n: Numbers of rows and measurements that the columns hold.
        columns: Columns of a log, written.

    Returns:
        The first step that was not written, T if there is none, and how many rows and measurements they hold then.
    """
    begin = 0
    for k in range(len(numbers)):
        for other in range(noted.shape[1]):
            note = noted[k, other]
            end = begin + int(note[L.USED])
            if other == robot and k >= first and note[L.LOGGED] > 0.0:
                if t == len(columns.steps) or n + end - begin > most or note[L.HAS_COVARIANCES] > 0.0:
                    return k, t, n
                columns.steps[t], columns.given[t] = numbers[k], False
                columns.kinds[t] = (
                    EXACT
                    if note[L.LOGGED_KIND] == L.EXACT_POSE
                    else ODOMETRY
                    if note[L.LOGGED_KIND] == L.MOVED
                    else STATIONARY
                )
                for axis in range(3):
                    columns.motions[t, axis] = note[L.MOTION + axis]
                for b in range(begin, end):
                    for axis in range(3):
                        columns.points[n, axis] = measured[b, axis]
                    columns.ids[n] = int(measured[b, L.NAME])
                    n += 1
                t += 1
                columns.starts[t] = n
            begin = end
    return len(numbers), t, n


def initial_poses_of(robot: int, numbers: IntArray, noted: FloatArray) -> tuple[IntArray, FloatArray, bool]:
    """Return the steps in which one of K robots did or measured anything, and where it was thought to be then.

    Args:
        robot: Index of the robot.
        numbers, noted: See `write_rows`.

    Returns:
        The numbers of these steps (t,), the poses (t, 3), and whether the robot was placed in any.
    """
    kept = noted[:, robot, L.LOGGED] > 0.0
    return (
        numbers[kept],
        noted[kept, robot, L.ESTIMATE :],
        bool((noted[kept, robot, L.LOGGED_KIND] == L.EXACT_POSE).any()),
    )


def turn_of(robot: int, k: int, noted: FloatArray, measured: FloatArray) -> dict[str, Any] | None:
    """Return what one of K robots did and measured in step k, by the names of `RobotLog.append`; None: nothing.

    Args:
        robot, k: Indices of the robot and of the step.
        noted, measured: See `write_rows`.
    """
    note = noted[k, robot]
    if not note[L.LOGGED]:
        return None
    begin = int(noted[:k, :, L.USED].sum() + noted[k, :robot, L.USED].sum())
    own = measured[begin : begin + int(note[L.USED])]
    move = note[L.MOTION : L.ESTIMATE] if note[L.LOGGED_KIND] in (L.MOVED, L.EXACT_POSE) else None
    return {
        "odometry": move,
        "pose": move if note[L.LOGGED_KIND] == L.EXACT_POSE else None,
        "points": own[:, :3],
        "ids": own[:, L.NAME].astype(np.int64),
        "covariances": own[:, 3 : L.NAME] if note[L.HAS_COVARIANCES] else None,
    }
