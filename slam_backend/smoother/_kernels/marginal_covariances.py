"""Marginal variances of the relative poses of neighbouring keyframes.

They need selected blocks of the inverse of the information matrix, which follow from its sparse Cholesky factor without
the whole inverse (Takahashi, Fagan, Chin 1973).
"""

import math

import numpy as np

from slam_backend.core.jit import jit_fma
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.smoother._kernels.records import LEVER, CholeskyFactor, SymbolicFactor


@jit_fma
def transition_variances(
    poses: FloatArray, columns: IntArray, previous: IntArray, factor: CholeskyFactor, pattern: SymbolicFactor
) -> FloatArray:
    """Return the mean square (k,) [m^2] by which the motion from the previous key scatters about that of the mode.

    Covariances of neighbours are blocks of the inverse that the factor has room for; these follow from each other, from
    the last column to the first (Takahashi, Fagan, Chin 1973). To first order in the deviations.

    Args:
        poses: (k, 3) the mode.
        columns, previous: (k,) first column of each pose, and its previous key.
        factor, pattern: Factor of the normal equations at the mode.
    """
    pivots, values, order, ranks, tops = factor.pivots, factor.values, pattern.order, pattern.ranks, pattern.tops
    rows, row_tops, link_places = pattern.rows, pattern.row_tops, pattern.link_places
    num, num_poses = len(order), 0
    for b in range(len(columns)):
        num_poses += columns[b] >= 0
    inverse, diagonal = np.zeros(values.shape), np.zeros((num, 9))
    where = np.empty(num, dtype=np.int64)
    most = 0
    for j in range(num):
        most = max(most, tops[j + 1] - tops[j])
    scaled, sums = np.empty((most, 9)), np.empty((most, 9))
    for j in range(num - 1, -1, -1):
        if order[j] >= num_poses and row_tops[j] == row_tops[j + 1]:
            continue  # no pose depends on this landmark
        pivot = pivots[j]
        i0, l10, i1, l20, l21, i2 = pivot[0], pivot[1], pivot[2], pivot[3], pivot[4], pivot[5]
        first, count = tops[j], tops[j + 1] - tops[j]
        for n in range(count):
            v, m = values[first + n], scaled[n]
            for i in range(0, 9, 3):
                m2 = v[i + 2] * i2
                m1 = (v[i + 1] - m2 * l21) * i1
                m[i + 2], m[i + 1] = m2, m1
                m[i] = (v[i] - m1 * l10 - m2 * l20) * i0
            sums[n] = 0.0
        for n in range(count):
            column = rows[first + n]
            for p in range(tops[column], tops[column + 1]):
                where[rows[p]] = p
            m, total = scaled[n], sums[n]
            z = diagonal[column]
            for i in range(0, 9, 3):
                for c in range(3):
                    total[i + c] += z[i] * m[c] + z[i + 1] * m[3 + c] + z[i + 2] * m[6 + c]
            for o in range(n + 1, count):
                z, v, out = inverse[where[rows[first + o]]], scaled[o], sums[o]
                for i in range(0, 9, 3):
                    for c in range(3):
                        out[i + c] += z[i] * m[c] + z[i + 1] * m[3 + c] + z[i + 2] * m[6 + c]
                for i in range(3):
                    for c in range(3):
                        total[3 * i + c] += z[i] * v[c] + z[3 + i] * v[3 + c] + z[6 + i] * v[6 + c]
        own = diagonal[j]
        t10, t21 = -l10 * i0 * i1, -l21 * i1 * i2
        t20 = -(l20 * i0 + l21 * t10) * i2
        own[0] = i0 * i0 + t10 * t10 + t20 * t20
        own[1] = t10 * i1 + t20 * t21
        own[2] = t20 * i2
        own[4] = i1 * i1 + t21 * t21
        own[5] = t21 * i2
        own[8] = i2 * i2
        for n in range(count):
            m, z = scaled[n], sums[n]
            for i in range(9):
                inverse[first + n, i] = -z[i]
            for i in range(3):
                for c in range(i, 3):
                    own[3 * i + c] += m[i] * z[c] + m[3 + i] * z[3 + c] + m[6 + i] * z[6 + c]
        own[3], own[6], own[7] = own[1], own[2], own[5]
    transition_variances = np.zeros(len(columns))
    joint = np.empty((3, 3))
    f, g = np.zeros((3, 3)), np.zeros((3, 3))
    for b in range(len(columns)):
        a = previous[b]
        if a < 0:
            continue
        cos, sin = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        g[0, 0], g[0, 1], g[1, 0], g[1, 1], g[2, 2] = cos, sin, -sin, cos, 1.0
        f[:] = -g
        f[0, 2], f[1, 2] = cos * dy - sin * dx, -cos * dx - sin * dy
        total = 0.0
        of_b = diagonal[ranks[columns[b] // 3]] if columns[b] >= 0 else np.zeros(9)
        of_a = diagonal[ranks[columns[a] // 3]] if columns[a] >= 0 else np.zeros(9)
        place = link_places[b]
        joint[:] = 0.0
        if place != 0:
            z = inverse[abs(place) - 1]
            for i in range(3):
                for e in range(3):
                    joint[i, e] = z[3 * i + e] if place > 0 else z[3 * e + i]
        for i in range(3):
            weight = LEVER * LEVER if i == 2 else 1.0
            for e in range(3):
                for n in range(3):
                    total += weight * g[i, e] * of_b[3 * e + n] * g[i, n]
                    total += weight * f[i, e] * of_a[3 * e + n] * f[i, n]
                    total += 2.0 * weight * g[i, e] * joint[e, n] * f[i, n]
        transition_variances[b] = total
    return transition_variances
