"""The most probable paths and landmarks: Gauss-Newton over key poses, landmarks eliminated."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack

from slam_backend.errors import FloatArray, IntArray
from slam_backend.smoothing import _kernels
from slam_backend.smoothing._kernels import FREE
from slam_backend.smoothing.graph import PathGraph
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.smoothing.sightings import Sightings

FIRST_DAMPING, MOST_DAMPING = 1e-4, 1e8
LARGEST_STEP = 1e3  # [m, rad]; nothing is sought so far away
CREEP = 10.0  # times the tolerance: so far from its end a descent may be that has used up the options' iterations


@dataclass(frozen=True, slots=True, eq=False)
class Mode:
    """The most probable paths, and the Gaussian about them.

    Attributes:
        poses: (k, 3) float64 [m, m, rad], map frame; headings are not wrapped against each other.
        landmarks: (l, 3) float64 [m], map frame.
        columns: (k,) int64. First row of each key in `factor`, `FREE` where the pose is given.
        factor: (n, n) float64, upper triangle U with U^T U the information of the paths, landmarks integrated out.
        sightings: As linearised there.
        odometry_infos: (k, 3, 3) float64. Information of the odometry from the key before; zeros where there is none.
        cost: Half the sum of squared distances (robust, and up to a constant of the frozen sightings).
        iterations: Systems solved.
        damping: Of the last system; where a descent that was not given the time goes on.
        reason: Why it is of no use; "" if it is of use. Poses and landmarks are then where the descent got to.
    """

    poses: FloatArray
    landmarks: FloatArray
    columns: IntArray
    factor: FloatArray
    sightings: Sightings
    odometry_infos: FloatArray
    cost: float
    iterations: int
    damping: float
    reason: str

    @property
    def unfinished(self) -> bool:
        """Whether nothing is wrong with the descent but that it was given too few iterations."""
        return bool(self.reason) and np.isfinite(self.cost)


def find_mode(
    graph: PathGraph, camera: FloatArray, options: SmoothingOptions, most: int | None = None, damping: float = 0.0
) -> Mode:
    """Descend from where the graph stands.

    A step that does not lower the cost is tried again with more damping (Levenberg, Marquardt). Where measurements lie
    at the edge of the kernel a descent may creep, each step promising what the one before did. So it ends in the last
    iteration of the options, too, if it can fall by no more than `CREEP` times the tolerance: by default half of a
    squared distance of two, in a space of hundreds of dimensions.

    Args:
        graph: Key poses, odometry, measurements; its poses and landmarks are the start.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Kernel, scale of the noise, tolerance, iterations.
        most: Iterations; None: as in the options.
        damping: Of the first one.
    """
    sought = graph.previous >= 0
    columns = np.where(sought, 3 * np.cumsum(sought) - 3, FREE)
    size = 3 * int(sought.sum())
    sightings = Sightings.of(graph)
    poses, landmarks = graph.poses.copy(), graph.landmarks.copy()
    empty, informations = np.zeros((0, 0)), np.zeros_like(graph.noises)

    creep = CREEP if most is None else 1.0
    most = options.max_iterations if most is None else most

    def given_up(reason: str, iterations: int = 0, cost: float = np.inf) -> Mode:
        return Mode(poses, landmarks, columns, empty, sightings, informations, cost, iterations, damping, reason)

    if not size:
        return given_up("no pose to seek")
    noises = graph.noises[sought]
    if not _kernels.invert(noises, of_sought := np.empty_like(noises)):
        return given_up("odometry without noise")
    informations[sought] = of_sought
    system = _System(graph, columns, size, informations, sightings, camera, options)
    cost = system.form(poses, landmarks)
    for iteration in range(1, most + 1):
        if not np.isfinite(cost):
            return given_up("a landmark at no finite place", iteration)
        factor = system.factor(damping)
        if factor is None:
            return given_up("a singular system", iteration)
        change = -lapack.dpotrs(factor, system.vector, lower=0)[0]
        if not np.abs(change).max() < LARGEST_STEP:
            return given_up("a descent that leaves the world", iteration)
        expected = -0.5 * float(system.vector @ change)  # if the cost were a parabola
        trial_poses, trial_landmarks = poses.copy(), landmarks.copy()
        trial_poses[sought] += change.reshape(-1, 3)
        system.move(trial_landmarks, change)
        near = creep * options.tolerance if iteration == most else options.tolerance
        if expected <= near and damping == 0.0:
            return Mode(
                trial_poses, trial_landmarks, columns, factor, sightings, informations, cost - expected,
                iteration, damping, "",
            )  # fmt: skip
        trial_cost = system.form(trial_poses, trial_landmarks)
        if trial_cost <= cost + 1e-9 * abs(cost):
            poses, landmarks, cost = trial_poses, trial_landmarks, trial_cost
            damping = damping / 10.0 if damping > FIRST_DAMPING else 0.0
        else:
            damping = max(10.0 * damping, FIRST_DAMPING)
            if damping > MOST_DAMPING:
                return given_up("no descent", iteration)
            cost = system.form(poses, landmarks)
    return given_up(f"no convergence in {most} iterations", most, cost)


class _System:
    """Room for the normal equations, and what they are formed of."""

    def __init__(
        self, graph: PathGraph, columns: IntArray, size: int, informations: FloatArray, sightings: Sightings,
        camera: FloatArray, options: SmoothingOptions,
    ) -> None:  # fmt: skip
        self.graph, self.columns, self.sightings = graph, columns, sightings
        self.informations, self.camera, self.options = informations, camera, options
        self.matrix = np.zeros((size, size))
        self.vector = np.zeros(size)
        self.cross = np.zeros((len(sightings.keys), 3, 3))
        self.spreads = np.zeros((len(graph.landmark_ids), 6))
        self.forces = np.zeros((len(graph.landmark_ids), 3))

    def form(self, poses: FloatArray, landmarks: FloatArray) -> float:
        """Form the equations at poses (k, 3) and landmarks (l, 3), map frame; return the cost there."""
        seen, graph = self.sightings, self.graph
        loss = seen.linearise(graph, poses, landmarks, self.camera, self.options.noise_scale, self.options.kernel)
        self.matrix.fill(0.0)
        self.vector.fill(0.0)
        return loss + _kernels.assemble(
            poses, landmarks, self.columns, graph.previous, graph.motions, self.informations, seen.keys, seen.starts,
            seen.centres, seen.infos, seen.slopes, self.matrix, self.vector, self.cross, self.spreads, self.forces,
        )  # fmt: skip

    def factor(self, damping: float) -> FloatArray | None:
        """Return U with U^T U = the matrix, its diagonal enlarged, in the matrix's place; None if there is none."""
        if damping:
            self.matrix[np.diag_indices(len(self.matrix))] *= 1.0 + damping
        upper, info = lapack.dpotrf(self.matrix.T, lower=0, overwrite_a=1, clean=0)
        return upper if info == 0 else None

    def move(self, landmarks: FloatArray, change: FloatArray) -> None:
        """Move landmarks (l, 3), in place, with a change (n,) of the poses from where the equations were formed."""
        seen = self.sightings
        _kernels.move_landmarks(
            landmarks, self.columns, seen.keys, seen.starts, self.cross, self.spreads, self.forces, change
        )
