"""Compiled inner loops of the smoother: sightings condensed, normal equations, landmarks and odometry of many paths.

A *sighting* says what was measured of one landmark from one key pose, as a quadratic form of c = R(theta)^T (l - p),
the landmark in the frame of the key:  E(c) = 1/2 (c - c0)^T L (c - c0) - g^T (c - c0) + const.  It needs no inverse,
and sightings of one landmark from frames that stand rigidly to each other add up. Symmetric 3 x 3 matrices are stored
as their upper triangles by rows (6).
"""

import math

import numpy as np

from slam_backend._jit import inlined, jit, lanes
from slam_backend.errors import BoolArray, FloatArray, IntArray

MIN_DEPTH = 0.05  # [m]; a landmark predicted nearer than this to the camera plane is linearised where it was measured
LANES = 64
FREE = -1  # column of a pose that is given, not sought
# Information [1/m^2] of a landmark about where it stands now, 1 km along each axis: where all its sightings have lost
# their weight nothing else holds it. It takes part in every step, and moves nothing that has come to rest.
WEAK = 1e-6

# Rows of a block of poses and of the workspace of `replay`.
PX, PY, COS, SIN, HEADING = (LANES * k for k in range(5))
POSE_ROWS = 5
A00, A01, A02, A11, A12, A22, B0, B1, B2, ENERGY = (LANES * k for k in range(10))
WORK_ROWS = 10


