"""Normal equations of key poses and landmarks, by blocks of 3 x 3.

A *node* is a pose that is sought or a landmark: first the poses, by their columns, then all landmarks. With A the
derivatives of a landmark in the key's frame by the pose, in map axes A = [[-1, 0, dy], [0, -1, -dx], [0, 0, 0]], and L
the information of a sighting turned into these, a sighting adds A^T L A to the key, L to the landmark, A^T L between.
"""

import math

import numpy as np

from slam_backend.core.jit import device, in_place, jit, stack_array
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother._kernels.factors import FREE, _inverse, _rotate_in_plane
from slam_backend.smoother._kernels.sparse_cholesky import solve


@device
@jit
def _sorted_by(codes: IntArray, order: IntArray, num_codes: int) -> IntArray:
    """Return an order (n,) by codes in [0, num_codes), that of equal ones as it was."""
    tops, result = np.zeros(num_codes + 1, dtype=np.int64), np.empty(len(order), dtype=np.int64)
    for item in order:
        tops[codes[item] + 1] += 1
    for code in range(num_codes):
        tops[code + 1] += tops[code]
    for item in order:
        result[tops[codes[item]]] = item
        tops[codes[item]] += 1
    return result


@jit
def gather(
    condensed_keys: IntArray, condensed_landmarks: IntArray, frozen_centres: FloatArray, frozen_infos: FloatArray,
    frozen_slopes: FloatArray, frozen_counts: IntArray, point_frames: IntArray, point_landmarks: IntArray,
    frame_keys: IntArray, num_keys: int, keys: IntArray, landmarks: IntArray, starts: IntArray, frozen: BoolArray,
    centres: FloatArray, infos: FloatArray, slopes: FloatArray, counts: IntArray, of_points: IntArray,
) -> int:  # fmt: skip
    """Write the sightings of a graph by landmark and key, frozen ones before the others of a pair.

    Args:
        condensed_keys, condensed_landmarks, frozen_centres, frozen_infos, frozen_slopes, frozen_counts: The f
            condensed factors.
        point_frames, point_landmarks: (n,) of the raw measurements.
        frame_keys: (F,) key of each frame.
        num_keys: k.
        keys, landmarks, frozen, centres, infos, slopes, counts: (f + n, ...), results, of which the first rows are
            written; forms of raw measurements are zeros.
        starts: (l + 1,), result: first row of each landmark.
        of_points: (n,), result: row of each raw measurement.

    Returns:
        How many rows there are.
    """
    num_frozen, num_points = len(condensed_keys), len(point_frames)
    of_key, of_landmark = np.empty(num_frozen + num_points, np.int64), np.empty(num_frozen + num_points, np.int64)
    of_key[:num_frozen], of_landmark[:num_frozen] = condensed_keys, condensed_landmarks
    for n in range(num_points):
        of_key[num_frozen + n], of_landmark[num_frozen + n] = frame_keys[point_frames[n]], point_landmarks[n]
    order = _sorted_by(of_key, np.arange(num_frozen + num_points), num_keys)
    order = _sorted_by(of_landmark, order, len(starts) - 1)
    num = 0
    starts[:] = 0
    for item in order:
        key, landmark = of_key[item], of_landmark[item]
        again = item >= num_frozen and num > 0 and not frozen[num - 1]
        if again and keys[num - 1] == key and landmarks[num - 1] == landmark:
            counts[num - 1] += 1
            of_points[item - num_frozen] = num - 1
            continue
        keys[num], landmarks[num], frozen[num] = key, landmark, item < num_frozen
        if item < num_frozen:
            centres[num], infos[num], slopes[num] = frozen_centres[item], frozen_infos[item], frozen_slopes[item]
            counts[num] = frozen_counts[item]
        else:
            centres[num] = 0.0
            infos[num] = 0.0
            slopes[num] = 0.0
            counts[num] = 1
            of_points[item - num_frozen] = num
        starts[landmark + 1] += 1
        num += 1
    for landmark in range(len(starts) - 1):
        starts[landmark + 1] += starts[landmark]
    return num


@in_place
def count(
    starts: IntArray, counts: IntArray, point_landmarks: IntArray, totals: IntArray, in_view: BoolArray
) -> None:  # fmt: skip
    """Say how often each landmark was measured, and which of them have raw measurements.

    Args:
        starts, counts: (l + 1,), (s,) as of `gather`.
        point_landmarks: (n,) of the raw measurements.
        totals, in_view: (l,), results.
    """
    for landmark in range(len(totals)):
        totals[landmark] = 0
        for q in range(starts[landmark], starts[landmark + 1]):
            totals[landmark] += counts[q]
    in_view[:] = False
    for landmark in point_landmarks:
        in_view[landmark] = True


