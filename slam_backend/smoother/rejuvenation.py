"""Rejuvenation: replacement of depleted particles by samples from the posterior of whole paths.

The work can be divided into bounded slices, at most one per step of the filter. A slice adds a few new steps to the
graph and does two Gauss-Newton iterations; or does two more iterations and, if the descent has converged, joins surplus
keys; or, if the graph is at its mode, adds the newest keys, completes the descent and samples. The state between slices
is a graph and the damping of the next iteration.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import wrap_angle
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import Keys
from slam_backend.smoother.duplicates import find_duplicates, without_duplicates
from slam_backend.smoother.gauge import fix_gauge, fix_start, move
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import InitialPoses, LandmarkPositions, extend_graph
from slam_backend.smoother.graph_reduction import reduce_keyframes, relinearise, without_unused_frames
from slam_backend.smoother.log_arrays import REJECTED, LogArrays
from slam_backend.smoother.optimizer import NO_POSE, MapEstimate, optimize
from slam_backend.smoother.options import SmoothingOptions, keyframe_limit
from slam_backend.smoother.reassociation import LandmarkTable
from slam_backend.smoother.relocalisation import Relocated, relocalise
from slam_backend.smoother.sampling import (
    PathLandmarks,
    PathSamples,
    lane_rows,
    replay,
    sample_paths,
    tempered,
    transition_variances,
)
from slam_backend.state import Float, Int, Record, with_state

DRAFT_TOLERANCE = 10.0  # factor on the tolerance of descents without draws


class Particles(NamedTuple):
    """M particles from the posterior of whole paths.

    Attributes:
        poses, starts: (K, 3, M) float64 [m, m, rad], map frame. Newest pose and start of each robot, in a fixed gauge
            (see `fix_gauge`); known starts are unchanged.
        log_weights: (M,) float64, normalised.
        log_densities: (M,) float64. Log densities of the newest poses under the Gaussian about the mode, up to a
            constant: 0 for the first particle, whose path is the mode, unless more than M were drawn.
        ids: (l,) int64. Landmarks with at least one sighting.
        landmarks: Landmarks of these particles, in the order of `ids`.
        counts: (l,) int64. Number of measurements of each landmark.
        means, covariances: (K, 3), (K, 3, 3) float64. Newest poses under the Gaussian about the mode.
        biases: (K, 3, M) float64 [m/m, rad/m, rad/rad]. Mean of each robot's odometry bias, given the path.
        bias_covariances: (K, 3, 3) float64. Covariance of each bias given the path; zeros where there is none.
        frame: (3, 3) float64 [m, m, rad]. Covariance of the gauge, a motion of the whole map; not in the particles.
        start_scatters: (K, 3, 3) float64 [m, m, rad], start frames. Covariance of each start; not in the particles.
    """

    poses: FloatArray
    starts: FloatArray
    log_weights: FloatArray
    log_densities: FloatArray
    ids: IntArray
    landmarks: PathLandmarks
    counts: IntArray
    means: FloatArray
    covariances: FloatArray
    biases: FloatArray
    bias_covariances: FloatArray
    frame: FloatArray
    start_scatters: FloatArray


class Rejuvenation(NamedTuple):
    """Result of an attempt.

    Attributes:
        graph: Graph for the next attempt.
        reason: Reason for the lack of new particles; "" on success.
        ess: Effective sample size of the importance weights of all draws, at most M; NaN without draws.
        iterations: Iterations of the last descent.
        particles: New particles, or None.
        relocated: A robot that returned to older landmarks without noticing it; None: no robot.
    """

    graph: SlamGraph
    reason: str
    ess: float
    iterations: int
    particles: Particles | None
    relocated: Relocated | None = None


def at_given_poses(graph: SlamGraph, camera: FloatArray, options: SmoothingOptions) -> Rejuvenation:
    """Return a refusal because no pose is unknown yet; all measurements are kept for later attempts.

    Args:
        graph: Graph with all steps of the logs, and landmarks at the filter's positions.
        camera, options: See `Smoother`.
    """
    return Rejuvenation(reduce_keyframes(graph, camera, options), NO_POSE, float("nan"), 0, None)


def relinearised_and_reduced(
    graph: SlamGraph, mode: MapEstimate, camera: FloatArray, options: SmoothingOptions
) -> SlamGraph:
    """Return the graph at its mode; if it has too many keys, those with the smallest relative variances are joined.

    Args:
        graph: Graph of the mode.
        mode: MAP estimate with an empty `reason`.
        camera, options: See `Smoother`.
    """
    if graph.num_keys <= keyframe_limit(options, len(graph.landmark_ids), graph.latest) + graph.num_biases:
        return relinearise(graph, mode)
    variances = transition_variances(graph, mode)
    return reduce_keyframes(relinearise(graph, mode, variances), camera, options, mode.sightings)


def sample_particles(
    grown: SlamGraph,
    mode: MapEstimate,
    camera: FloatArray,
    num_particles: int,
    rng: np.random.Generator,
    options: SmoothingOptions,
    known: LandmarkTable | None = None,
    descriptor_gate: float = 0.0,
) -> Rejuvenation:
    """Draw particles about the mode of a graph.

    Args:
        grown: Graph with all steps of the logs.
        mode: MAP estimate of the graph with an empty `reason`.
        camera, rng, options: See `Smoother`.
        num_particles: M.
        known: Landmarks with descriptors, to detect duplicates. None: no detection.
        descriptor_gate: Largest L2 distance of similar descriptors.
    """
    draws = sample_paths(grown, mode, num_particles, rng)
    ess, needed = draws.sample_size, options.least_ess * num_particles
    chosen = tempered(draws, needed) if ess < needed else draws
    graph = reduce_keyframes(relinearise(grown, mode, draws.transition_variances), camera, options, mode.sightings)
    if math.isnan(ess):
        return Rejuvenation(graph, f"an effective sample size of {ess:.1f}", ess, mode.iterations, None)
    if known is not None and len(known.ids):
        duplicates = find_duplicates(grown, mode, draws, _descriptors(grown, known), descriptor_gate)
        if len(duplicates):
            graph = without_unused_frames(without_duplicates(graph, duplicates))
    return Rejuvenation(graph, "", ess, mode.iterations, _particles(grown, mode, chosen))


def _descriptors(graph: SlamGraph, known: LandmarkTable) -> NDArray[np.float32]:
    """Return descriptors (l, d) by row of the graph's landmarks, NaN where unknown."""
    at = np.minimum(np.searchsorted(known.ids, graph.landmark_ids), len(known.ids) - 1)
    result = known.descriptors[at]
    result[known.ids[at] != graph.landmark_ids] = np.nan
    return result


