"""Motion of all lanes of a block: predicted with its covariance, sampled, or carried on blindly (Eq. 4)."""

import math

from slam_backend.core.jit import device, simd, simd_inline
from slam_backend.core.simd_math import sine_cosine, wrapped
from slam_backend.core.validation import FloatArray
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.motion.odometry_bias import add_bias_spread
from slam_backend.fastslam._kernels.records import Motion, Poses

WIDE_HEADING = 0.03  # [rad]; where the heading is less sure, one step of Gauss-Newton is not enough
ZERO_PIVOT = 1e-12  # relative to the variance: below it a direction is taken to be exact


@device
@simd
def load_rows(work: FloatArray, low: int, rows: FloatArray, first: int) -> None:
    """Copy a block of rows (c, P), from lane `first` on, into the rows of the workspace from `low` on."""
    for c in range(len(rows)):
        source, target = rows[c, first : first + LANES], work[low + c * LANES : low + (c + 1) * LANES]
        for i in range(LANES):
            target[i] = source[i]


@device
@simd
def store_rows(work: FloatArray, low: int, rows: FloatArray, first: int) -> None:
    """Copy rows of the workspace from `low` on into a block of rows (c, P), from lane `first` on."""
    for c in range(len(rows)):
        source, target = work[low + c * LANES : low + (c + 1) * LANES], rows[c, first : first + LANES]
        for i in range(LANES):
            target[i] = source[i]


@simd_inline
def advance(work: FloatArray, i: int, dx: float, dy: float, turn: float, v0: float, v1: float, v2: float) -> None:
    """Move one lane by (dx, dy, turn) of independent variances, and turn its covariance into the robot's axes."""
    s, c = sine_cosine(work[L.T0 + i])
    ox, oy = c * dx - s * dy, s * dx + c * dy
    work[L.X0 + i] += ox
    work[L.Y0 + i] += oy
    work[L.T0 + i] += turn
    p00, p01, p02 = work[L.N00 + i], work[L.N01 + i], work[L.N02 + i]
    p11, p12, p22 = work[L.N11 + i], work[L.N12 + i], work[L.N22 + i]
    # F = [[1, 0, -oy], [0, 1, ox], [0, 0, 1]]
    q00 = p00 - 2.0 * oy * p02 + oy * oy * p22 + c * c * v0 + s * s * v1
    q01 = p01 + ox * p02 - oy * p12 - ox * oy * p22 + c * s * (v0 - v1)
    q02 = p02 - oy * p22
    q11 = p11 + 2.0 * ox * p12 + ox * ox * p22 + s * s * v0 + c * c * v1
    q12 = p12 + ox * p22
    s, c = sine_cosine(work[L.T0 + i])
    work[L.N00 + i] = c * c * q00 + 2.0 * c * s * q01 + s * s * q11
    work[L.N01 + i] = c * s * (q11 - q00) + (c * c - s * s) * q01
    work[L.N02 + i] = c * q02 + s * q12
    work[L.N11 + i] = s * s * q00 - 2.0 * c * s * q01 + c * c * q11
    work[L.N12 + i] = c * q12 - s * q02
    work[L.N22 + i] = p22 + v2
    work[L.COS + i], work[L.SIN + i] = c, s
    work[L.XI0 + i], work[L.XI1 + i], work[L.XI2 + i] = 0.0, 0.0, 0.0


