"""The compiled inner loops of the filter: one robot's frame, for all particles.

Particles are taken in blocks of `LANES`, and every loop over the lanes of a block is plain arithmetic on rows of one
flat workspace, which the compiler turns into vector instructions; decisions become masks. A row is addressed as
`work[ROW + i]`, lane i, with ROW a multiple of LANES known at compile time.

Landmarks lie in `values[row, block, c, lane]` (flattened) with c = (x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz) in the map
frame, and `counts[row, particle]` says how often the particle saw it (0: it does not hold it). Resampling does not move
them: see `_particle_maps.py`, which says what `row_of`, `map_of` and `maps` are. Everything is expressed in the
map frame, where the derivative of a measured point with respect to the landmark is the identity (the robot only yaws).

The measurement model (Eqs. 5-7). A landmark mu lies at e = mu - p from the camera centre p. A point v measured in the
camera, turned into map axes, gives the innovation r = k (R v - e) with k = Z_predicted / Z_measured. This is the EKF in
(u, v, disparity): the innovation and its covariance are those of the image coordinates, mapped to metres at the
predicted point, and the density of the image coordinates is that of r times Z_predicted^4 (times a constant of the
camera). Where the caller gives covariances, k = 1 and there is no such factor.

The pose. x = x0 + C xi with xi ~ N(0, I) before the frame: nothing is inverted, so a motion without noise needs no
special case. With A = (dr/dx) C and S = Sigma + R, a match adds J = A^T S^-1 A to the information of xi and
g = A^T S^-1 r to the gradient. A gate takes S + A P A^T, with P the covariance of xi.
"""

import math

import numpy as np

from slam_backend._jit import any_order, bits_float, float_bits, jit, lanes, lanes_inlined
from slam_backend.errors import Float32Array, FloatArray, Int32Array, IntArray

LANES = 64
REJECTED = -1
MIN_DEPTH = 0.05  # [m]; nothing is predicted nearer to the camera plane than this
MIN_CONTRADICTIONS = 3.0  # three points fix a pose with one to spare
WIDE_HEADING = 0.03  # [rad]; where the heading is less sure, one step of Gauss-Newton is not enough
YOUNG = 4  # a landmark seen up to so many times is updated by the iterated EKF: its depth is still vague
ZERO_PIVOT = 1e-12  # relative to the variance: below it a direction is taken to be exact
FARTHEST = float(np.finfo(np.float64).max)  # the largest squared distance that is not infinite
FAR = np.float32(1e18)  # no descriptor comes near a free slot's
LOG_2PI = math.log(2.0 * math.pi)
HALF_PI_HIGH = 1.5707963267341256  # pi / 2 in two parts: the first has 33 bits, so that small multiples are exact
HALF_PI_LOW = 6.077100506506192e-11
ROUND = 6755399441055744.0  # 1.5 * 2^52: adding and subtracting it rounds to the nearest integer
LN2 = math.log(2.0)

# Rows of the workspace.
X, Y, T, COS, SIN = (LANES * k for k in range(5))  # the pose at which innovations are taken
X0, Y0, T0 = (LANES * k for k in range(5, 8))  # the predicted pose
C00, C10, C11, C20, C21, C22 = (LANES * k for k in range(8, 14))  # factor C of its covariance, with C01 below
XI0, XI1, XI2 = (LANES * k for k in range(14, 17))
SPREAD00, SPREAD01, SPREAD02, SPREAD11, SPREAD12, SPREAD22 = (LANES * k for k in range(17, 23))  # covariance of xi
R0, R1, R2 = (LANES * k for k in range(23, 26))  # innovation
N00, N01, N02, N11, N12, N22, DEPTH = (LANES * k for k in range(26, 33))  # sensor noise in map axes, predicted depth
J00, J01, J02, J11, J12, J22, G0, G1, G2 = (LANES * k for k in range(33, 42))  # sums over matches
SUM_D, MATCHED, DET, DET_EXP, DEPTHS, DEPTHS_EXP = (LANES * k for k in range(42, 48))  # of the likelihood
CLUTTER = LANES * 48  # log-likelihood of the measurements that are not matched
BEST, SECOND, CHOSEN, DEAD, LOG_BEST = (LANES * k for k in range(49, 54))  # of one measurement
LOST, SURE, CONTRADICT, WIDE = (LANES * k for k in range(54, 58))
TAKEN, C01 = LANES * 58, LANES * 59
KEPT00, KEPT10, KEPT11, KEPT20, KEPT21, KEPT22, KEPT01, KEPT_WIDE = (LANES * k for k in range(60, 68))  # of C
WORK_ROWS = 68

# Rows of one candidate's record.
QJ00, QJ01, QJ02, QJ11, QJ12, QJ22, QG0, QG1, QG2 = (LANES * k for k in range(9))
Q_SQUARE, Q_DET, Q_DET_POSE, Q_DEPTH, Q_METRES2, Q_D, Q_FIRST_D, Q_HELD = (LANES * k for k in range(9, 17))
CANDIDATE_ROWS = 17

TILE = 9 * LANES
RUN = 64  # descriptors looked at together
SHIFT = LANES.bit_length() - 1  # particle m is lane m & (LANES - 1) of block m >> SHIFT


# ---------------------------------------------------------------------------------------------------- one lane


@lanes_inlined
def _invert(
    a: float, b: float, c: float, d: float, e: float, f: float
) -> tuple[float, float, float, float, float, float, float]:
    """Invert the symmetric [[a, b, c], [b, d, e], [c, e, f]]: its inverse likewise (6), and its determinant."""
    p = d * f - e * e
    q = c * e - b * f
    r = b * e - c * d
    det = a * p + b * q + c * r
    g = 1.0 / det
    return p * g, q * g, r * g, (a * f - c * c) * g, (b * c - a * e) * g, (a * d - b * b) * g, det


@lanes_inlined
def _form(
    i00: float, i01: float, i02: float, i11: float, i12: float, i22: float, x: float, y: float, z: float
) -> float:
    """Return the quadratic form of (x, y, z)."""
    return i00 * x * x + i11 * y * y + i22 * z * z + 2.0 * (i01 * x * y + i02 * x * z + i12 * y * z)


@lanes_inlined
def _sine_cosine(angle: float) -> tuple[float, float]:
    """Return sine and cosine to the last bits but one, for angles up to some thousand turns, without a branch.

    Reduction to [-pi/4, pi/4] and Taylor's series there.
    """
    quarter = (angle * (2.0 / math.pi) + ROUND) - ROUND
    x = (angle - quarter * HALF_PI_HIGH) - quarter * HALF_PI_LOW
    z = x * x
    s = -1.0 / 1307674368000.0
    s = s * z + 1.0 / 6227020800.0
    s = s * z - 1.0 / 39916800.0
    s = s * z + 1.0 / 362880.0
    s = s * z - 1.0 / 5040.0
    s = s * z + 1.0 / 120.0
    s = s * z - 1.0 / 6.0
    s = x + x * z * s
    c = 1.0 / 20922789888000.0
    c = c * z - 1.0 / 87178291200.0
    c = c * z + 1.0 / 479001600.0
    c = c * z - 1.0 / 3628800.0
    c = c * z + 1.0 / 40320.0
    c = c * z - 1.0 / 720.0
    c = c * z + 1.0 / 24.0
    c = c * z - 0.5
    c = 1.0 + z * c
    turn = quarter - 4.0 * math.floor(0.25 * quarter)  # 0, 1, 2 or 3
    odd = turn == 1.0 or turn == 3.0
    sine = c if odd else s
    cosine = s if odd else c
    sine = -sine if turn >= 2.0 else sine
    cosine = -cosine if turn == 1.0 or turn == 2.0 else cosine
    return sine, cosine