def _particles(graph: SlamGraph, mode: MapEstimate, draws: PathSamples) -> Particles:
    """Return the particles of draws, in a fixed gauge."""
    weights, counts = draws.weights, np.zeros(len(graph.landmark_ids), dtype=np.int64)
    np.add.at(counts, mode.sightings.landmarks, mode.sightings.counts)
    in_view = np.zeros(len(counts), dtype=np.bool_)
    in_view[graph.point_landmarks] = True
    rows, in_sight = np.flatnonzero(counts), np.flatnonzero(in_view & (counts > 0))
    paths = lane_rows(draws.poses)
    poses, starts = draws.poses[graph.last_keys], draws.poses[graph.first_keys]
    means = mode.poses[graph.last_keys]
    covariances = np.zeros((len(means), 3, 3))
    (free,) = (mode.columns[graph.last_keys] >= 0).nonzero()
    joint = mode.covariance(graph.last_keys[free])
    off, densities = (poses - means[:, :, None])[free].reshape(-1, poses.shape[2]), np.empty(len(weights))
    for place, robot in enumerate(free):
        covariances[robot] = joint[3 * place : 3 * place + 3, 3 * place : 3 * place + 3]
    if not _kernels.weigh_deviations(joint, off, densities):
        raise np.linalg.LinAlgError("the joint covariance of the robots' poses is not positive definite")
    biases, bias_covariances = np.zeros(poses.shape), np.zeros(covariances.shape)
    for owner, key in enumerate(graph.bias_keys.tolist()):
        if key >= 0:
            biases[owner], bias_covariances[owner] = _kernels.condition_bias(
                draws.poses, graph.part(Keys), graph.biases_of_odometry(), mode.odometry_infos, key
            )
    frame, start_scatters = np.zeros((3, 3)), np.zeros((len(means), 3, 3))
    tiles, _ = replay(mode, paths, len(weights), in_sight)
    held = fix_gauge(tiles, np.arange(len(in_sight)), mode.landmarks[in_sight], poses, means, weights)
    if held is not None:
        paths, poses, frame = lane_rows(move(draws.poses, held.motions)), held.poses, held.scatter
    unknown = (mode.columns[graph.first_keys] >= 0).nonzero()[0].tolist()
    for index in unknown:
        start = starts[index : index + 1]
        if held is not None:
            start[:] = move(start, held.motions)
        at = mode.poses[graph.first_keys[index]], means[index]
        start_scatters[index] = fix_start(start[0], poses[index], *at, weights)
    for array in (poses, starts, means):
        array[:, 2] = wrap_angle(array[:, 2])
    return Particles(
        poses, starts, np.log(np.maximum(weights, 1e-300)), densities, graph.landmark_ids[rows],
        PathLandmarks(paths, mode, rows), counts[rows], means, covariances, biases, bias_covariances, frame,
        start_scatters,
    )  # fmt: skip


SLICE_TOLERANCE = 100.0  # factor on the tolerance of slices without draws: the next slice continues the descent
STEPS = 2  # Gauss-Newton iterations in a slice: the second usually confirms the convergence of the first
LAST_STEPS = 3  # Gauss-Newton iterations in the slice that draws: only the last few keys are not at the mode


