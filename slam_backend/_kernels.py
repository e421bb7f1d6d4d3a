"""The compiled inner loops of the filter: one robot's frame, for all particles.

Landmarks lie in `landmarks[slot, c, particle]` with c = (x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz) in the map frame; a
slot is one landmark, `present` tells which particles hold it. Everything is expressed in the map frame, where the
derivative of a measured point with respect to the landmark is the identity (the robot only yaws).

The measurement model (Eqs. 5-7). A landmark mu lies at e = mu - p from the camera centre p. A point v measured in the
camera, turned into map axes, gives the innovation r = k (R v - e) with k = Z_predicted / Z_measured. This is the EKF in
(u, v, disparity): the innovation and its covariance are those of the image coordinates, mapped to metres at the
predicted point, and the density of the image coordinates is that of r times Z_predicted^4 (times a constant of the
camera). Where the caller gives covariances, k = 1 and there is no such factor.
"""

import math

import numpy as np
from numpy.typing import NDArray

from slam_backend._jit import inlined, jit
from slam_backend.errors import BoolArray, FloatArray, IntArray

REJECTED = -1
MIN_DEPTH = 0.05  # [m]; nothing is predicted nearer to the camera plane than this
MIN_CONTRADICTIONS = 3  # three points fix a pose with one to spare
LOG_2PI = math.log(2.0 * math.pi)


@inlined
def _innovation(
    x: float, y: float, c: float, s: float, lx: float, ly: float, lz: float,
    points: FloatArray, noises: FloatArray, n: int, given: bool, camera: FloatArray,
) -> tuple[float, float, float, float, float, float, float, float, float, float]:
    """Return r (3), its sensor covariance R in map axes (6, upper triangle by rows), and the predicted depth.

    The robot is at (x, y) with heading (c, s) = (cos theta, sin theta).
    `points[n]` is the measured point relative to the camera centre in robot axes (x ahead = depth); `noises[n]` its
    covariance (6) in robot axes, used if `given`; `camera` = (focal, baseline, sigma_px, sigma_disparity, mount (3)).

    Rows are passed as array and index throughout, because a slice costs more than the arithmetic.
    """
    ex = lx - x - (c * camera[4] - s * camera[5])
    ey = ly - y - (s * camera[4] + c * camera[5])
    ez = lz - camera[6]
    depth = c * ex + s * ey
    mx = c * points[n, 0] - s * points[n, 1]
    my = s * points[n, 0] + c * points[n, 1]
    if given:
        a = noises[n, 0]
        b = noises[n, 1]
        d = noises[n, 3]
        return (
            mx - ex, my - ey, points[n, 2] - ez,
            c * c * a - 2.0 * c * s * b + s * s * d,
            c * s * (a - d) + (c * c - s * s) * b,
            c * noises[n, 2] - s * noises[n, 4],
            s * s * a + 2.0 * c * s * b + c * c * d,
            s * noises[n, 2] + c * noises[n, 4],
            noises[n, 5],
            depth,
        )
    k = depth / points[n, 0]
    pixel = (camera[2] * depth / camera[0]) ** 2
    disparity = (camera[3] * depth / (camera[0] * camera[1])) ** 2
    return (
        k * (mx - ex), k * (my - ey), k * (points[n, 2] - ez),
        pixel * s * s + disparity * ex * ex,
        -pixel * c * s + disparity * ex * ey,
        disparity * ex * ez,
        pixel * c * c + disparity * ey * ey,
        disparity * ey * ez,
        pixel + disparity * ez * ez,
        depth,
    )


@inlined
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


@inlined
def _form(
    i: tuple[float, float, float, float, float, float, float], x: float, y: float, z: float
) -> float:
    """Return the quadratic form of (x, y, z) under a packed inverse."""
    return (
        i[0] * x * x + i[3] * y * y + i[5] * z * z
        + 2.0 * (i[1] * x * y + i[2] * x * z + i[4] * y * z)
    )


