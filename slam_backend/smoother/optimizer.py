"""Maximum a posteriori paths and landmarks: Gauss-Newton over key poses and landmarks by sparse factorisation."""

from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import (
    CholeskyFactor,
    Condensed,
    EquationBlocks,
    Frames,
    Keys,
    LandmarkFactors,
    Points,
)
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.options import SmoothingOptions


def gathered(graph: SlamGraph) -> LandmarkFactors:
    """Return a graph's sightings; those of raw measurements are still to be linearised."""
    parts = graph.part(Condensed), graph.part(Points), graph.part(Frames)
    return _kernels.gather(*parts, graph.num_keys, len(graph.landmark_ids))


def linearise(
    seen: LandmarkFactors, graph: SlamGraph, poses: FloatArray, landmarks: FloatArray, camera: FloatArray,
    options: SmoothingOptions,
) -> float:  # fmt: skip
    """Linearise raw measurements, and return half the sum of their (robust) squared distances.

    Args:
        seen: Sightings; the forms of raw measurements and `squares` are written.
        graph: The graph of these.
        poses: (k, 3) float64 [m, m, rad], map frame. Where to linearise.
        landmarks: (l, 3) float64 [m], map frame. Where to linearise.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Scale of the noise, and kernel.
    """
    return _kernels.condense(
        graph.part(Points), graph.part(Frames), seen, poses, landmarks, camera, options.noise_scale, options.kernel
    )


FIRST_DAMPING, MAX_DAMPING = 1e-4, 1e8
LARGEST_STEP = 1e3  # [m, rad]; nothing is sought so far away
LONG_COLUMNS = 16  # blocks in a mean column, longer ones counting more: then draws are cheaper than the inverse
NO_POSE = "no pose to seek"  # the reason where all poses are given
SLOW_PROGRESS = (
    10.0  # times the tolerance: so far from its end a descent may be that has used up the options' iterations
)


class MapEstimate(NamedTuple):
    """The most probable paths, and the Gaussian about them.

    Attributes:
        poses: (k, 3) float64 [m, m, rad], map frame; headings are not wrapped against each other.
        landmarks: (l, 3) float64 [m], map frame.
        columns: (k,) int64. First of each key's rows among those of the poses sought, `FREE` where it is given.
        sightings: As linearised there.
        odometry_infos: (k, 3, 3) float64. Information of the odometry from the key before; zeros where there is none.
        cost: Half the sum of squared distances (robust, and up to a constant of the frozen sightings).
        iterations: Systems solved.
        damping: Of the last system; where a descent that was not given the time goes on.
        reason: Why it is of no use; "" if it is of use. Poses and landmarks are then where the descent got to.
        system: The last one, factored, if it is of use.
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
        """Whether nothing is wrong with the descent but that it was given too few iterations."""
        return bool(self.reason) and np.isfinite(self.cost)

    def paths(self, num_paths: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Draw paths from the Gaussian about the mode, if of use.

        Args:
            num_paths: M >= 1; the first is the mode.
            rng: Source of the draws.

        Returns:
            (k, 3, M) float64 [m, m, rad], map frame, and the logarithm of the density of each (M,), up to a constant.
        """
        assert self.system is not None
        return self.system.draw(self.poses, num_paths, rng)

    def covariance(self, keys: IntArray) -> FloatArray:
        """Return the joint covariance (3 r, 3 r) [m, m, rad] of r keys (r,) that are sought, if of use."""
        assert self.system is not None
        return self.system.covariance(self.columns[keys])

    @property
    def crowded(self) -> bool:
        """Whether many paths are drawn sooner than `spreads` are found, for the factor's columns are long; if of use.

        The work of either grows with the sum of the columns' lengths, that of `spreads` with the sum of their squares.
        """
        assert self.system is not None
        pattern = self.system.pattern
        return pattern.squares > LONG_COLUMNS * len(pattern.rows)

    def spreads(self) -> FloatArray:
        """Return how far the motions from the keys before scatter (k,) [m^2], headings felt at `LEVER`; if of use."""
        assert self.system is not None
        return self.system.spreads(self.poses)


def optimize(
    graph: SlamGraph, camera: FloatArray, options: SmoothingOptions, most: int | None = None, damping: float = 0.0,
    looseness: float = 1.0,
) -> MapEstimate:  # fmt: skip
    """Descend from where the graph stands.

    A step that does not lower the cost is tried again with more damping (Levenberg, Marquardt). Where measurements lie
    at the edge of the kernel a descent may creep, each step promising what the one before did. So it ends in the last
    iteration of the options, too, if it can fall by no more than `SLOW_PROGRESS` times the tolerance: by default half
    of a
    squared distance of two, in a space of hundreds of dimensions.

    Args:
        graph: Key poses, odometry, measurements; its poses and landmarks are the start.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Kernel, scale of the noise, tolerance, iterations.
        most: Iterations; None: as in the options.
        damping: Of the first one.
        looseness: Times the tolerance of the options.
    """
    columns, informations, size, is_noisy = _kernels.sum_pose_information(graph.parents, graph.odometry_covariances)
    sightings = gathered(graph)
    poses, landmarks = graph.poses.copy(), graph.landmarks.copy()
    tolerance = looseness * options.tolerance
    creep = SLOW_PROGRESS if most is None else 1.0
    most = options.max_iterations if most is None else most

    def given_up(reason: str, iterations: int = 0, cost: float = np.inf) -> MapEstimate:
        return MapEstimate(poses, landmarks, columns, sightings, informations, cost, iterations, damping, reason)

    if not size:
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
        expected = -0.5 * rise - system.eased  # if the cost were a parabola
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
        self.pattern = _kernels.lay_out(columns, graph.parents, sightings, num)
        cross = np.empty((len(sightings.keys), 3, 3))
        self.equations = EquationBlocks(
            np.empty((k, 2)), np.empty((num, 6)), np.empty((k, 3, 3)), cross, np.empty((num, 3))
        )
        values = np.empty((len(self.pattern.rows), 9))
        self.factor = CholeskyFactor(np.empty((num, 6)), values, np.empty(num, dtype=np.int64))
        self.eased = 0.0  # by so much the cost would fall if landmarks alone moved

    def form(self, poses: FloatArray, landmarks: FloatArray) -> float:
        """Form the equations at poses (k, 3) and landmarks (l, 3), map frame; return the cost there."""
        loss = linearise(self.sightings, self.graph, poses, landmarks, self.camera, self.options)
        cost, self.eased = _kernels.form(
            poses, landmarks, self.graph.part(Keys), self.columns, self.informations, self.sightings, self.equations
        )
        return loss + cost

    def factorise(self, damping: float) -> bool:
        """Factor the equations, the diagonal of poses enlarged; return whether that is possible."""
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
        """Return the joint covariance (3 r, 3 r) of poses by their columns (r,)."""
        return _kernels.covariance(self.factor, self.pattern, columns // 3)

    def spreads(self, poses: FloatArray) -> FloatArray:
        """Return how far motions to each pose (k, 3) scatter, see `MapEstimate.spreads`."""
        return _kernels.scatter_of_links(poses, self.columns, self.graph.parents, self.factor, self.pattern)