@with_state(graph=Record(SlamGraph), damping=Float(0.0), steps=Int())
class Draft(NamedTuple):
    """A graph in the middle of a descent.

    Attributes:
        graph: Graph with the current poses and landmarks of the descent.
        damping: Damping of the next iteration.
        steps: Number of iterations so far.
    """

    graph: SlamGraph
    damping: float = 0.0
    steps: int = 0


class Smoother(NamedTuple):
    """Slice-wise rejuvenation with fixed models and options.

    Attributes:
        motion: Noise of the odometry.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Options of the smoother.
        rng: Source of the draws.
        alignment: Gates and limits with which robots are found at older landmarks of their map.
    """

    motion: OdometryModel
    camera: FloatArray
    options: SmoothingOptions
    rng: np.random.Generator
    alignment: AlignmentOptions

    def add_logs(
        self,
        graph: SlamGraph,
        logs: Sequence[LogArrays],
        initial_poses: Sequence[InitialPoses],
        places: LandmarkPositions,
    ) -> SlamGraph | Draft | str:
        """Add all rows of short logs to the graph, and do the first iterations.

        Args:
            graph: Graph at its mode.
            logs: One log per robot, with the steps after `graph.latest`.
            initial_poses: Initial poses of each robot after some of these steps.
            places: Initial landmark positions from the filter, see `extend_graph`.

        Returns:
            Same result as `optimise_slice`.
        """
        grown = extend_graph(
            graph, logs, self.motion, self.camera[4:], initial_poses, self.options.rigid_within, places
        )
        return self.optimise_slice(Draft(graph=grown))

    def optimise_slice(self, draft: Draft) -> SlamGraph | Draft | str:
        """Do the next iterations of a descent.

        Args:
            draft: State of the descent.

        Returns:
            The graph on convergence, the new state before it, or the reason of a failure.
        """
        most = self._most(STEPS, draft.steps)
        mode = optimize(draft.graph, self.camera, self.options, most, draft.damping, SLICE_TOLERANCE)
        return self._after(draft, mode)

    def draw(
        self,
        graph: SlamGraph,
        logs: Sequence[LogArrays],
        initial_poses: Sequence[InitialPoses],
        places: LandmarkPositions,
        num_particles: int,
        known: LandmarkTable,
    ) -> Rejuvenation | SlamGraph | Draft | str:
        """Add the logs' last rows to the graph, and draw particles if `LAST_STEPS` iterations reach convergence.

        If no rows are left, slices have brought the graph to its mode: all iterations are done, and draws are refused
        if they do not reach it, as slices after them would end there again.

        Args:
            graph, logs, initial_poses, places: Same arguments as `add_logs`.
            num_particles: M.
            known: Landmarks of the filter, to detect duplicates and robots that hold a wrong pose.

        Returns:
            The result of the draws, or without draws the same result as `optimise_slice`.
        """
        grown = extend_graph(
            graph, logs, self.motion, self.camera[4:], initial_poses, self.options.rigid_within, places
        )
        draft = Draft(graph=grown)
        is_last = not any(map(len, logs))
        mode = optimize(grown, self.camera, self.options, None if is_last else self._most(LAST_STEPS))
        if not mode.reason:
            relocated = relocalise(relinearise(grown, mode), mode, known, self.alignment)
            if relocated is not None and (shifted := relocated.graph) is not None:
                moved = optimize(shifted, self.camera, self.options)
                if moved.reason:
                    relocated = None
                else:
                    grown, mode = shifted, moved
            drawn = sample_particles(
                grown, mode, self.camera, num_particles, self.rng, self.options, known, self.alignment.descriptor_gate
            )
            return drawn._replace(relocated=relocated)
        if mode.reason == NO_POSE:
            return at_given_poses(grown, self.camera, self.options)
        if is_last and mode.unfinished:
            return Rejuvenation(graph, mode.reason, float("nan"), mode.iterations, None)
        return self._after(draft, mode)

    def without_measurements(self, graph: SlamGraph, logs: Sequence[LogArrays]) -> SlamGraph:
        """Return the graph extended by the odometry of the logs, without their measurements."""
        blind = [replace(log, ids=np.full_like(log.ids, REJECTED)) for log in logs]
        return extend_graph(graph, blind, self.motion, self.camera[4:], rigid_within=self.options.rigid_within)

    def _most(self, steps: int, done: int = 0) -> int:
        """Return the number of iterations of a slice, within those of the options that are left."""
        return min(steps, self.options.max_iterations - done)

    def _after(self, draft: Draft, mode: MapEstimate) -> SlamGraph | Draft | str:
        """Return the result of `optimise_slice` after its iterations."""
        if not mode.reason:
            return relinearised_and_reduced(draft.graph, mode, self.camera, self.options)
        if mode.reason == NO_POSE:
            return at_given_poses(draft.graph, self.camera, self.options).graph
        steps = draft.steps + mode.iterations
        if not mode.unfinished:
            return mode.reason
        if steps >= self.options.max_iterations:
            return f"no convergence in {steps} iterations"
        return Draft(graph=relinearise(draft.graph, mode), damping=mode.damping, steps=steps)
