"""`rejuvenate`: new particles from the posterior of whole paths, in place of those that resampling has impoverished."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from slam_backend.errors import FloatArray, IntArray
from slam_backend.geometry import wrap_angle
from slam_backend.log_arrays import LogArrays
from slam_backend.motion import OdometryModel
from slam_backend.resampling import effective_sample_size
from slam_backend.smoothing.coarsening import coarsened
from slam_backend.smoothing.graph import PathGraph, extended
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.smoothing.sampling import draw_paths
from slam_backend.smoothing.solving import find_mode


@dataclass(frozen=True, slots=True, eq=False)
class Rejuvenation:
    """What came of an attempt.

    Attributes:
        graph: To go on with next time.
        reason: Why there are no new particles; "" if there are.
        ess: Effective sample size of the importance weights, in [1, M]; NaN if it did not come to that.
        iterations: Of the descent.
        poses: (K, 3, M) float64 [m, m, rad], map frame. Newest pose of each robot.
        log_weights: (M,) float64, normalised.
        ids: (l,) int64. Landmarks that have a sighting.
        landmarks: (l, 9, M) float64. Their means (3) and covariances (6).
        counts: (l,) int64. Measurements of each.
        means, covariances: (K, 3), (K, 3, 3) float64. The newest poses under the Gaussian about the mode.
    """

    graph: PathGraph
    reason: str
    ess: float
    iterations: int
    poses: FloatArray
    log_weights: FloatArray
    ids: IntArray
    landmarks: FloatArray
    counts: IntArray
    means: FloatArray
    covariances: FloatArray


def rejuvenate(
    graph: PathGraph,
    logs: Sequence[LogArrays],
    motion: OdometryModel,
    camera: FloatArray,
    num_particles: int,
    rng: np.random.Generator,
    options: SmoothingOptions,
    guesses: Sequence[Mapping[int, FloatArray]] | None = None,
) -> Rejuvenation:
    """Take in what the robots did since, smooth, and draw M particles."""
    grown = extended(graph, logs, motion, camera[4:], guesses)
    mode = find_mode(grown, camera, options)
    k = len(graph.tips)
    if mode.reason:
        none = np.zeros((0, 9, num_particles))
        return Rejuvenation(
            grown, mode.reason, float("nan"), mode.iterations, np.zeros((k, 3, num_particles)),
            np.zeros(num_particles), np.zeros(0, dtype=np.int64), none, np.zeros(0, dtype=np.int64), np.zeros((k, 3)),
            np.zeros((k, 3, 3)),
        )  # fmt: skip
    draws = draw_paths(grown, mode, num_particles, rng)
    weights = np.exp(draws.log_weights - draws.log_weights.max())
    weights /= weights.sum()
    ess = effective_sample_size(weights)
    reason = "" if ess >= options.least_ess * num_particles else f"an effective sample size of {ess:.1f}"
    counts = np.bincount(mode.sightings.landmarks, weights=mode.sightings.counts, minlength=len(grown.landmark_ids))
    seen = counts > 0
    poses = draws.poses[grown.tips]
    poses[:, 2] = wrap_angle(poses[:, 2])
    means = mode.poses[grown.tips].copy()
    means[:, 2] = wrap_angle(means[:, 2])
    fewer = coarsened(grown, mode, draws.spreads, options.max_keys, options.fresh_keys)
    return Rejuvenation(
        fewer, reason, ess, mode.iterations, poses, np.log(weights), grown.landmark_ids[seen], draws.landmarks[seen],
        counts[seen].astype(np.int64), means,
        _covariances(mode.factor, mode.columns[grown.tips]),
    )  # fmt: skip


def _covariances(factor: FloatArray, columns: IntArray) -> FloatArray:
    """Return the marginal covariances (K, 3, 3) of poses, from the factor U of the information U^T U."""
    result = np.zeros((len(columns), 3, 3))
    for robot, first in enumerate(columns):
        if first >= 0:
            unit = np.zeros((len(factor), 3), order="F")
            unit[first + np.arange(3), np.arange(3)] = 1.0
            half = lapack.dtrtrs(factor, unit, lower=0, trans=1)[0]
            result[robot] = half.T @ half
    return result
