"""Measurement model of all lanes of a block (Eqs. 5-7): innovations, and the log-likelihood of a frame (Eq. 11)."""

import numpy as np

from slam_backend.core.jit import device, simd, simd_inline
from slam_backend.core.simd_math import LN2, log_of, mantissa_exponent
from slam_backend.core.validation import FloatArray, Int32Array
from slam_backend.fastslam._kernels.layout import (
    C00,
    C01,
    C10,
    C11,
    C20,
    C21,
    C22,
    CLUTTER,
    COS,
    COV_XI00,
    COV_XI01,
    COV_XI02,
    COV_XI11,
    COV_XI12,
    COV_XI22,
    DEPTH,
    DEPTHS,
    DEPTHS_EXP,
    DET,
    DET_EXP,
    INNOV0,
    INNOV1,
    INNOV2,
    LANES,
    LOG_2PI,
    MATCHED,
    MIN_DEPTH,
    N00,
    N01,
    N02,
    N11,
    N12,
    N22,
    Q_D,
    Q_DEPTH,
    Q_DET,
    Q_DET_POSE,
    Q_GRAD0,
    Q_GRAD1,
    Q_GRAD2,
    Q_HELD,
    Q_INFO00,
    Q_INFO01,
    Q_INFO02,
    Q_INFO11,
    Q_INFO12,
    Q_INFO22,
    Q_METRES2,
    Q_SQUARE,
    SIN,
    SUM_D,
    X,
    Y,
)
from slam_backend.fastslam._kernels.records import Frame

# Share of a match in the system of xi: J (6) and g (3), see the package.
Terms = tuple[float, float, float, float, float, float, float, float, float]


@device
@simd
def innovate(work: FloatArray, tile: FloatArray, frame: Frame, n: int) -> None:
    """Write r (3), its sensor covariance in map axes (6) and the predicted depth, at the pose rows X .. SIN.

    The depth is 1 where covariances come with the measurements: it plays no part then.

    Args:
        work: Rows of the block.
        tile: Values of the landmark there.
        frame, n: Measurements of the robot, and the one that the landmark may have caused.
    """
    noise, camera, given = frame.noises[n], frame.camera, frame.given
    v0, v1, v2 = frame.points[n, 0], frame.points[n, 1], frame.points[n, 2]
    a, b, d, e, f, g = noise[0], noise[1], noise[2], noise[3], noise[4], noise[5]
    m0, m1, m2 = camera[4], camera[5], camera[6]
    pixel = (camera[2] / camera[0]) ** 2
    disparity = (camera[3] / (camera[0] * camera[1])) ** 2
    per_depth = 1.0 / v0
    for i in range(LANES):
        c, s = work[COS + i], work[SIN + i]
        if given:
            work[INNOV0 + i] = c * (v0 + m0) - s * (v1 + m1) + work[X + i] - tile[i]
            work[INNOV1 + i] = s * (v0 + m0) + c * (v1 + m1) + work[Y + i] - tile[LANES + i]
            work[INNOV2 + i] = v2 + m2 - tile[2 * LANES + i]
            work[N00 + i] = c * c * a - 2.0 * c * s * b + s * s * e
            work[N01 + i] = c * s * (a - e) + (c * c - s * s) * b
            work[N02 + i] = c * d - s * f
            work[N11 + i] = s * s * a + 2.0 * c * s * b + c * c * e
            work[N12 + i] = s * d + c * f
            work[N22 + i] = g
            work[DEPTH + i] = 1.0
        else:
            ex = tile[i] - work[X + i] - (c * m0 - s * m1)
            ey = tile[LANES + i] - work[Y + i] - (s * m0 + c * m1)
            ez = tile[2 * LANES + i] - m2
            depth = c * ex + s * ey
            k = depth * per_depth
            work[INNOV0 + i] = k * (c * v0 - s * v1 - ex)
            work[INNOV1 + i] = k * (s * v0 + c * v1 - ey)
            work[INNOV2 + i] = k * (v2 - ez)
            across, along = pixel * depth * depth, disparity * depth * depth
            work[N00 + i] = across * s * s + along * ex * ex
            work[N01 + i] = along * ex * ey - across * c * s
            work[N02 + i] = along * ex * ez
            work[N11 + i] = across * c * c + along * ey * ey
            work[N12 + i] = along * ey * ez
            work[N22 + i] = across + along * ez * ez
            work[DEPTH + i] = depth


