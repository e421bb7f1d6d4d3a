"""`Sightings`: all that was measured from key poses, one quadratic form for each pair of key and landmark."""

from dataclasses import dataclass
from typing import Self

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.smoothing import _kernels
from slam_backend.smoothing.graph import PathGraph


@dataclass(frozen=True, slots=True, eq=False)
class Sightings:
    """Forms of s sightings, by landmark; those of raw measurements change with the point of linearisation.

    Attributes:
        keys, landmarks: (s,) int64.
        starts: (l + 1,) int64. Those of landmark i are starts[i] to starts[i + 1].
        frozen: (s,) bool.
        centres, infos, slopes: (s, 3), (s, 6), (s, 3) float64. See `_kernels`.
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
        k = graph.num_keys
        codes = graph.point_landmarks * k + graph.frame_keys[graph.point_frames]
        raw, of_points, counts = np.unique(codes, return_inverse=True, return_counts=True)
        every = np.concatenate([graph.frozen_landmarks * k + graph.frozen_keys, raw])
        order = np.argsort(every, kind="stable")
        place = np.empty(len(order), dtype=np.int64)
        place[order] = np.arange(len(order))
        num_frozen = len(graph.frozen_keys)
        landmarks, keys = np.divmod(every[order], k)

        def placed(frozen: FloatArray) -> FloatArray:
            result = np.zeros((len(order), frozen.shape[1]))
            result[place[:num_frozen]] = frozen
            return result

        return cls(
            keys=keys,
            landmarks=landmarks,
            starts=np.searchsorted(landmarks, np.arange(len(graph.landmark_ids) + 1)),
            frozen=order < num_frozen,
            centres=placed(graph.centres),
            infos=placed(graph.infos),
            slopes=placed(graph.slopes),
            counts=np.concatenate([graph.counts, counts])[order],
            of_points=place[num_frozen + of_points],
            squares=np.zeros(len(codes)),
        )

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
