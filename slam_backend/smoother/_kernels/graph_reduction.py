"""Keyframe reduction: keys are joined, and the sightings of each pair of key and landmark added up."""

import math

import numpy as np

from slam_backend.core.jit import inline, jit, stack_array
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother._kernels.factors import _rotate_in_plane, invert
from slam_backend.smoother._kernels.records import LEVER, NONE, Condensed, Keys, LandmarkFactors


@inline
def put_before(first: FloatArray, motion: FloatArray, noise: FloatArray) -> None:
    """Put a rigid motion before another, in place.

    Args:
        first: (3,) [m, m, rad] the rigid motion.
        motion, noise: (3,), (3, 3) the motion that follows and its covariance, in the frame to which the first one
            leads; changed: both motions together, in the frame in which the first one begins.
    """
    c, s = math.cos(first[2]), math.sin(first[2])
    a00, a01, a02, a11, a12 = noise[0, 0], noise[0, 1], noise[0, 2], noise[1, 1], noise[1, 2]
    noise[0, 0] = c * c * a00 - 2.0 * c * s * a01 + s * s * a11
    noise[0, 1] = c * s * (a00 - a11) + (c * c - s * s) * a01
    noise[0, 2] = c * a02 - s * a12
    noise[1, 1] = s * s * a00 + 2.0 * c * s * a01 + c * c * a11
    noise[1, 2] = s * a02 + c * a12
    noise[1, 0], noise[2, 0], noise[2, 1] = noise[0, 1], noise[0, 2], noise[1, 2]
    x, y = first[0] + c * motion[0] - s * motion[1], first[1] + s * motion[0] + c * motion[1]
    motion[0], motion[1] = x, y
    motion[2] = (first[2] + motion[2] + math.pi) % (2.0 * math.pi) - math.pi


@inline
def chain(first: FloatArray, first_noise: FloatArray, motion: FloatArray, noise: FloatArray) -> None:
    """Put a motion (3,) and its covariance (3, 3) before another, in place, as `put_before` does, to first order."""
    c, s = math.cos(first[2]), math.sin(first[2])
    ahead, left = -(s * motion[0] + c * motion[1]), c * motion[0] - s * motion[1]
    put_before(first, motion, noise)
    n02, n12, n22 = first_noise[0, 2], first_noise[1, 2], first_noise[2, 2]
    noise[0, 0] += first_noise[0, 0] + 2.0 * ahead * n02 + ahead * ahead * n22
    noise[0, 1] += first_noise[0, 1] + left * n02 + ahead * n12 + ahead * left * n22
    noise[1, 1] += first_noise[1, 1] + 2.0 * left * n12 + left * left * n22
    noise[0, 2] += n02 + ahead * n22
    noise[1, 2] += n12 + left * n22
    noise[2, 2] += n22
    noise[1, 0], noise[2, 0], noise[2, 1] = noise[0, 1], noise[0, 2], noise[1, 2]


@inline
def chain_biased(
    first: FloatArray, first_noise: FloatArray, first_jacobian: FloatArray, bias: FloatArray, motion: FloatArray,
    noise: FloatArray, jacobian: FloatArray,
) -> None:  # fmt: skip
    """Put odometry before other odometry of the same robot, in place, linearised about its bias b.

    Args:
        first, first_noise, first_jacobian: (3,), (3, 3), (3, 3) odometry u, its covariance, and its derivative J by
            the bias: it measures the motion u - J b.
        bias: (3,) b.
        motion, noise, jacobian: Odometry that follows, its covariance and derivative; changed to those of both.
    """
    o0, o1, o2 = first[0], first[1], first[2]
    for i in range(3):
        first[i] -= first_jacobian[i, 0] * bias[0] + first_jacobian[i, 1] * bias[1] + first_jacobian[i, 2] * bias[2]
        motion[i] -= jacobian[i, 0] * bias[0] + jacobian[i, 1] * bias[1] + jacobian[i, 2] * bias[2]
    c, s = math.cos(first[2]), math.sin(first[2])
    dx, dy = c * motion[0] - s * motion[1], s * motion[0] + c * motion[1]
    for i in range(3):
        x, y, turn = jacobian[0, i], jacobian[1, i], first_jacobian[2, i]
        jacobian[0, i] = first_jacobian[0, i] - dy * turn + c * x - s * y
        jacobian[1, i] = first_jacobian[1, i] + dx * turn + s * x + c * y
        jacobian[2, i] += turn
    chain(first, first_noise, motion, noise)
    first[0], first[1], first[2] = o0, o1, o2
    for i in range(3):
        motion[i] += jacobian[i, 0] * bias[0] + jacobian[i, 1] * bias[1] + jacobian[i, 2] * bias[2]