@lanes_inlined
def _log(x: float) -> float:
    """Return the natural logarithm of a positive normal number, without a branch: x = 2^e m, and atanh's series."""
    bits = float_bits(x)
    exponent = float((bits >> 52) - 1023)
    m = bits_float((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000)
    big = m > 1.4142135623730951
    m = 0.5 * m if big else m
    exponent = exponent + 1.0 if big else exponent
    f = (m - 1.0) / (m + 1.0)
    z = f * f
    s = 1.0 / 21.0
    s = s * z + 1.0 / 19.0
    s = s * z + 1.0 / 17.0
    s = s * z + 1.0 / 15.0
    s = s * z + 1.0 / 13.0
    s = s * z + 1.0 / 11.0
    s = s * z + 1.0 / 9.0
    s = s * z + 1.0 / 7.0
    s = s * z + 0.2
    s = s * z + 1.0 / 3.0
    return exponent * LN2 + 2.0 * (f + f * z * s)


@lanes_inlined
def _split(x: float) -> tuple[float, float]:
    """Return mantissa in [1, 2) and exponent of a positive normal number: products of many never overflow."""
    bits = float_bits(x)
    return bits_float((bits & 0x000FFFFFFFFFFFFF) | 0x3FF0000000000000), float((bits >> 52) - 1023)


@lanes_inlined
def _wrap(angle: float) -> float:
    """Return the angle in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


# ------------------------------------------------------------------------------------- all lanes of one block


@lanes
def _innovate(
    work: FloatArray, tile: FloatArray, points: FloatArray, noises: FloatArray, n: int, given: bool, camera: FloatArray
) -> None:
    """Write r (3), its sensor covariance in map axes (6) and the predicted depth, at the pose rows X .. SIN.

    `points[n]` is the measured point relative to the camera centre in robot axes (x ahead = depth); `noises[n]` its
    covariance (6) in robot axes, used if `given`, and the depth is then 1: it plays no part. `camera` = (focal,
    baseline, sigma_px, sigma_disparity, mount (3)).
    """
    v0, v1, v2 = points[n, 0], points[n, 1], points[n, 2]
    m0, m1, m2 = camera[4], camera[5], camera[6]
    if given:
        a, b, d, e, f, g = noises[n, 0], noises[n, 1], noises[n, 2], noises[n, 3], noises[n, 4], noises[n, 5]
        for i in range(LANES):
            c, s = work[COS + i], work[SIN + i]
            work[R0 + i] = c * (v0 + m0) - s * (v1 + m1) + work[X + i] - tile[i]
            work[R1 + i] = s * (v0 + m0) + c * (v1 + m1) + work[Y + i] - tile[LANES + i]
            work[R2 + i] = v2 + m2 - tile[2 * LANES + i]
            work[N00 + i] = c * c * a - 2.0 * c * s * b + s * s * e
            work[N01 + i] = c * s * (a - e) + (c * c - s * s) * b
            work[N02 + i] = c * d - s * f
            work[N11 + i] = s * s * a + 2.0 * c * s * b + c * c * e
            work[N12 + i] = s * d + c * f
            work[N22 + i] = g
            work[DEPTH + i] = 1.0
    else:
        pixel = (camera[2] / camera[0]) ** 2
        disparity = (camera[3] / (camera[0] * camera[1])) ** 2
        per_depth = 1.0 / v0
        for i in range(LANES):
            c, s = work[COS + i], work[SIN + i]
            ex = tile[i] - work[X + i] - (c * m0 - s * m1)
            ey = tile[LANES + i] - work[Y + i] - (s * m0 + c * m1)
            ez = tile[2 * LANES + i] - m2
            depth = c * ex + s * ey
            k = depth * per_depth
            work[R0 + i] = k * (c * v0 - s * v1 - ex)
            work[R1 + i] = k * (s * v0 + c * v1 - ey)
            work[R2 + i] = k * (v2 - ez)
            across, along = pixel * depth * depth, disparity * depth * depth
            work[N00 + i] = across * s * s + along * ex * ex
            work[N01 + i] = along * ex * ey - across * c * s
            work[N02 + i] = along * ex * ez
            work[N11 + i] = across * c * c + along * ey * ey
            work[N12 + i] = along * ey * ez
            work[N22 + i] = across + along * ez * ez
            work[DEPTH + i] = depth


@lanes_inlined
def _match_terms(
    work: FloatArray, tile: FloatArray, i: int, refined: bool
) -> tuple[
    float, float, float, float, float, float, float, float, float, float, float, float, float, float, float
]:  # fmt: skip
    """Return what a match would add to the system of xi, and its gate, from the innovation in `work`.

    A robot turns about the vertical, so the pose says nothing of heights: r_z is eliminated first, and what is left is
    two by two. With T = S_xy - S_xz S_zz^-1 S_zx and p = r_xy - S_xz S_zz^-1 r_z: A^T S^-1 A = A_xy^T T^-1 A_xy,
    A^T S^-1 r = A_xy^T T^-1 p, and the gate takes T + A_xy P A_xy^T.

    Args:
        refined: Whether the covariance P of xi is that of the rows SPREAD00 ..; else it is the identity.

    Returns:
        J (6), g (3), r^T S^-1 r, |S|, |S + A P A^T|, the predicted depth, r^T r, and the squared distance of the gate,
        infinite behind the camera.
    """
    rx, ry, rz = work[R0 + i], work[R1 + i], work[R2 + i]
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
        q00, q01, q02 = work[SPREAD00 + i], work[SPREAD01 + i], work[SPREAD02 + i]
        q11, q12, q22 = work[SPREAD11 + i], work[SPREAD12 + i], work[SPREAD22 + i]
        e0, e1, e2 = q00 * a0 + q01 * a1 + q02 * a2, q01 * a0 + q11 * a1 + q12 * a2, q02 * a0 + q12 * a1 + q22 * a2
        f0, f1, f2 = q00 * b0 + q01 * b1 + q02 * b2, q01 * b0 + q11 * b1 + q12 * b2, q02 * b0 + q12 * b1 + q22 * b2
    else:
        e0, e1, e2, f0, f1, f2 = a0, a1, a2, b0, b1, b2
    d00, d01, d11 = (
        t00 + a0 * e0 + a1 * e1 + a2 * e2, t01 + a0 * f0 + a1 * f1 + a2 * f2, t11 + b0 * f0 + b1 * f1 + b2 * f2
    )
    det_pose = d00 * d11 - d01 * d01
    distance = height + (d11 * px * px - 2.0 * d01 * px * py + d00 * py * py) / det_pose
    return (
        a0 * u0 + b0 * w0, a0 * u1 + b0 * w1, a0 * u2 + b0 * w2, a1 * u1 + b1 * w1, a1 * u2 + b1 * w2,
        a2 * u2 + b2 * w2, a0 * sx + b0 * sy, a1 * sx + b1 * sy, a2 * sx + b2 * sy,
        height + px * sx + py * sy, det * s22, det_pose * s22, depth, rx * rx + ry * ry + rz * rz,
        distance if depth >= MIN_DEPTH else np.inf,
    )


@lanes
def _evaluate(work: FloatArray, tile: FloatArray, record: FloatArray, refined: bool) -> None:
    """Write the terms of a match, see `_match_terms`."""
    for i in range(LANES):
        j00, j01, j02, j11, j12, j22, g0, g1, g2, square, det, det_pose, depth, metres2, distance = _match_terms(
            work, tile, i, refined
        )
        record[QJ00 + i], record[QJ01 + i], record[QJ02 + i] = j00, j01, j02
        record[QJ11 + i], record[QJ12 + i], record[QJ22 + i] = j11, j12, j22
        record[QG0 + i], record[QG1 + i], record[QG2 + i] = g0, g1, g2
        record[Q_SQUARE + i] = square
        record[Q_DET + i] = det
        record[Q_DET_POSE + i] = det_pose
        record[Q_DEPTH + i] = depth
        record[Q_METRES2 + i] = metres2
        record[Q_D + i] = distance


@lanes_inlined
def _updated(
    work: FloatArray, tile: FloatArray, i: int, i00: float, i01: float, i02: float, i11: float, i12: float, i22: float,
    match: bool,
) -> None:
    """Update a landmark where `match`, S^-1 given (Eqs. 8-10)."""
    p00, p01, p02 = tile[3 * LANES + i], tile[4 * LANES + i], tile[5 * LANES + i]
    p11, p12, p22 = tile[6 * LANES + i], tile[7 * LANES + i], tile[8 * LANES + i]
    n00, n01, n02 = work[N00 + i], work[N01 + i], work[N02 + i]
    n11, n12, n22 = work[N11 + i], work[N12 + i], work[N22 + i]
    rx, ry, rz = work[R0 + i], work[R1 + i], work[R2 + i]
    k00, k01, k02 = p00 * i00 + p01 * i01 + p02 * i02, p00 * i01 + p01 * i11 + p02 * i12, (
        p00 * i02 + p01 * i12 + p02 * i22
    )  # Eq. 8
    k10, k11, k12 = p01 * i00 + p11 * i01 + p12 * i02, p01 * i01 + p11 * i11 + p12 * i12, (
        p01 * i02 + p11 * i12 + p12 * i22
    )
    k20, k21, k22 = p02 * i00 + p12 * i01 + p22 * i02, p02 * i01 + p12 * i11 + p22 * i12, (
        p02 * i02 + p12 * i12 + p22 * i22
    )
    tile[i] += k00 * rx + k01 * ry + k02 * rz if match else 0.0  # Eq. 9
    tile[LANES + i] += k10 * rx + k11 * ry + k12 * rz if match else 0.0
    tile[2 * LANES + i] += k20 * rx + k21 * ry + k22 * rz if match else 0.0
    # Eq. 10, (I - K) Sigma, written as K R: no difference of nearly equal numbers, and made symmetric.
    q01 = 0.5 * (k00 * n01 + k01 * n11 + k02 * n12 + k10 * n00 + k11 * n01 + k12 * n02)
    q02 = 0.5 * (k00 * n02 + k01 * n12 + k02 * n22 + k20 * n00 + k21 * n01 + k22 * n02)
    q12 = 0.5 * (k10 * n02 + k11 * n12 + k12 * n22 + k20 * n01 + k21 * n11 + k22 * n12)
    tile[3 * LANES + i] = k00 * n00 + k01 * n01 + k02 * n02 if match else p00
    tile[4 * LANES + i] = q01 if match else p01
    tile[5 * LANES + i] = q02 if match else p02
    tile[6 * LANES + i] = k10 * n01 + k11 * n11 + k12 * n12 if match else p11
    tile[7 * LANES + i] = q12 if match else p12
    tile[8 * LANES + i] = k20 * n02 + k21 * n12 + k22 * n22 if match else p22


@lanes_inlined
def _inverse_of_sum(
    work: FloatArray, tile: FloatArray, i: int
) -> tuple[float, float, float, float, float, float, float]:
    """Return S^-1 and |S|, S = Sigma + R (Eq. 7)."""
    return _invert(
        tile[3 * LANES + i] + work[N00 + i], tile[4 * LANES + i] + work[N01 + i], tile[5 * LANES + i] + work[N02 + i],
        tile[6 * LANES + i] + work[N11 + i], tile[7 * LANES + i] + work[N12 + i], tile[8 * LANES + i] + work[N22 + i],
    )


@lanes
def _update(work: FloatArray, tile: FloatArray, mask: FloatArray) -> None:
    """At a known pose: update the landmark where `mask` is 1 and it lies ahead of the camera (Eqs. 5-10)."""
    for i in range(LANES):
        i00, i01, i02, i11, i12, i22, _ = _inverse_of_sum(work, tile, i)
        match = mask[i] > 0.0 and work[DEPTH + i] >= MIN_DEPTH
        _updated(work, tile, i, i00, i01, i02, i11, i12, i22, match)


@lanes_inlined
def _count_likelihood(work: FloatArray, i: int, on: bool, square: float, det: float, depth: float) -> None:
    """Where `on`, add a match's part of the log-likelihood: r^T S^-1 r, and |S| and the depth as products."""
    work[SUM_D + i] += square if on else 0.0
    work[MATCHED + i] += 1.0 if on else 0.0
    mantissa, exponent = _split(work[DET + i] * (det if on else 1.0))
    work[DET + i] = mantissa
    work[DET_EXP + i] += exponent
    mantissa, exponent = _split(work[DEPTHS + i] * (depth if on else 1.0))
    work[DEPTHS + i] = mantissa
    work[DEPTHS_EXP + i] += exponent


@lanes
def _gate_and_update(
    work: FloatArray, tile: FloatArray, record: FloatArray, chosen: FloatArray, seen: Int32Array, q: float,
    admit: FloatArray, gate: float,
) -> None:
    """At a known pose: where admitted and inside the gate, weigh and update the landmark (Eqs. 5-11).

    Args:
        chosen: (LANES,) becomes q where the lane matched.
        seen: (LANES,) is counted up there.
        admit: (LANES,) 1 where the lane may match.
        record: Row Q_D is written.
    """
    for i in range(LANES):
        i00, i01, i02, i11, i12, i22, det = _inverse_of_sum(work, tile, i)
        distance = _form(i00, i01, i02, i11, i12, i22, work[R0 + i], work[R1 + i], work[R2 + i])
        depth = work[DEPTH + i]
        match = admit[i] > 0.0 and distance <= gate and depth >= MIN_DEPTH
        _updated(work, tile, i, i00, i01, i02, i11, i12, i22, match)
        _count_likelihood(work, i, match, distance, det, depth)
        record[Q_D + i] = distance
        chosen[i] = q if match else chosen[i]
        seen[i] += np.int32(1) if match else np.int32(0)


@lanes
def _add_likelihood(work: FloatArray, record: FloatArray, mask: FloatArray) -> None:
    """Add a match's part of the log-likelihood where `mask` is 1."""
    for i in range(LANES):
        _count_likelihood(
            work, i, mask[i] > 0.0, record[Q_SQUARE + i], record[Q_DET + i], record[Q_DEPTH + i]
        )


@lanes
def _clear_likelihood(work: FloatArray) -> None:
    for i in range(LANES):
        work[SUM_D + i] = 0.0
        work[MATCHED + i] = 0.0
        work[DET + i] = 1.0
        work[DET_EXP + i] = 0.0
        work[DEPTHS + i] = 1.0
        work[DEPTHS_EXP + i] = 0.0
        work[CLUTTER + i] = 0.0


@lanes_inlined
def _log_likelihood(work: FloatArray, i: int) -> float:
    """Return a lane's sum over matches of log N(r; 0, S) + 4 log depth (Eq. 11), and that of the unmatched."""
    log_det = _log(work[DET + i]) + LN2 * work[DET_EXP + i]
    log_depth = _log(work[DEPTHS + i]) + LN2 * work[DEPTHS_EXP + i]
    matched: float = work[SUM_D + i] + 3.0 * LOG_2PI * work[MATCHED + i] + log_det
    unmatched: float = work[CLUTTER + i]
    total: float = -0.5 * matched + 4.0 * log_depth + unmatched
    return total


@lanes_inlined
def _add_terms(
    work: FloatArray, i: int, on: bool, w: float, j00: float, j01: float, j02: float, j11: float, j12: float,
    j22: float, g0: float, g1: float, g2: float,
) -> None:
    """Where `on`, add a match's share of the Gauss-Newton system, times w; elsewhere it may be NaN."""
    work[J00 + i] += w * j00 if on else 0.0
    work[J01 + i] += w * j01 if on else 0.0
    work[J02 + i] += w * j02 if on else 0.0
    work[J11 + i] += w * j11 if on else 0.0
    work[J12 + i] += w * j12 if on else 0.0
    work[J22 + i] += w * j22 if on else 0.0
    work[G0 + i] += w * g0 if on else 0.0
    work[G1 + i] += w * g1 if on else 0.0
    work[G2 + i] += w * g2 if on else 0.0


@lanes
def _sum_matches(work: FloatArray, record: FloatArray, weights: FloatArray) -> None:
    """Add a candidate's share of the Gauss-Newton system, times `weights` (LANES)."""
    for i in range(LANES):
        _add_terms(
            work, i, weights[i] > 0.0, weights[i],
            record[QJ00 + i], record[QJ01 + i], record[QJ02 + i], record[QJ11 + i], record[QJ12 + i], record[QJ22 + i],
            record[QG0 + i], record[QG1 + i], record[QG2 + i],
        )


@lanes
def _clear_sums(work: FloatArray) -> None:
    """Start the system of xi from its prior N(0, I)."""
    for i in range(LANES):
        work[J00 + i] = 1.0
        work[J01 + i] = 0.0
        work[J02 + i] = 0.0
        work[J11 + i] = 1.0
        work[J12 + i] = 0.0
        work[J22 + i] = 1.0
        work[G0 + i] = work[XI0 + i]
        work[G1 + i] = work[XI1 + i]
        work[G2 + i] = work[XI2 + i]


@lanes
def _robust_weights(
    record: FloatArray, chosen: FloatArray, q: float, gate: float, weights: FloatArray
) -> int:
    """Write Cauchy's weights 1 / (1 + D / gate) where the lane chose candidate q, else 0; return how many chose it."""
    count = 0
    for i in range(len(chosen)):
        on = chosen[i] == q
        weights[i] = 1.0 / (1.0 + record[Q_D + i] / gate) if on else 0.0
        count += 1 if on else 0
    return count


@lanes
def _step_pose(work: FloatArray, only_wide: bool) -> None:
    """Take one step of Gauss-Newton from the sums: xi <- xi - J^-1 G, with covariance J^-1."""
    for i in range(LANES):
        go = work[WIDE + i] > 0.0 or not only_wide
        i00, i01, i02, i11, i12, i22, _ = _invert(
            work[J00 + i], work[J01 + i], work[J02 + i], work[J11 + i], work[J12 + i], work[J22 + i]
        )
        g0, g1, g2 = work[G0 + i], work[G1 + i], work[G2 + i]
        work[XI0 + i] -= i00 * g0 + i01 * g1 + i02 * g2 if go else 0.0
        work[XI1 + i] -= i01 * g0 + i11 * g1 + i12 * g2 if go else 0.0
        work[XI2 + i] -= i02 * g0 + i12 * g1 + i22 * g2 if go else 0.0
        work[SPREAD00 + i] = i00 if go else work[SPREAD00 + i]
        work[SPREAD01 + i] = i01 if go else work[SPREAD01 + i]
        work[SPREAD02 + i] = i02 if go else work[SPREAD02 + i]
        work[SPREAD11 + i] = i11 if go else work[SPREAD11 + i]
        work[SPREAD12 + i] = i12 if go else work[SPREAD12 + i]
        work[SPREAD22 + i] = i22 if go else work[SPREAD22 + i]


@lanes
def _place(work: FloatArray) -> None:
    """Write the pose rows X .. SIN of x0 + C xi."""
    for i in range(LANES):
        xi0, xi1, xi2 = work[XI0 + i], work[XI1 + i], work[XI2 + i]
        theta = work[T0 + i] + work[C20 + i] * xi0 + work[C21 + i] * xi1 + work[C22 + i] * xi2
        work[X + i] = work[X0 + i] + work[C00 + i] * xi0 + work[C01 + i] * xi1
        work[Y + i] = work[Y0 + i] + work[C10 + i] * xi0 + work[C11 + i] * xi1
        work[T + i] = theta
        work[SIN + i], work[COS + i] = _sine_cosine(theta)


@lanes
def _predict(work: FloatArray, mean: FloatArray, covariance: FloatArray, move: FloatArray, sigmas: FloatArray) -> None:
    """Write the predicted pose x0 and a factor C of its covariance P0 (Eq. 4, propagated).

    C = T L with L the lower Cholesky factor of T^T P0 T, where T is the turn by the predicted heading. Rows N00 .. N22
    hold T^T P0 T afterwards, COS and SIN the turn.

    Args:
        mean: (3 LANES,) the pose before the motion: rows x, y, theta.
        covariance: (6 LANES,) its covariance, upper triangle by rows.
        move: (3,) u, previous robot frame.
        sigmas: (3,) standard deviations of u.
    """
    dx, dy, turn = move[0], move[1], move[2]
    v0, v1, v2 = sigmas[0] ** 2, sigmas[1] ** 2, sigmas[2] ** 2
    for i in range(LANES):
        s, c = _sine_cosine(mean[2 * LANES + i])
        ox, oy = c * dx - s * dy, s * dx + c * dy
        work[X0 + i] = mean[i] + ox
        work[Y0 + i] = mean[LANES + i] + oy
        work[T0 + i] = mean[2 * LANES + i] + turn
        p00, p01, p02 = covariance[i], covariance[LANES + i], covariance[2 * LANES + i]
        p11, p12, p22 = covariance[3 * LANES + i], covariance[4 * LANES + i], covariance[5 * LANES + i]
        # F = [[1, 0, -oy], [0, 1, ox], [0, 0, 1]]
        q00 = p00 - 2.0 * oy * p02 + oy * oy * p22 + c * c * v0 + s * s * v1
        q01 = p01 + ox * p02 - oy * p12 - ox * oy * p22 + c * s * (v0 - v1)
        q02 = p02 - oy * p22
        q11 = p11 + 2.0 * ox * p12 + ox * ox * p22 + s * s * v0 + c * c * v1
        q12 = p12 + ox * p22
        # Factorised in the robot's axes, T^T P0 T: how the map frame happens to be turned plays no part.
        s, c = _sine_cosine(work[T0 + i])
        work[N00 + i] = c * c * q00 + 2.0 * c * s * q01 + s * s * q11
        work[N01 + i] = c * s * (q11 - q00) + (c * c - s * s) * q01
        work[N02 + i] = c * q02 + s * q12
        work[N11 + i] = s * s * q00 - 2.0 * c * s * q01 + c * c * q11
        work[N12 + i] = c * q12 - s * q02
        work[N22 + i] = p22 + v2
        work[COS + i], work[SIN + i] = c, s
        work[WIDE + i] = 1.0 if p22 + v2 > WIDE_HEADING**2 else 0.0
    for i in range(LANES):
        _factorise(work, i)


@lanes
def _to_map_axes(work: FloatArray) -> None:
    """Turn the covariance in rows N00 .. N22 from the robot's axes to the map's: T P T^T."""
    for i in range(LANES):
        c, s = work[COS + i], work[SIN + i]
        r00, r01, r02 = work[N00 + i], work[N01 + i], work[N02 + i]
        r11, r12 = work[N11 + i], work[N12 + i]
        work[N00 + i] = c * c * r00 - 2.0 * c * s * r01 + s * s * r11
        work[N01 + i] = c * s * (r00 - r11) + (c * c - s * s) * r01
        work[N02 + i] = c * r02 - s * r12
        work[N11 + i] = s * s * r00 + 2.0 * c * s * r01 + c * c * r11
        work[N12 + i] = s * r02 + c * r12


@lanes_inlined
def _factorise(work: FloatArray, i: int) -> None:
    """Write C = T L, L L^T the covariance in rows N00 .. N22; a vanishing pivot gives L a column of zeros."""
    q00, q11, q22 = work[N00 + i], work[N11 + i], work[N22 + i]
    c, s = work[COS + i], work[SIN + i]
    l00 = math.sqrt(q00 if q00 > 0.0 else 0.0)
    inverse = 1.0 / l00 if q00 > 0.0 else 0.0
    l10, l20 = work[N01 + i] * inverse, work[N02 + i] * inverse
    rest = q11 - l10 * l10
    rest = rest if rest > ZERO_PIVOT * q11 else 0.0
    l11 = math.sqrt(rest)
    inverse = 1.0 / l11 if rest > 0.0 else 0.0
    l21 = (work[N12 + i] - l20 * l10) * inverse
    rest = q22 - l20 * l20 - l21 * l21
    work[C00 + i], work[C01 + i] = c * l00 - s * l10, -s * l11
    work[C10 + i], work[C11 + i] = s * l00 + c * l10, c * l11
    work[C20 + i], work[C21 + i] = l20, l21
    work[C22 + i] = math.sqrt(rest if rest > ZERO_PIVOT * q22 else 0.0)


@lanes
def _match_alone(
    work: FloatArray, tile: FloatArray, record: FloatArray, seen: Int32Array, match: FloatArray, q: float,
    reach: float, gate: float,
) -> None:
    """Pass A for a measurement with one candidate: match, weigh by Cauchy's 1 / (1 + D / gate), sum, and judge.

    `reach` is the largest D that may match: the gate, or any where the caller names the landmarks.
    """
    for i in range(LANES):
        j00, j01, j02, j11, j12, j22, g0, g1, g2, _, _, _, _, _, distance = _match_terms(work, tile, i, False)
        held = seen[i] > 0
        inside = distance <= gate
        ok = held and distance <= reach
        match[i] = q if ok else -1.0
        _add_terms(work, i, ok, gate / (gate + distance), j00, j01, j02, j11, j12, j22, g0, g1, g2)
        record[Q_FIRST_D + i] = distance
        work[CONTRADICT + i] += 1.0 if held and not inside else 0.0


@lanes
def _decide_alone(
    work: FloatArray, tile: FloatArray, seen: Int32Array, match: FloatArray, q: float,
    reach: float, dead_zone: float, dead_radius: float, log_clutter: float,
) -> None:
    """Pass B for a measurement with one candidate: match, reject or start, and sum.

    Row TAKEN says where an earlier measurement has taken the landmark; for `reach` see `_match_alone`.
    """
    radius2 = dead_radius * dead_radius
    for i in range(LANES):
        j00, j01, j02, j11, j12, j22, g0, g1, g2, square, det, _, depth, metres2, distance = _match_terms(
            work, tile, i, True
        )
        front = seen[i] > 0 and distance < np.inf
        near = front and (distance <= dead_zone or metres2 <= radius2)
        ok = front and distance <= reach and work[TAKEN + i] == 0.0
        match[i] = q if ok else (-1.0 if near else -2.0)
        work[CLUTTER + i] += 0.0 if ok else log_clutter
        _add_terms(work, i, ok, 1.0, j00, j01, j02, j11, j12, j22, g0, g1, g2)
        _count_likelihood(work, i, ok, square, det, depth)


@lanes
def _begin_choice(work: FloatArray) -> None:
    for i in range(LANES):
        work[BEST + i] = np.inf
        work[SECOND + i] = np.inf
        work[CHOSEN + i] = -1.0
        work[DEAD + i] = 0.0
        work[LOG_BEST + i] = 0.0


@lanes
def _consider(work: FloatArray, record: FloatArray, q: float, look: float, reach: float) -> None:
    """Let candidate q compete for the measurement in pass A; `look` is what its descriptor costs."""
    for i in range(LANES):
        distance = record[Q_D + i]
        ok = record[Q_HELD + i] > 0.0 and distance <= reach
        depth = record[Q_DEPTH + i]
        log_det = _log(record[Q_DET_POSE + i] if ok else 1.0) - 8.0 * _log(depth if ok else 1.0)
        cost = distance + log_det + look if ok else np.inf
        best, second = work[BEST + i], work[SECOND + i]
        better = cost < best
        work[SECOND + i] = best if better else (cost if cost < second else second)
        work[BEST + i] = cost if better else best
        work[CHOSEN + i] = q if better else work[CHOSEN + i]


@lanes
def _end_choice(work: FloatArray, chosen: FloatArray, ambiguity: float) -> None:
    """Write the tentative match of each lane: the best candidate, if no other comes near."""
    for i in range(len(chosen)):
        second = work[SECOND + i]
        clear = second == np.inf or second - work[BEST + i] >= ambiguity
        chosen[i] = work[CHOSEN + i] if clear else -1.0


@lanes
def _drop_taken(chosen: FloatArray, q: float, earlier: FloatArray, p: float) -> None:
    """Unmatch lanes in which an earlier measurement took, as its candidate p, the landmark that is candidate q here."""
    for i in range(len(chosen)):
        chosen[i] = -1.0 if chosen[i] == q and earlier[i] == p else chosen[i]


@lanes
def _mark_taken(work: FloatArray, earlier: FloatArray, p: float) -> None:
    for i in range(len(earlier)):
        work[TAKEN + i] = 1.0 if earlier[i] == p else work[TAKEN + i]


@lanes
def _clear_taken(work: FloatArray) -> None:
    for i in range(LANES):
        work[TAKEN + i] = 0.0


@lanes
def _consider_again(
    work: FloatArray, record: FloatArray, q: float, look: float, cap: float, gate: float, dead_zone: float,
    dead_radius: float,
) -> None:
    """Let candidate q compete for the measurement in pass B, unless row TAKEN says that its landmark is taken.

    D counts no more than `cap`: the gate where the caller names the landmarks.
    """
    radius2 = dead_radius * dead_radius
    for i in range(LANES):
        distance = record[Q_D + i]
        front = record[Q_HELD + i] > 0.0 and distance < np.inf
        distance = cap if distance > cap else distance
        near = front and (distance <= dead_zone or record[Q_METRES2 + i] <= radius2)
        ok = front and distance <= gate and work[TAKEN + i] == 0.0
        work[DEAD + i] = 1.0 if near else work[DEAD + i]
        depth = record[Q_DEPTH + i]
        log_det = _log(record[Q_DET_POSE + i] if ok else 1.0) - 8.0 * _log(depth if ok else 1.0)
        cost = distance + log_det + look if ok else np.inf
        best, second = work[BEST + i], work[SECOND + i]
        better = cost < best
        work[SECOND + i] = best if better else (cost if cost < second else second)
        work[BEST + i] = cost if better else best
        work[CHOSEN + i] = q if better else work[CHOSEN + i]
        work[LOG_BEST + i] = -0.5 * (distance + log_det + 3.0 * LOG_2PI) if better else work[LOG_BEST + i]


@lanes
def _decide(work: FloatArray, match: FloatArray, ambiguity: float, log_clutter: float) -> None:
    """Write the candidate matched, -1 for rejected or -2 for new, and the log-likelihood of what is not matched."""
    for i in range(LANES):
        chosen, best, second = work[CHOSEN + i], work[BEST + i], work[SECOND + i]
        matched = chosen >= 0.0
        held_back = matched and second < np.inf and second - best < ambiguity
        dead = work[DEAD + i] > 0.0
        match[i] = (-1.0 if held_back else chosen) if matched else (-1.0 if dead else -2.0)
        work[CLUTTER + i] += (work[LOG_BEST + i] if held_back else 0.0) if matched else log_clutter


@lanes
def _mask_of(match: FloatArray, code: float, mask: FloatArray) -> int:
    """Write 1 where `match` equals `code`, else 0; return how many."""
    count = 0
    for i in range(len(match)):
        on = match[i] == code
        mask[i] = 1.0 if on else 0.0
        count += 1 if on else 0
    return count


@lanes
def _begin_judging(work: FloatArray) -> None:
    for i in range(LANES):
        work[SURE + i] = 0.0
        work[CONTRADICT + i] = 0.0


@lanes
def _nearest(work: FloatArray, record: FloatArray, begin: bool) -> None:
    """Fold candidate after candidate: BEST = least D at hand of those held, SECOND = least of the D kept before."""
    for i in range(LANES):
        held = record[Q_HELD + i] > 0.0
        now, before = record[Q_D + i] if held else np.inf, record[Q_FIRST_D + i] if held else np.inf
        work[BEST + i] = now if begin or now < work[BEST + i] else work[BEST + i]
        work[SECOND + i] = before if begin or before < work[SECOND + i] else work[SECOND + i]
        work[CHOSEN + i] = 1.0 if held else (0.0 if begin else work[CHOSEN + i])


@lanes
def _count_unexplained(work: FloatArray, gate: float) -> None:
    """Count a measurement that has candidates, none of which explains it at the predicted pose."""
    for i in range(LANES):
        work[CONTRADICT + i] += 1.0 if work[CHOSEN + i] > 0.0 and not work[BEST + i] <= gate else 0.0


@lanes
def _count_explained(work: FloatArray, gate: float) -> None:
    """Count a measurement that the wide prior explains, and whether the narrow one did not."""
    for i in range(LANES):
        sure = work[BEST + i] <= gate
        work[SURE + i] += 1.0 if sure else 0.0
        work[CONTRADICT + i] += 1.0 if sure and not work[SECOND + i] <= gate else 0.0


@lanes
def _any_suspect(work: FloatArray) -> int:
    """Return in how many lanes enough is unexplained."""
    count = 0
    for i in range(LANES):
        count += 1 if work[CONTRADICT + i] >= MIN_CONTRADICTIONS else 0
    return count


@lanes
def _widen_suspects(work: FloatArray, recovery: FloatArray) -> None:
    """Keep the factor C, and where enough is unexplained try T diag(recovery), T the turn by the predicted heading."""
    for i in range(LANES):
        work[KEPT00 + i], work[KEPT01 + i] = work[C00 + i], work[C01 + i]
        work[KEPT10 + i], work[KEPT11 + i] = work[C10 + i], work[C11 + i]
        work[KEPT20 + i], work[KEPT21 + i], work[KEPT22 + i] = work[C20 + i], work[C21 + i], work[C22 + i]
        work[KEPT_WIDE + i] = work[WIDE + i]
        suspect = work[CONTRADICT + i] >= MIN_CONTRADICTIONS
        c, s = work[COS + i], work[SIN + i]
        work[LOST + i] = 1.0 if suspect else 0.0
        work[WIDE + i] = 1.0 if suspect else work[WIDE + i]
        work[C00 + i] = c * recovery[0] if suspect else work[C00 + i]
        work[C01 + i] = -s * recovery[1] if suspect else work[C01 + i]
        work[C10 + i] = s * recovery[0] if suspect else work[C10 + i]
        work[C11 + i] = c * recovery[1] if suspect else work[C11 + i]
        work[C20 + i] = 0.0 if suspect else work[C20 + i]
        work[C21 + i] = 0.0 if suspect else work[C21 + i]
        work[C22 + i] = recovery[2] if suspect else work[C22 + i]


@lanes
def _acquit(work: FloatArray) -> int:
    """Give the kept factor back to suspects that are not lost after all; return how many those are."""
    count = 0
    for i in range(LANES):
        lost = work[CONTRADICT + i] >= MIN_CONTRADICTIONS and 2.0 * work[CONTRADICT + i] > work[SURE + i]
        back = work[LOST + i] > 0.0 and not lost
        work[C00 + i] = work[KEPT00 + i] if back else work[C00 + i]
        work[C01 + i] = work[KEPT01 + i] if back else work[C01 + i]
        work[C10 + i] = work[KEPT10 + i] if back else work[C10 + i]
        work[C11 + i] = work[KEPT11 + i] if back else work[C11 + i]
        work[C20 + i] = work[KEPT20 + i] if back else work[C20 + i]
        work[C21 + i] = work[KEPT21 + i] if back else work[C21 + i]
        work[C22 + i] = work[KEPT22 + i] if back else work[C22 + i]
        work[WIDE + i] = work[KEPT_WIDE + i] if back else work[WIDE + i]
        count += 1 if back else 0
    return count


@lanes
def _begin_pose(work: FloatArray) -> None:
    """Start from xi = 0 with covariance I, at the predicted pose."""
    for i in range(LANES):
        work[XI0 + i] = 0.0
        work[XI1 + i] = 0.0
        work[XI2 + i] = 0.0
        work[SPREAD00 + i] = 1.0
        work[SPREAD01 + i] = 0.0
        work[SPREAD02 + i] = 0.0
        work[SPREAD11 + i] = 1.0
        work[SPREAD12 + i] = 0.0
        work[SPREAD22 + i] = 1.0


@lanes
def _posterior(work: FloatArray, normals: FloatArray, log_likelihood: FloatArray, out: FloatArray) -> None:
    """Weigh by the predictive likelihood and sample the pose, from the sums of pass B (Laplace's formula).

    Args:
        normals: (3 LANES,) standard normal draws.
        log_likelihood: (LANES,) is added to.
        out: (12 LANES,), written: mean x^ (3), covariance P^ (6), sample (3), theta of the sample wrapped.
    """
    for i in range(LANES):
        i00, i01, i02, i11, i12, i22, det = _invert(
            work[J00 + i], work[J01 + i], work[J02 + i], work[J11 + i], work[J12 + i], work[J22 + i]
        )
        g0, g1, g2 = work[G0 + i], work[G1 + i], work[G2 + i]
        xi0, xi1, xi2 = work[XI0 + i], work[XI1 + i], work[XI2 + i]
        gain = _form(i00, i01, i02, i11, i12, i22, g0, g1, g2)
        log_likelihood[i] += _log_likelihood(work, i) - 0.5 * (
            xi0 * xi0 + xi1 * xi1 + xi2 * xi2 - gain + _log(det)
        )
        xi0 -= i00 * g0 + i01 * g1 + i02 * g2
        xi1 -= i01 * g0 + i11 * g1 + i12 * g2
        xi2 -= i02 * g0 + i12 * g1 + i22 * g2
        c00, c01, c10, c11 = work[C00 + i], work[C01 + i], work[C10 + i], work[C11 + i]
        c20, c21, c22 = work[C20 + i], work[C21 + i], work[C22 + i]
        out[i] = work[X0 + i] + c00 * xi0 + c01 * xi1
        out[LANES + i] = work[Y0 + i] + c10 * xi0 + c11 * xi1
        out[2 * LANES + i] = work[T0 + i] + c20 * xi0 + c21 * xi1 + c22 * xi2
        # P^ = C J^-1 C^T
        h00, h01 = c00 * i00 + c01 * i01, c00 * i01 + c01 * i11
        h10, h11 = c10 * i00 + c11 * i01, c10 * i01 + c11 * i11
        h20, h21, h22 = (
            c20 * i00 + c21 * i01 + c22 * i02, c20 * i01 + c21 * i11 + c22 * i12, c20 * i02 + c21 * i12 + c22 * i22
        )
        out[3 * LANES + i] = h00 * c00 + h01 * c01
        out[4 * LANES + i] = h10 * c00 + h11 * c01
        out[5 * LANES + i] = h20 * c00 + h21 * c01
        out[6 * LANES + i] = h10 * c10 + h11 * c11
        out[7 * LANES + i] = h20 * c10 + h21 * c11
        out[8 * LANES + i] = h20 * c20 + h21 * c21 + h22 * c22
        n0, n1, n2 = normals[i], normals[LANES + i], normals[2 * LANES + i]
        l00 = math.sqrt(i00)
        l10, l20 = i01 / l00, i02 / l00
        l11 = math.sqrt(i11 - l10 * l10)
        l21 = (i12 - l20 * l10) / l11
        l22 = math.sqrt(i22 - l20 * l20 - l21 * l21)
        xi0 += l00 * n0
        xi1 += l10 * n0 + l11 * n1
        xi2 += l20 * n0 + l21 * n1 + l22 * n2
        theta = work[T0 + i] + c20 * xi0 + c21 * xi1 + c22 * xi2
        work[X + i] = work[X0 + i] + c00 * xi0 + c01 * xi1
        work[Y + i] = work[Y0 + i] + c10 * xi0 + c11 * xi1
        work[SIN + i], work[COS + i] = _sine_cosine(theta)
        out[9 * LANES + i] = work[X + i]
        out[10 * LANES + i] = work[Y + i]
        out[11 * LANES + i] = _wrap(theta)


@lanes
def _new_landmark(
    work: FloatArray, tile: FloatArray, points: FloatArray, noises: FloatArray, n: int, given: bool, camera: FloatArray,
    mask: FloatArray, seen: Int32Array,
) -> None:
    """Write mean and covariance of a landmark first seen from a known pose (Algorithm 1, l. 30-31 corrected).

    All lanes of the block are written; `seen` becomes 1 where `mask` is, and 0 elsewhere: those do not hold it.
    """
    ahead, left, up = camera[4] + points[n, 0], camera[5] + points[n, 1], camera[6] + points[n, 2]
    for i in range(LANES):
        c, s = work[COS + i], work[SIN + i]
        tile[i] = work[X + i] + c * ahead - s * left
        tile[LANES + i] = work[Y + i] + s * ahead + c * left
        tile[2 * LANES + i] = up
    _innovate(work, tile, points, noises, n, given, camera)
    for i in range(LANES):  # l. 31 *: G^-1 R G^-T
        tile[3 * LANES + i] = work[N00 + i]
        tile[4 * LANES + i] = work[N01 + i]
        tile[5 * LANES + i] = work[N02 + i]
        tile[6 * LANES + i] = work[N11 + i]
        tile[7 * LANES + i] = work[N12 + i]
        tile[8 * LANES + i] = work[N22 + i]
    for i in range(len(seen)):
        seen[i] = np.int32(1) if mask[i] > 0.0 else np.int32(0)


# ------------------------------------------------------------------------------------------ where landmarks lie


@lanes
def refresh(
    slots: IntArray, values: FloatArray, counts: Int32Array, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, tops: IntArray,
) -> None:
    """Bring landmarks up to date: copy each particle's values from where its ancestor left them to its own place.

    One free row is needed: the row that a landmark leaves is taken by the next, while it is still in the cache.
    """
    size = 9 * counts.shape[1]
    for k in range(len(slots)):
        slot = slots[k]
        e = map_of[slot]
        if e == 0:
            continue
        row = row_of[slot]
        tops[0] -= 1
        target = free_rows[tops[0]]
        source, copy = values[row * size : (row + 1) * size], values[target * size : (target + 1) * size]
        _copy_row(source, copy, counts[row], counts[target], maps[e])
        free_rows[tops[0]] = row
        tops[0] += 1
        row_of[slot] = target
        users[e] -= 1
        map_of[slot] = 0


@jit
def carry_odds(slots: IntArray, odds: FloatArray, map_of: IntArray, maps: Int32Array) -> None:
    """Copy log-odds from where each particle's ancestor left them to its own place; `refresh` does the rest.

    Args:
        slots: Landmarks that are about to be brought up to date.
        odds: (slots, P), changed.
        map_of, maps: As yet of the old places, see `ParticleMaps`.
    """
    before = np.empty(odds.shape[1])
    for k in range(len(slots)):
        slot = slots[k]
        if map_of[slot] == 0:
            continue
        own = maps[map_of[slot]]
        for m in range(len(before)):
            before[m] = odds[slot, own[m]]
        for m in range(len(before)):
            odds[slot, m] = before[m]


@lanes
def _copy_row(
    source: FloatArray, target: FloatArray, before: Int32Array, seen: Int32Array, ancestors: Int32Array
) -> None:
    """Copy a row of values and counts, each particle's from its ancestor's place.

    Most particles are their own ancestors, and memory is fast where it is read and written in order: so first all of
    the row as it lies, then those that moved.
    """
    for j in range(len(target)):
        target[j] = source[j]
    for m in range(len(seen)):
        seen[m] = before[m]
    for m in range(len(ancestors)):
        ancestor = np.uint32(ancestors[m])  # unsigned: none counts from the end
        if ancestor != m:
            at = (ancestor >> SHIFT) * TILE + (ancestor & (LANES - 1))
            to = (m >> SHIFT) * TILE + (m & (LANES - 1))
            seen[m] = before[ancestor]
            for c in range(9):
                target[to + c * LANES] = source[at + c * LANES]


@lanes_inlined
def _tile(values: FloatArray, padded: int, row: int, block: int) -> FloatArray:
    """Return a block of a landmark that is up to date: a view."""
    start = row * 9 * padded + block * TILE
    return values[start : start + TILE]


@lanes
def _mark_held(record: FloatArray, seen: Int32Array) -> None:
    for i in range(len(seen)):
        record[Q_HELD + i] = 1.0 if seen[i] > 0 else 0.0


@jit
def _open_slot(
    b: int, new_slots: IntArray, new_rows: IntArray, row_of: IntArray, map_of: IntArray, values: FloatArray,
    counts: Int32Array, free_rows: IntArray, free_slots: IntArray, tops: IntArray,
) -> None:
    """Give measurement b a free slot and row for the landmark that it starts in some particles."""
    tops[0] -= 1
    tops[1] -= 1
    new_rows[b] = free_rows[tops[0]]
    new_slots[b] = free_slots[tops[1]]
    size = 9 * counts.shape[1]
    counts[new_rows[b], :] = 0
    values[new_rows[b] * size : (new_rows[b] + 1) * size] = 0.0
    row_of[new_slots[b]] = new_rows[b]
    map_of[new_slots[b]] = 0


# ------------------------------------------------------------------------------------------------- candidates


@jit
def extent(points: FloatArray) -> tuple[float, float]:
    """Return the smallest depth Z and the largest coordinate, by magnitude, of points (n, 3), camera frame."""
    nearest, farthest = np.inf, 0.0
    for n in range(len(points)):
        nearest = min(nearest, points[n, 2])
        for c in range(3):
            farthest = max(farthest, abs(points[n, c]))
    return nearest, farthest


@jit
def to_robot_axes(points: FloatArray, covariances: FloatArray, turned: FloatArray, noises: FloatArray) -> None:
    """Turn points (n, 3) and covariances (n, 3, 3), or none (0, 3, 3), from camera axes to the robot's.

    Args:
        points, covariances: As measured.
        turned: (n, 3), written: relative to the camera centre, x ahead, y left, z up.
        noises: (n, 6), written: upper triangles by rows, zeros for none.
    """
    n = len(points)
    for i in range(n):
        turned[i, 0], turned[i, 1], turned[i, 2] = points[i, 2], -points[i, 0], -points[i, 1]
        noises[i] = 0.0
    for i in range(len(covariances)):
        noises[i, 0], noises[i, 1], noises[i, 2] = covariances[i, 2, 2], -covariances[i, 2, 0], -covariances[i, 2, 1]
        noises[i, 3], noises[i, 4], noises[i, 5] = covariances[i, 0, 0], covariances[i, 0, 1], covariances[i, 1, 1]


@lanes
def _head_distances(
    measured: Float32Array, b: int, heads: Float32Array, stride: int, n: int, out: Float32Array
) -> None:
    """Write the squared distances over every `stride`-th component between a measured and all stored descriptors."""
    for slot in range(n):
        out[slot] = np.float32(0.0)
    whole = heads.shape[0] // 4 * 4
    for k in range(0, whole, 4):
        v0, v1 = measured[b, k * stride], measured[b, (k + 1) * stride]
        v2, v3 = measured[b, (k + 2) * stride], measured[b, (k + 3) * stride]
        row0, row1, row2, row3 = heads[k], heads[k + 1], heads[k + 2], heads[k + 3]
        for slot in range(n):
            d0, d1, d2, d3 = v0 - row0[slot], v1 - row1[slot], v2 - row2[slot], v3 - row3[slot]
            out[slot] += (d0 * d0 + d1 * d1) + (d2 * d2 + d3 * d3)
    for k in range(whole, heads.shape[0]):
        value = measured[b, k * stride]
        row = heads[k]
        for slot in range(n):
            difference = value - row[slot]
            out[slot] += difference * difference


@any_order
def _squared_distance(a: Float32Array, b: Float32Array) -> float:
    """Return the squared distance of two descriptors, in double precision."""
    total = 0.0
    for j in range(len(a)):
        difference = np.float64(a[j]) - np.float64(b[j])
        total += difference * difference
    return total


@lanes
def _hits(partial: Float32Array, limit: float, hits: IntArray) -> int:
    """Write the indices of the entries up to `limit`, ascending; return how many. Runs without one are skipped."""
    count, n = 0, len(partial)
    for first in range(0, n, RUN):
        last = min(first + RUN, n)
        run = partial[first:last]
        inside = 0
        for i in range(len(run)):
            inside += 1 if run[i] <= limit else 0
        if inside > 0:
            for i in range(len(run)):
                if run[i] <= limit:
                    hits[count] = first + i
                    count += 1
    return count


@jit
def find_candidates(
    measured: Float32Array, stored: Float32Array, heads: Float32Array, ids: IntArray, names: IntArray,
    identities: IntArray, named: bool, gate: float,
) -> tuple[IntArray, IntArray, FloatArray, IntArray, IntArray, IntArray]:
    """List for each measurement the landmarks that may have caused it, nearest descriptor first.

    Some components alone rule most landmarks out, for all particles at once; the others are compared in full.

    Args:
        measured: (B, d) descriptors of the frame.
        stored: (n, d) descriptors of the landmarks.
        heads: (h, n) every (d / h)-th component of them; large where the slot is free.
        ids: (n,) stable names of the landmarks, -1 = free; equal distances are ordered by them.
        names: (B,) the caller's names of the measurements, if `named`.
        identities: (n,) the caller's names of the landmarks.
        named: Whether names decide instead of descriptors.
        gate: Largest admitted squared distance E0.

    Returns:
        starts (B + 1,) of each measurement's candidates; per candidate its slot, squared distance E, measurement, and
        the previous candidate with the same slot (-1: none); and all these slots, each once.
    """
    num, n = measured.shape[0], len(ids)
    while n > 0 and ids[n - 1] < 0:
        n -= 1
    starts = np.zeros(num + 1, dtype=np.int64)
    size = 4 * num + 16
    slots = np.empty(size, dtype=np.int64)
    squares = np.empty(size)
    partial = np.empty(n, dtype=np.float32)
    hits = np.empty(n, dtype=np.int64)
    stride = measured.shape[1] // max(heads.shape[0], 1)
    limit = 1.0001 * gate + 1e-4  # rounding of single precision decides nothing
    total = 0
    for b in range(num):
        starts[b] = total
        if named:
            count = 0
            for slot in range(n):
                if identities[slot] == names[b] and ids[slot] >= 0:
                    hits[count] = slot
                    count += 1
        else:
            _head_distances(measured, b, heads, stride, n, partial)
            count = _hits(partial, limit, hits)
        for k in range(count):
            slot = hits[k]
            if ids[slot] < 0:
                continue
            e = _squared_distance(measured[b], stored[slot])
            if e > gate and not named:
                continue
            if total == size:
                size *= 2
                slots = np.append(slots, np.empty(size - total, dtype=np.int64))
                squares = np.append(squares, np.empty(size - total))
            at = total
            while at > starts[b] and (
                squares[at - 1] > e or (squares[at - 1] == e and ids[slots[at - 1]] > ids[slot])
            ):
                squares[at] = squares[at - 1]
                slots[at] = slots[at - 1]
                at -= 1
            squares[at] = e
            slots[at] = slot
            total += 1
    starts[num] = total
    owners = np.empty(total, dtype=np.int64)
    same = np.full(total, REJECTED, dtype=np.int64)
    unique = np.empty(total, dtype=np.int64)
    last = np.full(n, REJECTED, dtype=np.int64)
    count = 0
    for b in range(num):
        for q in range(starts[b], starts[b + 1]):
            owners[q] = b
            slot = slots[q]
            same[q] = last[slot]
            if last[slot] == REJECTED:
                unique[count] = slot
                count += 1
            last[slot] = q
    return starts, slots[:total], squares[:total], owners, same, unique[:count]


# --------------------------------------------------------------------------------------------------- proposals


@lanes
def update_fastslam1(
    poses: FloatArray, means: FloatArray, covariances: FloatArray, moved: bool, odometry: FloatArray,
    sigmas: FloatArray, normals: FloatArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, free_slots: IntArray, tops: IntArray, ids: IntArray, identities: IntArray,
    stored: Float32Array, heads: Float32Array,
    points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray, descriptors: Float32Array, names: IntArray,
    named: bool, descriptor_gate: float, position_gate: float, log_p0: float, one_to_one: bool,
    work: FloatArray, records: FloatArray,
    found: Int32Array, distances: FloatArray, new_slots: IntArray, log_likelihood: FloatArray,
) -> None:
    """Sample one robot's motion and integrate its frame as in Algorithm 1 (corrected).

    Args:
        poses: (3, P) rows x, y, theta of the particles, padded to P; replaced by the sampled ones if `moved`.
        means, covariances: (3, P), (6, P), written: the samples themselves, and zeros.
        odometry: (3,) u, previous robot frame.
        sigmas: (3,) standard deviations of u.
        normals: (M, 3) standard normal draws.
        values, counts, odds, ..., heads: The store, see `ParticleMaps`. B + 1 rows and B slots are free.
        points: (B, 3) measured points relative to the camera centre, robot axes.
        noises: (B, 6) their covariances in robot axes if `given`.
        given: Whether the covariances come with the measurements.
        camera: (7,) focal, baseline, sigma_px, sigma_disparity, mount.
        descriptors: (B, d).
        names: (B,) the caller's names of the landmarks measured, if `named`; gates then play no part.
        descriptor_gate: Largest admitted squared distance E0.
        position_gate: D0.
        log_p0: Log-density of a measurement that starts a new landmark.
        one_to_one: Whether a landmark is matched at most once in a frame.
        work, records: Working space.
        found: (B, P), written: the slot, new ones included.
        distances: (B, P), written: D of matches, NaN otherwise.
        new_slots: (B,), written: the slot of the landmark that a measurement started in some particle, else -1.
        log_likelihood: (P,), the frame's is added.
    """
    num_particles, padded = normals.shape[0], poses.shape[1]
    num = points.shape[0]
    starts, slots, _, owners, same, unique = find_candidates(
        descriptors, stored, heads, ids, names, identities, named, descriptor_gate
    )
    if len(odds) > 0:
        carry_odds(unique, odds, map_of, maps)
    refresh(unique, values, counts, row_of, map_of, maps, users, free_rows, tops)
    if len(slots) > len(records):
        records = np.empty((len(slots), CANDIDATE_ROWS * LANES))
    new_rows = np.empty(num, dtype=np.int64)
    match = np.empty((num, LANES))
    mask, draws = np.empty(LANES), np.zeros(3 * LANES)
    gate = np.inf if named else position_gate
    for b in range(num):
        new_slots[b] = REJECTED
    for block in range(padded // LANES):
        first = block * LANES
        real = min(LANES, num_particles - first)
        if moved:
            _take_draws(draws, normals, first, real)
            _sample_motion(work, poses, first, odometry, sigmas, draws)
        _enter_pose(work, poses, first)
        _clear_likelihood(work)
        for b in range(num):
            chosen = match[b]
            for i in range(LANES):
                chosen[i] = -2.0 if i < real else -1.0
            for q in range(starts[b], starts[b + 1]):  # l. 15-24: the nearest descriptor inside the gate
                row = row_of[slots[q]]
                tile, record, seen = _tile(values, padded, row, block), records[q], counts[row, first : first + LANES]
                _admit(chosen, seen, mask)
                p = same[q] if one_to_one else REJECTED
                while p >= 0:
                    _bar_taken(match[owners[p]], float(p), mask)
                    p = same[p]
                _innovate(work, tile, points, noises, b, given, camera)
                _gate_and_update(work, tile, record, chosen, seen, float(q), mask, gate)  # l. 33-37, 39
            log_clutter = log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))
            if _mask_of(chosen, -2.0, mask) > 0:  # l. 28-32
                if new_slots[b] == REJECTED:
                    _open_slot(b, new_slots, new_rows, row_of, map_of, values, counts, free_rows, free_slots, tops)
                _new_landmark(
                    work, _tile(values, padded, new_rows[b], block), points, noises, b, given, camera, mask,
                    counts[new_rows[b], first : first + LANES],
                )
                for i in range(LANES):
                    work[CLUTTER + i] += log_clutter if mask[i] > 0.0 else 0.0
            _write_found(
                found[b, first : first + LANES], distances[b, first : first + LANES], chosen, starts[b], starts[b + 1],
                slots, records, False, new_slots[b],
            )
        for i in range(LANES):
            log_likelihood[first + i] += _log_likelihood(work, i)
        for i in range(LANES):
            for c in range(3):
                means[c, first + i] = poses[c, first + i]
            for c in range(6):
                covariances[c, first + i] = 0.0
    name_new(new_slots, descriptors, names, named, ids, identities, stored, heads, tops)


