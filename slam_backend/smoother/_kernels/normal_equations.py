"""Normal equations of key poses and landmarks, by blocks of 3 x 3.

A *node* is a pose that is sought or a landmark: first the poses, by their columns, then all landmarks. With A the
derivatives of a landmark in the key's frame by the pose, in map axes A = [[-1, 0, dy], [0, -1, -dx], [0, 0, 0]], and L
the information of a sighting turned into these, a sighting adds A^T L A to the key, L to the landmark, A^T L between.
"""

import math

import numpy as np

from slam_backend.core.jit import in_place, jit, stack_array
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.smoother._kernels.factors import _inverse, _rotate_in_plane
from slam_backend.smoother._kernels.records import (
    FREE,
    NONE,
    CholeskyFactor,
    EquationBlocks,
    Keys,
    LandmarkFactors,
    SymbolicFactor,
)
from slam_backend.smoother._kernels.sparse_cholesky import sweep

# Information [1/m^2] of a landmark about where it stands now, 1 km along each axis: where all its sightings have lost
# their weight nothing else holds it. It takes part in every step, and moves nothing that has come to rest.
WEAK = 1e-6


@in_place
def form(
    poses: FloatArray, landmarks: FloatArray, graph_keys: Keys, biases: IntArray, columns: IntArray,
    link_infos: FloatArray, seen: LandmarkFactors, equations: EquationBlocks,
) -> tuple[float, float]:  # fmt: skip
    """Write the normal equations of n poses and l landmarks.

    Args:
        poses, landmarks: (k, 3), (l, 3) where to linearise.
        graph_keys: Keys of the graph, of which the odometry is used.
        biases: (k,) key of the bias of each key's odometry, `NONE` if it has none; (0,) without biases.
        columns: (k,) first row of each pose among those sought, `FREE` if it is given.
        link_infos: (k, 3, 3) information of the odometry, in the frame of the previous key.
        seen: Sightings, linearised there.
        equations: Result.

    Returns:
        Half the sum of squares of odometry, and of frozen sightings' forms up to a constant; infinite if a landmark is
        at no finite place. And by how much the cost would fall if landmarks alone moved.
    """
    previous, motions, keys, starts = graph_keys.parents, graph_keys.odometry, seen.keys, seen.starts
    centres, infos, slopes = seen.linearisation_points, seen.information, seen.gradients
    turns, blocks, links, cross, bias_links, vector = equations
    blocks[:] = 0.0
    bias_links[:] = 0.0
    vector[:] = 0.0
    cost = 0.0
    for b in range(len(poses)):
        turns[b, 0], turns[b, 1] = math.cos(poses[b, 2]), math.sin(poses[b, 2])
    f, g, h = stack_array(9).reshape(3, 3), stack_array(9).reshape(3, 3), stack_array(9).reshape(3, 3)
    r = stack_array(3)
    for b in range(len(poses)):  # odometry
        a = previous[b]
        if a < 0:
            continue
        c, s = turns[a, 0], turns[a, 1]
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        mx, my = c * dx + s * dy, -s * dx + c * dy
        r[0], r[1] = mx - motions[b, 0], my - motions[b, 1]
        turn = poses[b, 2] - poses[a, 2] - motions[b, 2]
        r[2] = turn - 2.0 * math.pi * math.floor((turn + math.pi) / (2.0 * math.pi))
        bias = biases[b] if len(biases) > 0 else NONE
        if bias >= 0:
            jacobian, value = graph_keys.bias_jacobians[b], poses[bias]
            for i in range(3):
                r[i] += jacobian[i, 0] * value[0] + jacobian[i, 1] * value[1] + jacobian[i, 2] * value[2]
        g[:] = 0.0
        g[0, 0], g[0, 1], g[1, 0], g[1, 1], g[2, 2] = c, s, -s, c, 1.0
        f[:] = 0.0
        f[0, 0], f[0, 1], f[1, 0], f[1, 1], f[2, 2] = -c, -s, s, -c, -1.0
        f[0, 2], f[1, 2] = my, -mx
        w = link_infos[b]
        for side in range(2):
            column = columns[b] if side else columns[a]
            if column < 0:
                continue
            own = column // 3
            left = g if side else f
            for i in range(3):
                for j in range(3):
                    h[i, j] = left[0, i] * w[0, j] + left[1, i] * w[1, j] + left[2, i] * w[2, j]
            at = 0
            for i in range(3):
                vector[own, i] += h[i, 0] * r[0] + h[i, 1] * r[1] + h[i, 2] * r[2]
                for j in range(i, 3):
                    blocks[own, at] += h[i, 0] * left[0, j] + h[i, 1] * left[1, j] + h[i, 2] * left[2, j]
                    at += 1
            if bias >= 0:
                block = bias_links[b if side else a]
                for i in range(3):
                    for j in range(3):
                        block[i, j] += h[i, 0] * jacobian[0, j] + h[i, 1] * jacobian[1, j] + h[i, 2] * jacobian[2, j]
            if side and columns[a] >= 0:
                for i in range(3):
                    for j in range(3):
                        links[b, i, j] = h[i, 0] * f[0, j] + h[i, 1] * f[1, j] + h[i, 2] * f[2, j]
        if bias >= 0:
            own, at = columns[bias] // 3, 0
            for i in range(3):
                for j in range(3):
                    h[i, j] = jacobian[0, i] * w[0, j] + jacobian[1, i] * w[1, j] + jacobian[2, i] * w[2, j]
            for i in range(3):
                vector[own, i] += h[i, 0] * r[0] + h[i, 1] * r[1] + h[i, 2] * r[2]
                for j in range(i, 3):
                    blocks[own, at] += h[i, 0] * jacobian[0, j] + h[i, 1] * jacobian[1, j] + h[i, 2] * jacobian[2, j]
                    at += 1
        for i in range(3):
            for j in range(3):
                cost += 0.5 * r[i] * w[i, j] * r[j]
    first_landmark = len(blocks) - len(landmarks)
    turned, p = stack_array(6), stack_array(6)
    eased = 0.0
    for landmark in range(len(landmarks)):
        first, last = starts[landmark], starts[landmark + 1]
        block, force = blocks[first_landmark + landmark], vector[first_landmark + landmark]
        block[0] = block[3] = block[5] = WEAK
        for q in range(first, last):
            key = keys[q]
            c, s = turns[key, 0], turns[key, 1]
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
            _rotate_in_plane(c, s, n, turned)
            for i in range(6):
                block[i] += turned[i]
            if columns[key] < 0:
                continue
            own = columns[key] // 3
            x, mine = cross[q], blocks[own]
            x[0, 0], x[0, 1], x[0, 2] = -turned[0], -turned[1], -turned[2]
            x[1, 0], x[1, 1], x[1, 2] = -turned[1], -turned[3], -turned[4]
            x[2, 0] = dy * turned[0] - dx * turned[1]
            x[2, 1] = dy * turned[1] - dx * turned[3]
            x[2, 2] = dy * turned[2] - dx * turned[4]
            vector[own, 0] -= m0
            vector[own, 1] -= m1
            vector[own, 2] += dy * m0 - dx * m1
            mine[0] += turned[0]
            mine[1] += turned[1]
            mine[2] -= x[2, 0]
            mine[3] += turned[3]
            mine[4] -= x[2, 1]
            mine[5] += dy * x[2, 0] - dx * x[2, 1]
        if not _inverse(block, p) > 0.0:
            return math.inf, 0.0
        m0, m1, m2 = force[0], force[1], force[2]
        eased += 0.5 * (p[0] * m0 * m0 + p[3] * m1 * m1 + p[5] * m2 * m2)
        eased += p[1] * m0 * m1 + p[2] * m0 * m2 + p[4] * m1 * m2
    return cost, eased


