"""Initial estimates of the motion between two maps, from candidate matches or nearest landmarks.

`svd` is the closed form over all candidates. `icp` is that of Besl and McKay (1992), which pairs each landmark with the
closest, with far pairs left out as by Zhang (1994), because maps overlap only in part. `impicp` is the improved ICP of
Ballesta et al. (2010), of which we know only the idea: two starts from two sets of matches, the better end is kept.
"""

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.maps.registration import squared_distances
from slam_backend.metrics import align_se2

ICP_ROUNDS = 50
ICP_FAR = 3.0  # largest distance of a pair over the median


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
    scores = [np.maximum(0.0, 1.0 - squared_distances(table, end, floor) / gate).sum() for end in ends]
    return ends[int(np.argmax(scores))]