@lanes
def _admit(chosen: FloatArray, seen: Int32Array, mask: FloatArray) -> None:
    """Write 1 where the measurement is still without a match and the particle holds the candidate."""
    for i in range(len(chosen)):
        mask[i] = 1.0 if chosen[i] == -2.0 and seen[i] > 0 else 0.0


@lanes
def _bar_taken(earlier: FloatArray, p: float, mask: FloatArray) -> None:
    for i in range(len(earlier)):
        mask[i] = 0.0 if earlier[i] == p else mask[i]


@lanes
def _find_young(seen: Int32Array, mask: FloatArray, young: FloatArray) -> int:
    """Write 1 where a matched landmark was seen a few times only; return how many those are."""
    count = 0
    for i in range(len(seen)):
        on = mask[i] > 0.0 and seen[i] <= YOUNG
        young[i] = 1.0 if on else 0.0
        count += 1 if on else 0
    return count


@lanes
def _relinearise(work: FloatArray, tile: FloatArray, before: FloatArray) -> None:
    """Refer the innovation, taken at the means in `tile`, to those in `before`, which come back (iterated EKF)."""
    for i in range(LANES):
        work[R0 + i] += tile[i] - before[i]
        work[R1 + i] += tile[LANES + i] - before[LANES + i]
        work[R2 + i] += tile[2 * LANES + i] - before[2 * LANES + i]
    for j in range(TILE):
        tile[j] = before[j]