@jit
def step(
    equations: EquationBlocks,
    factor: CholeskyFactor,
    pattern: SymbolicFactor,
    columns: IntArray,
    poses: FloatArray,
    landmarks: FloatArray,
) -> tuple[FloatArray, FloatArray, float, float]:
    """Solve the factored equations.

    Args:
        equations, factor, pattern: The equations, and their factor.
        columns: (k,) first column of each pose, `FREE` if it is given.
        poses, landmarks: (k, 3), (l, 3) where the equations were formed.

    Returns:
        Poses (k, 3) and landmarks (l, 3) to which the solution leads; by how much the cost rises along its slope; the
        largest change of a pose, NaN if any is.
    """
    vector, order, ranks = equations.vector, pattern.order, pattern.ranks
    change = np.empty((len(order), 3))  # by rank
    for j in range(len(order)):
        for axis in range(3):
            change[j, axis] = -vector[order[j], axis]
    sweep(factor, pattern, np.arange(len(order)), change)
    rise, largest = 0.0, 0.0
    for node in range(len(order)):
        for axis in range(3):
            rise += vector[node, axis] * change[ranks[node], axis]
    new_poses, new_landmarks = poses.copy(), landmarks.copy()
    for key in range(len(poses)):
        if columns[key] != FREE:
            for axis in range(3):
                own = change[ranks[columns[key] // 3], axis]
                new_poses[key, axis] += own
                if abs(own) > largest or math.isnan(own):
                    largest = abs(own)
    first_landmark = len(order) - len(landmarks)
    for landmark in range(len(landmarks)):
        for axis in range(3):
            new_landmarks[landmark, axis] += change[ranks[first_landmark + landmark], axis]
    return new_poses, new_landmarks, rise, largest