@inlined
def _whitened(
    lx: float, ly: float, x: float, y: float, factor: FloatArray
) -> tuple[float, float, float, float, float, float]:
    """Return the two non-zero rows of H C: how r moves with the whitened pose error xi, pose = x0 + C xi."""
    hx = -(ly - y)
    hy = lx - x
    return (
        factor[0, 0] + hx * factor[2, 0], factor[0, 1] + hx * factor[2, 1], factor[0, 2] + hx * factor[2, 2],
        factor[1, 0] + hy * factor[2, 0], factor[1, 1] + hy * factor[2, 1], factor[1, 2] + hy * factor[2, 2],
    )


@jit
def _gate(
    pose: FloatArray, local: FloatArray, q: int, points: FloatArray, noises: FloatArray, n: int, given: bool,
    camera: FloatArray, factor: FloatArray, spread: FloatArray,
) -> tuple[float, float, float]:
    """Return the squared Mahalanobis distance D and log|S|, pose uncertainty C L^-1 C^T included, and |r| [m].

    `local[q]` is the landmark (9), `factor` is C (3, 3), `spread` is L^-1 (3, 3). D is infinite where the landmark is
    predicted behind the camera. Unless `given`, S is that of the image coordinates (up to a constant of the camera):
    landmarks at different depths are compared in the space in which the measurement was made.
    """
    rx, ry, rz, s0, s1, s2, s3, s4, s5, depth = _innovation(
        pose[0], pose[1], pose[3], pose[4], local[q, 0], local[q, 1], local[q, 2], points, noises, n, given, camera
    )
    if not given and depth < MIN_DEPTH:
        return np.inf, 0.0, np.inf
    a0, a1, a2, b0, b1, b2 = _whitened(local[q, 0], local[q, 1], pose[0], pose[1], factor)
    u0 = spread[0, 0] * a0 + spread[0, 1] * a1 + spread[0, 2] * a2
    u1 = spread[1, 0] * a0 + spread[1, 1] * a1 + spread[1, 2] * a2
    u2 = spread[2, 0] * a0 + spread[2, 1] * a1 + spread[2, 2] * a2
    w0 = spread[0, 0] * b0 + spread[0, 1] * b1 + spread[0, 2] * b2
    w1 = spread[1, 0] * b0 + spread[1, 1] * b1 + spread[1, 2] * b2
    w2 = spread[2, 0] * b0 + spread[2, 1] * b1 + spread[2, 2] * b2
    inverse = _invert(
        local[q, 3] + s0 + a0 * u0 + a1 * u1 + a2 * u2,
        local[q, 4] + s1 + a0 * w0 + a1 * w1 + a2 * w2,
        local[q, 5] + s2,
        local[q, 6] + s3 + b0 * w0 + b1 * w1 + b2 * w2,
        local[q, 7] + s4,
        local[q, 8] + s5,
    )  # Eq. 7, plus what the pose adds
    log_det = math.log(inverse[6] if given else inverse[6] / depth**8)
    return _form(inverse, rx, ry, rz), log_det, math.sqrt(rx * rx + ry * ry + rz * rz)


@inlined
def _accumulate(
    pose: FloatArray, local: FloatArray, q: int, points: FloatArray, noises: FloatArray, n: int, given: bool,
    camera: FloatArray, factor: FloatArray, robust: float, information: FloatArray, gradient: FloatArray,
) -> float:
    """Add one match to the Gauss-Newton system of xi, and return its log-likelihood given the pose.

    `robust` > 0 down-weights the match by 1 / (1 + D / robust) (Cauchy); 0 does not.
    """
    rx, ry, rz, s0, s1, s2, s3, s4, s5, depth = _innovation(
        pose[0], pose[1], pose[3], pose[4], local[q, 0], local[q, 1], local[q, 2], points, noises, n, given, camera
    )
    if not given and depth < MIN_DEPTH:
        return 0.0
    i = _invert(
        local[q, 3] + s0, local[q, 4] + s1, local[q, 5] + s2, local[q, 6] + s3, local[q, 7] + s4, local[q, 8] + s5
    )  # Eq. 7
    distance = _form(i, rx, ry, rz)
    weight = 1.0 / (1.0 + distance / robust) if robust > 0.0 else 1.0
    a0, a1, a2, b0, b1, b2 = _whitened(local[q, 0], local[q, 1], pose[0], pose[1], factor)
    gx = weight * (i[0] * rx + i[1] * ry + i[2] * rz)
    gy = weight * (i[1] * rx + i[3] * ry + i[4] * rz)
    gradient[0] += a0 * gx + b0 * gy
    gradient[1] += a1 * gx + b1 * gy
    gradient[2] += a2 * gx + b2 * gy
    xx, xy, yy = weight * i[0], weight * i[1], weight * i[3]
    u0, u1, u2 = xx * a0 + xy * b0, xx * a1 + xy * b1, xx * a2 + xy * b2
    v0, v1, v2 = xy * a0 + yy * b0, xy * a1 + yy * b1, xy * a2 + yy * b2
    information[0] += a0 * u0 + b0 * v0
    information[1] += a0 * u1 + b0 * v1
    information[2] += a0 * u2 + b0 * v2
    information[3] += a1 * u1 + b1 * v1
    information[4] += a1 * u2 + b1 * v2
    information[5] += a2 * u2 + b2 * v2
    log_scale = 0.0 if given else 4.0 * math.log(depth)
    return -0.5 * (distance + 3.0 * LOG_2PI + math.log(i[6])) + log_scale  # Eq. 11, in logarithms


