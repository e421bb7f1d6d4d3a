"""Importance sampling of whole paths and their landmarks from the posterior of a smoother.

Under heading uncertainty the poses of a path have a banana-shaped distribution, which is not Gaussian in coordinates.
The motions between poses are nearly Gaussian (Long et al., The Banana Distribution Is Gaussian, RSS 2012): paths are
sampled about the mode and then retracted motion by motion.
"""

import math
from collections.abc import Callable
from typing import NamedTuple, Self, TypeVar

import numpy as np

from slam_backend.core.jit import jit
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.resampling import systematic
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import LANES, POSE_ROWS, Keys
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.optimizer import MapEstimate


@jit
def retract_on_se2(mode: FloatArray, previous: IntArray, offsets: FloatArray) -> FloatArray:
    """Return paths (k, 3, M) whose motions differ from those of the mode by the first-order effect of offsets.

    Let r_b be the first-order change, by the offsets of a and b, of the motion from the previous pose a to b, and m_b
    the motion of the mode. Then a path is x_b = x_a * (m_b + r_b). Both steps, offsets to r and r to x, are triangular
    in the order of the keys with rotations on the diagonal, so they preserve volumes and densities. Zero offsets give
    the mode.

    Args:
        mode: (k, 3) [m, m, rad], map frame.
        previous: (k,) previous key of each key, -1 for a fixed pose. No cycles.
        offsets: (k, 3, M) [m, m, rad] from the mode, map frame; zeros for fixed poses.
    """
    k, m = len(mode), offsets.shape[2]
    paths = np.empty(offsets.shape)
    is_done = np.zeros(k, dtype=np.bool_)
    line = np.empty(k, dtype=np.int64)
    for key in range(k):
        top, at = 0, key
        while at >= 0 and not is_done[at]:  # up to a computed pose, and back
            is_done[at] = True
            line[top] = at
            top += 1
            at = previous[at]
        for place in range(top - 1, -1, -1):
            b = line[place]
            a = previous[b]
            if a < 0:
                for i in range(m):
                    for axis in range(3):
                        paths[b, axis, i] = mode[b, axis] + offsets[b, axis, i]
                continue
            c, s = math.cos(mode[a, 2]), math.sin(mode[a, 2])
            dx, dy, turn = mode[b, 0] - mode[a, 0], mode[b, 1] - mode[a, 1], mode[b, 2] - mode[a, 2]
            ahead, left = c * dx + s * dy, c * dy - s * dx
            for i in range(m):
                ox, oy = offsets[b, 0, i] - offsets[a, 0, i], offsets[b, 1, i] - offsets[a, 1, i]
                motion_x = ahead + c * ox + s * oy + left * offsets[a, 2, i]
                motion_y = left + c * oy - s * ox - ahead * offsets[a, 2, i]
                cos, sin = math.cos(paths[a, 2, i]), math.sin(paths[a, 2, i])
                paths[b, 0, i] = paths[a, 0, i] + cos * motion_x - sin * motion_y  # (8), x
                paths[b, 1, i] = paths[a, 1, i] + sin * motion_x + cos * motion_y  # (8), y
                paths[b, 2, i] = paths[a, 2, i] + turn + offsets[b, 2, i] - offsets[a, 2, i]
    return paths


MIN_GAUSSIAN_SAMPLE_SIZE = 0.5  # share of M: below this sample size of the Gaussian draws, retracted ones are tried