@lanes
def _count_matches(seen: Int32Array, mask: FloatArray) -> None:
    for i in range(len(seen)):
        seen[i] += np.int32(1) if mask[i] > 0.0 else np.int32(0)


@lanes
def _write_found(
    found: Int32Array, distances: FloatArray, chosen: FloatArray, low: int, high: int, slots: IntArray,
    records: FloatArray, first_pass: bool, new_slot: int,
) -> None:
    """Write the slot (or -1) and the squared distance (or NaN) of one measurement, that of pass A if `first_pass`."""
    if low == high:
        for i in range(len(found)):
            found[i] = new_slot if chosen[i] == -2.0 else REJECTED
            distances[i] = np.nan
        return
    for q in range(low, high):
        record, slot, code, begin = records[q], slots[q], float(q), q == low
        for i in range(len(found)):
            on = chosen[i] == code
            distance = record[Q_FIRST_D + i] if first_pass else record[Q_D + i]
            found[i] = slot if on else ((new_slot if chosen[i] == -2.0 else REJECTED) if begin else found[i])
            distances[i] = distance if on else (np.nan if begin else distances[i])


@lanes
def _enter_pose(work: FloatArray, poses: FloatArray, first: int) -> None:
    for i in range(LANES):
        work[X + i] = poses[0, first + i]
        work[Y + i] = poses[1, first + i]
        work[T + i] = poses[2, first + i]
    for i in range(LANES):
        work[SIN + i], work[COS + i] = _sine_cosine(work[T + i])


