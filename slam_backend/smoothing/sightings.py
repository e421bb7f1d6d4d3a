"""`Sightings`: all that was measured from key poses, one quadratic form for each pair of key and landmark."""

from typing import NamedTuple, Self

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.smoothing import _kernels
from slam_backend.smoothing.graph import PathGraph


class Sightings(NamedTuple):
    """Forms of s sightings, by landmark; those of raw measurements change with the point of linearisation.

    Attributes:
        keys, landmarks: (s,) int64.
        starts: (l + 1,) int64. Those of landmark i are starts[i] to starts[i + 1].
        frozen: (s,) bool.
        centres, infos, slopes: (s, 3), (s, 6), (s, 3) float64. See `_kernels.forms`.
        counts: (s,) int64. Measurements in each.
        of_points: (n,) int64. Sighting of each raw measurement.
        squares: (n,) float64. Squared Mahalanobis distance of each, where it was last linearised.
    """

    keys: IntArray
    landmarks: IntArray
    starts: IntArray
    frozen: BoolArray
    centres: FloatArray
    infos: FloatArray
    slopes: FloatArray
    counts: IntArray
    of_points: IntArray
    squares: FloatArray

    @classmethod
    def of(cls, graph: PathGraph) -> Self:
        """Gather a graph's sightings; those of raw measurements are still to be linearised."""
        most, n = len(graph.frozen_keys) + len(graph.points), len(graph.points)
        keys, landmarks, counts = (np.empty(most, dtype=np.int64) for _ in range(3))
        starts, of_points = np.empty(len(graph.landmark_ids) + 1, dtype=np.int64), np.empty(n, dtype=np.int64)
        frozen = np.empty(most, dtype=np.bool_)
        centres, infos, slopes = np.empty((most, 3)), np.empty((most, 6)), np.empty((most, 3))
        num = _kernels.gather(
            graph.frozen_keys, graph.frozen_landmarks, graph.centres, graph.infos, graph.slopes, graph.counts,
            graph.point_frames, graph.point_landmarks, graph.frame_keys, graph.num_keys, keys, landmarks, starts,
            frozen, centres, infos, slopes, counts, of_points,
        )  # fmt: skip
        return cls(
            keys[:num], landmarks[:num], starts, frozen[:num], centres[:num], infos[:num], slopes[:num], counts[:num],
            of_points, np.zeros(n),
        )  # fmt: skip

    def linearise(
        self, graph: PathGraph, poses: FloatArray, landmarks: FloatArray, camera: FloatArray, scale: float,
        kernel: float,
    ) -> float:  # fmt: skip
        """Linearise the raw measurements, whose forms and `squares` are written.

        Args:
            graph: Which these sightings are of.
            poses: (k, 3) float64 [m, m, rad], map frame. Where to linearise.
            landmarks: (l, 3) float64 [m], map frame. Likewise.
            camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
            scale: Of all measurement covariances.
            kernel: Squared distance above which a measurement loses weight, 0: none does.

        Returns:
            Half the sum of their (robust) squared distances.
        """
        return _kernels.condense(
            graph.points, graph.point_noises, graph.given, graph.point_frames, self.of_points, graph.frame_keys,
            graph.frame_offsets, poses, landmarks, self.keys, self.landmarks, self.frozen, camera, scale, kernel,
            self.centres, self.infos, self.slopes, self.squares,
        )  # fmt: skip