class PathSamples(NamedTuple):
    """M paths, each with its conditional landmarks.

    Attributes:
        poses: (k, 3, M) float64 [m, m, rad], map frame.
        tiles: (l, P / LANES, 9, LANES) float64. Means (3) and covariances (6) of the landmarks, map frame, by lanes.
        log_weights: (M,) float64. Importance weights, not normalised.
        weights: (M,) float64. Normalised importance weights; NaN if one is not finite.
        sample_size: Effective sample size of the weights; NaN if one is not finite.
        transition_variances: (k,) float64 [m^2]. Variances of the motions from the previous keys, headings at `LEVER`.
    """

    poses: FloatArray
    tiles: FloatArray
    log_weights: FloatArray
    weights: FloatArray
    sample_size: float
    transition_variances: FloatArray

    @classmethod
    def weighed(
        cls, poses: FloatArray, tiles: FloatArray, log_weights: FloatArray, transition_variances: FloatArray
    ) -> Self:
        """Return paths with normalised weights; arguments as the attributes."""
        weights = np.empty(len(log_weights))
        sample_size = _kernels.normalise(log_weights, weights)
        return cls(poses, tiles, log_weights, weights, sample_size, transition_variances)

    @property
    def landmarks(self) -> FloatArray:
        """Means and covariances (l, 9, M) float64 of the landmarks, a copy."""
        count, blocks = self.tiles.shape[:2]
        rows = self.tiles.transpose(0, 2, 1, 3).reshape(count, 9, blocks * LANES)
        return np.ascontiguousarray(rows[:, :, : self.poses.shape[2]])


class PathWeights(NamedTuple):
    """M paths without landmarks: the attributes of `PathSamples` that weighing them yields."""

    poses: FloatArray
    log_weights: FloatArray
    weights: FloatArray
    sample_size: float
    transition_variances: FloatArray


def sample_paths(graph: SlamGraph, mode: MapEstimate, num_particles: int, rng: np.random.Generator) -> PathSamples:
    """Draw x^(i) from the Gaussian about the mode, and replay each path.

    log w = log p(path given odometry) + log p(measurements given path) - log q(path). The first path is the mode. If
    their effective sample size is low, the same paths are also retracted on SE(2) (`retract_on_se2`), and the set with
    the larger effective sample size is returned.

    Args:
        graph: Odometry and measurements.
        mode: MAP estimate of the graph, with the factored information matrix.
        num_particles: M >= 1.
        rng: Source of the draws.
    """
    return _best_of_two_charts(graph, mode, num_particles, rng, _importance_weights)


def sample_more_paths(
    graph: SlamGraph, mode: MapEstimate, num_drawn: int, num_particles: int, rng: np.random.Generator
) -> tuple[PathSamples, float]:
    """Draw and weigh paths as `sample_paths` does, and resample fewer of them: only these get landmarks.

    Args:
        graph, mode, rng: Same arguments as `sample_paths`.
        num_drawn: Number of weighed paths.
        num_particles: M, number of resampled paths.

    Returns:
        M paths with equal weights, and the effective sample size of the weighed ones.
    """
    drawn = _best_of_two_charts(graph, mode, num_drawn, rng, _weights_alone)
    poses = drawn.poses[:, :, systematic(drawn.weights, rng, num_particles)]
    tiles = replay(mode, lane_rows(poses), num_particles)[0]
    chosen = PathSamples.weighed(poses, tiles, np.zeros(num_particles), drawn.transition_variances)
    return chosen, drawn.sample_size


Draws = TypeVar("Draws", PathSamples, PathWeights)


def _best_of_two_charts(
    graph: SlamGraph, mode: MapEstimate, num_paths: int, rng: np.random.Generator,
    weigh: Callable[[SlamGraph, MapEstimate, FloatArray, FloatArray], Draws],
) -> Draws:  # fmt: skip
    """Draw paths and weigh them, see `sample_paths`."""
    poses, log_proposals = mode.paths(num_paths, rng)
    gaussian = weigh(graph, mode, poses, log_proposals)
    if gaussian.sample_size >= MIN_GAUSSIAN_SAMPLE_SIZE * num_paths:
        return gaussian
    retracted = weigh(
        graph, mode, retract_on_se2(mode.poses, graph.parents, poses - mode.poses[:, :, None]), log_proposals
    )
    return max(gaussian, retracted, key=lambda draws: np.nan_to_num(draws.sample_size))


def sample_transition_variances(graph: SlamGraph, mode: MapEstimate, rng: np.random.Generator) -> FloatArray:
    """Return the variances (k,) [m^2] of motions from the previous keys over `LANES` paths, each to about 14 %.

    Args:
        graph: Odometry and measurements.
        mode: MAP estimate of the graph, with the factored information matrix.
        rng: Source of the draws.
    """
    paths, _ = mode.paths(LANES, rng)
    return odometry_log_density(graph, mode, lane_rows(paths), LANES)[1]