@lanes
def _take_draws(draws: FloatArray, normals: FloatArray, first: int, real: int) -> None:
    """Write a block's rows of normal draws (M, 3) as (3 LANES,); surplus lanes keep theirs."""
    for i in range(real):
        for c in range(3):
            draws[c * LANES + i] = normals[first + i, c]


@lanes
def _sample_motion(
    work: FloatArray, poses: FloatArray, first: int, odometry: FloatArray, sigmas: FloatArray, draws: FloatArray
) -> None:
    """Replace poses by draws from p(x_t | x_{t-1}, u_t), each particle from its own past (Eq. 4)."""
    _enter_pose(work, poses, first)
    for i in range(LANES):
        dx = odometry[0] + draws[i] * sigmas[0]
        dy = odometry[1] + draws[LANES + i] * sigmas[1]
        c, s = work[COS + i], work[SIN + i]
        poses[0, first + i] = work[X + i] + (c * dx - s * dy)
        poses[1, first + i] = work[Y + i] + (s * dx + c * dy)
        poses[2, first + i] = _wrap(work[T + i] + odometry[2] + draws[2 * LANES + i] * sigmas[2])


@lanes
def move_blind(
    poses: FloatArray, means: FloatArray, covariances: FloatArray, blind: bool, odometry: FloatArray,
    sigmas: FloatArray, normals: FloatArray, work: FloatArray,
) -> None:
    """Move a robot that sees nothing: each particle's N(x^, P^) is propagated, and its sample moves by itself.

    Args:
        poses: (3, P) the samples; replaced.
        means, covariances: (3, P), (6, P) N(x^, P^), written; read if `blind`, else particles start from their samples.
        odometry, sigmas, normals: As in `update_fastslam1`.
        work: Working space.
    """
    num_particles = normals.shape[0]
    mean, covariance, draws = np.empty(3 * LANES), np.empty(6 * LANES), np.zeros(3 * LANES)
    for block in range(poses.shape[1] // LANES):
        first = block * LANES
        real = min(LANES, num_particles - first)
        _prior(poses, means, covariances, blind, first, mean, covariance)
        _predict(work, mean, covariance, odometry, sigmas)
        _to_map_axes(work)
        for i in range(LANES):
            means[0, first + i], means[1, first + i], means[2, first + i] = work[X0 + i], work[Y0 + i], work[T0 + i]
            covariances[0, first + i], covariances[1, first + i] = work[N00 + i], work[N01 + i]
            covariances[2, first + i], covariances[3, first + i] = work[N02 + i], work[N11 + i]
            covariances[4, first + i], covariances[5, first + i] = work[N12 + i], work[N22 + i]
        _take_draws(draws, normals, first, real)
        _sample_motion(work, poses, first, odometry, sigmas, draws)


@lanes
def _prior(
    poses: FloatArray, means: FloatArray, covariances: FloatArray, blind: bool, first: int, mean: FloatArray,
    covariance: FloatArray,
) -> None:
    """Fetch a block's poses before the motion: N(x^, P^) where the robot is blind, else the samples, exact."""
    for i in range(LANES):
        for c in range(3):
            mean[c * LANES + i] = means[c, first + i] if blind else poses[c, first + i]
        for c in range(6):
            covariance[c * LANES + i] = covariances[c, first + i] if blind else 0.0


@lanes
def update_fastslam2(
    poses: FloatArray, means: FloatArray, covariances: FloatArray, blind: bool,
    odometry: FloatArray, sigmas: FloatArray, normals: FloatArray,
    values: FloatArray, counts: Int32Array, odds: FloatArray, row_of: IntArray, map_of: IntArray, maps: Int32Array,
    users: IntArray, free_rows: IntArray, free_slots: IntArray, tops: IntArray, ids: IntArray, identities: IntArray,
    stored: Float32Array, heads: Float32Array,
    points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray, descriptors: Float32Array, names: IntArray,
    named: bool, descriptor_gate: float, descriptor_variance: float, position_gate: float, dead_zone: float,
    dead_radius: float, ambiguity: float,
    recovery: FloatArray, log_p0: float, one_to_one: bool,
    work: FloatArray, records: FloatArray,
    found: Int32Array, distances: FloatArray, new_slots: IntArray, log_likelihood: FloatArray,
) -> None:
    """Integrate one robot's motion and frame, the measurements shaping the sampled pose (FastSLAM 2.0, Laplace form).

    Association takes two passes: unambiguous candidates first refine the pose robustly, then all decisions are taken at
    the refined pose. A particle filter forgets how wrong its pose may be; where a wide prior explains three or more
    measurements, and most of all it can explain, that the stated uncertainty does not, this is not believed, and the
    wide prior takes its place. Written out, step by step, in `slam_backend.plain`.

    Args:
        poses: (3, P), the samples before the motion; replaced by the sampled ones.
        means, covariances: (3, P), (6, P), written: N(x^, P^) of each particle before sampling; read if `blind`.
        blind: Whether the robot has not been sampled at a sighting since N(x^, P^) was propagated.
        descriptor_variance: What squared distances between descriptors are divided by, to be weighed against D.
        dead_zone: Between `position_gate` and this D a measurement is neither matched nor new.
        dead_radius: Nor is it new this near to a landmark that looks like it [m].
        ambiguity: A runner-up within this cost makes a measurement ambiguous: it is held back.
        recovery: (3,) standard deviations of the pose [m, m, rad] where most matches contradict it; zeros: never.
        The others are as in `update_fastslam1`; rejected measurements are found at -1.
    """
    num_particles, padded = normals.shape[0], poses.shape[1]
    num = points.shape[0]
    starts, slots, looks, owners, same, unique = find_candidates(
        descriptors, stored, heads, ids, names, identities, named, descriptor_gate
    )
    for q in range(len(looks)):
        looks[q] /= descriptor_variance
    if len(odds) > 0:
        carry_odds(unique, odds, map_of, maps)
    refresh(unique, values, counts, row_of, map_of, maps, users, free_rows, tops)
    if len(slots) > len(records):
        records = np.empty((len(slots), CANDIDATE_ROWS * LANES))
    new_rows = np.empty(num, dtype=np.int64)
    log_clutter = np.empty(num)
    match = np.empty((num, LANES))
    mask, young, before = np.empty(LANES), np.empty(LANES), np.empty(TILE)
    reach, cap = (FARTHEST, position_gate) if named else (position_gate, FARTHEST)
    mean, covariance, draws, out = np.empty(3 * LANES), np.empty(6 * LANES), np.zeros(3 * LANES), np.empty(12 * LANES)
    for b in range(num):
        new_slots[b] = REJECTED
        log_clutter[b] = log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))
    for block in range(padded // LANES):
        first = block * LANES
        real = min(LANES, num_particles - first)
        _prior(poses, means, covariances, blind, first, mean, covariance)
        _take_draws(draws, normals, first, real)
        _predict(work, mean, covariance, odometry, sigmas)
        _begin_pose(work)
        _place(work)
        _clear_likelihood(work)

        # Pass A: refine the pose with what is beyond doubt.
        _match_first(
            work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
            starts, slots, looks, owners, same, named, position_gate, ambiguity, one_to_one,
        )
        if recovery[0] > 0.0 and _any_suspect(work) > 0:
            _widen_suspects(work, recovery)
            _begin_judging(work)
            for b in range(num):
                for q in range(starts[b], starts[b + 1]):
                    row = row_of[slots[q]]
                    tile = _tile(values, padded, row, block)
                    if starts[b + 1] - starts[b] > 1 or not (same[q] < 0 or not one_to_one):
                        _keep_distance(records[q])
                    _mark_held(records[q], counts[row, first : first + LANES])
                    _innovate(work, tile, points, noises, b, given, camera)
                    _evaluate(work, tile, records[q], False)
                    _nearest(work, records[q], q == starts[b])
                if starts[b] < starts[b + 1]:
                    _count_explained(work, position_gate)
            _acquit(work)
            _match_first(
                work, records, match, mask, values, counts, row_of, block, points, noises, given, camera,
                starts, slots, looks, owners, same, named, position_gate, ambiguity, one_to_one,
            )
        _step_pose(work, False)
        if _any_wide(work) > 0:  # a wide prior is a long way for one iteration
            for _ in range(3):
                _place(work)
                _clear_sums(work)
                for b in range(num):
                    for q in range(starts[b], starts[b + 1]):
                        if _mask_of(match[b], float(q), mask) > 0:
                            tile = _tile(values, padded, row_of[slots[q]], block)
                            _innovate(work, tile, points, noises, b, given, camera)
                            _evaluate(work, tile, records[q], True)
                            _robust_weights(records[q], match[b], float(q), position_gate, mask)
                            _sum_matches(work, records[q], mask)
                _step_pose(work, True)
        _place(work)

        # Pass B: decide at the refined pose.
        _clear_sums(work)
        for b in range(num):
            low, high = starts[b], starts[b + 1]
            if high - low == 1:
                row = row_of[slots[low]]
                tile = _tile(values, padded, row, block)
                p = same[low] if one_to_one else REJECTED
                _clear_taken(work)
                while p >= 0:
                    _mark_taken(work, match[owners[p]], float(p))
                    p = same[p]
                _innovate(work, tile, points, noises, b, given, camera)
                _decide_alone(
                    work, tile, counts[row, first : first + LANES], match[b], float(low), reach,
                    FARTHEST if named else dead_zone, dead_radius, log_clutter[b],
                )
            else:
                _begin_choice(work)
                for q in range(low, high):
                    _clear_taken(work)
                    p = same[q] if one_to_one else REJECTED
                    while p >= 0:
                        _mark_taken(work, match[owners[p]], float(p))
                        p = same[p]
                    tile = _tile(values, padded, row_of[slots[q]], block)
                    _innovate(work, tile, points, noises, b, given, camera)
                    _evaluate(work, tile, records[q], True)
                    _consider_again(
                        work, records[q], float(q), looks[q], cap, position_gate, dead_zone, dead_radius
                    )
                _decide(work, match[b], ambiguity, log_clutter[b])
                for q in range(low, high):
                    if _mask_of(match[b], float(q), mask) > 0:
                        _sum_matches(work, records[q], mask)
                        _add_likelihood(work, records[q], mask)
            for i in range(real, LANES):  # surplus lanes of the last block start no landmark
                match[b, i] = -1.0

        # The pose: N(x^, P^) from all matches; weigh by the predictive likelihood; sample once.
        _posterior(work, draws, log_likelihood[first : first + LANES], out)
        for i in range(LANES):
            for c in range(3):
                means[c, first + i] = out[c * LANES + i]
                poses[c, first + i] = out[(9 + c) * LANES + i]
            for c in range(6):
                covariances[c, first + i] = out[(3 + c) * LANES + i]

        # The landmarks, at the sampled pose.
        for b in range(num):
            for q in range(starts[b], starts[b + 1]):
                if _mask_of(match[b], float(q), mask) > 0:
                    row = row_of[slots[q]]
                    tile = _tile(values, padded, row, block)
                    seen = counts[row, first : first + LANES]
                    num_young = _find_young(seen, mask, young)
                    _count_matches(seen, mask)
                    _innovate(work, tile, points, noises, b, given, camera)
                    if num_young > 0:
                        before[:] = tile
                        _update(work, tile, young)
                        _innovate(work, tile, points, noises, b, given, camera)
                        _relinearise(work, tile, before)
                    _update(work, tile, mask)
            if _mask_of(match[b], -2.0, mask) > 0:
                if new_slots[b] == REJECTED:
                    _open_slot(b, new_slots, new_rows, row_of, map_of, values, counts, free_rows, free_slots, tops)
                _new_landmark(
                    work, _tile(values, padded, new_rows[b], block), points, noises, b, given, camera, mask,
                    counts[new_rows[b], first : first + LANES],
                )
            _write_found(
                found[b, first : first + LANES], distances[b, first : first + LANES], match[b], starts[b],
                starts[b + 1], slots, records, True, new_slots[b],
            )
    name_new(new_slots, descriptors, names, named, ids, identities, stored, heads, tops)


@lanes
def _match_first(
    work: FloatArray, records: FloatArray, match: FloatArray, mask: FloatArray, values: FloatArray, counts: Int32Array,
    row_of: IntArray, block: int, points: FloatArray, noises: FloatArray, given: bool, camera: FloatArray,
    starts: IntArray, slots: IntArray, looks: FloatArray, owners: IntArray, same: IntArray, named: bool,
    position_gate: float, ambiguity: float, one_to_one: bool,
) -> None:
    """Pass A for one block: match at the predicted pose what is beyond doubt, sum it, and count what is unexplained."""
    padded, first = counts.shape[1], block * LANES
    reach = FARTHEST if named else position_gate
    _clear_sums(work)
    _begin_judging(work)
    for b in range(len(starts) - 1):
        low, high = starts[b], starts[b + 1]
        if high - low == 1 and (same[low] < 0 or not one_to_one):
            row = row_of[slots[low]]
            tile = _tile(values, padded, row, block)
            _innovate(work, tile, points, noises, b, given, camera)
            _match_alone(
                work, tile, records[low], counts[row, first : first + LANES], match[b], float(low), reach, position_gate
            )
            continue
        _begin_choice(work)
        for q in range(low, high):
            row = row_of[slots[q]]
            tile = _tile(values, padded, row, block)
            _mark_held(records[q], counts[row, first : first + LANES])
            _innovate(work, tile, points, noises, b, given, camera)
            _evaluate(work, tile, records[q], False)
            _consider(work, records[q], float(q), looks[q], reach)
        _end_choice(work, match[b], ambiguity)
        for q in range(low, high):
            p = same[q] if one_to_one else REJECTED
            while p >= 0:
                _drop_taken(match[b], float(q), match[owners[p]], float(p))
                p = same[p]
            if _robust_weights(records[q], match[b], float(q), position_gate, mask) > 0:
                _sum_matches(work, records[q], mask)
            _keep_distance(records[q])
        for q in range(low, high):  # the choice is made: rows BEST and CHOSEN are free
            _nearest(work, records[q], q == low)
        if low < high:
            _count_unexplained(work, position_gate)


@lanes
def _keep_distance(record: FloatArray) -> None:
    """Keep the squared distance at the predicted pose: it is the NIS."""
    for i in range(LANES):
        record[Q_FIRST_D + i] = record[Q_D + i]


@lanes
def _any_wide(work: FloatArray) -> int:
    count = 0
    for i in range(LANES):
        count += 1 if work[WIDE + i] > 0.0 else 0
    return count


# -------------------------------------------------------------------------------------- weights and estimates


@jit
def weigh(
    log_likelihood: FloatArray, log_weights: FloatArray, path_log_weights: FloatArray, weights: FloatArray
) -> float:
    """Add a step's log-likelihood to the log-weights (M,) and normalise (Eqs. 3, 11, 12; Algorithm 1, l. 9).

    Args:
        log_likelihood: (P,), read up to M.
        log_weights, path_log_weights: (M,), updated.
        weights: (M,), written: they sum to 1.

    Returns:
        The effective sample size.
    """
    m = len(log_weights)
    largest = -np.inf
    for i in range(m):
        path_log_weights[i] += log_likelihood[i]
        log_weights[i] += log_likelihood[i]
        largest = max(largest, log_weights[i])
    total = 0.0
    for i in range(m):
        weights[i] = math.exp(log_weights[i] - largest)
        total += weights[i]
    log_total = math.log(total)
    squares = 0.0
    for i in range(m):
        log_weights[i] = log_weights[i] - largest - log_total  # one after the other: the largest may be huge
        weights[i] /= total
        squares += weights[i] * weights[i]
    return 1.0 / squares


@lanes
def mixture(
    means: FloatArray, covariances: FloatArray, weights: FloatArray, mean: FloatArray, covariance: FloatArray
) -> None:
    """Write mean (3,) and covariance (3, 3) of a weighted mixture of Gaussian poses.

    Args:
        means: (3, P), headings averaged on the circle.
        covariances: (6, P), upper triangles.
        weights: (M,), summing to 1.
    """
    m = len(weights)
    sums = np.zeros((4, LANES))
    w = np.empty(LANES)
    for first in range(0, m, LANES):
        real = min(LANES, m - first)
        for i in range(LANES):
            w[i] = weights[first + i] if i < real else 0.0
        for i in range(LANES):
            sine, cosine = _sine_cosine(means[2, first + i])
            sums[0, i] += w[i] * means[0, first + i]
            sums[1, i] += w[i] * means[1, first + i]
            sums[2, i] += w[i] * sine
            sums[3, i] += w[i] * cosine
    mean[0], mean[1] = sums[0].sum(), sums[1].sum()
    mean[2] = _wrap(math.atan2(sums[2].sum(), sums[3].sum()))
    spread = np.zeros((6, LANES))
    for first in range(0, m, LANES):
        real = min(LANES, m - first)
        for i in range(LANES):
            w[i] = weights[first + i] if i < real else 0.0
        for i in range(LANES):
            x, y = means[0, first + i] - mean[0], means[1, first + i] - mean[1]
            t = _wrap(means[2, first + i] - mean[2])
            spread[0, i] += w[i] * (x * x + covariances[0, first + i])
            spread[1, i] += w[i] * (x * y + covariances[1, first + i])
            spread[2, i] += w[i] * (x * t + covariances[2, first + i])
            spread[3, i] += w[i] * (y * y + covariances[3, first + i])
            spread[4, i] += w[i] * (y * t + covariances[4, first + i])
            spread[5, i] += w[i] * (t * t + covariances[5, first + i])
    covariance[0, 0] = spread[0].sum()
    covariance[0, 1] = covariance[1, 0] = spread[1].sum()
    covariance[0, 2] = covariance[2, 0] = spread[2].sum()
    covariance[1, 1] = spread[3].sum()
    covariance[1, 2] = covariance[2, 1] = spread[4].sum()
    covariance[2, 2] = spread[5].sum()


@jit
def name_new(
    new_slots: IntArray, measured: Float32Array, names: IntArray, named: bool, ids: IntArray,
    identities: IntArray, stored: Float32Array, heads: Float32Array, tops: IntArray,
) -> None:
    """Give the landmarks that a frame has started their lasting names `tops[2]`, ..., in the order of measurements.

    Args:
        new_slots: (B,) slot of the landmark that each measurement started, -1 = none.
        measured: (B, d) descriptors; a landmark takes that of its first measurement.
        names: (B,) the caller's names, if `named`.
        ids, identities, stored, heads, tops: The store, see `ParticleMaps`.
    """
    for b in range(len(new_slots)):
        slot = new_slots[b]
        if slot < 0:
            continue
        ids[slot] = tops[2]
        tops[2] += 1
        identities[slot] = names[b] if named else -1
        for j in range(measured.shape[1]):
            stored[slot, j] = measured[b, j]
        for k in range(heads.shape[0]):
            heads[k, slot] = measured[b, k * (measured.shape[1] // heads.shape[0])]


@jit
def summarise(
    found: Int32Array, distances: FloatArray, new_slots: IntArray, keep: IntArray, best: int, ids: IntArray,
    associations: IntArray, created: IntArray,
) -> tuple[int, int, float, int]:
    """Tell what became of one robot's measurements.

    Args:
        found: (n, P) slots to which the particles gave the used measurements, -1 = rejected.
        distances: (n, P) squared distances of matches.
        new_slots: (n,) slots of the landmarks that were started, -1 = none.
        keep: (n,) which of the caller's measurements were used.
        best: The most probable particle.
        ids: (slots,) stable names.
        associations: Written: the id to which the most probable particle gave each measurement, -1 = rejected.
        created: Written: the id of the landmark that each measurement created in any particle, -1 = none.

    Returns:
        How many the most probable particle started and matched, and the sum and number of its squared distances,
        without what it predicted behind the camera.
    """
    associations[:] = REJECTED
    created[:] = REJECTED
    num_new, num_matched, squares, judged = 0, 0, 0.0, 0
    for b in range(len(keep)):
        slot = found[b, best]
        if new_slots[b] >= 0:
            created[keep[b]] = ids[new_slots[b]]
        if slot < 0:
            continue
        associations[keep[b]] = ids[slot]
        if slot == new_slots[b]:
            num_new += 1
        else:
            num_matched += 1
            if distances[b, best] < np.inf:
                squares += distances[b, best]
                judged += 1
    return num_new, num_matched, squares, judged


# ------------------------------------------------------------------------------------------- lazy resampling


@jit
def settle(ancestors: IntArray, count: int) -> tuple[IntArray, IntArray]:
    """Arrange resampled particles so that most stay in place.

    A particle with at least one copy keeps its place; surplus copies fill the places of the dead, in ascending order.

    Args:
        ancestors: (count,) index of each new particle's parent, ascending.
        count: M.

    Returns:
        The places that change and, for each, the particle that is copied into it.
    """
    copies = np.zeros(count, dtype=np.int64)
    for i in range(count):
        copies[ancestors[i]] += 1
    targets = np.empty(count, dtype=np.int64)
    sources = np.empty(count, dtype=np.int64)
    moves, place = 0, 0
    for parent in range(count):
        for _ in range(copies[parent] - 1):
            while copies[place] > 0:
                place += 1
            targets[moves] = place
            sources[moves] = parent
            moves += 1
            place += 1
    return targets[:moves], sources[:moves]


@jit
def resample(
    ancestors: IntArray, poses: FloatArray, starts: FloatArray, means: FloatArray, covariances: FloatArray,
    path_log_weights: FloatArray, maps: Int32Array, users: IntArray, map_of: IntArray, ids: IntArray,
    row_of: IntArray, counts: Int32Array, heads: Float32Array, free_rows: IntArray, free_slots: IntArray,
    tops: IntArray,
) -> int:
    """Let particles become copies of their ancestors, their landmarks lazily, and free what no survivor holds.

    Landmarks that were up to date get one new ancestor map; the others' maps are composed with it.

    Args:
        ancestors: (M,) index of each new particle's parent, ascending; they are settled first.
        poses, starts, means, covariances: (K, c, P); columns are copied.
        path_log_weights: (M,), likewise.
        maps and the following: The store, see `ParticleMaps`. At least one map is free.

    Returns:
        How many maps are still free.
    """
    count = len(ancestors)
    places = settle(ancestors, count)
    targets, sources = places[0].astype(np.uint32), places[1].astype(np.uint32)  # unsigned: none counts from the end
    moves = len(targets)
    for i in range(moves):
        path_log_weights[targets[i]] = path_log_weights[sources[i]]
    for robot in range(poses.shape[0]):
        for c in range(3):
            for i in range(moves):
                target, source = targets[i], sources[i]
                poses[robot, c, target] = poses[robot, c, source]
                starts[robot, c, target] = starts[robot, c, source]
                means[robot, c, target] = means[robot, c, source]
        for c in range(6):
            for i in range(moves):
                covariances[robot, c, targets[i]] = covariances[robot, c, sources[i]]
    fresh, free = 0, 0
    for e in range(1, len(users)):
        if users[e] > 0:
            own = maps[e]
            for i in range(moves):
                own[targets[i]] = own[sources[i]]
        else:
            fresh = e
            free += 1
    used = False
    for slot in range(len(ids)):
        if ids[slot] < 0:
            continue
        if moves > 0 and map_of[slot] == 0:
            if not used:
                used = True
                free -= 1
                own = maps[fresh]
                for m in range(len(own)):
                    own[m] = m
                for i in range(moves):
                    own[targets[i]] = sources[i]
            map_of[slot] = fresh
            users[fresh] += 1
        e = map_of[slot]
        row = row_of[slot]
        alive = False
        for m in range(count):
            if counts[row, maps[e, m] if e > 0 else m] > 0:
                alive = True
                break
        if not alive:
            if e > 0:
                users[e] -= 1
                map_of[slot] = 0
            ids[slot] = -1
            for k in range(heads.shape[0]):
                heads[k, slot] = FAR
            free_rows[tops[0]] = row
            free_slots[tops[1]] = slot
            tops[0] += 1
            tops[1] += 1
    return free
