"""What robots read in a step: how far its points reach, and all of it in one table."""

import math

import numpy as np

from slam_backend.core.jit import in_place
from slam_backend.core.validation import Float32Array, FloatArray, IntArray
from slam_backend.fastslam._kernels import layout as L


@in_place
def extent(points: FloatArray) -> tuple[float, float]:
    """Return the smallest depth Z and the largest coordinate, by magnitude, of points (n, 3), camera frame.

    Both are NaN if any number is.
    """
    nearest, farthest = np.inf, 0.0
    for n in range(len(points)):
        nearest = min(nearest, points[n, 2])
        for c in range(3):
            if math.isnan(points[n, c]):
                return np.nan, np.nan
            farthest = max(farthest, abs(points[n, c]))
    return nearest, farthest


@in_place
def read_team(
    moves: FloatArray, points: FloatArray, descriptors: Float32Array, ends: IntArray, farthest_move: float,
    farthest_point: float, largest_entry: float, table: IntArray, measurements: FloatArray,
) -> bool:  # fmt: skip
    """Write what N robots read that have all moved and looked, without covariances and names, if nothing is amiss.

    Args:
        moves: (N, 3) [m, m, rad] odometry.
        points: (n, 3) [m], camera frames, one robot's after the other's.
        descriptors: (n, d) their descriptors.
        ends: (N,) where the points of each end.
        farthest_move: [m, rad] limit to the odometry.
        farthest_point: [m] limit to coordinates.
        largest_entry: Limit to components of descriptors.
        table, measurements: (N, 6), (n, 9), written as in `StepInput`.

    Returns:
        Whether ends rise up to n, numbers are within their limits, and depths begin at `MIN_DEPTH`. If not, what is
        written means nothing.
    """
    begin = 0
    for robot in range(len(moves)):
        for c in range(3):
            if not abs(moves[robot, c]) <= farthest_move:  # NaN is not
                return False
        end, entry = ends[robot], table[robot]
        if end < begin:
            return False
        (
            entry[L.MOTION_KIND],
            entry[L.BEGIN],
            entry[L.END],
            entry[L.COVARIANCES_GIVEN],
            entry[L.HAS_IDS],
            entry[L.COUNT],
        ) = (
            L.MOVED,
            begin,
            end,
            0,
            0,
            end - begin,
        )
        begin = end
    for n in range(len(points)):  # to the robots' axes: x ahead, y left, z up
        measurements[n, 0], measurements[n, 1], measurements[n, 2] = points[n, 2], -points[n, 0], -points[n, 1]
        for c in range(3, 9):
            measurements[n, c] = 0.0
    nearest, farthest = extent(points)
    fine = begin == len(points) and nearest >= L.MIN_DEPTH and farthest <= farthest_point
    largest = np.float32(largest_entry)
    for i in range(len(descriptors)):
        for j in range(descriptors.shape[1]):
            fine &= abs(descriptors[i, j]) <= largest
    return fine
