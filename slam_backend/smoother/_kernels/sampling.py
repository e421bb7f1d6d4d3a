"""Samples of whole paths: Gaussian densities, draws from the factor, and many paths at a time in blocks of lanes."""

import math

import numpy as np

from slam_backend.core.jit import in_place, jit_fma, simd, stack_array
from slam_backend.core.simd_math import log_of, sine_cosine
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother._kernels.factors import _inverse
from slam_backend.smoother._kernels.normal_equations import WEAK
from slam_backend.smoother._kernels.records import (
    LEVER,
    NONE,
    CholeskyFactor,
    EquationBlocks,
    Keys,
    LandmarkFactors,
    SymbolicFactor,
)


@jit_fma
def weigh_deviations(covariance: FloatArray, off: FloatArray, log_densities: FloatArray) -> bool:
    """Write the logarithms of a Gaussian's density, up to a constant: 0 at its mean.

    Of L L^T the covariance, the squares of L^-1 d add up to the squared distance of a deviation d.

    Args:
        covariance: (n, n), positive definite.
        off: (n, M) deviations from the mean; changed: L^-1 times these.
        log_densities: (M,), result.

    Returns:
        Whether the covariance is positive definite; if not, what is written means nothing.
    """
    lower, m = covariance.copy(), off.shape[1]
    log_densities[:] = 0.0
    for i in range(len(lower)):
        row = lower[i]
        for j in range(i):
            for k in range(j):
                row[j] -= row[k] * lower[j, k]
            row[j] /= lower[j, j]
            row[i] -= row[j] * row[j]
            for p in range(m):
                off[i, p] -= row[j] * off[j, p]
        if not row[i] > 0.0:
            return False
        row[i] = math.sqrt(row[i])
        scale = 1.0 / row[i]
        for p in range(m):
            off[i, p] *= scale
            log_densities[p] -= 0.5 * off[i, p] * off[i, p]
    return True


@in_place
def normalise(log_weights: FloatArray, weights: FloatArray) -> float:
    """Write weights (M,) that sum to 1 from their logarithms (M,); return their effective sample size, 1 / sum w^2.

    Where one is NaN, or infinitely large, all are NaN, as is the size.
    """
    top, total, squares = -math.inf, 0.0, 0.0
    for log_weight in log_weights:
        top = max(top, log_weight)
    for i in range(len(weights)):
        weights[i] = math.exp(log_weights[i] - top)
        total += weights[i]
    for i in range(len(weights)):
        weights[i] /= total
        squares += weights[i] * weights[i]
    return 1.0 / squares


