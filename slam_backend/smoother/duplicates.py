"""Detection of duplicate landmarks: similar descriptors, one position on the smoothed path, no common keyframe."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.optimizer import MapEstimate
from slam_backend.smoother.sampling import PathSamples, lane_rows, replay

REACH = 0.5  # [m]; largest distance of duplicates
GATE = 7.81  # squared Mahalanobis distance, 95 % of 3 degrees of freedom


def find_duplicates(
    graph: SlamGraph, mode: MapEstimate, draws: PathSamples, descriptors: NDArray[np.float32], descriptor_gate: float
) -> IntArray:
    """Return rows (id to drop, id to keep), each landmark in at most one of them; the older id is kept.

    The covariance of a difference has two parts, both from the draws: the landmarks' own covariances and the scatter of
    the paths.

    Args:
        graph: Pose-landmark graph.
        mode: MAP estimate of the graph.
        draws: Paths drawn about it.
        descriptors: (l, d) by row of `graph.landmark_ids`; NaN for a landmark that must stay as it is.
        descriptor_gate: Largest L2 distance of similar descriptors.
    """
    seen = mode.sightings
    pairs = similar_pairs(mode.landmarks, descriptors, seen.keys, seen.starts, REACH, descriptor_gate)
    if not len(pairs):
        return pairs
    taken: set[int] = set()
    rows = []
    for _, a, b in sorted(_together(mode, draws, pairs)):
        if a not in taken and b not in taken:
            taken |= {a, b}
            rows.append(sorted((int(graph.landmark_ids[a]), int(graph.landmark_ids[b])), reverse=True))
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def similar_pairs(
    landmarks: FloatArray, descriptors: NDArray[np.float32], keys: IntArray, starts: IntArray, reach: float, gate: float
) -> IntArray:
    """Return pairs (n, 2) of landmarks that are near, have similar descriptors and have no key in common.

    Args:
        landmarks: (l, 3) float64 [m].
        descriptors: (l, d) float32. A descriptor with NaN is similar to none.
        keys, starts: (s,), (l + 1,) int64. Key of each sighting; landmark i has the rows starts[i] to starts[i + 1]. A
            landmark without sightings is in no pair.
        reach: Largest distance of a pair [m].
        gate: Largest L2 distance of similar descriptors.
    """
    pairs = KDTree(landmarks).query_pairs(reach, output_type="ndarray").reshape(-1, 2)
    pairs = pairs[np.linalg.norm(descriptors[pairs[:, 0]] - descriptors[pairs[:, 1]], axis=1) <= gate]
    keys_of = {i: set(keys[starts[i] : starts[i + 1]].tolist()) for i in np.unique(pairs).tolist()}
    apart = [bool(keys_of[a] and keys_of[b]) and keys_of[a].isdisjoint(keys_of[b]) for a, b in pairs.tolist()]
    return np.asarray(pairs[np.array(apart, np.bool_)], np.int64)


@single_threaded_blas
def _together(mode: MapEstimate, draws: PathSamples, pairs: IntArray) -> list[tuple[float, int, int]]:
    """Return (squared Mahalanobis distance, a, b) of the pairs (n, 2) within the gate."""
    rows, num_paths = np.unique(pairs), draws.poses.shape[2]
    tiles, _ = replay(mode, lane_rows(draws.poses), num_paths, rows)
    values = tiles.transpose(0, 2, 1, 3).reshape(len(rows), 9, -1)[:, :, :num_paths]
    found = []
    for a, b in pairs.tolist():
        distance = _distance(*values[np.searchsorted(rows, (a, b))])
        if distance <= GATE:
            found.append((distance, a, b))
    return found


def _distance(a: FloatArray, b: FloatArray) -> float:
    """Return the squared Mahalanobis distance of two landmarks (9, M) at the first path, scatter of paths included."""
    apart = a[:3] - b[:3]
    scatter = apart[:, 1:] - apart[:, :1]
    covariance = (a[3:, 0] + b[3:, 0])[UNPACK_INDEX] + scatter @ scatter.T / max(scatter.shape[1], 1)
    return float(apart[:, 0] @ np.linalg.solve(covariance, apart[:, 0]))


def without_duplicates(graph: SlamGraph, duplicates: IntArray) -> SlamGraph:
    """Return the graph with duplicate landmarks (rows of `find_duplicates`) joined."""
    if not len(duplicates):
        return graph
    row = {int(name): i for i, name in enumerate(graph.landmark_ids)}
    new = np.arange(len(graph.landmark_ids))
    known = [(row[int(old)], row[int(kept)]) for old, kept in duplicates if int(old) in row and int(kept) in row]
    for old, kept in known:
        new[old] = kept
    return graph.with_columns(
        point_landmarks=new[graph.point_landmarks],
        condensed_landmarks=new[graph.condensed_landmarks],
        merged_ids=np.concatenate([graph.merged_ids, duplicates]),
    )
