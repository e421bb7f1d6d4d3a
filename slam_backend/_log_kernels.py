"""The compiled part of logs: what robots did and measured in many steps is written into a robot's columns."""

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import in_place
from slam_backend._kernels import IDLE, MOVED, PLACED
from slam_backend._kernels.layout import ACT, BEGIN, COUNT, END, GIVEN
from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.log_arrays import EXACT, ODOMETRY, STOOD


@in_place
def write_rows(
    row: int, first: int, numbers: IntArray, table: IntArray, moves: FloatArray, sightings: FloatArray,
    found: IntArray, most: int, t: int, n: int,
    steps: IntArray, kinds: NDArray[np.int8], motions: FloatArray, given: BoolArray, starts: IntArray,
    points: FloatArray, ids: IntArray,
) -> tuple[int, int, int]:  # fmt: skip
    """Write the steps of one of N robots in which it did or measured anything, up to one that cannot stand there.

    That is one for which there is no room in the columns, or whose measurements come with covariances.

    Args:
        row: Which robot.
        first: Of the steps to be written.
        numbers: (T,) of the steps.
        table, moves: (T N, 6), (T N, 3). Of all steps one after the other, as in `StepInput`.
        sightings, found: (n, 9), (n,). Likewise, and the landmarks that the measurements were taken for, -1 = none.
        most: So many measurements may stand there.
        t, n: Rows and measurements that the columns hold.
        steps, kinds, motions, given, starts, points, ids: Columns of `LogArrays`, with room; written.

    Returns:
        The first step that was not written, T if there is none, and how many rows and measurements they hold then.
    """
    count, base = len(table) // len(numbers), 0
    for k in range(len(numbers)):
        turn = table[k * count + row]
        if k >= first and (turn[ACT] != IDLE or turn[COUNT] > 0):
            used = turn[END] - turn[BEGIN]
            if t == len(steps) or n + used > most or turn[GIVEN]:
                return k, t, n
            steps[t], given[t] = numbers[k], False
            kinds[t] = EXACT if turn[ACT] == PLACED else ODOMETRY if turn[ACT] == MOVED else STOOD
            for c in range(3):
                motions[t, c] = moves[k * count + row, c]
            for b in range(base + turn[BEGIN], base + turn[END]):
                for c in range(3):
                    points[n, c] = sightings[b, c]
                ids[n] = found[b]
                n += 1
            t += 1
            starts[t] = n
        base += table[(k + 1) * count - 1, END]
    return len(numbers), t, n


@in_place
def write_guesses(
    row: int, robot: int, numbers: IntArray, table: IntArray, means: FloatArray, steps: IntArray, poses: FloatArray
) -> tuple[int, bool]:
    """Write in which steps one of N robots did or measured anything, and where it was thought to be then.

    Args:
        row: Which robot.
        robot: Which of the filter's K.
        numbers, table: As of `write_rows`.
        means: (T K, 3) [m, m, rad] poses after all steps, map frame.
        steps, poses: (T,), (T, 3), results, of which the first rows are written.

    Returns:
        How many steps there are, and whether it was told where it is in any.
    """
    count, of_filter, num, is_placed = len(table) // len(numbers), len(means) // len(numbers), 0, False
    for k in range(len(numbers)):
        turn = table[k * count + row]
        if turn[ACT] != IDLE or turn[COUNT] > 0:
            steps[num] = numbers[k]
            for c in range(3):
                poses[num, c] = means[k * of_filter + robot, c]
            is_placed |= turn[ACT] == PLACED
            num += 1
    return num, is_placed