@inlined
def _place(start: FloatArray, factor: FloatArray, xi: FloatArray, pose: FloatArray) -> None:
    """Write pose = start + C xi as (x, y, theta, cos theta, sin theta)."""
    for j in range(3):
        pose[j] = start[j] + factor[j, 0] * xi[0] + factor[j, 1] * xi[1] + factor[j, 2] * xi[2]
    pose[3] = math.cos(pose[2])
    pose[4] = math.sin(pose[2])


@jit
def _refine(
    start: FloatArray, factor: FloatArray, matches: IntArray, local: FloatArray, points: FloatArray, noises: FloatArray,
    given: bool, camera: FloatArray, robust: float, xi: FloatArray, pose: FloatArray, spread: FloatArray,
    information: FloatArray, gradient: FloatArray,
) -> float:
    """Gauss-Newton, twice from the given xi, on |xi|^2 + sum r^T S^-1 r; leave xi, pose, spread = L^-1 at the mode.

    `information` (6) and `gradient` (3) are working space.

    Returns:
        log p(measurements, xi at the mode) - log p(xi | measurements) there: the predictive log-likelihood of the frame
        by Laplace's formula, -1/2 |xi|^2 - 1/2 log|L| + sum log N(r; 0, S).
    """
    log_likelihood = 0.0
    for iteration in range(3):
        _place(start, factor, xi, pose)
        log_likelihood = 0.0
        information[:] = 0.0
        information[0] = information[3] = information[5] = 1.0
        for j in range(3):
            gradient[j] = xi[j]
        for n in range(len(matches)):
            if matches[n] >= 0:
                log_likelihood += _accumulate(
                    pose, local, matches[n], points, noises, n, given, camera, factor, robust, information, gradient
                )
        i = _invert(
            information[0], information[1], information[2], information[3], information[4], information[5]
        )
        if iteration < 2:
            xi[0] -= i[0] * gradient[0] + i[1] * gradient[1] + i[2] * gradient[2]
            xi[1] -= i[1] * gradient[0] + i[3] * gradient[1] + i[4] * gradient[2]
            xi[2] -= i[2] * gradient[0] + i[4] * gradient[1] + i[5] * gradient[2]
        else:
            spread[0, 0], spread[0, 1], spread[0, 2] = i[0], i[1], i[2]
            spread[1, 0], spread[1, 1], spread[1, 2] = i[1], i[3], i[4]
            spread[2, 0], spread[2, 1], spread[2, 2] = i[2], i[4], i[5]
            log_likelihood -= 0.5 * (xi[0] ** 2 + xi[1] ** 2 + xi[2] ** 2 + math.log(i[6]))
    return log_likelihood


