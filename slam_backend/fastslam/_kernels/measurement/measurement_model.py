"""Measurement model of all lanes of a block (Eqs. 5-7): innovations, and the log-likelihood of a frame (Eq. 11)."""

from typing import NamedTuple

import numpy as np

from slam_backend.core.jit import device, simd, simd_inline
from slam_backend.core.simd_math import LN2, log_of, mantissa_exponent
from slam_backend.core.validation import FloatArray, Int32Array
from slam_backend.fastslam._kernels import layout as L
from slam_backend.fastslam._kernels.layout import LANES
from slam_backend.fastslam._kernels.records import Frame

# Share of a match in the system of xi: J (6) and g (3), see the package.
Terms = tuple[float, float, float, float, float, float, float, float, float]


class Match(NamedTuple):
    """What a match of a measurement and a landmark would mean for one particle.

    Attributes:
        terms: Share in the system of xi.
        square: r^T S^-1 r.
        det: |S|.
        det_pose: |S + A P A^T|.
        depth: Predicted depth [m].
        metres2: r^T r [m^2].
        distance: Squared distance of the gate, infinite behind the camera.
    """

    terms: Terms
    square: float
    det: float
    det_pose: float
    depth: float
    metres2: float
    distance: float


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
        c, s = work[L.COS + i], work[L.SIN + i]
        if given:
            work[L.INNOV0 + i] = c * (v0 + m0) - s * (v1 + m1) + work[L.X + i] - tile[i]
            work[L.INNOV1 + i] = s * (v0 + m0) + c * (v1 + m1) + work[L.Y + i] - tile[LANES + i]
            work[L.INNOV2 + i] = v2 + m2 - tile[2 * LANES + i]
            work[L.N00 + i] = c * c * a - 2.0 * c * s * b + s * s * e
            work[L.N01 + i] = c * s * (a - e) + (c * c - s * s) * b
            work[L.N02 + i] = c * d - s * f
            work[L.N11 + i] = s * s * a + 2.0 * c * s * b + c * c * e
            work[L.N12 + i] = s * d + c * f
            work[L.N22 + i] = g
            work[L.DEPTH + i] = 1.0
        else:
            ex = tile[i] - work[L.X + i] - (c * m0 - s * m1)
            ey = tile[LANES + i] - work[L.Y + i] - (s * m0 + c * m1)
            ez = tile[2 * LANES + i] - m2
            depth = c * ex + s * ey
            k = depth * per_depth
            work[L.INNOV0 + i] = k * (c * v0 - s * v1 - ex)
            work[L.INNOV1 + i] = k * (s * v0 + c * v1 - ey)
            work[L.INNOV2 + i] = k * (v2 - ez)
            across, along = pixel * depth * depth, disparity * depth * depth
            work[L.N00 + i] = across * s * s + along * ex * ex
            work[L.N01 + i] = along * ex * ey - across * c * s
            work[L.N02 + i] = along * ex * ez
            work[L.N11 + i] = across * c * c + along * ey * ey
            work[L.N12 + i] = along * ey * ez
            work[L.N22 + i] = across + along * ez * ez
            work[L.DEPTH + i] = depth


@simd_inline
def match_terms(work: FloatArray, tile: FloatArray, i: int, refined: bool) -> Match:
    """Return what a match would add to the system of xi, and its gate, from the innovation in `work`.

    A robot turns about the vertical, so the pose says nothing of heights: r_z is eliminated first, and what is left is
    two by two. With T = S_xy - S_xz S_zz^-1 S_zx and p = r_xy - S_xz S_zz^-1 r_z: A^T S^-1 A = A_xy^T T^-1 A_xy,
    A^T S^-1 r = A_xy^T T^-1 p, and the gate takes T + A_xy P A_xy^T.

    Args:
        work: Rows of the block.
        tile: Values of the landmark there.
        i: The lane.
        refined: Whether the covariance P of xi is that of the rows COV_XI00 ..; else it is the identity.
    """
    rx, ry, rz = work[L.INNOV0 + i], work[L.INNOV1 + i], work[L.INNOV2 + i]
    depth = work[L.DEPTH + i]
    s00, s01 = tile[3 * LANES + i] + work[L.N00 + i], tile[4 * LANES + i] + work[L.N01 + i]
    s02, s11 = tile[5 * LANES + i] + work[L.N02 + i], tile[6 * LANES + i] + work[L.N11 + i]
    s12, s22 = tile[7 * LANES + i] + work[L.N12 + i], tile[8 * LANES + i] + work[L.N22 + i]
    per_s22 = 1.0 / s22
    k0, k1 = s02 * per_s22, s12 * per_s22
    t00, t01, t11 = s00 - k0 * s02, s01 - k0 * s12, s11 - k1 * s12
    px, py, height = rx - k0 * rz, ry - k1 * rz, rz * rz * per_s22
    det = t00 * t11 - t01 * t01
    per_det = 1.0 / det
    i00, i01, i11 = t11 * per_det, -t01 * per_det, t00 * per_det  # Eq. 7
    sx, sy = i00 * px + i01 * py, i01 * px + i11 * py
    hx, hy = work[L.Y + i] - tile[LANES + i], tile[i] - work[L.X + i]
    c20, c21, c22 = work[L.C20 + i], work[L.C21 + i], work[L.C22 + i]
    a0, a1, a2 = work[L.C00 + i] + hx * c20, work[L.C01 + i] + hx * c21, hx * c22
    b0, b1, b2 = work[L.C10 + i] + hy * c20, work[L.C11 + i] + hy * c21, hy * c22
    u0, u1, u2 = i00 * a0 + i01 * b0, i00 * a1 + i01 * b1, i00 * a2 + i01 * b2
    w0, w1, w2 = i01 * a0 + i11 * b0, i01 * a1 + i11 * b1, i01 * a2 + i11 * b2
    if refined:
        q00, q01, q02 = work[L.COV_XI00 + i], work[L.COV_XI01 + i], work[L.COV_XI02 + i]
        q11, q12, q22 = work[L.COV_XI11 + i], work[L.COV_XI12 + i], work[L.COV_XI22 + i]
        e0, e1, e2 = q00 * a0 + q01 * a1 + q02 * a2, q01 * a0 + q11 * a1 + q12 * a2, q02 * a0 + q12 * a1 + q22 * a2
        f0, f1, f2 = q00 * b0 + q01 * b1 + q02 * b2, q01 * b0 + q11 * b1 + q12 * b2, q02 * b0 + q12 * b1 + q22 * b2
    else:
        e0, e1, e2, f0, f1, f2 = a0, a1, a2, b0, b1, b2
    d00, d01, d11 = (
        t00 + a0 * e0 + a1 * e1 + a2 * e2, t01 + a0 * f0 + a1 * f1 + a2 * f2, t11 + b0 * f0 + b1 * f1 + b2 * f2
    )  # fmt: skip
    det_pose = d00 * d11 - d01 * d01
    distance = height + (d11 * px * px - 2.0 * d01 * px * py + d00 * py * py) / det_pose
    return Match(
        (a0 * u0 + b0 * w0, a0 * u1 + b0 * w1, a0 * u2 + b0 * w2, a1 * u1 + b1 * w1, a1 * u2 + b1 * w2,
         a2 * u2 + b2 * w2, a0 * sx + b0 * sy, a1 * sx + b1 * sy, a2 * sx + b2 * sy),
        height + px * sx + py * sy, det * s22, det_pose * s22, depth, rx * rx + ry * ry + rz * rz,
        distance if depth >= L.MIN_DEPTH else np.inf,
    )  # fmt: skip