@jit
def _wrapped(angle: float) -> float:
    """Return an angle [rad] in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@inlined
def _spun(c: float, s: float, a: FloatArray, out: FloatArray) -> None:
    """Write R A R^T (6) for the rotation (c, s) about the vertical."""
    a00, a01, a02, a11, a12, a22 = a[0], a[1], a[2], a[3], a[4], a[5]
    out[0] = c * c * a00 - 2.0 * c * s * a01 + s * s * a11
    out[1] = c * s * (a00 - a11) + (c * c - s * s) * a01
    out[2] = c * a02 - s * a12
    out[3] = s * s * a00 + 2.0 * c * s * a01 + c * c * a11
    out[4] = s * a02 + c * a12
    out[5] = a22


@jit
def _inverse(a: FloatArray, out: FloatArray) -> float:
    """Write the inverse of a symmetric matrix (6); return its determinant."""
    p = a[3] * a[5] - a[4] * a[4]
    q = a[2] * a[4] - a[1] * a[5]
    r = a[1] * a[4] - a[2] * a[3]
    det: float = a[0] * p + a[1] * q + a[2] * r
    if det <= 0.0:
        return det
    out[0], out[1], out[2] = p / det, q / det, r / det
    out[3] = (a[0] * a[5] - a[2] * a[2]) / det
    out[4] = (a[1] * a[2] - a[0] * a[4]) / det
    out[5] = (a[0] * a[3] - a[1] * a[1]) / det
    return det


@jit
def invert(matrices: FloatArray, out: FloatArray) -> bool:
    """Write the inverses of symmetric matrices (n, 3, 3) to `out`, likewise; return whether all are positive definite.

    Where one is not, those after it are not written.
    """
    upper, inverse = np.empty(6), np.empty(6)
    for n in range(len(matrices)):
        a = matrices[n]
        upper[0], upper[1], upper[2], upper[3], upper[4], upper[5] = (
            a[0, 0], a[0, 1], a[0, 2], a[1, 1], a[1, 2], a[2, 2],
        )  # fmt: skip
        minor = upper[0] * upper[3] - upper[1] * upper[1]
        if not (upper[0] > 0.0 and minor > 0.0 and _inverse(upper, inverse) > 0.0):
            return False
        b = out[n]
        b[0, 0], b[1, 1], b[2, 2] = inverse[0], inverse[3], inverse[5]
        b[0, 1], b[0, 2], b[1, 2] = inverse[1], inverse[2], inverse[4]
        b[1, 0], b[2, 0], b[2, 1] = inverse[1], inverse[2], inverse[4]
    return True


@jit
def linearise(
    point: FloatArray, noise: FloatArray, given: bool, camera: FloatArray, e: FloatArray, y: FloatArray,
    info: FloatArray,
) -> None:  # fmt: skip
    """Write the measured point `y` (3), robot axes, from the camera centre, and its information (6), at `e` (3).

    Stereo: an error of (u, v, disparity) at the predicted point e is, in metres, that of y = e + k (v - e),
    k = e_x / v_x, under the information J^T diag(1/su^2, 1/su^2, 1/sd^2) J with J = d(u, v, d)/de.

    Args:
        point: (3,) as measured [m], robot axes, from the camera centre.
        noise: (6,) its covariance [m^2], if the sensor gave it.
        given: Whether it did.
        camera: (focal, baseline, sigma_px, sigma_disparity, mount (3)).
        e: (3,) as predicted [m], likewise.
        y, info: Results.
    """
    if given:
        _inverse(noise, info)
        y[:] = point
        return
    ahead = e[0] >= MIN_DEPTH
    x0, x1, x2 = (e[0], e[1], e[2]) if ahead else (point[0], point[1], point[2])
    k = x0 / point[0] if ahead else 1.0
    for i in range(3):
        y[i] = e[i] + k * (point[i] - e[i]) if ahead else point[i]
    pixel = (camera[0] / (camera[2] * x0)) ** 2
    disparity = (camera[0] * camera[1] / (camera[3] * x0 * x0)) ** 2
    across, up = x1 / x0, x2 / x0
    info[0] = pixel * (across * across + up * up) + disparity
    info[1], info[2] = -pixel * across, -pixel * up
    info[3], info[4], info[5] = pixel, 0.0, pixel


@jit
def condense(
    points: FloatArray, noises: FloatArray, given: BoolArray, frames: IntArray, sightings: IntArray,
    frame_keys: IntArray, frame_offsets: FloatArray, poses: FloatArray, landmarks: FloatArray,
    keys: IntArray, named: IntArray, frozen: BoolArray, camera: FloatArray, scale: float, kernel: float,
    centres: FloatArray, infos: FloatArray, slopes: FloatArray, squares: FloatArray,
) -> float:  # fmt: skip
    """Write centre, information and slope of all sightings that are not frozen, from their measurements.

    Args:
        points, noises, given, frames, sightings: (n,) measurements: (n, 3) robot axes from the camera centre; their
            covariances (n, 6), if given; the frame and the sighting to which each belongs.
        frame_keys, frame_offsets: (f,) key of each frame, (f, 3) its pose in that of the key.
        poses, landmarks: (k, 3), (l, 3) where to linearise, map frame.
        keys, named, frozen: (s,) of the sightings: key, landmark, whether to leave it alone.
        camera: (focal, baseline, sigma_px, sigma_disparity, mount (3)).
        scale: Of all measurement covariances.
        kernel: Squared distance above which Geman and McClure's kernel, scaled to leave the rest alone, sets in; 0:
            none.
        centres, infos, slopes: (s, 3), (s, 6), (s, 3), results.
        squares: (n,), result: squared Mahalanobis distances of the measurements.

    Returns:
        Half the sum of the (robust) squared distances.
    """
    e, y, d = np.empty(3), np.empty(3), np.empty(3)
    info, turned = np.empty(6), np.empty(6)
    for s in range(len(keys)):
        if frozen[s]:
            continue
        pose, landmark = poses[keys[s]], landmarks[named[s]]
        c, sn = math.cos(pose[2]), math.sin(pose[2])
        dx, dy = landmark[0] - pose[0], landmark[1] - pose[1]
        centres[s, 0], centres[s, 1], centres[s, 2] = c * dx + sn * dy, -sn * dx + c * dy, landmark[2]
        infos[s] = 0.0
        slopes[s] = 0.0
    total = 0.0
    for n in range(len(sightings)):
        s = sightings[n]
        if frozen[s]:
            continue
        offset = frame_offsets[frames[n]]
        c, sn = math.cos(offset[2]), math.sin(offset[2])
        dx, dy = centres[s, 0] - offset[0], centres[s, 1] - offset[1]
        e[0] = c * dx + sn * dy - camera[4]
        e[1] = -sn * dx + c * dy - camera[5]
        e[2] = centres[s, 2] - camera[6]
        linearise(points[n], noises[n], given[n], camera, e, y, info)
        for i in range(3):
            d[i] = y[i] - e[i]
        v0 = (info[0] * d[0] + info[1] * d[1] + info[2] * d[2]) / scale
        v1 = (info[1] * d[0] + info[3] * d[1] + info[4] * d[2]) / scale
        v2 = (info[2] * d[0] + info[4] * d[1] + info[5] * d[2]) / scale
        square = d[0] * v0 + d[1] * v1 + d[2] * v2
        squares[n] = square
        weight, loss = 1.0, square
        if 0.0 < kernel < square:
            weight = (2.0 * kernel / (kernel + square)) ** 2
            loss = kernel * (3.0 * square - kernel) / (kernel + square)
        total += 0.5 * loss
        _spun(c, sn, info, turned)
        for i in range(6):
            infos[s, i] += weight / scale * turned[i]
        slopes[s, 0] += weight * (c * v0 - sn * v1)
        slopes[s, 1] += weight * (sn * v0 + c * v1)
        slopes[s, 2] += weight * v2
    return total


@jit
def assemble(
    poses: FloatArray, landmarks: FloatArray, columns: IntArray, previous: IntArray, motions: FloatArray,
    link_infos: FloatArray, keys: IntArray, starts: IntArray, centres: FloatArray, infos: FloatArray,
    slopes: FloatArray, matrix: FloatArray, vector: FloatArray, cross: FloatArray, spreads: FloatArray,
    forces: FloatArray,
) -> float:  # fmt: skip
    """Write the normal equations of the key poses, landmarks eliminated: lower triangle of `matrix`, and `vector`.

    Args:
        poses, landmarks: (k, 3), (l, 3) where to linearise.
        columns: (k,) first row of each pose in `matrix`, `FREE` if it is given.
        previous: (k,) key that odometry comes from, -1 for none. motions, link_infos: (k, 3), (k, 3, 3) that odometry,
            in the frame of the previous key, and its information.
        keys, starts: (s,) key of each sighting; those of landmark i are starts[i] to starts[i + 1].
        centres, infos, slopes: Of the sightings.
        matrix, vector: (n, n), (n,), zeros; results. `vector` is the slope of the cost.
        cross: (s, 3, 3), result: second derivatives by pose and landmark.
        spreads, forces: (l, 6), (l, 3), results: inverse of the landmarks' own block, and their slopes.

    Returns:
        Half the sum of squares of odometry, and of frozen sightings' forms up to a constant; infinite if a landmark is
        at no finite place.
    """
    cost = 0.0
    cosines, sines = np.cos(poses[:, 2]), np.sin(poses[:, 2])
    f, g, h = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    r = np.empty(3)
    for b in range(len(poses)):  # odometry
        a = previous[b]
        if a < 0:
            continue
        c, s = cosines[a], sines[a]
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        mx, my = c * dx + s * dy, -s * dx + c * dy
        r[0], r[1] = mx - motions[b, 0], my - motions[b, 1]
        r[2] = _wrapped(poses[b, 2] - poses[a, 2] - motions[b, 2])
        g[:] = 0.0
        g[0, 0], g[0, 1], g[1, 0], g[1, 1], g[2, 2] = c, s, -s, c, 1.0
        f[:] = -g
        f[0, 2], f[1, 2] = my, -mx
        w = link_infos[b]
        for side in range(2):
            own = columns[b] if side else columns[a]
            if own < 0:
                continue
            left = g if side else f
            for i in range(3):
                for j in range(3):
                    h[i, j] = left[0, i] * w[0, j] + left[1, i] * w[1, j] + left[2, i] * w[2, j]
            for i in range(3):
                vector[own + i] += h[i, 0] * r[0] + h[i, 1] * r[1] + h[i, 2] * r[2]
                for j in range(i + 1):
                    matrix[own + i, own + j] += h[i, 0] * left[0, j] + h[i, 1] * left[1, j] + h[i, 2] * left[2, j]
            if side and columns[a] >= 0:
                other = columns[a]
                for i in range(3):
                    for j in range(3):
                        value = h[i, 0] * f[0, j] + h[i, 1] * f[1, j] + h[i, 2] * f[2, j]
                        if own > other:
                            matrix[own + i, other + j] += value
                        else:
                            matrix[other + j, own + i] += value
        for i in range(3):
            for j in range(3):
                cost += 0.5 * r[i] * w[i, j] * r[j]
    turned = np.empty(6)
    block = np.empty(6)
    most = 0
    for landmark in range(len(landmarks)):
        most = max(most, starts[landmark + 1] - starts[landmark])
    sought, column_of = np.empty(most, dtype=np.int64), np.empty(most, dtype=np.int64)
    for landmark in range(len(landmarks)):
        first, last = starts[landmark], starts[landmark + 1]
        block[:] = 0.0
        block[0] = block[3] = block[5] = WEAK
        force = forces[landmark]
        force[:] = 0.0
        for q in range(first, last):
            key = keys[q]
            c, s = cosines[key], sines[key]
            dx, dy = landmarks[landmark, 0] - poses[key, 0], landmarks[landmark, 1] - poses[key, 1]
            u0 = c * dx + s * dy - centres[q, 0]
            u1 = -s * dx + c * dy - centres[q, 1]
            u2 = landmarks[landmark, 2] - centres[q, 2]
            n = infos[q]
            l0 = n[0] * u0 + n[1] * u1 + n[2] * u2
            l1 = n[1] * u0 + n[3] * u1 + n[4] * u2
            l2 = n[2] * u0 + n[4] * u1 + n[5] * u2
            cost += u0 * (0.5 * l0 - slopes[q, 0]) + u1 * (0.5 * l1 - slopes[q, 1]) + u2 * (0.5 * l2 - slopes[q, 2])
            e0, e1, e2 = l0 - slopes[q, 0], l1 - slopes[q, 1], l2 - slopes[q, 2]
            m0, m1 = c * e0 - s * e1, s * e0 + c * e1
            force[0] += m0
            force[1] += m1
            force[2] += e2
            _spun(c, s, n, turned)
            for i in range(6):
                block[i] += turned[i]
            own = columns[key]
            if own < 0:
                continue
            x = cross[q]  # A^T L with A = [[-1, 0, dy], [0, -1, -dx], [0, 0, 0]]
            x[0, 0], x[0, 1], x[0, 2] = -turned[0], -turned[1], -turned[2]
            x[1, 0], x[1, 1], x[1, 2] = -turned[1], -turned[3], -turned[4]
            x[2, 0] = dy * turned[0] - dx * turned[1]
            x[2, 1] = dy * turned[1] - dx * turned[3]
            x[2, 2] = dy * turned[2] - dx * turned[4]
            vector[own] -= m0
            vector[own + 1] -= m1
            vector[own + 2] += dy * m0 - dx * m1
            matrix[own, own] -= x[0, 0]
            matrix[own + 1, own] -= x[1, 0]
            matrix[own + 1, own + 1] -= x[1, 1]
            matrix[own + 2, own] -= x[2, 0]
            matrix[own + 2, own + 1] -= x[2, 1]
            matrix[own + 2, own + 2] += dy * x[2, 0] - dx * x[2, 1]
        if first == last:
            spreads[landmark] = 0.0
            continue
        p = spreads[landmark]
        if not _inverse(block, p) > 0.0:
            return np.inf
        num = 0
        for q in range(first, last):
            own = columns[keys[q]]
            if own >= 0:
                sought[num], column_of[num] = q, own
                num += 1
        for n in range(num):  # keys ascend, and columns with them
            x, own = cross[sought[n]], column_of[n]
            for i in range(3):
                h[i, 0] = x[i, 0] * p[0] + x[i, 1] * p[1] + x[i, 2] * p[2]
                h[i, 1] = x[i, 0] * p[1] + x[i, 1] * p[3] + x[i, 2] * p[4]
                h[i, 2] = x[i, 0] * p[2] + x[i, 1] * p[4] + x[i, 2] * p[5]
                vector[own + i] -= h[i, 0] * force[0] + h[i, 1] * force[1] + h[i, 2] * force[2]
            h00, h01, h02 = h[0, 0], h[0, 1], h[0, 2]
            h10, h11, h12 = h[1, 0], h[1, 1], h[1, 2]
            h20, h21, h22 = h[2, 0], h[2, 1], h[2, 2]
            for o in range(num):
                at = column_of[o]
                if at > own:
                    break
                z = cross[sought[o]]
                for j in range(3):
                    z0, z1, z2 = z[j, 0], z[j, 1], z[j, 2]
                    matrix[own, at + j] -= h00 * z0 + h01 * z1 + h02 * z2
                    matrix[own + 1, at + j] -= h10 * z0 + h11 * z1 + h12 * z2
                    matrix[own + 2, at + j] -= h20 * z0 + h21 * z1 + h22 * z2
    return cost


@jit
def move_landmarks(
    landmarks: FloatArray, columns: IntArray, keys: IntArray, starts: IntArray, cross: FloatArray, spreads: FloatArray,
    forces: FloatArray, change: FloatArray,
) -> None:  # fmt: skip
    """Add to the landmarks, in place, what a change of the poses asks of them.

    Args:
        landmarks: (l, 3) [m], map frame; changed.
        columns, keys, starts, cross, spreads, forces: As of `assemble`, which formed the equations.
        change: (n,) of the poses sought [m, m, rad], by columns.
    """
    for landmark in range(len(landmarks)):
        r0, r1, r2 = forces[landmark, 0], forces[landmark, 1], forces[landmark, 2]
        for q in range(starts[landmark], starts[landmark + 1]):
            own = columns[keys[q]]
            if own >= 0:
                x = cross[q]
                for i in range(3):
                    r0 += x[i, 0] * change[own + i]
                    r1 += x[i, 1] * change[own + i]
                    r2 += x[i, 2] * change[own + i]
        p = spreads[landmark]
        landmarks[landmark, 0] -= p[0] * r0 + p[1] * r1 + p[2] * r2
        landmarks[landmark, 1] -= p[1] * r0 + p[3] * r1 + p[4] * r2
        landmarks[landmark, 2] -= p[2] * r0 + p[4] * r1 + p[5] * r2


@lanes
def replay(
    poses: FloatArray, num_keys: int, num_blocks: int, landmarks: FloatArray, keys: IntArray, starts: IntArray,
    centres: FloatArray, infos: FloatArray, slopes: FloatArray, work: FloatArray, tiles: FloatArray,
    log_likelihood: FloatArray,
) -> None:  # fmt: skip
    """Give each path the landmarks that its sightings ask for, and the log-likelihood of these, up to a constant.

    Args:
        poses: (num_blocks * num_keys * 5 * LANES,) x, y, cos, sin, heading of each block and key.
        num_keys, num_blocks: k, and the number of blocks of lanes.
        landmarks: (l, 3) about which forms are evaluated, map frame.
        keys, starts, centres, infos, slopes: Sightings, those of landmark i are starts[i] to starts[i + 1].
        work: (WORK_ROWS * LANES,) room.
        tiles: (l * num_blocks * 9 * LANES,), result: mean (3) and covariance (6) per lane. Landmarks without sightings
            are left alone.
        log_likelihood: (num_blocks * LANES,), result.
    """
    log_likelihood[:] = 0.0
    for landmark in range(len(landmarks)):
        first, last = starts[landmark], starts[landmark + 1]
        if first == last:
            continue
        x, y, z = landmarks[landmark, 0], landmarks[landmark, 1], landmarks[landmark, 2]
        for block in range(num_blocks):
            for i in range(WORK_ROWS * LANES):
                work[i] = 0.0
            for i in range(LANES):
                work[A00 + i] = work[A11 + i] = work[A22 + i] = WEAK
            for q in range(first, last):
                base = (block * num_keys + keys[q]) * POSE_ROWS * LANES
                pose = poses[base : base + POSE_ROWS * LANES]
                o0, o1, o2 = centres[q, 0], centres[q, 1], centres[q, 2]
                n0, n1, n2, n3, n4, n5 = infos[q, 0], infos[q, 1], infos[q, 2], infos[q, 3], infos[q, 4], infos[q, 5]
                g0, g1, g2 = slopes[q, 0], slopes[q, 1], slopes[q, 2]
                for i in range(LANES):
                    c, s = pose[COS + i], pose[SIN + i]
                    dx, dy = x - pose[PX + i], y - pose[PY + i]
                    u0, u1, u2 = c * dx + s * dy - o0, c * dy - s * dx - o1, z - o2
                    l0 = n0 * u0 + n1 * u1 + n2 * u2
                    l1 = n1 * u0 + n3 * u1 + n4 * u2
                    l2 = n2 * u0 + n4 * u1 + n5 * u2
                    work[ENERGY + i] += u0 * (0.5 * l0 - g0) + u1 * (0.5 * l1 - g1) + u2 * (0.5 * l2 - g2)
                    e0, e1 = l0 - g0, l1 - g1
                    work[B0 + i] += c * e0 - s * e1
                    work[B1 + i] += s * e0 + c * e1
                    work[B2 + i] += l2 - g2
                    work[A00 + i] += c * c * n0 - 2.0 * c * s * n1 + s * s * n3
                    work[A01 + i] += c * s * (n0 - n3) + (c * c - s * s) * n1
                    work[A02 + i] += c * n2 - s * n4
                    work[A11 + i] += s * s * n0 + 2.0 * c * s * n1 + c * c * n3
                    work[A12 + i] += s * n2 + c * n4
                    work[A22 + i] += n5
            base = (landmark * num_blocks + block) * 9 * LANES
            tile = tiles[base : base + 9 * LANES]
            out = log_likelihood[block * LANES : (block + 1) * LANES]
            for i in range(LANES):
                a, b, d = work[A00 + i], work[A01 + i], work[A02 + i]
                e, f, h = work[A11 + i], work[A12 + i], work[A22 + i]
                p, q1, r = e * h - f * f, d * f - b * h, b * f - d * e
                det = a * p + b * q1 + d * r
                inverse = 1.0 / det
                s00, s01, s02 = p * inverse, q1 * inverse, r * inverse
                s11, s12, s22 = (a * h - d * d) * inverse, (b * d - a * f) * inverse, (a * e - b * b) * inverse
                b0, b1, b2 = work[B0 + i], work[B1 + i], work[B2 + i]
                m0 = s00 * b0 + s01 * b1 + s02 * b2
                m1 = s01 * b0 + s11 * b1 + s12 * b2
                m2 = s02 * b0 + s12 * b1 + s22 * b2
                tile[i] = x - m0
                tile[LANES + i] = y - m1
                tile[2 * LANES + i] = z - m2
                tile[3 * LANES + i], tile[4 * LANES + i], tile[5 * LANES + i] = s00, s01, s02
                tile[6 * LANES + i], tile[7 * LANES + i], tile[8 * LANES + i] = s11, s12, s22
                work[ENERGY + i] = 0.5 * (b0 * m0 + b1 * m1 + b2 * m2) - work[ENERGY + i]
                work[A00 + i] = det
            for i in range(LANES):
                out[i] += work[ENERGY + i] - 0.5 * math.log(work[A00 + i])


@lanes
def odometry_of_paths(
    poses: FloatArray, num_keys: int, num_blocks: int, num_paths: int, previous: IntArray, mode: FloatArray,
    motions: FloatArray, infos: FloatArray, lever: float, log_density: FloatArray, spreads: FloatArray,
) -> None:  # fmt: skip
    """Weigh paths by odometry, and say how rigid they are from each key to the next.

    Args:
        poses, num_keys, num_blocks: As in `replay`.
        num_paths: M; the lanes after these are copies.
        previous, motions, infos: (k,), (k, 3), (k, 3, 3) odometry from the previous key and its information.
        mode: (k, 3) motion from the previous key in the most probable path.
        lever: [m] At which an error of the heading counts.
        log_density: (num_blocks * LANES,), result: log p(path given odometry) up to a constant.
        spreads: (k,), result [m^2]: mean square of what the motion from the previous key differs from that of the mode.
    """
    log_density[:] = 0.0
    for b in range(num_keys):
        a = previous[b]
        spreads[b] = 0.0
        if a < 0:
            continue
        u0, u1, u2 = motions[b, 0], motions[b, 1], motions[b, 2]
        d0, d1, d2 = mode[b, 0] - u0, mode[b, 1] - u1, mode[b, 2] - u2
        w = infos[b]
        w00, w01, w02, w11, w12, w22 = w[0, 0], w[0, 1], w[0, 2], w[1, 1], w[1, 2], w[2, 2]
        total = 0.0
        for block in range(num_blocks):
            base_a, base_b = (block * num_keys + a) * POSE_ROWS * LANES, (block * num_keys + b) * POSE_ROWS * LANES
            first = poses[base_a : base_a + POSE_ROWS * LANES]
            second = poses[base_b : base_b + POSE_ROWS * LANES]
            out = log_density[block * LANES : (block + 1) * LANES]
            for i in range(LANES):
                c, s = first[COS + i], first[SIN + i]
                dx, dy = second[PX + i] - first[PX + i], second[PY + i] - first[PY + i]
                r0, r1 = c * dx + s * dy - u0, c * dy - s * dx - u1
                r2 = second[HEADING + i] - first[HEADING + i] - u2
                r2 = r2 - 2.0 * math.pi * math.floor((r2 + math.pi) / (2.0 * math.pi))
                out[i] -= 0.5 * (w00 * r0 * r0 + w11 * r1 * r1 + w22 * r2 * r2) + (
                    w01 * r0 * r1 + w02 * r0 * r2 + w12 * r1 * r2
                )
            for i in range(min(LANES, num_paths - block * LANES)):
                c, s = first[COS + i], first[SIN + i]
                dx, dy = second[PX + i] - first[PX + i], second[PY + i] - first[PY + i]
                r0, r1 = c * dx + s * dy - u0 - d0, c * dy - s * dx - u1 - d1
                r2 = second[HEADING + i] - first[HEADING + i] - u2 - d2
                r2 = r2 - 2.0 * math.pi * math.floor((r2 + math.pi) / (2.0 * math.pi))
                total += r0 * r0 + r1 * r1 + lever * lever * r2 * r2
        spreads[b] = total / num_paths