@jit
def _update_landmark(
    pose: FloatArray, local: FloatArray, q: int, points: FloatArray, noises: FloatArray, n: int, given: bool,
    camera: FloatArray, iterations: int,
) -> None:
    """Update the landmark `local[q]` in place by the (iterated) EKF at a known pose (Eqs. 5-10, G = 1)."""
    px, py, pz = local[q, 0], local[q, 1], local[q, 2]
    p0, p1, p2, p3, p4, p5 = local[q, 3], local[q, 4], local[q, 5], local[q, 6], local[q, 7], local[q, 8]
    x, y, z = px, py, pz
    for iteration in range(iterations):
        rx, ry, rz, s0, s1, s2, s3, s4, s5, depth = _innovation(
            pose[0], pose[1], pose[3], pose[4], x, y, z, points, noises, n, given, camera
        )  # Eq. 5
        if not given and depth < MIN_DEPTH:
            return
        i = _invert(p0 + s0, p1 + s1, p2 + s2, p3 + s3, p4 + s4, p5 + s5)  # Eq. 7
        k00 = p0 * i[0] + p1 * i[1] + p2 * i[2]  # Eq. 8
        k01 = p0 * i[1] + p1 * i[3] + p2 * i[4]
        k02 = p0 * i[2] + p1 * i[4] + p2 * i[5]
        k10 = p1 * i[0] + p3 * i[1] + p4 * i[2]
        k11 = p1 * i[1] + p3 * i[3] + p4 * i[4]
        k12 = p1 * i[2] + p3 * i[4] + p4 * i[5]
        k20 = p2 * i[0] + p4 * i[1] + p5 * i[2]
        k21 = p2 * i[1] + p4 * i[3] + p5 * i[4]
        k22 = p2 * i[2] + p4 * i[4] + p5 * i[5]
        rx += x - px
        ry += y - py
        rz += z - pz
        x = px + k00 * rx + k01 * ry + k02 * rz  # Eq. 9
        y = py + k10 * rx + k11 * ry + k12 * rz
        z = pz + k20 * rx + k21 * ry + k22 * rz
        if iteration == iterations - 1:
            local[q, 0], local[q, 1], local[q, 2] = x, y, z
            # Eq. 10 in Joseph's form, J P J^T + K R K^T with J = I - K: symmetric and positive whatever the rounding.
            j00, j01, j02 = 1.0 - k00, -k01, -k02
            j10, j11, j12 = -k10, 1.0 - k11, -k12
            j20, j21, j22 = -k20, -k21, 1.0 - k22
            a0, a1, a2 = j00 * p0 + j01 * p1 + j02 * p2, j00 * p1 + j01 * p3 + j02 * p4, j00 * p2 + j01 * p4 + j02 * p5
            b0, b1, b2 = j10 * p0 + j11 * p1 + j12 * p2, j10 * p1 + j11 * p3 + j12 * p4, j10 * p2 + j11 * p4 + j12 * p5
            c0, c1, c2 = j20 * p0 + j21 * p1 + j22 * p2, j20 * p1 + j21 * p3 + j22 * p4, j20 * p2 + j21 * p4 + j22 * p5
            d0, d1, d2 = k00 * s0 + k01 * s1 + k02 * s2, k00 * s1 + k01 * s3 + k02 * s4, k00 * s2 + k01 * s4 + k02 * s5
            e0, e1, e2 = k10 * s0 + k11 * s1 + k12 * s2, k10 * s1 + k11 * s3 + k12 * s4, k10 * s2 + k11 * s4 + k12 * s5
            f0, f1, f2 = k20 * s0 + k21 * s1 + k22 * s2, k20 * s1 + k21 * s3 + k22 * s4, k20 * s2 + k21 * s4 + k22 * s5
            local[q, 3] = a0 * j00 + a1 * j01 + a2 * j02 + d0 * k00 + d1 * k01 + d2 * k02
            local[q, 4] = a0 * j10 + a1 * j11 + a2 * j12 + d0 * k10 + d1 * k11 + d2 * k12
            local[q, 5] = a0 * j20 + a1 * j21 + a2 * j22 + d0 * k20 + d1 * k21 + d2 * k22
            local[q, 6] = b0 * j10 + b1 * j11 + b2 * j12 + e0 * k10 + e1 * k11 + e2 * k12
            local[q, 7] = b0 * j20 + b1 * j21 + b2 * j22 + e0 * k20 + e1 * k21 + e2 * k22
            local[q, 8] = c0 * j20 + c1 * j21 + c2 * j22 + f0 * k20 + f1 * k21 + f2 * k22


