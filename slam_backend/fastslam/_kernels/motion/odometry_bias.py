"""Odometry bias of a robot, constant in a run: its share of the predicted motion, and what a sampled pose says of it.

Given its path, the bias b of a particle is Gaussian. Its covariance depends on the motions alone and is the same in all
particles of a robot; its mean is each particle's own. With u the reading, J its derivative by b and n the noise, the
motion is u - J b - n. While a robot sees nothing its pose is not sampled, and correlates with b: the covariance of
both, in the robot's axes, is again the same in all particles. Everything is to first order.
"""

import math

from slam_backend.core.jit import device, in_place, simd, stack_array
from slam_backend.core.simd_math import sine_cosine, wrapped
from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.records import Motion

LARGEST_INNOVATION = 30.0  # squared Mahalanobis distance; a pose farther off was recovered and says nothing of the bias


@device
@in_place
def write_bias_jacobian(move: FloatArray, jacobian: FloatArray) -> None:
    """Write the derivative J (3, 3) of a reading (3,) by the bias, as `OdometryModel.bias_jacobians` says."""
    distance, turn = math.hypot(move[0], move[1]), move[2]
    jacobian[0, 0], jacobian[0, 1], jacobian[0, 2] = move[0], -0.5 * move[1] * distance, -0.5 * move[1] * turn
    jacobian[1, 0], jacobian[1, 1], jacobian[1, 2] = move[1], 0.5 * move[0] * distance, 0.5 * move[0] * turn
    jacobian[2, 0], jacobian[2, 1], jacobian[2, 2] = 0.0, distance, turn


@device
@in_place
def prepare_bias(motion: Motion, covariance: FloatArray, cross: FloatArray) -> None:
    """Write what the bias adds to the uncertainty of a motion, and the factor of all of it.

    Args:
        motion: Motion; `jacobian`, `spread` and `factor` are written.
        covariance: (3, 3) P of the bias.
        cross: (3, 3) covariance X of the pose (rows, axes of the robot) and the bias; moved along, F X - J P.
    """
    u, j, spread, factor = motion.odometry, motion.jacobian, motion.spread, motion.factor
    write_bias_jacobian(u, j)
    a, b = stack_array(9).reshape(3, 3), stack_array(9).reshape(3, 3)  # J P, and F X
    s = stack_array(9).reshape(3, 3)
    for c in range(3):
        b[0, c], b[1, c], b[2, c] = cross[0, c] - u[1] * cross[2, c], cross[1, c] + u[0] * cross[2, c], cross[2, c]
        for r in range(3):
            a[r, c] = j[r, 0] * covariance[0, c] + j[r, 1] * covariance[1, c] + j[r, 2] * covariance[2, c]
    for r in range(3):
        for c in range(3):
            s[r, c] = a[r, 0] * j[c, 0] + a[r, 1] * j[c, 1] + a[r, 2] * j[c, 2]  # J P J^T
    factor[:] = 0.0  # of diag(sigmas^2) + J P J^T
    for r in range(3):
        for c in range(r + 1):
            total = s[r, c] + (motion.sigmas[r] ** 2 if r == c else 0.0)
            for k in range(c):
                total -= factor[r, k] * factor[c, k]
            if r == c:
                factor[r, r] = math.sqrt(total) if total > 0.0 else 0.0
            else:
                factor[r, c] = total / factor[c, c] if factor[c, c] > 0.0 else 0.0
    for r in range(3):
        for c in range(3):
            s[r, c] -= b[r, 0] * j[c, 0] + b[r, 1] * j[c, 1] + b[r, 2] * j[c, 2]
            s[r, c] -= j[r, 0] * b[c, 0] + j[r, 1] * b[c, 1] + j[r, 2] * b[c, 2]
    cosine, sine = math.cos(u[2]), math.sin(u[2])  # to the axes after the motion
    spread[0] = cosine * cosine * s[0, 0] + 2.0 * cosine * sine * s[0, 1] + sine * sine * s[1, 1]
    spread[1] = cosine * sine * (s[1, 1] - s[0, 0]) + (cosine * cosine - sine * sine) * s[0, 1]
    spread[2] = cosine * s[0, 2] + sine * s[1, 2]
    spread[3] = sine * sine * s[0, 0] - 2.0 * cosine * sine * s[0, 1] + cosine * cosine * s[1, 1]
    spread[4] = cosine * s[1, 2] - sine * s[0, 2]
    spread[5] = s[2, 2]
    for c in range(3):
        x, y = b[0, c] - a[0, c], b[1, c] - a[1, c]
        cross[0, c], cross[1, c], cross[2, c] = cosine * x + sine * y, cosine * y - sine * x, b[2, c] - a[2, c]


@device
@simd
def add_bias_spread(work: FloatArray, motion: Motion) -> None:
    """Add to the predicted covariances, robot axes, what the bias adds; keep the predicted pose."""
    e = motion.spread
    e0, e1, e2, e3, e4, e5 = e[0], e[1], e[2], e[3], e[4], e[5]
    for i in range(LANES):
        work[L.N00 + i] += e0
        work[L.N01 + i] += e1
        work[L.N02 + i] += e2
        work[L.N11 + i] += e3
        work[L.N12 + i] += e4
        work[L.N22 + i] += e5
        work[L.PREDICTED0 + i], work[L.PREDICTED1 + i], work[L.PREDICTED2 + i] = (
            work[L.X0 + i],
            work[L.Y0 + i],
            work[L.T0 + i],
        )


