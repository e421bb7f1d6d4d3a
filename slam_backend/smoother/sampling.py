"""Importance sampling of whole paths from the posterior of a smoother, and the landmarks given these paths.

Under heading uncertainty the poses of a path have a banana-shaped distribution, which is not Gaussian in coordinates.
The motions between poses are nearly Gaussian (Long et al., The Banana Distribution Is Gaussian, RSS 2012): paths are
sampled about the mode and then retracted motion by motion.
"""

import math
from typing import NamedTuple, Self

import numpy as np

from slam_backend.core.jit import jit
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import LANES, POSE_ROWS, Keys, LandmarkFactors
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
    """M weighed paths.

    Attributes:
        poses: (k, 3, M) float64 [m, m, rad], map frame.
        log_weights: (M,) float64. Importance weights, not normalised.
        weights: (M,) float64. Normalised importance weights; NaN if one is not finite.
        sample_size: Effective sample size of the weights; NaN if one is not finite.
        transition_variances: (k,) float64 [m^2]. Variances of the motions from the previous keys, headings at `LEVER`.
    """

    poses: FloatArray
    log_weights: FloatArray
    weights: FloatArray
    sample_size: float
    transition_variances: FloatArray

    @classmethod
    def weighed(cls, poses: FloatArray, log_weights: FloatArray, transition_variances: FloatArray) -> Self:
        """Return paths with normalised weights; arguments as the attributes."""
        weights = np.empty(len(log_weights))
        sample_size = _kernels.normalise(log_weights, weights)
        return cls(poses, log_weights, weights, sample_size, transition_variances)


class PathLandmarks(NamedTuple):
    """Landmarks given M paths, computed where they are written.

    Attributes:
        paths: (P / LANES, k, 5, LANES) float64. Paths as `lane_rows` returns them.
        mode: Sightings, linearised there.
        rows: (l,) int64. Rows of the landmarks in the graph.
    """

    paths: FloatArray
    mode: MapEstimate
    rows: IntArray

    def write(self, chosen: IntArray, walk: float, tiles: FloatArray) -> None:
        """Write means and covariances, map frame.

        Args:
            chosen: (n,) int64. Indices of the landmarks to write.
            walk: Variance [m^2] of a random walk along each axis, which is added.
            tiles: (>= n, P / LANES, 9, LANES) float64. The first n are written, in blocks of lanes.
        """
        seen, rows = self.mode.sightings, self.rows[chosen]
        blocks, k = self.paths.shape[:2]
        out, paths = tiles[: len(rows)].reshape(-1), self.paths.reshape(-1)
        is_rigid = has_single_sighting(seen)[rows]
        others, log_likelihood = np.where(is_rigid, -1, rows), np.empty(blocks * LANES)
        _kernels.replay(paths, k, blocks, self.mode.landmarks, seen, others, out, log_likelihood)
        _kernels.place_landmarks(paths, k, blocks, seen, rows, is_rigid, walk, out)


WELL_DETERMINED = 1.0  # [1/m^6] least determinant of the information of a single sighting that determines its landmark


def has_single_sighting(seen: LandmarkFactors) -> BoolArray:
    """Return which landmarks (l,) have a single sighting that determines their place from its key."""
    first = np.minimum(seen.starts[:-1], max(len(seen.keys) - 1, 0))
    if not len(seen.keys):
        return np.zeros(len(first), dtype=np.bool_)
    a, b, c, d, e, f = seen.information[first].T
    determinant = a * (d * f - e * e) - b * (b * f - c * e) + c * (b * e - c * d)
    return np.asarray((np.diff(seen.starts) == 1) & (determinant > WELL_DETERMINED))


def sample_paths(graph: SlamGraph, mode: MapEstimate, num_particles: int, rng: np.random.Generator) -> PathSamples:
    """Draw x^(i) from the Gaussian about the mode, and weigh each path.

    log w = log p(path given odometry) + log p(measurements given path) - log q(path). The first path is the mode. If
    their effective sample size is low, the same paths are also retracted on SE(2) (`retract_on_se2`), and the set with
    the larger effective sample size is returned.

    Args:
        graph: Odometry and measurements.
        mode: MAP estimate of the graph, with the factored information matrix.
        num_particles: M >= 1.
        rng: Source of the draws.
    """
    poses, log_proposals = mode.paths(num_particles, rng)
    gaussian = importance_weights(graph, mode, poses, log_proposals)
    if gaussian.sample_size >= MIN_GAUSSIAN_SAMPLE_SIZE * num_particles:
        return gaussian
    retracted = importance_weights(graph, mode, _retracted(graph, mode, poses), log_proposals)
    return max(gaussian, retracted, key=lambda draws: np.nan_to_num(draws.sample_size))