@jit
def _new_landmark(
    pose: FloatArray, local: FloatArray, q: int, points: FloatArray, noises: FloatArray, n: int, given: bool,
    camera: FloatArray,
) -> None:
    """Write mean and covariance of a landmark first seen from a known pose (Algorithm 1, l. 30-31 corrected)."""
    c = pose[3]
    s = pose[4]
    local[q, 0] = pose[0] + c * (camera[4] + points[n, 0]) - s * (camera[5] + points[n, 1])
    local[q, 1] = pose[1] + s * (camera[4] + points[n, 0]) + c * (camera[5] + points[n, 1])
    local[q, 2] = camera[6] + points[n, 2]
    _, _, _, local[q, 3], local[q, 4], local[q, 5], local[q, 6], local[q, 7], local[q, 8], _ = _innovation(
        pose[0], pose[1], c, s, local[q, 0], local[q, 1], local[q, 2], points, noises, n, given, camera
    )  # l. 31 *: G^-1 R G^-T


@inlined
def _load(landmarks: FloatArray, slot: int, m: int, local: FloatArray, q: int) -> None:
    for c in range(9):
        local[q, c] = landmarks[slot, c, m]


@inlined
def _store(landmarks: FloatArray, slot: int, m: int, local: FloatArray, q: int) -> None:
    for c in range(9):
        landmarks[slot, c, m] = local[q, c]