def _importance_weights(
    graph: SlamGraph, mode: MapEstimate, poses: FloatArray, log_proposals: FloatArray
) -> PathSamples:
    """Replay paths (k, 3, M) and compute their importance weights."""
    num_paths = poses.shape[2]
    rows = lane_rows(poses)
    tiles, log_likelihood = replay(mode, rows, num_paths)
    log_odometry, transition_variances = odometry_log_density(graph, mode, rows, num_paths)
    return PathSamples.weighed(poses, tiles, log_likelihood + log_odometry - log_proposals, transition_variances)  # (2)


def _weights_alone(graph: SlamGraph, mode: MapEstimate, poses: FloatArray, log_proposals: FloatArray) -> PathWeights:
    """Return the importance weights of paths (k, 3, M) as `_importance_weights` does; landmarks are not kept."""
    num_paths = poses.shape[2]
    rows = lane_rows(poses)
    tiles = np.empty(len(mode.landmarks) * 9 * LANES)  # of one block after the other: of all they exceed a cache
    log_likelihood = np.empty((len(rows), LANES))
    for block, out in zip(rows, log_likelihood, strict=True):
        _kernels.replay(block.reshape(-1), len(poses), 1, mode.landmarks, mode.sightings, tiles, out)
    log_odometry, transition_variances = odometry_log_density(graph, mode, rows, num_paths)
    log_weights = log_likelihood.reshape(-1)[:num_paths] + log_odometry - log_proposals
    weights = np.empty(num_paths)
    sample_size = _kernels.normalise(log_weights, weights)
    return PathWeights(poses, log_weights, weights, sample_size, transition_variances)


def lane_rows(poses: FloatArray) -> FloatArray:
    """Return paths in the kernels' layout, in blocks of lanes; surplus lanes are copies of the first path.

    Args:
        poses: (k, 3, M) float64 [m, m, rad], map frame.

    Returns:
        (P / LANES, k, 5, LANES) float64: x, y, cos, sin, heading.
    """
    k, _, m = poses.shape
    rows = np.empty((-(-m // LANES), k, POSE_ROWS, LANES))
    _kernels.to_lanes(poses, rows.reshape(-1))
    return rows


def replay(mode: MapEstimate, rows: FloatArray, num_particles: int) -> tuple[FloatArray, FloatArray]:
    """Return the landmarks of M paths, and log p(measurements given path) up to a constant.

    Args:
        mode: Sightings, linearised there.
        rows: Paths as `lane_rows` returns them.
        num_particles: M.

    Returns:
        (l, P / LANES, 9, LANES) means and covariances in blocks of lanes, zeros where a landmark has no sighting; (M,).
    """
    blocks, k = rows.shape[:2]
    tiles = np.empty((len(mode.landmarks), blocks, 9, LANES))
    log_likelihood = np.empty(blocks * LANES)
    _kernels.replay(rows.reshape(-1), k, blocks, mode.landmarks, mode.sightings, tiles.reshape(-1), log_likelihood)
    return tiles, log_likelihood[:num_particles]


def odometry_log_density(
    graph: SlamGraph, mode: MapEstimate, rows: FloatArray, num_particles: int
) -> tuple[FloatArray, FloatArray]:
    """Return the log density of M paths given the odometry, and the variances of their motions.

    Args:
        graph: The odometry between keys.
        mode: Motions are compared about those of the mode.
        rows: Paths as `lane_rows` returns them.
        num_particles: M.

    Returns:
        (M,) log p(path given odometry) up to a constant, and (k,) [m^2] how far the motions from the keys before
        scatter, headings felt at `LEVER`.
    """
    blocks, k = rows.shape[:2]
    log_density, transition_variances = np.empty(blocks * LANES), np.empty(k)
    _kernels.odometry_log_density(
        rows.reshape(-1), k, blocks, num_particles, graph.part(Keys), graph.biases_of_odometry(), mode.odometry_infos,
        mode.poses, log_density, transition_variances,
    )  # fmt: skip
    return log_density[:num_particles], transition_variances