def _retracted(graph: SlamGraph, mode: MapEstimate, poses: FloatArray) -> FloatArray:
    """Return paths (k, 3, M) drawn from the Gaussian about the mode, retracted on SE(2)."""
    return retract_on_se2(mode.poses, graph.parents, poses - mode.poses[:, :, None])


HALVINGS = 30  # of the interval of powers


def tempered(draws: PathSamples, sample_size: float) -> PathSamples:
    """Return paths whose weights are raised to the largest power that lets their effective sample size reach a value.

    The power is found as in adaptive tempering (Jasra et al., Scandinavian Journal of Statistics 38, 2011). The paths
    then lie between the Gaussian about the mode (power 0) and the posterior (power 1).

    Args:
        draws: Paths with finite weights.
        sample_size: Effective sample size to reach, at most M.
    """
    low, high = 0.0, 1.0
    logs, weights = draws.log_weights - draws.log_weights.max(), np.empty(len(draws.weights))
    for _ in range(HALVINGS):
        power = 0.5 * (low + high)
        low, high = (power, high) if _kernels.normalise(power * logs, weights) >= sample_size else (low, power)
    size = _kernels.normalise(low * logs, weights)
    return draws._replace(log_weights=low * logs, weights=weights, sample_size=size)


def importance_weights(
    graph: SlamGraph, mode: MapEstimate, poses: FloatArray, log_proposals: FloatArray
) -> PathSamples:
    """Return paths (k, 3, M) with their importance weights, up to a common factor.

    Landmarks seen from one key alone do not take part: their likelihood is the same given any path.

    Args:
        graph: Odometry and measurements.
        mode: Sightings, linearised there.
        poses: (k, 3, M) float64 [m, m, rad], map frame.
        log_proposals: (M,) float64. Log densities of the draws.
    """
    num_paths, seen = poses.shape[2], mode.sightings
    rows = lane_rows(poses)
    blocks, log_likelihood = len(rows), np.empty(len(rows) * LANES)
    chosen = np.flatnonzero(np.diff(seen.starts) > 0)
    chosen = chosen[seen.keys[seen.starts[chosen]] != seen.keys[seen.starts[chosen + 1] - 1]]
    one_tile = np.empty(9 * LANES)
    _kernels.replay(rows.reshape(-1), len(poses), blocks, mode.landmarks, seen, chosen, one_tile, log_likelihood)
    log_odometry, variances = odometry_log_density(graph, mode, rows, num_paths)
    log_weights = log_likelihood[:num_paths] + log_odometry - log_proposals  # (2)
    return PathSamples.weighed(poses, log_weights, variances)


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


def replay(
    mode: MapEstimate, rows: FloatArray, num_particles: int, chosen: IntArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return the landmarks of M paths, and log p(their measurements given path) up to a constant.

    Args:
        mode: Sightings, linearised there.
        rows: Paths as `lane_rows` returns them.
        num_particles: M.
        chosen: (n,) int64. Rows of some landmarks. None: all.

    Returns:
        (n, P / LANES, 9, LANES) means and covariances in blocks of lanes, zeros where a landmark has no sighting; (M,).
    """
    blocks, k = rows.shape[:2]
    chosen = np.arange(len(mode.landmarks)) if chosen is None else chosen
    tiles = np.empty((len(chosen), blocks, 9, LANES))
    log_likelihood = np.empty(blocks * LANES)
    _kernels.replay(
        rows.reshape(-1), k, blocks, mode.landmarks, mode.sightings, chosen, tiles.reshape(-1), log_likelihood
    )
    return tiles, log_likelihood[:num_particles]


VARIANCE_DRAWS = 64


def transition_variances(graph: SlamGraph, mode: MapEstimate) -> FloatArray:
    """Return the variances (k,) [m^2] of the motions from the previous keys over some paths about the mode.

    The draws are the same in each call, headings are felt at `LEVER`.
    """
    poses, _ = mode.paths(VARIANCE_DRAWS, np.random.default_rng(0))
    return odometry_log_density(graph, mode, lane_rows(poses), VARIANCE_DRAWS)[1]


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
    log_density, variances = np.empty(blocks * LANES), np.empty(k)
    _kernels.odometry_log_density(
        rows.reshape(-1), k, blocks, num_particles, graph.part(Keys), graph.biases_of_odometry(), mode.odometry_infos,
        mode.poses, log_density, variances,
    )  # fmt: skip
    return log_density[:num_particles], variances
