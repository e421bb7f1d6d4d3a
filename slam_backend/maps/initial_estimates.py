"""Initial estimates of the motion between two maps, from candidate matches or nearest landmarks.

`svd` is the closed form over all candidates. `icp` is that of Besl and McKay (1992), which pairs each landmark with the
closest, with far pairs left out as by Zhang (1994), because maps overlap only in part. `impicp` is the improved ICP of
Ballesta et al. (2010), of which we know only the idea: two starts from two sets of matches, the better end is kept.
`gnc` is graduated non-convexity with truncated least squares (Yang, Antonante, Tzoumas and Carlone 2020). `clique` is
the largest set of candidates that agree pairwise (`_kernels.max_clique`).
"""

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import transform_points
from slam_backend.maps import _kernels as kernels
from slam_backend.maps._kernels import max_clique as cliques
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.metrics import align_se2

ICP_ROUNDS = 50
ICP_FAR = 3.0  # largest distance of a pair over the median
GNC_FACTOR = 1.4  # growth of the control parameter per round (Yang et al., Sec. V)
GNC_ROUNDS = 100
MOST_IN_GRAPH = 1000  # candidates in a graph, one megabyte of pairs
MAX_NODES = 20_000  # nodes of the clique search


def icp(map_a: LandmarkMap, map_b: LandmarkMap, start: FloatArray) -> FloatArray:
    """Return the motion (3,) of iterative closest point (ICP).

    Args:
        map_a: Map in the target frame a.
        map_b: Map in frame b.
        start: (3,) Initial motion a_from_b [m, m, rad].
    """
    from scipy.spatial import KDTree  # slow to import, and not always needed

    tree = KDTree(map_a.means)
    pose, before = start, np.empty((0, 2), np.int64)
    for _ in range(ICP_ROUNDS):
        distances, rows_a = tree.query(transform_points(pose, map_b.means))
        near = np.flatnonzero(distances <= ICP_FAR * np.median(distances))
        pairs = np.column_stack([np.asarray(rows_a)[near], near])
        if len(near) < 2 or np.array_equal(pairs, before):
            break
        pose = align_se2(map_a.means[pairs[:, 0], :2], map_b.means[pairs[:, 1], :2])
        before = pairs
    return pose


def improved_icp(
    map_a: LandmarkMap, map_b: LandmarkMap, matches: IntArray, table: FloatArray, floor: float, gate: float
) -> FloatArray:
    """Return the better result of ICP from two starts: all candidates, and the half with the most similar descriptors.

    The better result has the larger support of candidates, weighted by their fit.
    """
    unlike = np.linalg.norm(map_a.descriptors[matches[:, 0]] - map_b.descriptors[matches[:, 1]], axis=1)
    closer = matches[unlike <= np.median(unlike)]
    starts = (align_se2(map_a.means[some[:, 0], :2], map_b.means[some[:, 1], :2]) for some in (matches, closer))
    ends = [icp(map_a, map_b, start) for start in starts]
    scores = [np.maximum(0.0, 1.0 - kernels.squared_distances(table, end, floor) / gate).sum() for end in ends]
    return ends[int(np.argmax(scores))]


def gnc_tls(table: FloatArray, floor: float, gate: float) -> FloatArray:
    """Return the motion (3,) of truncated least squares, by graduated non-convexity.

    Args:
        table: (k, 18) candidates.
        floor: Variance added to each residual [m^2].
        gate: Squared residual c^2, in units of its variance, at which the cost of a match is truncated.
    """
    a, b = kernels.planar_points(table)
    # The solver inside is a closed form, which asks for one variance per match in place of a covariance.
    variance = kernels.planar_variances(table) + floor
    weights = np.ones(len(table))
    pose = align_se2(a, b, weights / variance)
    squares = _squares(pose, a, b, variance)
    if 2.0 * squares.max() <= gate:
        return pose
    mu = gate / (2.0 * squares.max() - gate)
    for _ in range(GNC_ROUNDS):
        low, high = mu / (mu + 1.0) * gate, (mu + 1.0) / mu * gate
        between = np.sqrt(gate * mu * (mu + 1.0) / np.maximum(squares, 1e-300)) - mu  # Eq. 14 of Yang et al.
        weights = np.where(squares >= high, 0.0, np.where(squares <= low, 1.0, between))
        if np.count_nonzero(weights) < 2:
            break
        pose = align_se2(a, b, weights / variance)
        squares = _squares(pose, a, b, variance)
        if ((weights == 0.0) | (weights == 1.0)).all():
            break
        mu *= GNC_FACTOR
    return pose


def clique_estimate(table: FloatArray, matches: IntArray, unlike: FloatArray, floor: float, gate: float) -> FloatArray:
    """Return the motion (3,) fitted to the largest set of candidates with pairwise consistent distances.

    Args:
        table: (k, 18) candidates.
        matches: (k, 2) rows (a, b) of the candidates.
        unlike: (k,) Descriptor distances; of more than `MOST_IN_GRAPH` candidates the most similar are used.
        floor: Variance added in each map [m^2].
        gate: Gate of the consistency test.
    """
    chosen = np.sort(np.argsort(unlike, kind="stable")[:MOST_IN_GRAPH])
    agrees = cliques.agreement(table[chosen], matches[chosen], floor, gate)
    members = chosen[cliques.largest_clique(agrees, MAX_NODES)]
    return align_se2(*kernels.planar_points(table[members]))


def _squares(pose: FloatArray, a: FloatArray, b: FloatArray, variance: FloatArray) -> FloatArray:
    """Return squared residuals (k,) over their variances."""
    return np.asarray(((a - transform_points(pose, b)) ** 2).sum(axis=1) / variance)