@jit
def absorb_odometry(
    off: FloatArray, noise: FloatArray, jacobian: FloatArray, variance: float, bias: FloatArray, prior: FloatArray,
    prior_noise: FloatArray,
) -> None:  # fmt: skip
    """Add what odometry says of its bias to the prior of the bias, in place, before the motion becomes rigid.

    The slope of the cost by the bias stays as it is, so that the mode does. Of the information the share 1 - v / q
    counts, q the variance of the motion by odometry alone and v the one by all measurements: where odometry alone tells
    the motion, it tells nothing of its own bias.

    Args:
        off: (3,) residual of the odometry at the mode.
        noise, jacobian: (3, 3), (3, 3) its covariance, and its derivative by the bias.
        variance: v [m^2].
        bias: (3,) bias at the mode.
        prior, prior_noise: (3,), (3, 3) mean and covariance of the bias.
    """
    weight, information, slope, total = np.empty((3, 3)), np.empty((3, 3)), stack_array(3), np.empty((3, 3))
    whole = noise[0, 0] + noise[1, 1] + LEVER**2 * noise[2, 2]
    if whole <= 0.0:
        return
    share = max(1.0 - variance / whole, 0.0)
    invert(noise, weight)
    invert(prior_noise, information)
    for r in range(3):
        slope[r] = 0.0
        for c in range(3):
            slope[r] += information[r, c] * (bias[c] - prior[c])
            total[r, c] = information[r, c]
            for i in range(3):
                slope[r] += jacobian[c, r] * weight[c, i] * off[i]
                for n in range(3):
                    total[r, c] += share * jacobian[i, r] * weight[i, n] * jacobian[n, c]
    invert(total, prior_noise)
    for r in range(3):
        prior[r] = bias[r]
        for c in range(3):
            prior[r] -= prior_noise[r, c] * slope[c]


@jit
def merge_keys(
    fresh: BoolArray, sighted: BoolArray, most_keys: int, keys: Keys, biases: IntArray
) -> tuple[int, IntArray, IntArray, FloatArray]:
    """Leave few enough keys, and say where the others stand to them; odometry is carried there.

    Old keys from which nothing was measured are chained away if they have a successor. Then, as long as there are too
    many, the old key goes whose motion from the key before costs least with what either has cost already: it stands
    rigidly to the key before from then on.

    Args:
        fresh: (k,) whether a key stays in any case.
        sighted: (k,) whether anything was measured from it.
        most_keys: Limit of their number.
        keys: Keys of the graph in the order of time; `transition_variances` [m^2] is what joining a key to the one
            before costs, `rigid_variances` what each has cost. Changed: the first rows are those of the keys that are
            left, whose odometry begins at another one that is left, by its new number.
        biases: (k,) key of the bias of each key's odometry, `NONE` if it has none; (0,) without biases. The
            information of a removed key's odometry about its bias is added to the prior of the bias.

    Returns:
        Number of keys that are left; (k,) the key to which each stands rigidly, itself if it is left, `NONE` if it was
        chained away; (k,) new number of each that is left, `NONE` of the others; (k, 3) pose of each seen from the key
        to which it stands.
    """
    robots, poses, previous, motions, noises, jacobians, costs, rigid = keys
    k = len(robots)
    roots, numbers, offsets = np.empty(k, np.int64), np.full(k, NONE), np.zeros((k, 3))
    following = np.full(k, NONE)
    linked = np.empty(k, dtype=np.bool_)  # whether a key comes after another of the same robot
    for b in range(k):
        linked[b] = previous[b] >= 0 and robots[previous[b]] == robots[b]
    for b in range(k):
        if linked[b]:
            a = previous[b]
            while linked[a] and not sighted[a] and not fresh[a]:
                if len(biases) > 0 and biases[b] >= 0:
                    value = poses[biases[b]]
                    chain_biased(motions[a], noises[a], jacobians[a], value, motions[b], noises[b], jacobians[b])
                else:
                    chain(motions[a], noises[a], motions[b], noises[b])
                a = previous[a]
            previous[b] = a
            following[a] = b
    before, left = previous.copy(), 0
    for b in range(k):
        roots[b] = b if not linked[b] or following[previous[b]] == b else NONE
        left += roots[b] == b
    while left > most_keys:
        best, least = NONE, np.inf
        for b in range(k):
            if linked[b] and roots[b] == b and not fresh[b]:
                price = costs[b] + rigid[before[b]] + rigid[b]
                if price < least:
                    best, least = b, price
        if best == NONE:
            break
        a, after = before[best], following[best]
        roots[best] = a
        rigid[a] += rigid[best] + costs[best]
        following[a] = after
        if after >= 0:
            before[after] = a
        left -= 1
    number = 0
    for b in range(k):
        if roots[b] == b:
            numbers[b] = number
            number += 1
    for b in range(k):
        if roots[b] == b or roots[b] == NONE:
            continue
        while roots[roots[b]] != roots[b]:
            roots[b] = roots[roots[b]]
        a = roots[b]
        c, s = math.cos(poses[a, 2]), math.sin(poses[a, 2])
        dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
        offsets[b, 0], offsets[b, 1] = c * dx + s * dy, -s * dx + c * dy
        offsets[b, 2] = (poses[b, 2] - poses[a, 2] + math.pi) % (2.0 * math.pi) - math.pi
    off = stack_array(3)
    for b in range(len(biases)):
        if biases[b] >= 0 and roots[b] != b and roots[b] != NONE:
            a, value = previous[b], biases[b]
            c, s = math.cos(poses[a, 2]), math.sin(poses[a, 2])
            dx, dy = poses[b, 0] - poses[a, 0], poses[b, 1] - poses[a, 1]
            off[0], off[1] = c * dx + s * dy - motions[b, 0], -s * dx + c * dy - motions[b, 1]
            off[2] = (poses[b, 2] - poses[a, 2] - motions[b, 2] + math.pi) % (2.0 * math.pi) - math.pi
            for i in range(3):
                for n in range(3):
                    off[i] += jacobians[b, i, n] * poses[value, n]
            absorb_odometry(off, noises[b], jacobians[b], costs[b], poses[value], motions[value], noises[value])
    for b in range(k):
        if roots[b] != b:
            continue
        a = previous[b]
        if a >= 0:
            previous[b] = numbers[roots[a]]
            if roots[a] != a:
                put_before(offsets[a], motions[b], noises[b])
                c, s = math.cos(offsets[a, 2]), math.sin(offsets[a, 2])
                for i in range(3):
                    x, y = jacobians[b, 0, i], jacobians[b, 1, i]
                    jacobians[b, 0, i], jacobians[b, 1, i] = c * x - s * y, s * x + c * y
        n = numbers[b]
        robots[n], previous[n], costs[n], rigid[n] = robots[b], previous[b], costs[b], rigid[b]
        for i in range(3):
            poses[n, i], motions[n, i] = poses[b, i], motions[b, i]
            for j in range(3):
                noises[n, i, j], jacobians[n, i, j] = noises[b, i, j], jacobians[b, i, j]
    return number, roots, numbers, offsets