@device
@simd
def predict(work: FloatArray, robot: Poses, motion: Motion, propagated_only: bool, first: int) -> None:
    """Predict the poses of a block, of particles from `first` on, and write a factor C of their covariance P0 (Eq. 4).

    C = T L with L the lower Cholesky factor of T^T P0 T, where T is the turn by the predicted heading: factorised in
    the robot's axes, how the map frame happens to be turned plays no part. Rows X0 .. T0 hold the predicted pose
    afterwards, N00 .. N22 hold T^T P0 T, COS and SIN the turn, and xi is 0.

    Args:
        work: Rows of the block.
        robot: Poses before the motion: N(x^, P^) if `propagated_only`, else the samples, exact.
        motion: Odometry, its standard deviations and its bias.
        propagated_only: Whether the robot has not been sampled at a sighting since N(x^, P^) was propagated.
        first: First particle of the block.
    """
    if propagated_only:
        load_rows(work, L.X0, robot.means, first)
        load_rows(work, L.N00, robot.covariances, first)
    else:
        load_rows(work, L.X0, robot.samples, first)
        for j in range(L.N00, L.N22 + LANES):
            work[j] = 0.0
    dx, dy, turn = motion.odometry[0], motion.odometry[1], motion.odometry[2]
    v0, v1, v2 = motion.sigmas[0] ** 2, motion.sigmas[1] ** 2, motion.sigmas[2] ** 2
    if motion.biased:
        load_rows(work, L.BIAS0, robot.biases, first)
        by_bias = motion.jacobian
        j00, j01, j02 = by_bias[0, 0], by_bias[0, 1], by_bias[0, 2]
        j10, j11, j12 = by_bias[1, 0], by_bias[1, 1], by_bias[1, 2]
        j21, j22 = by_bias[2, 1], by_bias[2, 2]
        for i in range(LANES):
            b0, b1, b2 = work[L.BIAS0 + i], work[L.BIAS1 + i], work[L.BIAS2 + i]
            x, y = dx - (j00 * b0 + j01 * b1 + j02 * b2), dy - (j10 * b0 + j11 * b1 + j12 * b2)
            advance(work, i, x, y, turn - (j21 * b1 + j22 * b2), v0, v1, v2)
        add_bias_spread(work, motion)
    else:
        for i in range(LANES):
            advance(work, i, dx, dy, turn, v0, v1, v2)
    for i in range(LANES):
        work[L.IS_WIDE + i] = 1.0 if work[L.N22 + i] > WIDE_HEADING**2 else 0.0
    for i in range(LANES):
        q00, q11, q22 = work[L.N00 + i], work[L.N11 + i], work[L.N22 + i]
        c, s = work[L.COS + i], work[L.SIN + i]
        l00 = math.sqrt(q00 if q00 > 0.0 else 0.0)
        inverse = 1.0 / l00 if q00 > 0.0 else 0.0  # a vanishing pivot gives L a column of zeros
        l10, l20 = work[L.N01 + i] * inverse, work[L.N02 + i] * inverse
        rest = q11 - l10 * l10
        rest = rest if rest > ZERO_PIVOT * q11 else 0.0
        l11 = math.sqrt(rest)
        inverse = 1.0 / l11 if rest > 0.0 else 0.0
        l21 = (work[L.N12 + i] - l20 * l10) * inverse
        rest = q22 - l20 * l20 - l21 * l21
        work[L.C00 + i], work[L.C01 + i] = c * l00 - s * l10, -s * l11
        work[L.C10 + i], work[L.C11 + i] = s * l00 + c * l10, c * l11
        work[L.C20 + i], work[L.C21 + i] = l20, l21
        work[L.C22 + i] = math.sqrt(rest if rest > ZERO_PIVOT * q22 else 0.0)


@device
@simd
def take_draws(work: FloatArray, normals: FloatArray, first: int) -> None:
    """Write a block's normal draws (M, 3) into the rows DRAW0 .. DRAW2, zeros for surplus lanes."""
    for i in range(LANES):
        m = first + i
        for c in range(3):
            work[L.DRAW0 + c * LANES + i] = normals[m, c] if m < len(normals) else 0.0


