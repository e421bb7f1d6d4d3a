"""Maximum a posteriori paths and landmarks: Gauss-Newton over key poses and landmarks by sparse factorisation."""

from typing import NamedTuple, Self

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother import _kernels
from slam_backend.smoother.graph import LEVER_ARM, SlamGraph
from slam_backend.smoother.options import SmoothingOptions


class LandmarkFactors(NamedTuple):
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
    def of(cls, graph: SlamGraph) -> Self:
        """Gather a graph's sightings; those of raw measurements are still to be linearised."""
        most, n = len(graph.condensed_keys) + len(graph.points), len(graph.points)
        keys, landmarks, counts = (np.empty(most, dtype=np.int64) for _ in range(3))
        starts, of_points = np.empty(len(graph.landmark_ids) + 1, dtype=np.int64), np.empty(n, dtype=np.int64)
        frozen = np.empty(most, dtype=np.bool_)
        centres, infos, slopes = np.empty((most, 3)), np.empty((most, 6)), np.empty((most, 3))
        num = _kernels.gather(
            graph.condensed_keys, graph.condensed_landmarks, graph.linearisation_points, graph.information,
            graph.gradients, graph.counts,
            graph.point_frames, graph.point_landmarks, graph.frame_keys, graph.num_keys, keys, landmarks, starts,
            frozen, centres, infos, slopes, counts, of_points,
        )  # fmt: skip
        return cls(
            keys[:num], landmarks[:num], starts, frozen[:num], centres[:num], infos[:num], slopes[:num], counts[:num],
            of_points, np.zeros(n),
        )  # fmt: skip

    def linearise(
        self, graph: SlamGraph, poses: FloatArray, landmarks: FloatArray, camera: FloatArray, scale: float,
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
            graph.points, graph.point_noises, graph.has_covariance, graph.point_frames, self.of_points,
            graph.frame_keys,
            graph.frame_offsets, poses, landmarks, self.keys, self.landmarks, self.frozen, camera, scale, kernel,
            self.centres, self.infos, self.slopes, self.squares,
        )  # fmt: skip


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
        """Return the variances (k,) [m^2] of the motions from the previous keys, headings at `LEVER_ARM`."""
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
    columns, informations = np.empty(graph.num_keys, dtype=np.int64), np.empty(graph.odometry_covariances.shape)
    size, is_noisy = _kernels.sum_pose_information(graph.parents, graph.odometry_covariances, columns, informations)
    sightings = LandmarkFactors.of(graph)
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
        if not system.factor(damping):
            return given_up("a singular system", iteration)
        trial_poses, trial_landmarks = np.empty_like(poses), np.empty_like(landmarks)
        rise, largest = system.step(poses, landmarks, trial_poses, trial_landmarks)
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


