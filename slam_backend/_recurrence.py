"""Whether the constellation that two maps share occurs elsewhere in one of them: then it could be any of these places.

Posters of one print hang on every wall: the landmarks of three of them fit those of any other three. Which of the many
look-alikes in the other map are meant is not asked where there are too many of them, so that no rival motion may show.
But the map itself then fits onto itself by a motion that is none of standing still.
"""

import math

import numpy as np
from scipy.special import bdtrc

from slam_backend import _alignment_kernels as kernels
from slam_backend._candidates import match_table
from slam_backend._evidence import differ, fitting
from slam_backend._matching import look_alikes
from slam_backend.alignment_types import RIVAL_DISTANCE, AlignmentOptions
from slam_backend.errors import FloatArray, IntArray
from slam_backend.landmark_map import LandmarkMap

MOST_RECURRING = 0.2  # of the shared landmarks, but for the two that any motion can be made to fit
NEEDLESS = 0.05  # how often a right alignment may be refused because chance makes a double: it is tried again later
MOST_LANDMARKS = 200  # of a constellation that are looked at, every so many-th of it
MOST_ALIKE = 50  # landmarks with more look-alikes than this tell nothing
SAMPLES = 4000  # pairs of pairs that are tried
STRONGEST = 3  # motions that are refined


def recurs(landmarks: LandmarkMap, rows: IntArray, variance: float, options: AlignmentOptions) -> bool:
    """Tell whether a constellation of a map occurs in it a second time, as far as two maps of one place agree.

    It does if by some motion a fifth of its landmarks come to lie on landmarks that look like them, and so many would
    do so by chance, among as many look-alikes spread over the map, in less than one of twenty maps.

    Args:
        landmarks: The map.
        rows: (k,) int64. The constellation.
        variance: Scale of the differences between the two maps [m^2].
        options: Gates.
    """
    points, variance = landmarks.means, max(variance, options.position_floor**2)
    rows = rows[:: 1 + len(rows) // MOST_LANDMARKS]
    looks = landmarks.descriptors
    pairs = look_alikes(looks[rows], looks, options.descriptor_gate, MOST_ALIKE)
    matches = np.column_stack([rows[pairs[:, 0]], pairs[:, 1]])
    apart = points[matches[:, 0]] - points[matches[:, 1]]
    climb = landmarks.covariances[matches, 2, 2].sum(axis=1) + variance
    level = apart[:, 2] ** 2 <= options.position_gate * climb
    matches = matches[level & (np.hypot(apart[:, 0], apart[:, 1]) > RIVAL_DISTANCE)]
    beyond = max(3, math.ceil(MOST_RECURRING * (len(rows) - 2)))
    if len(np.unique(matches[:, 0])) < beyond + 2:
        return False
    table = match_table(landmarks, landmarks, matches[:, ::-1])  # motions take the constellation, as b, to its double
    count = len(matches) * (len(matches) - 1) // 2
    samples = np.random.default_rng(0).integers(0, count, min(SAMPLES, count))
    found = kernels.search(
        table, samples, variance, options.position_gate, 0.25 * options.min_spread, beyond + 2, options.max_ratio,
        math.log(1.0 - options.success_probability),
    )  # fmt: skip
    found = found[differ(found[:, :3], np.zeros(3), points[rows, :2].mean(axis=0))]
    chance = _chance(table, landmarks, matches, len(rows), variance, options)
    for start in found[np.argsort(-found[:, 3], kind="stable")[:STRONGEST], :3]:
        pose = kernels.refine(table, start.copy(), variance, options.position_gate)[0]
        more = np.count_nonzero(fitting(table, matches, pose, variance, options.position_gate)) - 2
        if more >= beyond and count * bdtrc(more - 1, len(rows) - 2, chance) <= NEEDLESS:
            return True
    return False


def _chance(
    table: FloatArray, landmarks: LandmarkMap, matches: IntArray, size: int, variance: float, options: AlignmentOptions
) -> float:
    """Return the mean probability that a landmark has a look-alike near where some motion takes it, by chance."""
    spread = (table[:, 6] + table[:, 9] + table[:, 12] + table[:, 15]) / 2.0 + variance
    area = np.prod(np.ptp(landmarks.means[:, :2], axis=0))
    share = np.minimum(np.pi * options.position_gate * spread / max(area, 1e-9), 1.0)
    owners = np.unique(matches[:, 0], return_inverse=True)[1]
    return float((1.0 - np.exp(-np.bincount(owners, share))).sum() / size)
