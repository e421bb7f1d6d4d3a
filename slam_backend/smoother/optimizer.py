"""Maximum a posteriori estimation of paths and landmarks by damped Gauss-Newton with sparse Cholesky factorisation."""

from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import FREE, CholeskyFactor, EquationBlocks, Frames, Keys, LandmarkFactors, Points
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.options import SmoothingOptions


def gathered(graph: SlamGraph) -> LandmarkFactors:
    """Return a graph's sightings by landmark and key, frozen ones before the others of a pair.

    Forms of raw measurements are zeros: they are still to be linearised.
    """
    num_frozen, num_points, num_keys = len(graph.counts), len(graph.points), graph.num_keys
    pairs = np.concatenate([
        graph.condensed_landmarks * num_keys + graph.condensed_keys,
        graph.point_landmarks * num_keys + graph.frame_keys[graph.point_frames],
    ])  # fmt: skip
    order = pairs.argsort(kind="stable")
    pairs, is_frozen = pairs[order], order < num_frozen
    begins = np.ones(len(order), np.bool_)  # raw measurements of a landmark from one key are one sighting
    begins[1:] = is_frozen[1:] | is_frozen[:-1] | (pairs[1:] != pairs[:-1])
    place, first = begins.cumsum() - 1, begins.nonzero()[0]
    counts, places = np.diff(first, append=len(order)), np.empty(len(order), np.int64)
    places[order] = place
    at, condensed = places[:num_frozen], is_frozen[first]
    centres, infos, slopes = np.zeros((len(first), 3)), np.zeros((len(first), 6)), np.zeros((len(first), 3))
    centres[at], infos[at], slopes[at] = graph.linearisation_points, graph.information, graph.gradients
    counts[at] = graph.counts
    landmarks, keys = np.divmod(pairs[first], num_keys)
    starts = np.searchsorted(landmarks, np.arange(len(graph.landmark_ids) + 1))
    return LandmarkFactors(
        keys, landmarks, starts, condensed, centres, infos, slopes, counts, places[num_frozen:], np.zeros(num_points)
    )


def linearise(
    seen: LandmarkFactors, graph: SlamGraph, poses: FloatArray, landmarks: FloatArray, camera: FloatArray,
    options: SmoothingOptions,
) -> float:  # fmt: skip
    """Linearise raw measurements, and return half the sum of their (robust) squared distances.

    Args:
        seen: Sightings; the forms of raw measurements and `squares` are written.
        graph: Graph of these sightings.
        poses: (k, 3) float64 [m, m, rad], map frame. Poses of the linearisation point.
        landmarks: (l, 3) float64 [m], map frame. Landmarks of the linearisation point.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Scale of the noise, and kernel.
    """
    return _kernels.condense(
        graph.part(Points), graph.part(Frames), seen, poses, landmarks, camera, options.noise_scale, options.kernel
    )


FIRST_DAMPING, MAX_DAMPING = 1e-4, 1e8
LARGEST_STEP = 1e3  # [m, rad]; larger steps count as divergence
FEW_POSES = 10  # landmarks that are seen from at most so many poses are eliminated first
NO_POSE = "no pose to seek"  # reason if all poses are fixed
SLOW_PROGRESS = 10.0  # factor on the tolerance in the last iteration of the options


