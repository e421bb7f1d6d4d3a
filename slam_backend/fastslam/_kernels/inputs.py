"""What robots read in a step: how far its points reach, measurements in the robots' axes, all of it in one table."""

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
def to_robot_axes(points: FloatArray, covariances: FloatArray | None, measurements: FloatArray) -> None:
    """Turn measured points from camera axes to the robot's: x ahead, y left, z up.

    Args:
        points: (n, 3) [m], camera frame.
        covariances: (n, 3, 3) [m^2], camera frame, or None.
        measurements: (n, 9), written: the points relative to the camera centre, and the upper triangles of their
            covariances by rows, or zeros.
    """
    for i in range(len(points)):
        measurements[i, 0], measurements[i, 1], measurements[i, 2] = points[i, 2], -points[i, 0], -points[i, 1]
        for c in range(3, 9):
            measurements[i, c] = 0.0
    if covariances is not None:
        for i in range(len(points)):
            own, noise = covariances[i], measurements[i, 3:]
            noise[0], noise[1], noise[2] = own[2, 2], -own[2, 0], -own[2, 1]
            noise[3], noise[4], noise[5] = own[0, 0], own[0, 1], own[1, 1]


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
    to_robot_axes(points, None, measurements)
    nearest, farthest = extent(points)
    fine = begin == len(points) and nearest >= L.MIN_DEPTH and farthest <= farthest_point
    largest = np.float32(largest_entry)
    for i in range(len(descriptors)):
        for j in range(descriptors.shape[1]):
            fine &= abs(descriptors[i, j]) <= largest
    return fine