@simd_inline
def match_terms(
    work: FloatArray, tile: FloatArray, i: int, refined: bool
) -> tuple[Terms, float, float, float, float, float, float]:
    """Return what a match would add to the system of xi, and its gate, from the innovation in `work`.

    A robot turns about the vertical, so the pose says nothing of heights: r_z is eliminated first, and what is left is
    two by two. With T = S_xy - S_xz S_zz^-1 S_zx and p = r_xy - S_xz S_zz^-1 r_z: A^T S^-1 A = A_xy^T T^-1 A_xy,
    A^T S^-1 r = A_xy^T T^-1 p, and the gate takes T + A_xy P A_xy^T.

    Args:
        work: Rows of the block.
        tile: Values of the landmark there.
        i: The lane.
        refined: Whether the covariance P of xi is that of the rows COV_XI00 ..; else it is the identity.

    Returns:
        J and g, r^T S^-1 r, |S|, |S + A P A^T|, the predicted depth, r^T r, and the squared distance of the gate,
        infinite behind the camera.
    """
    rx, ry, rz = work[INNOV0 + i], work[INNOV1 + i], work[INNOV2 + i]
    depth = work[DEPTH + i]
    s00, s01 = tile[3 * LANES + i] + work[N00 + i], tile[4 * LANES + i] + work[N01 + i]
    s02, s11 = tile[5 * LANES + i] + work[N02 + i], tile[6 * LANES + i] + work[N11 + i]
    s12, s22 = tile[7 * LANES + i] + work[N12 + i], tile[8 * LANES + i] + work[N22 + i]
    per_s22 = 1.0 / s22
    k0, k1 = s02 * per_s22, s12 * per_s22
    t00, t01, t11 = s00 - k0 * s02, s01 - k0 * s12, s11 - k1 * s12
    px, py, height = rx - k0 * rz, ry - k1 * rz, rz * rz * per_s22
    det = t00 * t11 - t01 * t01
    per_det = 1.0 / det
    i00, i01, i11 = t11 * per_det, -t01 * per_det, t00 * per_det  # Eq. 7
    sx, sy = i00 * px + i01 * py, i01 * px + i11 * py
    hx, hy = work[Y + i] - tile[LANES + i], tile[i] - work[X + i]
    c20, c21, c22 = work[C20 + i], work[C21 + i], work[C22 + i]
    a0, a1, a2 = work[C00 + i] + hx * c20, work[C01 + i] + hx * c21, hx * c22
    b0, b1, b2 = work[C10 + i] + hy * c20, work[C11 + i] + hy * c21, hy * c22
    u0, u1, u2 = i00 * a0 + i01 * b0, i00 * a1 + i01 * b1, i00 * a2 + i01 * b2
    w0, w1, w2 = i01 * a0 + i11 * b0, i01 * a1 + i11 * b1, i01 * a2 + i11 * b2
    if refined:
        q00, q01, q02 = work[COV_XI00 + i], work[COV_XI01 + i], work[COV_XI02 + i]
        q11, q12, q22 = work[COV_XI11 + i], work[COV_XI12 + i], work[COV_XI22 + i]
        e0, e1, e2 = q00 * a0 + q01 * a1 + q02 * a2, q01 * a0 + q11 * a1 + q12 * a2, q02 * a0 + q12 * a1 + q22 * a2
        f0, f1, f2 = q00 * b0 + q01 * b1 + q02 * b2, q01 * b0 + q11 * b1 + q12 * b2, q02 * b0 + q12 * b1 + q22 * b2
    else:
        e0, e1, e2, f0, f1, f2 = a0, a1, a2, b0, b1, b2
    d00, d01, d11 = (
        t00 + a0 * e0 + a1 * e1 + a2 * e2, t01 + a0 * f0 + a1 * f1 + a2 * f2, t11 + b0 * f0 + b1 * f1 + b2 * f2
    )  # fmt: skip
    det_pose = d00 * d11 - d01 * d01
    distance = height + (d11 * px * px - 2.0 * d01 * px * py + d00 * py * py) / det_pose
    return (
        (a0 * u0 + b0 * w0, a0 * u1 + b0 * w1, a0 * u2 + b0 * w2, a1 * u1 + b1 * w1, a1 * u2 + b1 * w2,
         a2 * u2 + b2 * w2, a0 * sx + b0 * sy, a1 * sx + b1 * sy, a2 * sx + b2 * sy),
        height + px * sx + py * sy, det * s22, det_pose * s22, depth, rx * rx + ry * ry + rz * rz,
        distance if depth >= MIN_DEPTH else np.inf,
    )  # fmt: skip


