"""Landmarks that a smoothed path reveals to be one: they look alike, lie in one place, and were never seen together."""

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from slam_backend._packed import UNPACK
from slam_backend.errors import FloatArray, IntArray
from slam_backend.smoothing.graph import PathGraph
from slam_backend.smoothing.sampling import Draws
from slam_backend.smoothing.solving import Mode

REACH = 0.5  # [m]; no duplicates are sought farther apart
GATE = 7.81  # squared Mahalanobis distance, 95 % of 3 degrees of freedom


def find_duplicates(
    graph: PathGraph, mode: Mode, draws: Draws, descriptors: NDArray[np.float32], descriptor_gate: float
) -> IntArray:
    """Return rows (id to give up, id to keep), each landmark in at most one of them; the older id is kept.

    The difference of two landmarks scatters by their own covariances and by the paths: both are in the draws.

    Args:
        graph: What was seen from which key.
        mode: Of it.
        draws: Paths with their landmarks.
        descriptors: (l, d) by row of `graph.landmark_ids`; NaN for a landmark that is not to be touched.
        descriptor_gate: L2 distance beyond which two do not look alike.
    """
    seen = mode.sightings
    usable = np.flatnonzero((np.diff(seen.starts) > 0) & np.isfinite(descriptors).all(axis=1))
    if len(usable) < 2:
        return np.zeros((0, 2), dtype=np.int64)
    found: list[tuple[float, int, int]] = []
    for i, j in cKDTree(mode.landmarks[usable]).query_pairs(REACH, output_type="ndarray"):
        a, b = int(usable[i]), int(usable[j])
        if np.linalg.norm(descriptors[a] - descriptors[b]) > descriptor_gate:
            continue
        keys_a, keys_b = seen.keys[seen.starts[a] : seen.starts[a + 1]], seen.keys[seen.starts[b] : seen.starts[b + 1]]
        if np.intersect1d(keys_a, keys_b).size:
            continue
        distance = _distance(_values(draws, a), _values(draws, b))
        if distance <= GATE:
            found.append((distance, a, b))
    taken: set[int] = set()
    rows = []
    for _, a, b in sorted(found):
        if a not in taken and b not in taken:
            taken |= {a, b}
            rows.append(sorted((int(graph.landmark_ids[a]), int(graph.landmark_ids[b])), reverse=True))
    return np.array(rows, dtype=np.int64).reshape(-1, 2)


def _values(draws: Draws, row: int) -> FloatArray:
    """Return means and covariances (9, M) of one landmark."""
    return np.asarray(draws.tiles[row].transpose(1, 0, 2).reshape(9, -1)[:, : draws.poses.shape[2]])


def _distance(a: FloatArray, b: FloatArray) -> float:
    """Return the squared Mahalanobis distance of two landmarks (9, M), paths included, at the first path."""
    apart = a[:3] - b[:3]
    scatter = apart[:, 1:] - apart[:, :1]
    covariance = (a[3:, 0] + b[3:, 0])[UNPACK] + scatter @ scatter.T / max(scatter.shape[1], 1)
    return float(apart[:, 0] @ np.linalg.solve(covariance, apart[:, 0]))


def without_duplicates(graph: PathGraph, duplicates: IntArray) -> PathGraph:
    """Return the graph in which each given-up landmark (rows of `find_duplicates`) is the one that is kept."""
    if not len(duplicates):
        return graph
    row = {int(name): i for i, name in enumerate(graph.landmark_ids)}
    new = np.arange(len(graph.landmark_ids))
    known = [(row[int(old)], row[int(kept)]) for old, kept in duplicates if int(old) in row and int(kept) in row]
    for old, kept in known:
        new[old] = kept
    return graph.with_columns(
        point_landmarks=new[graph.point_landmarks],
        frozen_landmarks=new[graph.frozen_landmarks],
        aliases=np.concatenate([graph.aliases, duplicates]),
    )