# Information [1/m^2] of a landmark about where it stands now, 1 km along each axis: where all its sightings have lost
# their weight nothing else holds it. It takes part in every step, and moves nothing that has come to rest.
WEAK = 1e-6


@device
@in_place
def _wrapped(angle: float) -> float:
    """Return an angle [rad] in [-pi, pi)."""
    return angle - 2.0 * math.pi * math.floor((angle + math.pi) / (2.0 * math.pi))


@in_place
def form(
    poses: FloatArray, landmarks: FloatArray, columns: IntArray, previous: IntArray, motions: FloatArray,
    link_infos: FloatArray, keys: IntArray, starts: IntArray, centres: FloatArray, infos: FloatArray,
    slopes: FloatArray, turns: FloatArray, blocks: FloatArray, links: FloatArray, cross: FloatArray, vector: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Write the normal equations of n poses and l landmarks.

    Args:
        poses, landmarks: (k, 3), (l, 3) where to linearise.
        columns: (k,) first row of each pose among those sought, `FREE` if it is given.
        previous: (k,) key that odometry comes from, -1 for none. motions, link_infos: (k, 3), (k, 3, 3) that odometry,
            in the frame of the previous key, and its information.
        keys, starts: (s,) key of each sighting; those of landmark i are starts[i] to starts[i + 1].
        centres, infos, slopes: Of the sightings.
        turns: (k, 2), result: cosine and sine of each heading.
        blocks: (n + l, 6), result: second derivatives by each node.
        links: (k, 3, 3), result: by a key (rows) and the one before (columns), where both are sought.
        cross: (s, 3, 3), result: by pose (rows) and landmark (columns), where the pose is sought.
        vector: (n + l, 3), result: slope of the cost.

    Returns:
        Half the sum of squares of odometry, and of frozen sightings' forms up to a constant; infinite if a landmark is
        at no finite place. And by how much the cost would fall if landmarks alone moved.
    """
    blocks[:] = 0.0
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
        r[2] = _wrapped(poses[b, 2] - poses[a, 2] - motions[b, 2])
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
            if side and columns[a] >= 0:
                for i in range(3):
                    for j in range(3):
                        links[b, i, j] = h[i, 0] * f[0, j] + h[i, 1] * f[1, j] + h[i, 2] * f[2, j]
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


@device
@in_place
def advance(
    change: FloatArray, vector: FloatArray, columns: IntArray, poses: FloatArray, landmarks: FloatArray,
    new_poses: FloatArray, new_landmarks: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Write where a change of all nodes leads.

    Args:
        change: (n + l, 3) of the poses that are sought, then of the landmarks.
        vector, columns: As of `form`.
        poses, landmarks: (k, 3), (l, 3) where they are.
        new_poses, new_landmarks: (k, 3), (l, 3), results.

    Returns:
        By how much the cost rises along its slope, and the largest change of a pose, NaN if any is.
    """
    rise, largest = 0.0, 0.0
    for node in range(len(change)):
        for axis in range(3):
            rise += vector[node, axis] * change[node, axis]
    for key in range(len(poses)):
        for axis in range(3):
            new_poses[key, axis] = poses[key, axis]
            if columns[key] != FREE:
                step = change[columns[key] // 3, axis]
                new_poses[key, axis] += step
                if abs(step) > largest or math.isnan(step):
                    largest = abs(step)
    first_landmark = len(change) - len(landmarks)
    for landmark in range(len(landmarks)):
        for axis in range(3):
            new_landmarks[landmark, axis] = landmarks[landmark, axis] + change[first_landmark + landmark, axis]
    return rise, largest


@jit
def step(
    pivots: FloatArray, values: FloatArray, order: IntArray, tops: IntArray, rows: IntArray, vector: FloatArray,
    columns: IntArray, poses: FloatArray, landmarks: FloatArray, new_poses: FloatArray, new_landmarks: FloatArray,
) -> tuple[float, float]:  # fmt: skip
    """Write where the factored equations lead.

    Args:
        pivots, values, order, tops, rows: As of `solve`.
        vector, columns, poses, landmarks, new_poses, new_landmarks: As of `advance`.

    Returns:
        As `advance`.
    """
    change = solve(pivots, values, order, tops, rows, -vector)
    return advance(change, vector, columns, poses, landmarks, new_poses, new_landmarks)