@device
@simd
def evaluate(work: FloatArray, tile: FloatArray, record: FloatArray, seen: Int32Array, refined: bool) -> None:
    """Write the record of a candidate: the terms of a match, see `match_terms`, and whether the lanes hold it."""
    for i in range(LANES):
        match = match_terms(work, tile, i, refined)
        terms = match.terms
        record[L.Q_INFO00 + i], record[L.Q_INFO01 + i], record[L.Q_INFO02 + i] = terms[0], terms[1], terms[2]
        record[L.Q_INFO11 + i], record[L.Q_INFO12 + i], record[L.Q_INFO22 + i] = terms[3], terms[4], terms[5]
        record[L.Q_GRAD0 + i], record[L.Q_GRAD1 + i], record[L.Q_GRAD2 + i] = terms[6], terms[7], terms[8]
        record[L.Q_SQUARE + i] = match.square
        record[L.Q_DET + i] = match.det
        record[L.Q_DET_POSE + i] = match.det_pose
        record[L.Q_DEPTH + i] = match.depth
        record[L.Q_METRES2 + i] = match.metres2
        record[L.Q_D + i] = match.distance
    for i in range(LANES):  # by itself: integers among the numbers above cost vectors
        record[L.Q_HELD + i] = 1.0 if seen[i] > 0 else 0.0


@simd_inline
def accumulate_likelihood(work: FloatArray, i: int, on: bool, square: float, det: float, depth: float) -> None:
    """Where `on`, add a match's part of the log-likelihood: r^T S^-1 r, and |S| and the depth as products."""
    work[L.SUM_D + i] += square if on else 0.0
    work[L.MATCHED + i] += 1.0 if on else 0.0
    mantissa, exponent = mantissa_exponent(work[L.DET + i] * (det if on else 1.0))
    work[L.DET + i] = mantissa
    work[L.DET_EXP + i] += exponent
    mantissa, exponent = mantissa_exponent(work[L.DEPTHS + i] * (depth if on else 1.0))
    work[L.DEPTHS + i] = mantissa
    work[L.DEPTHS_EXP + i] += exponent


@device
@simd
def clear_likelihood(work: FloatArray) -> None:
    """Clear the sums of the log-likelihood of a frame."""
    for i in range(LANES):
        work[L.SUM_D + i] = 0.0
        work[L.MATCHED + i] = 0.0
        work[L.DET + i] = 1.0
        work[L.DET_EXP + i] = 0.0
        work[L.DEPTHS + i] = 1.0
        work[L.DEPTHS_EXP + i] = 0.0
        work[L.CLUTTER + i] = 0.0


@simd_inline
def total_log_likelihood(work: FloatArray, i: int) -> float:
    """Return a lane's sum over matches of log N(r; 0, S) + 4 log depth (Eq. 11), and that of the unmatched."""
    log_det = log_of(work[L.DET + i]) + LN2 * work[L.DET_EXP + i]
    log_depth = log_of(work[L.DEPTHS + i]) + LN2 * work[L.DEPTHS_EXP + i]
    matched: float = work[L.SUM_D + i] + 3.0 * L.LOG_2PI * work[L.MATCHED + i] + log_det
    unmatched: float = work[L.CLUTTER + i]
    total: float = -0.5 * matched + 4.0 * log_depth + unmatched
    return total