class SymbolicFactor(NamedTuple):
    """Where the blocks of a factor lie, how many nodes are drawn, and how long columns are; see `_kernels.lay_out`."""

    order: IntArray
    ranks: IntArray
    tops: IntArray
    rows: IntArray
    link_places: IntArray
    cross_places: IntArray
    row_tops: IntArray
    row_columns: IntArray
    row_places: IntArray
    drawn: int
    squares: int

    @classmethod
    def of(cls, graph: SlamGraph, columns: IntArray, seen: LandmarkFactors, num: int) -> Self:
        """Choose an order in which the `num` poses and landmarks are eliminated, and lay out what that fills in."""
        near = np.zeros((num, -(-num // 64)), dtype=np.uint64)
        _kernels.neighbours(columns, graph.parents, seen.keys, seen.starts, near)
        order, ranks = np.empty(num, dtype=np.int64), np.empty(num, dtype=np.int64)
        filled = _kernels.minimum_degree(near, order)
        tops, row_tops = np.empty(num + 1, dtype=np.int64), np.empty(num + 1, dtype=np.int64)
        rows, row_columns, row_places = (np.empty(filled, dtype=np.int64) for _ in range(3))
        links, cross = np.empty(len(columns), dtype=np.int64), np.empty(len(seen.keys), dtype=np.int64)
        drawn, squares = _kernels.lay_out(
            near, order, columns, graph.parents, seen.keys, seen.starts, ranks, tops, rows, links, cross, row_tops,
            row_columns, row_places,
        )  # fmt: skip
        return cls(order, ranks, tops, rows, links, cross, row_tops, row_columns, row_places, drawn, squares)


class NormalEquations:
    """Room for the normal equations, and what they are formed of."""

    def __init__(
        self, graph: SlamGraph, columns: IntArray, size: int, informations: FloatArray, sightings: LandmarkFactors,
        camera: FloatArray, options: SmoothingOptions,
    ) -> None:  # fmt: skip
        self.graph, self.columns, self.sightings = graph, columns, sightings
        self.informations, self.camera, self.options = informations, camera, options
        num, k = size + len(graph.landmark_ids), graph.num_keys
        self.num_poses = size
        self.pattern = SymbolicFactor.of(graph, columns, sightings, num)
        self.blocks, self.links, self.turns = np.empty((num, 6)), np.empty((k, 3, 3)), np.empty((k, 2))
        self.cross = np.empty((len(sightings.keys), 3, 3))
        self.vector = np.empty((num, 3))
        self.pivots, self.values = np.empty((num, 6)), np.empty((len(self.pattern.rows), 9))
        self.where = np.empty(num, dtype=np.int64)
        self.eased = 0.0  # by so much the cost would fall if landmarks alone moved

    def form(self, poses: FloatArray, landmarks: FloatArray) -> float:
        """Form the equations at poses (k, 3) and landmarks (l, 3), map frame; return the cost there."""
        seen, graph = self.sightings, self.graph
        loss = seen.linearise(graph, poses, landmarks, self.camera, self.options.noise_scale, self.options.kernel)
        cost, self.eased = _kernels.form(
            poses, landmarks, self.columns, graph.parents, graph.odometry, self.informations, seen.keys, seen.starts,
            seen.centres, seen.infos, seen.slopes, self.turns, self.blocks, self.links, self.cross, self.vector,
        )  # fmt: skip
        return loss + cost

    def factor(self, damping: float) -> bool:
        """Factor the equations, the diagonal of poses enlarged; return whether that is possible."""
        p = self.pattern
        return _kernels.factorise(
            self.blocks, self.links, self.cross, damping, self.num_poses, p.order, p.tops, p.rows, p.link_places,
            p.cross_places, p.row_tops, p.row_columns, p.row_places, self.where, self.pivots, self.values,
        )  # fmt: skip

    def step(
        self, poses: FloatArray, landmarks: FloatArray, new_poses: FloatArray, new_landmarks: FloatArray
    ) -> tuple[float, float]:
        """Write where the factored equations lead; return how the cost rises along its slope, and the largest change.

        Args:
            poses, landmarks: (k, 3), (l, 3) where they were formed.
            new_poses, new_landmarks: (k, 3), (l, 3), results.
        """
        p = self.pattern
        return _kernels.step(
            self.pivots, self.values, p.order, p.tops, p.rows, self.vector, self.columns, poses, landmarks, new_poses,
            new_landmarks,
        )  # fmt: skip

    def draw(self, poses: FloatArray, num_paths: int, rng: np.random.Generator) -> tuple[FloatArray, FloatArray]:
        """Return paths about poses (k, 3) and their log densities, see `MapEstimate.paths`."""
        p, seen = self.pattern, self.sightings
        normals = rng.standard_normal((p.drawn, 3, num_paths))
        normals[:, :, 0] = 0.0
        paths, log_densities = np.empty((len(poses), 3, num_paths)), np.empty(num_paths)
        _kernels.draw(
            normals, poses, self.columns, seen.keys, seen.starts, self.blocks, self.cross, self.pivots, self.values,
            p.order, p.ranks, p.tops, p.rows, p.row_tops, paths, log_densities,
        )  # fmt: skip
        return paths, log_densities

    def covariance(self, columns: IntArray) -> FloatArray:
        """Return the joint covariance (3 r, 3 r) of poses by their columns (r,)."""
        p = self.pattern
        return _kernels.covariance(self.pivots, self.values, p.ranks, p.tops, p.rows, columns // 3)

    def spreads(self, poses: FloatArray) -> FloatArray:
        """Return how far motions to each pose (k, 3) scatter, see `MapEstimate.spreads`."""
        p = self.pattern
        return _kernels.scatter_of_links(
            poses, self.columns, self.graph.parents, LEVER_ARM, self.pivots, self.values, p.order, p.ranks, p.tops,
            p.rows, p.row_tops, p.link_places,
        )  # fmt: skip