class MapEstimate(NamedTuple):
    """Maximum a posteriori (MAP) paths and landmarks, and the Gaussian about them.

    Attributes:
        poses: (k, 3) float64 [m, m, rad], map frame; headings are not wrapped.
        landmarks: (l, 3) float64 [m], map frame.
        columns: (k,) int64. First row of each key among the unknown poses, `FREE` for a fixed pose.
        sightings: Sightings, linearised at the estimate.
        odometry_infos: (k, 3, 3) float64. Information of the odometry from the previous key; zeros without odometry.
        cost: Half the sum of squared distances (robust, and up to a constant of the frozen sightings).
        iterations: Number of systems solved.
        damping: Damping of the last system, from which an unfinished descent continues.
        reason: Reason of a failure, with the last poses and landmarks of the descent; "" on success.
        system: Last system, factored, on success.
    """

    poses: FloatArray
    landmarks: FloatArray
    columns: IntArray
    sightings: LandmarkFactors
    odometry_infos: FloatArray
    cost: float
    iterations: int
    damping: float
    reason: str
    system: "NormalEquations | None" = None

    @property
    def unfinished(self) -> bool:
        """Whether the descent failed only for lack of iterations."""
        return bool(self.reason) and np.isfinite(self.cost)

    def paths(self, num_paths: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Draw paths from the Gaussian about the mode of a successful estimate.

        Args:
            num_paths: M >= 1; the first is the mode.
            rng: Source of the draws.

        Returns:
            (k, 3, M) float64 [m, m, rad], map frame, and the log density of each (M,), up to a constant.
        """
        assert self.system is not None
        return self.system.draw(self.poses, num_paths, rng)

    def covariance(self, keys: IntArray) -> FloatArray:
        """Return the joint covariance (3 r, 3 r) [m, m, rad] of r unknown keys (r,) of a successful estimate."""
        assert self.system is not None
        return self.system.covariance(self.columns[keys])


def optimize(
    graph: SlamGraph, camera: FloatArray, options: SmoothingOptions, most: int | None = None, damping: float = 0.0,
    looseness: float = 1.0,
) -> MapEstimate:  # fmt: skip
    """Return the MAP estimate of a graph, by Levenberg-Marquardt from its poses and landmarks.

    A step that does not lower the cost is repeated with more damping. With measurements at the edge of the robust
    kernel convergence may be slow. Therefore the last iteration of the options also counts as converged if the expected
    decrease is at most `SLOW_PROGRESS` times the tolerance, by default half a squared distance of 2 in a space of
    hundreds of dimensions.

    Args:
        graph: Keys, odometry and measurements; its poses and landmarks are the initial estimate.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Kernel, scale of the noise, tolerance, iterations.
        most: Maximum number of iterations; None: `options.max_iterations`.
        damping: Damping of the first iteration.
        looseness: Factor on the tolerance of the options.
    """
    columns, informations, size, is_noisy = sum_pose_information(graph.parents, graph.odometry_covariances)
    sightings = gathered(graph)
    poses, landmarks = graph.poses.copy(), graph.landmarks.copy()
    tolerance = looseness * options.tolerance
    creep = SLOW_PROGRESS if most is None else 1.0
    most = options.max_iterations if most is None else most

    def given_up(reason: str, iterations: int = 0, cost: float = np.inf) -> MapEstimate:
        return MapEstimate(poses, landmarks, columns, sightings, informations, cost, iterations, damping, reason)

    if size == graph.num_biases:
        return given_up(NO_POSE)
    if not is_noisy:
        return given_up("odometry without noise")
    system = NormalEquations(graph, columns, size, informations, sightings, camera, options)
    cost = system.form(poses, landmarks)
    for iteration in range(1, most + 1):
        if not np.isfinite(cost):
            return given_up("a landmark at no finite place", iteration)
        if not system.factorise(damping):
            return given_up("a singular system", iteration)
        trial_poses, trial_landmarks, rise, largest = system.step(poses, landmarks)
        if not largest < LARGEST_STEP:
            return given_up("a descent that leaves the world", iteration)
        expected = -0.5 * rise - system.eased  # under the quadratic approximation
        near = creep * tolerance if iteration == most else tolerance
        if expected <= near and damping == 0.0:
            return MapEstimate(
                trial_poses, trial_landmarks, columns, sightings, informations, cost - expected, iteration, damping,
                "", system,
            )  # fmt: skip
        trial_cost = system.form(trial_poses, trial_landmarks)
        if trial_cost <= cost + 1e-9 * abs(cost):
            poses, landmarks, cost = trial_poses, trial_landmarks, trial_cost
            damping = damping / 10.0 if damping > FIRST_DAMPING else 0.0
        else:
            damping = max(10.0 * damping, FIRST_DAMPING)
            if damping > MAX_DAMPING:
                return given_up("no descent", iteration)
            cost = system.form(poses, landmarks)
    return given_up(f"no convergence in {most} iterations", most, cost)


def sum_pose_information(previous: IntArray, noises: FloatArray) -> tuple[IntArray, FloatArray, int, bool]:
    """Number the poses that are sought, and invert the covariances of the odometry that leads to them.

    Args:
        previous: (k,) key that odometry comes from, `NONE` where a pose is given.
        noises: (k, 3, 3) covariance of that odometry.

    Returns:
        (k,) First of the three rows of each pose that is sought, `FREE` of the others; (k, 3, 3) information of the
        odometry, zeros where a pose is given; how many poses are sought; whether all of their odometry has noise.
    """
    sought = np.flatnonzero(previous >= 0)
    columns, informations = np.full(len(previous), FREE), np.zeros(noises.shape)
    columns[sought] = 3 * np.arange(len(sought))
    (xx, xy, xt), (_, yy, yt), (_, _, tt) = noises[sought].transpose(1, 2, 0)
    p, q, r = yy * tt - yt * yt, xt * yt - xy * tt, xy * yt - xt * yy
    determinants = xx * p + xy * q + xt * r
    has_noise = (xx > 0.0) & (xx * yy - xy * xy > 0.0) & (determinants > 0.0)
    u, v, w = xx * tt - xt * xt, xy * xt - xx * yt, xx * yy - xy * xy
    inverses = np.array([[p, q, r], [q, u, v], [r, v, w]]).transpose(2, 0, 1)
    informations[sought[has_noise]] = inverses[has_noise] / determinants[has_noise, None, None]
    return columns, informations, len(sought), bool(has_noise.all())


class NormalEquations:
    """Normal equations, their factor, and what they are formed of."""

    def __init__(
        self, graph: SlamGraph, columns: IntArray, size: int, informations: FloatArray, sightings: LandmarkFactors,
        camera: FloatArray, options: SmoothingOptions,
    ) -> None:  # fmt: skip
        self.graph, self.columns, self.sightings = graph, columns, sightings
        self.informations, self.camera, self.options = informations, camera, options
        num, k = size + len(graph.landmark_ids), graph.num_keys
        self.num_poses = size
        self.biases = graph.biases_of_odometry()
        self.pattern = _kernels.lay_out(columns, graph.parents, self.biases, sightings, num, FEW_POSES)
        cross = np.empty((len(sightings.keys), 3, 3))
        self.equations = EquationBlocks(
            np.empty((k, 2)), np.empty((num, 6)), np.empty((k, 3, 3)), cross, np.empty((len(self.biases), 3, 3)),
            np.empty((num, 3)),
        )  # fmt: skip
        values = np.empty((len(self.pattern.rows), 9))
        self.factor = CholeskyFactor(np.empty((num, 6)), values, np.empty(num, dtype=np.int64))
        self.eased = 0.0  # by so much the cost would fall if landmarks alone moved

    def form(self, poses: FloatArray, landmarks: FloatArray) -> float:
        """Form the equations at poses (k, 3) and landmarks (l, 3), map frame; return the cost there."""
        loss = linearise(self.sightings, self.graph, poses, landmarks, self.camera, self.options)
        cost, self.eased = _kernels.form(
            poses, landmarks, self.graph.part(Keys), self.biases, self.columns, self.informations, self.sightings,
            self.equations,
        )  # fmt: skip
        return loss + cost

    def factorise(self, damping: float) -> bool:
        """Factor the equations with a damped diagonal of poses; return whether they are positive definite."""
        return _kernels.factorise(self.equations, self.pattern, damping, self.num_poses, self.factor)

    def step(self, poses: FloatArray, landmarks: FloatArray) -> tuple[FloatArray, FloatArray, float, float]:
        """Solve the factored equations, see `_kernels.step`.

        Args:
            poses, landmarks: (k, 3), (l, 3) where they were formed.
        """
        return _kernels.step(self.equations, self.factor, self.pattern, self.columns, poses, landmarks)

    def draw(self, poses: FloatArray, num_paths: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return paths about poses (k, 3) and their log densities, see `MapEstimate.paths`."""
        normals = rng.standard_normal((self.pattern.drawn, 3, num_paths))
        normals[:, :, 0] = 0.0
        return _kernels.draw(normals, poses, self.columns, self.sightings, self.equations, self.factor, self.pattern)

    def covariance(self, columns: IntArray) -> FloatArray:
        """Return the joint covariance (3 r, 3 r) of poses given by their columns (r,)."""
        return _kernels.covariance(self.factor, self.pattern, columns // 3)