@jit
def sort_candidates(
    rows: IntArray, slots: IntArray, measured: NDArray[np.float32], stored: NDArray[np.float32], gate: float,
    num_measurements: int,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Turn (measurement, slot) pairs into lists per measurement, nearest descriptor first.

    Args:
        rows: (p,) int64. Measurement of each pair, ascending.
        slots: (p,) int64. Landmark slot of each pair, ascending within a measurement.
        measured: (B, d) descriptors of the frame.
        stored: (slots, d) descriptors of the landmarks.
        gate: Largest admitted squared distance E0.
        num_measurements: B.

    Returns:
        starts (B + 1,), slots (q,) and squared distances E (q,); equal distances keep the order of the slots.
    """
    starts = np.zeros(num_measurements + 1, dtype=np.int64)
    out_slots = np.empty(len(rows), dtype=np.int64)
    out_e = np.empty(len(rows), dtype=np.float64)
    q = 0
    p = 0
    for b in range(num_measurements):
        starts[b] = q
        while p < len(rows) and rows[p] == b:
            e = 0.0
            for j in range(measured.shape[1]):
                difference = float(measured[b, j]) - float(stored[slots[p], j])
                e += difference * difference
            if e <= gate:
                at = q
                while at > starts[b] and out_e[at - 1] > e:
                    out_e[at] = out_e[at - 1]
                    out_slots[at] = out_slots[at - 1]
                    at -= 1
                out_e[at] = e
                out_slots[at] = slots[p]
                q += 1
            p += 1
    starts[num_measurements] = q
    return starts, out_slots[:q], out_e[:q]


@jit
def update_fastslam1(
    poses: FloatArray, landmarks: FloatArray, present: BoolArray, counts: IntArray, points: FloatArray,
    noises: FloatArray, given: bool, camera: FloatArray, starts: IntArray, slots: IntArray, known: BoolArray,
    new_slots: IntArray, position_gate: float, log_p0: float, one_to_one: bool,
    associations: IntArray, distances: FloatArray, log_weights: FloatArray,
) -> None:
    """Integrate one robot's frame as in Algorithm 1 (corrected), at poses that are already sampled.

    Args:
        poses: (M, 3), sampled from the motion model. Read only.
        landmarks: (slots, 9, M). Updated in place, as are `present` (slots, M) and `counts` (slots, M).
        points: (B, 3) measured points relative to the camera centre, robot axes.
        noises: (B, 6) their covariances in robot axes if `given`.
        given: Whether the covariances come with the measurements.
        camera: (7,) focal, baseline, sigma_px, sigma_disparity, mount.
        starts, slots: Candidates per measurement, nearest descriptor first.
        known: (B,) whether the candidate is the landmark by the caller's word, gates aside.
        new_slots: (B,) a free slot for each measurement.
        position_gate: D0.
        log_p0: Log-density of a measurement that starts a new landmark.
        one_to_one: Whether a landmark is matched at most once in a frame.
        associations: (B, M), written: the slot, new ones included.
        distances: (B, M), written: D of matches, NaN otherwise.
        log_weights: (M,), the frame's log-likelihood is added.
    """
    num_particles = poses.shape[0]
    num = points.shape[0]
    local = np.empty((1, 9))
    zero = np.zeros((3, 3))
    information = np.zeros(6)
    gradient = np.zeros(3)
    pose = np.empty(5)
    for m in range(num_particles):
        pose[:3] = poses[m]
        pose[3] = math.cos(pose[2])
        pose[4] = math.sin(pose[2])
        for b in range(num):
            match = REJECTED
            for q in range(starts[b], starts[b + 1]):
                slot = slots[q]
                if not present[slot, m]:
                    continue
                if one_to_one:
                    taken = False
                    for earlier in range(b):
                        if associations[earlier, m] == slot:
                            taken = True
                    if taken:
                        continue
                _load(landmarks, slot, m, local, 0)
                distance, _, _ = _gate(pose, local, 0, points, noises, b, given, camera, zero, zero)
                if distance <= position_gate or (known[b] and distance < np.inf):
                    match = slot  # l. 23-24: the nearest descriptor inside the gate
                    distances[b, m] = distance
                    break
            if match == REJECTED:
                slot = new_slots[b]
                _new_landmark(pose, local, 0, points, noises, b, given, camera)
                log_weights[m] += log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))  # l. 32
                present[slot, m] = True
                counts[slot, m] = 1
                distances[b, m] = np.nan
            else:
                slot = match
                log_weights[m] += _accumulate(
                    pose, local, 0, points, noises, b, given, camera, zero, 0.0, information, gradient
                )  # l. 39, before the update
                _update_landmark(pose, local, 0, points, noises, b, given, camera, 1)
                counts[slot, m] += 1
            _store(landmarks, slot, m, local, 0)
            associations[b, m] = slot


@jit
def _is_lost(
    start: FloatArray, local: FloatArray, held: BoolArray, points: FloatArray, noises: FloatArray, given: bool,
    camera: FloatArray, factor: FloatArray, identity: FloatArray, starts: IntArray, costs: FloatArray,
    position_gate: float, ambiguity: float,
) -> bool:
    """Tell whether at least three, and most, of the measurements with one look-alike contradict the predicted pose."""
    sure = 0
    contradict = 0
    for b in range(points.shape[0]):
        first, second = REJECTED, REJECTED
        for q in range(starts[b], starts[b + 1]):
            if held[q] and first == REJECTED:
                first = q
            elif held[q] and second == REJECTED:
                second = q
        if first == REJECTED or (second != REJECTED and costs[second] - costs[first] < ambiguity):
            continue
        distance, _, _ = _gate(start, local, first, points, noises, b, given, camera, factor, identity)
        sure += 1
        if distance > position_gate:
            contradict += 1
    return contradict >= MIN_CONTRADICTIONS and 2 * contradict > sure


@jit
def update_fastslam2(
    poses: FloatArray, odometry: FloatArray, sigmas: FloatArray, normals: FloatArray,
    landmarks: FloatArray, present: BoolArray, counts: IntArray, points: FloatArray, noises: FloatArray, given: bool,
    camera: FloatArray, starts: IntArray, slots: IntArray, costs: FloatArray, known: BoolArray, new_slots: IntArray,
    position_gate: float, dead_zone: float, dead_radius: float, ambiguity: float, recovery: FloatArray, log_p0: float,
    associations: IntArray, distances: FloatArray, log_weights: FloatArray,
    pose_means: FloatArray, pose_covariances: FloatArray,
) -> None:
    """Integrate one robot's motion and frame, the measurements shaping the sampled pose (FastSLAM 2.0, Laplace form).

    The pose is x0 + C xi, x0 = x_{t-1} composed with u, C C^T the covariance of the motion, xi ~ N(0, I): nothing is
    inverted, so a motion without noise needs no special case. Association takes two passes: unambiguous candidates
    first refine the pose robustly, then all decisions are taken at the refined pose. A particle filter forgets how
    wrong its pose may be; where most of the measurements with one look-alike in the map contradict the predicted pose,
    its stated uncertainty is not believed, and a wide one takes its place.

    Args:
        poses: (M, 3), poses before the motion; replaced by the sampled ones.
        odometry: (3,) u, previous robot frame.
        sigmas: (3,) standard deviations of u.
        normals: (M, 3) standard normal draws.
        costs: (q,) what each candidate's descriptor adds to its cost.
        dead_zone: Between `position_gate` and this D a measurement is neither matched nor new.
        dead_radius: Nor is it new this near to a landmark that looks like it [m].
        ambiguity: A runner-up within this cost makes a measurement ambiguous: it is held back.
        recovery: (3,) standard deviations of the pose [m, m, rad] where most matches contradict it; zeros: never.
        pose_means, pose_covariances: (M, 3), (M, 3, 3), written: N(x^, P^) of each particle before sampling.
        landmarks, present, counts, points, noises, given, camera, starts, slots, known, new_slots, position_gate,
        log_p0, associations, distances, log_weights: As in `update_fastslam1`; rejected measurements get -1.
    """
    num_particles = poses.shape[0]
    num = points.shape[0]
    total = len(slots)
    local = np.empty((total + 1, 9))  # the particle's own candidates, and room for a new landmark
    held = np.empty(total, dtype=np.bool_)
    tentative = np.empty(num, dtype=np.int64)
    matches = np.empty(num, dtype=np.int64)
    factor = np.zeros((3, 3))
    identity = np.eye(3)
    spread = np.empty((3, 3))
    start = np.empty(5)
    pose = np.empty(5)
    xi = np.empty(3)
    half = np.empty((3, 3))
    information = np.empty(6)
    gradient = np.empty(3)
    for m in range(num_particles):
        c = math.cos(poses[m, 2])
        s = math.sin(poses[m, 2])
        start[0] = poses[m, 0] + c * odometry[0] - s * odometry[1]
        start[1] = poses[m, 1] + s * odometry[0] + c * odometry[1]
        start[2] = poses[m, 2] + odometry[2]
        start[3] = math.cos(start[2])
        start[4] = math.sin(start[2])
        factor[:] = 0.0
        factor[0, 0], factor[0, 1] = c * sigmas[0], -s * sigmas[1]
        factor[1, 0], factor[1, 1] = s * sigmas[0], c * sigmas[1]
        factor[2, 2] = sigmas[2]
        for q in range(total):
            held[q] = present[slots[q], m]
            if held[q]:
                _load(landmarks, slots[q], m, local, q)

        lost = recovery[0] > 0.0 and _is_lost(
            start, local, held, points, noises, given, camera, factor, identity, starts, costs, position_gate, ambiguity
        )
        if lost:
            factor[:] = 0.0
            factor[0, 0], factor[1, 1], factor[2, 2] = recovery[0], recovery[1], recovery[2]

        # Pass A: refine the pose with what is beyond doubt.
        for b in range(num):
            best, runner_up, chosen = np.inf, np.inf, REJECTED
            for q in range(starts[b], starts[b + 1]):
                if not held[q]:
                    continue
                distance, log_det, _ = _gate(start, local, q, points, noises, b, given, camera, factor, identity)
                if distance <= position_gate or (known[b] and distance < np.inf):
                    cost = distance + log_det + costs[q]
                    if cost < best:
                        best, runner_up, chosen = cost, best, q
                    elif cost < runner_up:
                        runner_up = cost
            tentative[b] = chosen if runner_up - best >= ambiguity or runner_up == np.inf else REJECTED
            if tentative[b] >= 0:
                for earlier in range(b):
                    if tentative[earlier] >= 0 and slots[tentative[earlier]] == slots[chosen]:
                        tentative[b] = REJECTED
        xi[:] = 0.0
        for _ in range(2 if lost else 1):  # a wide prior is a long way for two iterations
            _refine(
                start, factor, tentative, local, points, noises, given, camera, position_gate, xi, pose, spread,
                information, gradient,
            )

        # Pass B: decide at the refined pose.
        clutter = 0.0
        for b in range(num):
            best, runner_up, dead, chosen, log_best = np.inf, np.inf, False, REJECTED, 0.0
            for q in range(starts[b], starts[b + 1]):
                if not held[q]:
                    continue
                distance, log_det, metres = _gate(pose, local, q, points, noises, b, given, camera, factor, spread)
                if known[b] and distance < np.inf:
                    distance = min(distance, position_gate)
                dead = dead or distance <= dead_zone or metres <= dead_radius
                if distance > position_gate:
                    continue
                taken = False
                for earlier in range(b):
                    if matches[earlier] >= 0 and slots[matches[earlier]] == slots[q]:
                        taken = True
                if taken:
                    continue
                cost = distance + log_det + costs[q]
                if cost < best:
                    best, runner_up, chosen = cost, best, q
                    log_best = -0.5 * (distance + log_det + 3.0 * LOG_2PI)
                elif cost < runner_up:
                    runner_up = cost
            matches[b] = REJECTED
            log_clutter = log_p0 + (0.0 if given else 4.0 * math.log(points[b, 0]))
            if chosen >= 0:
                if runner_up - best < ambiguity:
                    associations[b, m] = REJECTED  # held back; its likelihood is that of the better candidate
                    clutter += log_best
                else:
                    matches[b] = chosen
                    associations[b, m] = slots[chosen]
            elif dead:
                associations[b, m] = REJECTED
                clutter += log_clutter
            else:
                associations[b, m] = new_slots[b]
                clutter += log_clutter
            distances[b, m] = np.nan
            if matches[b] >= 0:
                distances[b, m] = _gate(
                    start, local, matches[b], points, noises, b, given, camera, factor, identity
                )[0]

        # The pose: N(x^, P^) from all matches; weigh by the predictive likelihood; sample once.
        log_weights[m] += clutter + _refine(
            start, factor, matches, local, points, noises, given, camera, 0.0, xi, pose, spread, information, gradient
        )
        for i in range(3):
            pose_means[m, i] = pose[i]
            for j in range(3):
                half[i, j] = factor[i, 0] * spread[0, j] + factor[i, 1] * spread[1, j] + factor[i, 2] * spread[2, j]
        for i in range(3):
            for j in range(3):
                pose_covariances[m, i, j] = (
                    half[i, 0] * factor[j, 0] + half[i, 1] * factor[j, 1] + half[i, 2] * factor[j, 2]
                )
        # Lower Cholesky factor of L^-1, in place of a library call on 3 x 3.
        l00 = math.sqrt(spread[0, 0])
        l10 = spread[1, 0] / l00
        l20 = spread[2, 0] / l00
        l11 = math.sqrt(spread[1, 1] - l10 * l10)
        l21 = (spread[2, 1] - l20 * l10) / l11
        l22 = math.sqrt(spread[2, 2] - l20 * l20 - l21 * l21)
        xi[0] += l00 * normals[m, 0]
        xi[1] += l10 * normals[m, 0] + l11 * normals[m, 1]
        xi[2] += l20 * normals[m, 0] + l21 * normals[m, 1] + l22 * normals[m, 2]
        _place(start, factor, xi, pose)
        poses[m, 0], poses[m, 1] = pose[0], pose[1]
        poses[m, 2] = (pose[2] + math.pi) % (2.0 * math.pi) - math.pi

        # The landmarks, at the sampled pose.
        for b in range(num):
            slot = associations[b, m]
            if matches[b] >= 0:
                _update_landmark(pose, local, matches[b], points, noises, b, given, camera, 2)
                counts[slot, m] += 1
                _store(landmarks, slot, m, local, matches[b])
            elif slot >= 0:
                _new_landmark(pose, local, total, points, noises, b, given, camera)
                present[slot, m] = True
                counts[slot, m] = 1
                _store(landmarks, slot, m, local, total)