@device
@simd
def sample_motion(work: FloatArray, samples: FloatArray, biases: FloatArray, motion: Motion, first: int) -> None:
    """Replace poses (3, P) by draws from p(x_t | x_{t-1}, u_t), each particle from its own past and bias (Eq. 4)."""
    odometry, sigmas = motion.odometry, motion.sigmas
    take_draws(work, motion.normals, first)
    load_rows(work, L.X, samples, first)
    for i in range(LANES):
        work[L.SIN + i], work[L.COS + i] = sine_cosine(work[L.T + i])
    if motion.biased:
        j, f = motion.jacobian, motion.factor
        load_rows(work, L.BIAS0, biases, first)
        for i in range(LANES):
            b0, b1, b2 = work[L.BIAS0 + i], work[L.BIAS1 + i], work[L.BIAS2 + i]
            n0, n1, n2 = work[L.DRAW0 + i], work[L.DRAW1 + i], work[L.DRAW2 + i]
            dx = odometry[0] - (j[0, 0] * b0 + j[0, 1] * b1 + j[0, 2] * b2) + f[0, 0] * n0
            dy = odometry[1] - (j[1, 0] * b0 + j[1, 1] * b1 + j[1, 2] * b2) + f[1, 0] * n0 + f[1, 1] * n1
            turn = odometry[2] - (j[2, 1] * b1 + j[2, 2] * b2) + f[2, 0] * n0 + f[2, 1] * n1 + f[2, 2] * n2
            c, s = work[L.COS + i], work[L.SIN + i]
            samples[0, first + i] = work[L.X + i] + (c * dx - s * dy)
            samples[1, first + i] = work[L.Y + i] + (s * dx + c * dy)
            samples[2, first + i] = wrapped(work[L.T + i] + turn)
        return
    for i in range(LANES):
        dx = odometry[0] + work[L.DRAW0 + i] * sigmas[0]
        dy = odometry[1] + work[L.DRAW1 + i] * sigmas[1]
        c, s = work[L.COS + i], work[L.SIN + i]
        samples[0, first + i] = work[L.X + i] + (c * dx - s * dy)
        samples[1, first + i] = work[L.Y + i] + (s * dx + c * dy)
        samples[2, first + i] = wrapped(work[L.T + i] + odometry[2] + work[L.DRAW2 + i] * sigmas[2])


@device
@simd
def set_exact(robot: Poses) -> None:
    """Write N(x^, P^) of poses that are exactly where their particles have them."""
    for c in range(3):
        for m in range(robot.samples.shape[1]):
            robot.means[c, m] = robot.samples[c, m]
    robot.covariances[:] = 0.0


@device
@simd
def propagate(robot: Poses, motion: Motion, propagated_only: bool, work: FloatArray) -> None:
    """Move a robot that sees nothing: each particle's N(x^, P^) is propagated, and its sample moves by itself.

    Args:
        robot: Poses, written; N(x^, P^) is read if `propagated_only`, else particles start from their samples.
        motion: Motion of the robot.
        propagated_only: See `predict`.
        work: Working space.
    """
    for block in range(robot.samples.shape[1] // LANES):
        first = block * LANES
        predict(work, robot, motion, propagated_only, first)
        for i in range(LANES):  # the covariance is turned from the robot's axes to the map's: T P T^T
            c, s = work[L.COS + i], work[L.SIN + i]
            r00, r01, r02 = work[L.N00 + i], work[L.N01 + i], work[L.N02 + i]
            r11, r12 = work[L.N11 + i], work[L.N12 + i]
            work[L.N00 + i] = c * c * r00 - 2.0 * c * s * r01 + s * s * r11
            work[L.N01 + i] = c * s * (r00 - r11) + (c * c - s * s) * r01
            work[L.N02 + i] = c * r02 - s * r12
            work[L.N11 + i] = s * s * r00 + 2.0 * c * s * r01 + c * c * r11
            work[L.N12 + i] = s * r02 + c * r12
        store_rows(work, L.X0, robot.means, first)
        store_rows(work, L.N00, robot.covariances, first)
        sample_motion(work, robot.samples, robot.biases, motion, first)
