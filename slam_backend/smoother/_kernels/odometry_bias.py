"""Odometry bias of a robot given each sampled path."""

import math

import numpy as np

from slam_backend.core.jit import jit_fma
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.smoother._kernels.factors import invert
from slam_backend.smoother._kernels.records import Keys


@jit_fma
def condition_bias(
    paths: FloatArray, keys: Keys, biases: IntArray, infos: FloatArray, bias: int
) -> tuple[FloatArray, FloatArray]:
    """Return the Gaussian of a robot's odometry bias given each of M paths.

    Args:
        paths: (k, 3, M) poses, and samples of the biases in their keys.
        keys: Keys of the graph, of which the odometry is used.
        biases: (k,) key of the bias of each key's odometry, `NONE` if it has none.
        infos: (k, 3, 3) information of the odometry; in the key of a bias that of its prior.
        bias: Key of the robot's bias.

    Returns:
        Means (3, M), and the covariance (3, 3), the same for all paths.
    """
    m, previous = paths.shape[2], keys.parents
    information, slopes, mean = infos[bias].copy(), np.empty((3, m)), paths[bias].copy()
    product = np.empty((3, 3))  # J^T W
    for axis in range(3):
        for i in range(m):
            slopes[axis, i] = 0.0
            for n in range(3):
                slopes[axis, i] += information[axis, n] * (mean[n, i] - keys.odometry[bias, n])
    for b in range(len(previous)):
        if biases[b] != bias:
            continue
        a, j, w, u = previous[b], keys.bias_jacobians[b], infos[b], keys.odometry[b]
        for r in range(3):
            for c in range(3):
                product[r, c] = j[0, r] * w[0, c] + j[1, r] * w[1, c] + j[2, r] * w[2, c]
        for r in range(3):
            for c in range(3):
                information[r, c] += product[r, 0] * j[0, c] + product[r, 1] * j[1, c] + product[r, 2] * j[2, c]
        for i in range(m):
            cosine, sine = math.cos(paths[a, 2, i]), math.sin(paths[a, 2, i])
            dx, dy = paths[b, 0, i] - paths[a, 0, i], paths[b, 1, i] - paths[a, 1, i]
            turn = paths[b, 2, i] - paths[a, 2, i] - u[2]
            r0, r1 = cosine * dx + sine * dy - u[0], cosine * dy - sine * dx - u[1]
            r2 = turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
            r0 += j[0, 0] * mean[0, i] + j[0, 1] * mean[1, i] + j[0, 2] * mean[2, i]
            r1 += j[1, 0] * mean[0, i] + j[1, 1] * mean[1, i] + j[1, 2] * mean[2, i]
            r2 += j[2, 1] * mean[1, i] + j[2, 2] * mean[2, i]
            for axis in range(3):
                slopes[axis, i] += product[axis, 0] * r0 + product[axis, 1] * r1 + product[axis, 2] * r2
    covariance = np.empty((3, 3))
    invert(information, covariance)
    for axis in range(3):
        for i in range(m):
            mean[axis, i] -= (
                covariance[axis, 0] * slopes[0, i] + covariance[axis, 1] * slopes[1, i]
                + covariance[axis, 2] * slopes[2, i]
            )  # fmt: skip
    return mean, covariance
