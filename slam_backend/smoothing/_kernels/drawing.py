"""Many paths at a time from the Gaussian of poses and landmarks that a factor stands for."""

import numpy as np

from slam_backend._jit import fused
from slam_backend.errors import FloatArray, IntArray
from slam_backend.smoothing._kernels.forms import _inverse


@fused
def draw(
    draws: FloatArray, poses: FloatArray, columns: IntArray, keys: IntArray, starts: IntArray, blocks: FloatArray,
    cross: FloatArray, pivots: FloatArray, values: FloatArray, order: IntArray, ranks: IntArray, tops: IntArray,
    rows: IntArray, row_tops: IntArray, paths: FloatArray, log_densities: FloatArray,
) -> None:  # fmt: skip
    """Write M paths, the landmarks that come with them left out.

    Of L L^T the information of all nodes, x = mode + L^-T z. A landmark that goes before all poses that see it is not
    drawn, for no pose depends on it. Of the others' density what they have given the path is taken off: with S the
    information of a landmark, X that between it and the poses, and d the deviations, S d_l + X^T d_x is what it
    deviates from its conditional mean, times S.

    Args:
        draws: (D, 3, M) standard normal draws: of the nodes that are drawn, in the order of elimination. Changed: by
            how much these deviate from the mode.
        poses: (k, 3) of the mode.
        columns, keys, starts, blocks, cross: As of `form`.
        pivots, values: As `factorise` wrote them.
        order, ranks, tops, rows, row_tops: As of `lay_out`.
        paths: (k, 3, M), result.
        log_densities: (M,), result: log of the density of each path, up to a constant.
    """
    num, m, num_landmarks = len(order), draws.shape[2], len(starts) - 1
    num_poses = num - num_landmarks
    places = np.empty(num, dtype=np.int64)  # of nodes among those that are drawn, by rank
    log_densities[:] = 0.0
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