@device
@in_place
def set_bias_gain(work: FloatArray, motion: Motion, covariance: FloatArray, cross: FloatArray) -> None:
    """Write the gain by which a sampled pose corrects the bias, and reduce the covariance of the bias.

    Args:
        work: Rows of a block after the prediction; the predicted covariance N of one lane stands for all.
        motion: Motion; `gain` G = X^T N^-1 and `information` N^-1 are written, zeros where N is singular.
        covariance: (3, 3) P, changed: P - G X.
        cross: (3, 3) X; zeros afterwards.
    """
    n00, n01, n02, n11, n12, n22 = work[L.N00], work[L.N01], work[L.N02], work[L.N11], work[L.N12], work[L.N22]
    gain, information = motion.gain, motion.information
    p, q, r = n11 * n22 - n12 * n12, n02 * n12 - n01 * n22, n01 * n12 - n02 * n11
    det = n00 * p + n01 * q + n02 * r
    gain[:] = 0.0
    information[:] = 0.0
    if det > 0.0:
        information[0], information[1], information[2] = p / det, q / det, r / det
        information[3], information[4] = (n00 * n22 - n02 * n02) / det, (n01 * n02 - n00 * n12) / det
        information[5] = (n00 * n11 - n01 * n01) / det
        w = information
        for c in range(3):
            x0, x1, x2 = cross[0, c], cross[1, c], cross[2, c]
            gain[c, 0] = w[0] * x0 + w[1] * x1 + w[2] * x2
            gain[c, 1] = w[1] * x0 + w[3] * x1 + w[4] * x2
            gain[c, 2] = w[2] * x0 + w[4] * x1 + w[5] * x2
        for r_ in range(3):
            for c in range(r_, 3):
                covariance[r_, c] -= gain[r_, 0] * cross[0, c] + gain[r_, 1] * cross[1, c] + gain[r_, 2] * cross[2, c]
                covariance[c, r_] = covariance[r_, c]
    cross[:] = 0.0


@device
@simd
def correct_bias(work: FloatArray, biases: FloatArray, motion: Motion, first: int) -> None:
    """Correct the biases (3, P) of a block by the poses that were sampled (rows X .. T), from particle `first` on."""
    g, w = motion.gain, motion.information
    w0, w1, w2, w3, w4, w5 = w[0], w[1], w[2], w[3], w[4], w[5]
    for i in range(LANES):
        s, c = sine_cosine(work[L.PREDICTED2 + i])
        dx, dy = work[L.X + i] - work[L.PREDICTED0 + i], work[L.Y + i] - work[L.PREDICTED1 + i]
        d0, d1, d2 = c * dx + s * dy, c * dy - s * dx, wrapped(work[L.T + i] - work[L.PREDICTED2 + i])
        square = d0 * (w0 * d0 + 2.0 * (w1 * d1 + w2 * d2)) + d1 * (w3 * d1 + 2.0 * w4 * d2) + w5 * d2 * d2
        on = square <= LARGEST_INNOVATION
        work[L.BIAS0 + i] = d0 if on else 0.0
        work[L.BIAS1 + i] = d1 if on else 0.0
        work[L.BIAS2 + i] = d2 if on else 0.0
    for k in range(3):
        g0, g1, g2 = g[k, 0], g[k, 1], g[k, 2]
        own = biases[k, first : first + LANES]
        for i in range(LANES):
            own[i] += g0 * work[L.BIAS0 + i] + g1 * work[L.BIAS1 + i] + g2 * work[L.BIAS2 + i]


@device
@in_place
def set_draw_gain(motion: Motion, covariance: FloatArray) -> None:
    """Write the gain by which the normal draws of a motion correct the bias, and reduce the covariance of the bias.

    With L L^T the covariance of the motion, L z what was drawn: G = -P J^T L^-T, and P - G G^T.

    Args:
        motion: Motion; `gain` is written.
        covariance: (3, 3) P, changed.
    """
    j, factor, gain = motion.jacobian, motion.factor, motion.gain
    for c in range(3):
        for r in range(3):  # forward substitution in L G^T = -J P
            total = -(j[r, 0] * covariance[0, c] + j[r, 1] * covariance[1, c] + j[r, 2] * covariance[2, c])
            for k in range(r):
                total -= factor[r, k] * gain[c, k]
            gain[c, r] = total / factor[r, r] if factor[r, r] > 0.0 else 0.0
    for r in range(3):
        for c in range(3):
            covariance[r, c] -= gain[r, 0] * gain[c, 0] + gain[r, 1] * gain[c, 1] + gain[r, 2] * gain[c, 2]


@device
@simd
def correct_bias_by_draws(work: FloatArray, biases: FloatArray, motion: Motion, first: int) -> None:
    """Correct the biases (3, P) of a block by the draws of its motion (rows DRAW0 .. DRAW2)."""
    for k in range(3):
        g0, g1, g2 = motion.gain[k, 0], motion.gain[k, 1], motion.gain[k, 2]
        own = biases[k, first : first + LANES]
        for i in range(LANES):
            own[i] += g0 * work[L.DRAW0 + i] + g1 * work[L.DRAW1 + i] + g2 * work[L.DRAW2 + i]
