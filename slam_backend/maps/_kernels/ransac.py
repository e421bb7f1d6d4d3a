"""The search for the motion that most matches fit: hypotheses from pairs of them, each locally optimised."""

import math

import numpy as np

from slam_backend.core.jit import device, jit
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.maps._kernels.registration import gauss_newton_step, support
from slam_backend.maps.alignment_types import FEWEST_INLIERS

SAME_DISTANCE, SAME_ANGLE = 0.25, math.radians(2.5)  # half of what makes two alignments differ


@device
@jit
def _pose_from_two(table: FloatArray, i: int, j: int, gate: float, floor: float, min_baseline: float) -> FloatArray:
    """Return the rigid motion (3,) that two candidates suggest; NaN if their distances disagree or are too short."""
    ax, ay = table[j, 0] - table[i, 0], table[j, 1] - table[i, 1]
    bx, by = table[j, 3] - table[i, 3], table[j, 4] - table[i, 4]
    length_a, length_b = math.hypot(ax, ay), math.hypot(bx, by)
    if min(length_a, length_b) <= min_baseline:
        return np.full(3, np.nan)
    ux, uy, vx, vy = ax / length_a, ay / length_a, bx / length_b, by / length_b
    variance = 2.0 * floor
    for m in (i, j):
        variance += ux * ux * table[m, 6] + 2.0 * ux * uy * table[m, 7] + uy * uy * table[m, 9]
        variance += vx * vx * table[m, 12] + 2.0 * vx * vy * table[m, 13] + vy * vy * table[m, 15]
    if (length_a - length_b) ** 2 > gate * variance:
        return np.full(3, np.nan)
    theta = math.atan2(vx * uy - vy * ux, ux * vx + uy * vy)
    cos, sin = math.cos(theta), math.sin(theta)
    mx, my = 0.5 * (table[i, 3] + table[j, 3]), 0.5 * (table[i, 4] + table[j, 4])
    tx = 0.5 * (table[i, 0] + table[j, 0]) - cos * mx + sin * my
    ty = 0.5 * (table[i, 1] + table[j, 1]) - sin * mx - cos * my
    return np.array([tx, ty, theta])


@jit
def search(
    table: FloatArray,
    samples: IntArray,
    floor: float,
    gate: float,
    min_baseline: float,
    min_inliers: int,
    max_ratio: float,
    log_failure: float,
) -> FloatArray:
    """Turn minimal samples into locally optimised hypotheses, until enough samples have been drawn.

    A sample is the number n of a pair (i, j), j < i, with n = i (i - 1) / 2 + j. Drawing stops when a consensus set
    of `max_ratio` times the best one's size would have been sampled with probability 1 - exp(log_failure): so the
    best is found, and every rival that would make it ambiguous.

    Returns:
        (h, 5) rows (tx, ty, theta, inliers, score) of all hypotheses with at least `FEWEST_INLIERS` inliers.
    """
    found = np.empty((len(samples), 5))
    members = np.zeros(len(table), np.bool_)
    h, most, best = 0, min_inliers, np.full(3, np.nan)
    considered, needed = 0, 0.0
    for drawn in range(len(samples)):
        if considered != most:  # half of the pairs of a consensus set are taken to lie too close together to be useful
            considered = most
            needed = log_failure / math.log(1.0 - 0.5 * min(max_ratio * most / len(table), 1.0) ** 2)
        if drawn >= needed:
            break
        n = samples[drawn]
        i = int((1.0 + math.sqrt(1.0 + 8.0 * n)) // 2.0)
        i -= i * (i - 1) // 2 > n
        i += i * (i + 1) // 2 <= n
        pose = _pose_from_two(table, i, n - i * (i - 1) // 2, gate, floor, min_baseline)
        if math.isnan(pose[0]):
            continue
        # Refining a pose that agrees with the best one about a landmark of b would waste time.
        turned = abs((pose[2] - best[2] + math.pi) % (2.0 * math.pi) - math.pi)
        cos, sin = math.cos(pose[2]) - math.cos(best[2]), math.sin(pose[2]) - math.sin(best[2])
        x, y = table[i, 3], table[i, 4]
        apart = math.hypot(pose[0] - best[0] + cos * x - sin * y, pose[1] - best[1] + sin * x + cos * y)
        if turned < SAME_ANGLE and apart < SAME_DISTANCE:
            continue
        # Two noisy points aim badly at far ones: the first set is taken at twice the distance.
        count, score = support(table, pose, floor, 4.0 * gate, members)
        for _ in range(2):
            if count < FEWEST_INLIERS:
                break
            pose = gauss_newton_step(table, members, pose, floor)
            count, score = support(table, pose, floor, gate, members)
        if count >= FEWEST_INLIERS:
            found[h, 0], found[h, 1], found[h, 2], found[h, 3], found[h, 4] = pose[0], pose[1], pose[2], count, score
            h += 1
            if count > most:
                most, best = count, pose
    return found[:h]