@device
@simd
def evaluate(work: FloatArray, tile: FloatArray, record: FloatArray, seen: Int32Array, refined: bool) -> None:
    """Write the record of a candidate: the terms of a match, see `match_terms`, and whether the lanes hold it."""
    for i in range(LANES):
        terms, square, det, det_pose, depth, metres2, distance = match_terms(work, tile, i, refined)
        record[Q_INFO00 + i], record[Q_INFO01 + i], record[Q_INFO02 + i] = terms[0], terms[1], terms[2]
        record[Q_INFO11 + i], record[Q_INFO12 + i], record[Q_INFO22 + i] = terms[3], terms[4], terms[5]
        record[Q_GRAD0 + i], record[Q_GRAD1 + i], record[Q_GRAD2 + i] = terms[6], terms[7], terms[8]
        record[Q_SQUARE + i] = square
        record[Q_DET + i] = det
        record[Q_DET_POSE + i] = det_pose
        record[Q_DEPTH + i] = depth
        record[Q_METRES2 + i] = metres2
        record[Q_D + i] = distance
    for i in range(LANES):  # by itself: integers among the numbers above cost vectors
        record[Q_HELD + i] = 1.0 if seen[i] > 0 else 0.0


@simd_inline
def accumulate_likelihood(work: FloatArray, i: int, on: bool, square: float, det: float, depth: float) -> None:
    """Where `on`, add a match's part of the log-likelihood: r^T S^-1 r, and |S| and the depth as products."""
    work[SUM_D + i] += square if on else 0.0
    work[MATCHED + i] += 1.0 if on else 0.0
    mantissa, exponent = mantissa_exponent(work[DET + i] * (det if on else 1.0))
    work[DET + i] = mantissa
    work[DET_EXP + i] += exponent
    mantissa, exponent = mantissa_exponent(work[DEPTHS + i] * (depth if on else 1.0))
    work[DEPTHS + i] = mantissa
    work[DEPTHS_EXP + i] += exponent


@device
@simd
def clear_likelihood(work: FloatArray) -> None:
    """Clear the sums of the log-likelihood of a frame."""
    for i in range(LANES):
        work[SUM_D + i] = 0.0
        work[MATCHED + i] = 0.0
        work[DET + i] = 1.0
        work[DET_EXP + i] = 0.0
        work[DEPTHS + i] = 1.0
        work[DEPTHS_EXP + i] = 0.0
        work[CLUTTER + i] = 0.0


@simd_inline
def total_log_likelihood(work: FloatArray, i: int) -> float:
    """Return a lane's sum over matches of log N(r; 0, S) + 4 log depth (Eq. 11), and that of the unmatched."""
    log_det = log_of(work[DET + i]) + LN2 * work[DET_EXP + i]
    log_depth = log_of(work[DEPTHS + i]) + LN2 * work[DEPTHS_EXP + i]
    matched: float = work[SUM_D + i] + 3.0 * LOG_2PI * work[MATCHED + i] + log_det
    unmatched: float = work[CLUTTER + i]
    total: float = -0.5 * matched + 4.0 * log_depth + unmatched
    return total