@jit
def add_sightings(
    rows: IntArray, seen: LandmarkFactors, roots: IntArray, numbers: IntArray, offsets: FloatArray
) -> Condensed:
    """Move sightings to the keys to which theirs stand rigidly, add up the forms of each pair, and return the sums.

    A sum lies about the centre of its first part.

    Args:
        rows: (n,) which sightings, those of a landmark one after the other; reordered: by key in each landmark.
        seen: All sightings.
        roots, numbers, offsets: Results of `merge_keys`; keys of the sums have their new numbers.
    """
    n, keys, landmarks, counts = len(rows), seen.keys, seen.landmarks, seen.counts
    centres, infos, slopes = seen.linearisation_points, seen.information, seen.gradients
    for i in range(1, len(rows)):
        row, at = rows[i], i
        while at > 0 and landmarks[rows[at - 1]] == landmarks[row] and roots[keys[rows[at - 1]]] > roots[keys[row]]:
            rows[at] = rows[at - 1]
            at -= 1
        rows[at] = row
    new_keys, new_landmarks, new_counts = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.int64)
    new_centres, new_infos, new_slopes = np.empty((n, 3)), np.empty((n, 6)), np.empty((n, 3))
    num = 0
    info, own, slope = stack_array(6), stack_array(6), stack_array(3)
    for row in rows:
        key, landmark, offset = numbers[roots[keys[row]]], landmarks[row], offsets[keys[row]]
        x, y, z = centres[row, 0], centres[row, 1], centres[row, 2]
        for i in range(3):
            slope[i] = slopes[row, i]
        for i in range(6):
            info[i] = own[i] = infos[row, i]
        g0, g1, g2 = slope[0], slope[1], slope[2]
        if roots[keys[row]] != keys[row]:
            c, s = math.cos(offset[2]), math.sin(offset[2])
            x, y = c * x - s * y + offset[0], s * x + c * y + offset[1]
            g0, g1 = c * g0 - s * g1, s * g0 + c * g1
            _rotate_in_plane(c, s, own, info)
        if num > 0 and new_keys[num - 1] == key and new_landmarks[num - 1] == landmark:
            d0, d1, d2 = new_centres[num - 1, 0] - x, new_centres[num - 1, 1] - y, new_centres[num - 1, 2] - z
            new_slopes[num - 1, 0] += g0 - (info[0] * d0 + info[1] * d1 + info[2] * d2)
            new_slopes[num - 1, 1] += g1 - (info[1] * d0 + info[3] * d1 + info[4] * d2)
            new_slopes[num - 1, 2] += g2 - (info[2] * d0 + info[4] * d1 + info[5] * d2)
            for i in range(6):
                new_infos[num - 1, i] += info[i]
            new_counts[num - 1] += counts[row]
            continue
        new_keys[num], new_landmarks[num], new_counts[num] = key, landmark, counts[row]
        new_centres[num, 0], new_centres[num, 1], new_centres[num, 2] = x, y, z
        new_slopes[num, 0], new_slopes[num, 1], new_slopes[num, 2] = g0, g1, g2
        for i in range(6):
            new_infos[num, i] = info[i]
        num += 1
    return Condensed(
        new_keys[:num], new_landmarks[:num], new_centres[:num], new_infos[:num], new_slopes[:num], new_counts[:num]
    )