@jit_fma
def draw(
    draws: FloatArray, poses: FloatArray, columns: IntArray, seen: LandmarkFactors, equations: EquationBlocks,
    factor: CholeskyFactor, pattern: SymbolicFactor,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Return M paths without the landmarks that come with them, and the logarithms of their densities.

    Of L L^T the information of all nodes, x = mode + L^-T z. A landmark that goes before all poses that see it is not
    drawn, for no pose depends on it. Of the others' density what they have given the path is taken off: with S the
    information of a landmark, X that between it and the poses, and d the deviations, S d_l + X^T d_x is what it
    deviates from its conditional mean, times S.

    Args:
        draws: (D, 3, M) standard normal draws: of the nodes that are drawn, in the order of elimination. Changed: by
            how much these deviate from the mode.
        poses: (k, 3) of the mode.
        columns: (k,) first column of each pose, `FREE` where it is given.
        seen, equations, factor, pattern: Sightings, normal equations at the mode, and their factor.

    Returns:
        (k, 3, M) paths; (M,) logarithm of the density of each, up to a constant.
    """
    keys, starts, blocks, cross = seen.keys, seen.starts, equations.blocks, equations.cross
    pivots, values, order, ranks, tops = factor.pivots, factor.values, pattern.order, pattern.ranks, pattern.tops
    rows, row_tops = pattern.rows, pattern.row_tops
    num, m, num_landmarks = len(order), draws.shape[2], len(starts) - 1
    num_poses = num - num_landmarks
    places = np.empty(num, dtype=np.int64)  # of nodes among those that are drawn, by rank
    paths, log_densities = np.empty((len(poses), 3, m)), np.zeros(m)
    drawn = len(draws)
    for j in range(num - 1, -1, -1):
        if order[j] >= num_poses and row_tops[j] == row_tops[j + 1]:
            continue
        drawn -= 1
        places[j] = drawn
        own = draws[drawn]
        for axis in range(3):
            for i in range(m):
                log_densities[i] -= 0.5 * own[axis, i] * own[axis, i]
        for p in range(tops[j], tops[j + 1]):
            v, y = values[p], draws[places[rows[p]]]
            v0, v1, v2, v3, v4, v5, v6, v7, v8 = v[0], v[1], v[2], v[3], v[4], v[5], v[6], v[7], v[8]
            for i in range(m):
                own[0, i] -= v0 * y[0, i] + v3 * y[1, i] + v6 * y[2, i]
                own[1, i] -= v1 * y[0, i] + v4 * y[1, i] + v7 * y[2, i]
                own[2, i] -= v2 * y[0, i] + v5 * y[1, i] + v8 * y[2, i]
        pivot = pivots[j]
        i0, l10, i1, l20, l21, i2 = pivot[0], pivot[1], pivot[2], pivot[3], pivot[4], pivot[5]
        for i in range(m):
            x2 = own[2, i] * i2
            x1 = (own[1, i] - l21 * x2) * i1
            own[0, i], own[1, i], own[2, i] = (own[0, i] - l10 * x1 - l20 * x2) * i0, x1, x2
    for b in range(len(columns)):
        for axis in range(3):
            for i in range(m):
                paths[b, axis, i] = poses[b, axis]
            if columns[b] >= 0:
                deviations = draws[places[ranks[columns[b] // 3]]]
                for i in range(m):
                    paths[b, axis, i] += deviations[axis, i]
    off, inverse = np.empty((3, m)), np.empty(6)
    for landmark in range(num_landmarks):
        node = num_poses + landmark
        j = ranks[node]
        if row_tops[j] == row_tops[j + 1]:
            continue
        s, own = blocks[node], draws[places[j]]
        s0, s1, s2, s3, s4, s5 = s[0], s[1], s[2], s[3], s[4], s[5]
        for i in range(m):
            off[0, i] = s0 * own[0, i] + s1 * own[1, i] + s2 * own[2, i]
            off[1, i] = s1 * own[0, i] + s3 * own[1, i] + s4 * own[2, i]
            off[2, i] = s2 * own[0, i] + s4 * own[1, i] + s5 * own[2, i]
        for q in range(starts[landmark], starts[landmark + 1]):
            if columns[keys[q]] < 0:
                continue
            v, y = cross[q], draws[places[ranks[columns[keys[q]] // 3]]]
            for axis in range(3):
                v0, v1, v2 = v[0, axis], v[1, axis], v[2, axis]
                for i in range(m):
                    off[axis, i] += v0 * y[0, i] + v1 * y[1, i] + v2 * y[2, i]
        _inverse(s, inverse)
        t0, t1, t2, t3, t4, t5 = inverse[0], inverse[1], inverse[2], inverse[3], inverse[4], inverse[5]
        for i in range(m):
            o0, o1, o2 = off[0, i], off[1, i], off[2, i]
            log_densities[i] += 0.5 * (t0 * o0 * o0 + t3 * o1 * o1 + t5 * o2 * o2)
            log_densities[i] += t1 * o0 * o1 + t2 * o0 * o2 + t4 * o1 * o2
    return paths, log_densities


LANES = 52  # as in the filter, which takes over tiles as they are

# Rows of a block of poses and of the workspace of `replay`.
PX, PY, COS, SIN, HEADING = (LANES * k for k in range(5))
POSE_ROWS = 5
A00, A01, A02, A11, A12, B0, B1, B2, ENERGY = (LANES * k for k in range(9))
WORK_SIZE = 9 * LANES


@simd
def to_lanes(poses: FloatArray, rows: FloatArray) -> None:
    """Write paths in blocks of lanes; surplus lanes are copies of the first path.

    Args:
        poses: (k, 3, M) float64 [m, m, rad].
        rows: (P / LANES * k * 5 * LANES,), result: x, y, cos, sin, heading of each block and key.
    """
    num_keys, num_paths = len(poses), poses.shape[2]
    for block in range(len(rows) // (num_keys * POSE_ROWS * LANES)):
        first = block * LANES
        count = min(LANES, num_paths - first)
        for key in range(num_keys):
            base = (block * num_keys + key) * POSE_ROWS * LANES
            row, pose = rows[base : base + POSE_ROWS * LANES], poses[key]
            for i in range(count):
                path = first + i
                row[PX + i], row[PY + i], row[HEADING + i] = pose[0, path], pose[1, path], pose[2, path]
            for i in range(count, LANES):
                row[PX + i], row[PY + i], row[HEADING + i] = pose[0, 0], pose[1, 0], pose[2, 0]
            for i in range(LANES):
                row[SIN + i], row[COS + i] = sine_cosine(row[HEADING + i])


@simd
def replay(
    poses: FloatArray, num_keys: int, num_blocks: int, landmarks: FloatArray, seen: LandmarkFactors, chosen: IntArray,
    tiles: FloatArray, log_likelihood: FloatArray,
) -> None:  # fmt: skip
    """Give each path the landmarks that its sightings ask for, and the log-likelihood of these, up to a constant.

    Args:
        poses: (num_blocks * num_keys * 5 * LANES,) x, y, cos, sin, heading of each block and key.
        num_keys, num_blocks: k, and the number of blocks of lanes.
        landmarks: (l, 3) about which forms are evaluated, map frame.
        seen: Sightings, linearised there.
        chosen: (n,) rows of the landmarks that take part; negative: left out.
        tiles: (n * num_blocks * 9 * LANES,), result: mean (3) and covariance (6) per lane; zeros for a landmark without
            sightings. (9 * LANES,): each landmark overwrites the one before, where likelihoods alone are wanted.
        log_likelihood: (num_blocks * LANES,), result.
    """
    keys, starts, centres, infos, slopes = (
        seen.keys,
        seen.starts,
        seen.linearisation_points,
        seen.information,
        seen.gradients,
    )
    log_likelihood[:] = 0.0
    work = stack_array(WORK_SIZE)
    for block in range(num_blocks):  # one after the other, for the poses of one are as many as a cache holds
        out = log_likelihood[block * LANES : (block + 1) * LANES]
        for n in range(len(chosen)):
            landmark = chosen[n]
            if landmark < 0:
                continue
            first, last = starts[landmark], starts[landmark + 1]
            x, y, z = landmarks[landmark, 0], landmarks[landmark, 1], landmarks[landmark, 2]
            base = (n * num_blocks + block) * 9 * LANES if len(tiles) > 9 * LANES else 0
            tile = tiles[base : base + 9 * LANES]
            if first == last:
                tile[:] = 0.0
                continue
            for i in range(WORK_SIZE):
                work[i] = 0.0
            for i in range(LANES):
                work[A00 + i] = work[A11 + i] = WEAK
            h = WEAK  # of the height: the same however a path turns
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
                    work[ENERGY + i] += u0 * (0.5 * l0 - g0) + u1 * (0.5 * l1 - g1) + u2 * (0.5 * l2 - g2)  # (4)
                    e0, e1 = l0 - g0, l1 - g1
                    work[B0 + i] += c * e0 - s * e1
                    work[B1 + i] += s * e0 + c * e1
                    work[B2 + i] += l2 - g2
                    work[A00 + i] += c * c * n0 - 2.0 * c * s * n1 + s * s * n3
                    work[A01 + i] += c * s * (n0 - n3) + (c * c - s * s) * n1
                    work[A02 + i] += c * n2 - s * n4
                    work[A11 + i] += s * s * n0 + 2.0 * c * s * n1 + c * c * n3
                    work[A12 + i] += s * n2 + c * n4
                h += n5
            for i in range(LANES):
                a, b, d = work[A00 + i], work[A01 + i], work[A02 + i]
                e, f = work[A11 + i], work[A12 + i]
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
                det = work[A00 + i]
                log_det = log_of(det) if det > 0.0 else math.nan
                out[i] += work[ENERGY + i] - 0.5 * log_det  # (6)


@simd
def place_landmarks(
    poses: FloatArray, num_keys: int, num_blocks: int, seen: LandmarkFactors, chosen: IntArray, is_rigid: BoolArray,
    walk: float, tiles: FloatArray,
) -> None:  # fmt: skip
    """Write landmarks with a single sighting, which stand rigidly to its key, and add a random walk to all.

    Args:
        poses, num_keys, num_blocks: Paths, as `replay` takes them.
        seen: Sightings.
        chosen: (n,) rows of landmarks.
        is_rigid: (n,) bool. True for those with a single sighting, which are written.
        walk: Variance [m^2] that is added along each axis.
        tiles: (n * num_blocks * 9 * LANES,), landmarks of the chosen rows as `replay` writes them; changed.
    """
    keys, starts, centres, infos, slopes = (
        seen.keys,
        seen.starts,
        seen.linearisation_points,
        seen.information,
        seen.gradients,
    )
    p = stack_array(6)
    for n in range(len(chosen)):
        row = starts[chosen[n]]
        if is_rigid[n]:
            _inverse(infos[row], p)
            g0, g1, g2 = slopes[row, 0], slopes[row, 1], slopes[row, 2]
            ahead = centres[row, 0] + p[0] * g0 + p[1] * g1 + p[2] * g2
            left = centres[row, 1] + p[1] * g0 + p[3] * g1 + p[4] * g2
            up = centres[row, 2] + p[2] * g0 + p[4] * g1 + p[5] * g2
            p0, p1, p2, p3, p4, p5 = p[0], p[1], p[2], p[3], p[4], p[5]
        else:
            ahead, left, up = 0.0, 0.0, 0.0
            p0, p1, p2, p3, p4, p5 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for block in range(num_blocks):
            base = (n * num_blocks + block) * 9 * LANES
            tile = tiles[base : base + 9 * LANES]
            if not is_rigid[n]:
                for i in range(LANES):
                    tile[3 * LANES + i] += walk
                    tile[6 * LANES + i] += walk
                    tile[8 * LANES + i] += walk
                continue
            base = (block * num_keys + keys[row]) * POSE_ROWS * LANES
            pose = poses[base : base + POSE_ROWS * LANES]
            for i in range(LANES):
                c, s = pose[COS + i], pose[SIN + i]
                tile[i] = pose[PX + i] + c * ahead - s * left
                tile[LANES + i] = pose[PY + i] + s * ahead + c * left
                tile[2 * LANES + i] = up
                tile[3 * LANES + i] = c * c * p0 - 2.0 * c * s * p1 + s * s * p3 + walk
                tile[4 * LANES + i] = c * s * (p0 - p3) + (c * c - s * s) * p1
                tile[5 * LANES + i] = c * p2 - s * p4
                tile[6 * LANES + i] = s * s * p0 + 2.0 * c * s * p1 + c * c * p3 + walk
                tile[7 * LANES + i] = s * p2 + c * p4
                tile[8 * LANES + i] = p5 + walk


@simd
def odometry_log_density(
    poses: FloatArray, num_keys: int, num_blocks: int, num_paths: int, keys: Keys, biases: IntArray, infos: FloatArray,
    mode: FloatArray, log_density: FloatArray, transition_variances: FloatArray,
) -> None:  # fmt: skip
    """Weigh paths by odometry, and say how rigid they are from each key to the next.

    Args:
        poses, num_keys, num_blocks: Paths in blocks of lanes, as `replay` takes them.
        num_paths: M; the lanes after these are copies.
        keys, infos: Keys of the graph, of which the odometry is used, and the information (k, 3, 3) of that.
        biases: (k,) key of the bias of each key's odometry, `NONE` if it has none; (0,) without biases.
        mode: (k, 3) [m, m, rad] the most probable path.
        log_density: (num_blocks * LANES,), result: log p(path given odometry) up to a constant.
        transition_variances: (k,), result [m^2]: mean square by which the motion from the previous key differs from
            that of the mode.
    """
    previous, motions = keys.parents, keys.odometry
    log_density[:] = 0.0
    squares, e0, e1, e2 = stack_array(LANES), stack_array(LANES), stack_array(LANES), stack_array(LANES)
    e0[:] = 0.0
    e1[:] = 0.0
    e2[:] = 0.0
    for b in range(num_keys):
        a = previous[b]
        transition_variances[b] = 0.0
        if a < 0:
            continue
        u0, u1, u2 = motions[b, 0], motions[b, 1], motions[b, 2]
        c, s = math.cos(mode[a, 2]), math.sin(mode[a, 2])
        dx, dy = mode[b, 0] - mode[a, 0], mode[b, 1] - mode[a, 1]
        d0, d1, d2 = c * dx + s * dy - u0, c * dy - s * dx - u1, mode[b, 2] - mode[a, 2] - u2
        w = infos[b]
        w00, w01, w02, w11, w12, w22 = w[0, 0], w[0, 1], w[0, 2], w[1, 1], w[1, 2], w[2, 2]
        total, bias = 0.0, biases[b] if len(biases) > 0 else NONE
        for block in range(num_blocks):
            if bias >= 0:  # J b of each path
                j = keys.bias_jacobians[b]
                base_a = (block * num_keys + bias) * POSE_ROWS * LANES
                value = poses[base_a : base_a + POSE_ROWS * LANES]
                for i in range(LANES):
                    b0, b1, b2 = value[PX + i], value[PY + i], value[HEADING + i]
                    e0[i] = j[0, 0] * b0 + j[0, 1] * b1 + j[0, 2] * b2
                    e1[i] = j[1, 0] * b0 + j[1, 1] * b1 + j[1, 2] * b2
                    e2[i] = j[2, 0] * b0 + j[2, 1] * b1 + j[2, 2] * b2
            base_a, base_b = (block * num_keys + a) * POSE_ROWS * LANES, (block * num_keys + b) * POSE_ROWS * LANES
            first = poses[base_a : base_a + POSE_ROWS * LANES]
            second = poses[base_b : base_b + POSE_ROWS * LANES]
            out = log_density[block * LANES : (block + 1) * LANES]
            for i in range(LANES):
                c, s = first[COS + i], first[SIN + i]
                dx, dy = second[PX + i] - first[PX + i], second[PY + i] - first[PY + i]
                r0, r1 = c * dx + s * dy - u0, c * dy - s * dx - u1
                turn = second[HEADING + i] - first[HEADING + i] - u2
                r2 = turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
                r0, r1, r2 = r0 + e0[i], r1 + e1[i], r2 + e2[i]
                out[i] -= 0.5 * (w00 * r0 * r0 + w11 * r1 * r1 + w22 * r2 * r2) + (
                    w01 * r0 * r1 + w02 * r0 * r2 + w12 * r1 * r2
                )
                r0, r1, r2 = r0 - e0[i] - d0, r1 - e1[i] - d1, turn - d2
                r2 = r2 - 2.0 * math.pi * math.floor((r2 + math.pi) / (2.0 * math.pi))
                squares[i] = r0 * r0 + r1 * r1 + LEVER * LEVER * r2 * r2
            for i in range(min(LANES, num_paths - block * LANES)):
                total += squares[i]
        if bias >= 0:
            e0[:] = 0.0
            e1[:] = 0.0
            e2[:] = 0.0
        transition_variances[b] = total / num_paths
