"""The search for the motion that most matches fit: hypotheses from pairs of them, each locally optimised."""

import math

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import cosine_sine, transform_points, wrap_angle
from slam_backend.maps.alignment_types import FEWEST_INLIERS
from slam_backend.maps.registration import gauss_newton_step, squared_distances

SAME_DISTANCE, SAME_ANGLE = 0.25, math.radians(2.5)  # half of what makes two alignments differ
FEWEST, MOST = 2**13, 2**16  # residuals that are computed together


def motions_of_pairs(
    table: FloatArray, i: IntArray, j: IntArray, floor: float, gate: float, min_baseline: float
) -> tuple[FloatArray, IntArray]:
    """Return the motions (h, 3) that pairs of matches suggest, and their first matches (h,).

    Pairs whose distances disagree in the two maps, or are too short, are left out.
    """
    a, b = table[:, :2], table[:, 3:5]
    with np.errstate(divide="ignore", invalid="ignore"):
        ab = a[j] - a[i], b[j] - b[i]
        (length_a, u), (length_b, v) = ((length := np.hypot(*d.T), d / length[:, None]) for d in ab)
    spread = 2.0 * floor
    for first, (x, y) in ((6, u.T), (12, v.T)):
        xx, xy, yy = (table[i, first + part] + table[j, first + part] for part in (0, 1, 3))
        spread = spread + x * x * xx + 2.0 * x * y * xy + y * y * yy
    fits = (np.minimum(length_a, length_b) > min_baseline) & ((length_a - length_b) ** 2 <= gate * spread)
    i, j, u, v = i[fits], j[fits], u[fits], v[fits]
    sines, cosines = v[:, 0] * u[:, 1] - v[:, 1] * u[:, 0], (u * v).sum(axis=1)
    headings = np.array([math.atan2(y, x) for y, x in zip(sines.tolist(), cosines.tolist(), strict=True)])
    cos, sin = cosine_sine(headings)
    centre_a, (x, y) = 0.5 * (a[i] + a[j]), 0.5 * (b[i] + b[j]).T
    return np.column_stack([centre_a[:, 0] - cos * x + sin * y, centre_a[:, 1] - sin * x - cos * y, headings]), i


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
        (h, 5) rows (tx, ty, theta, inliers, score) of all hypotheses with at least `FEWEST_INLIERS` inliers; the score
        is the sum of 1 - D / gate over the inliers.
    """
    found, most, best = [np.empty((0, 5))], min_inliers, np.full(3, np.nan)
    drawn, batch = 0, max(FEWEST // len(table), 1)
    while drawn < len(samples):
        # Half of the pairs of a consensus set are taken to lie too close together to be useful.
        if drawn >= log_failure / math.log(1.0 - 0.5 * min(max_ratio * most / len(table), 1.0) ** 2):
            break
        n = samples[drawn : drawn + batch]
        drawn, batch = drawn + batch, max(min(2 * batch, MOST // len(table)), 1)
        i = ((1.0 + np.sqrt(1.0 + 8.0 * n)) // 2.0).astype(np.int64)
        i -= i * (i - 1) // 2 > n
        i += i * (i + 1) // 2 <= n
        motions, first = motions_of_pairs(table, i, n - i * (i - 1) // 2, floor, gate, min_baseline)
        # Refining a motion that agrees with the best one about a landmark of b would waste time.
        apart = np.hypot(*(moved(motions, table[first, 3:5]) - transform_points(best, table[first, 3:5])).T)
        turned = np.abs(wrap_angle(motions[:, 2] - best[2]))
        motions = motions[~((turned < SAME_ANGLE) & (apart < SAME_DISTANCE))]
        # Two noisy points aim badly at far ones: the first set is taken at twice the distance.
        members = squared_distances(table, motions, floor) <= 4.0 * gate
        for _ in range(2):
            enough = members.sum(axis=1) >= FEWEST_INLIERS
            motions = gauss_newton_step(table, members[enough], motions[enough], floor)
            distances = squared_distances(table, motions, floor)
            members = distances <= gate
        counts, scores = members.sum(axis=1), np.where(members, 1.0 - distances / gate, 0.0).sum(axis=1)
        found.append(np.column_stack([motions, counts, scores])[counts >= FEWEST_INLIERS])
        if counts.max(initial=0) > most:
            most, best = int(counts.max()), motions[counts.argmax()]
    return np.concatenate(found)


def moved(motions: FloatArray, points: FloatArray) -> FloatArray:
    """Return points (h, 2) [m], each moved by its own motion (h, 3)."""
    cos, sin = cosine_sine(motions[:, 2])
    x, y = points.T
    return np.column_stack([motions[:, 0] + cos * x - sin * y, motions[:, 1] + sin * x + cos * y])
