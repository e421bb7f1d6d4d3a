"""`rejuvenate`: new particles from the posterior of whole paths, in place of those that resampling has impoverished.

The work can be done in slices, each of them bounded, so that no step of a filter waits for more than one. A slice
either takes in a few new steps and does two steps of Gauss-Newton; or does two more of these, until the descent has
ended, and then joins surplus keys; or, when all is at its mode, takes in the very last keys, ends the descent and
samples. Between slices there is nothing but a graph, and how damped its next step is.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import wrap_angle
from slam_backend.models.odometry import OdometryModel
from slam_backend.resampling import systematic
from slam_backend.smoother import _kernels
from slam_backend.smoother.duplicates import find_duplicates, without_duplicates
from slam_backend.smoother.gauge import fix_gauge, fix_start, move, transform_tiles
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import InitialPoses, LandmarkPositions, extend_graph, log_head
from slam_backend.smoother.graph_reduction import reduce_keyframes, relinearise, without_unused_frames
from slam_backend.smoother.log_arrays import EXACT, REJECTED, LogArrays
from slam_backend.smoother.optimizer import NO_POSE, MapEstimate, optimize
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.sampling import PathSamples, sample_paths, sample_transition_variances

DRAFT_TOLERANCE = 10.0  # times the tolerance: a descent that is not followed by draws may end so much sooner


class LandmarkDescriptors(NamedTuple):
    """Appearance of landmarks that no caller has named.

    Attributes:
        ids: (n,) int64, ascending.
        descriptors: (n, d) float32.
        gate: L2 distance beyond which two do not look alike.
    """

    ids: IntArray
    descriptors: NDArray[np.float32]
    gate: float


class Particles(NamedTuple):
    """M particles from the posterior of whole paths.

    Attributes:
        poses, starts: (K, 3, M) float64 [m, m, rad], map frame. Newest pose and start of each robot. A start that is
            given stays where it is; all else is held, see `fix_gauge`.
        log_weights: (M,) float64, normalised.
        log_densities: (M,) float64. Of the newest poses under the Gaussian about the mode, up to a constant: 0 for the
            first particle, whose path is the mode, unless more than M were drawn.
        ids: (l,) int64. Landmarks that have a sighting.
        tiles: (l, P / LANES, 9, LANES) float64. Their means (3) and covariances (6), map frame, in blocks of lanes.
        counts: (l,) int64. Measurements of each.
        means, covariances: (K, 3), (K, 3, 3) float64. The newest poses under the Gaussian about the mode.
        frame: (3, 3) float64 [m, m, rad]. Covariance of the motion of the whole map that the particles do not show.
        start_scatters: (K, 3, 3) float64 [m, m, rad], start frames. Covariance of each start that they do not show.
    """

    poses: FloatArray
    starts: FloatArray
    log_weights: FloatArray
    log_densities: FloatArray
    ids: IntArray
    tiles: FloatArray
    counts: IntArray
    means: FloatArray
    covariances: FloatArray
    frame: FloatArray
    start_scatters: FloatArray


class Rejuvenation(NamedTuple):
    """What came of an attempt.

    Attributes:
        graph: To go on with next time.
        reason: Why there are no new particles; "" if there are.
        ess: Effective sample size of the importance weights of all draws, at most M; NaN if it did not come to that.
        iterations: Of the last descent.
        particles: The new ones, or None.
    """

    graph: SlamGraph
    reason: str
    ess: float
    iterations: int
    particles: Particles | None


def rejuvenate(
    graph: SlamGraph,
    logs: Sequence[LogArrays],
    motion: OdometryModel,
    camera: FloatArray,
    num_particles: int,
    rng: np.random.Generator,
    options: SmoothingOptions,
    guesses: Sequence[InitialPoses] | None = None,
    looks: LandmarkDescriptors | None = None,
    places: LandmarkPositions | None = None,
) -> Rejuvenation:
    """Take in what the robots did since, smooth, and draw particles.

    A long log is taken in part by part, so that the effort stays that of `most_keys` poses each time. Nothing is raised
    for what may happen in a run: the reason says why there are no new particles.

    Args:
        graph: As the last attempt left it, or `SlamGraph.at_starts`.
        logs: Per robot, of the steps after `graph.latest`.
        motion: Noise of the odometry.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        num_particles: M.
        rng: Source of the draws.
        options: What decides the rest.
        guesses: Per robot where it may be after some of the new steps.
        looks: For landmarks that turn out to be one. None: all are what they are called.
        places: Where the filter holds landmarks to be, see `extend_graph`.

    Returns:
        The graph to go on with, and M particles, or why there are none.
    """
    if any((log.kinds == EXACT).any() for log in logs):
        return Rejuvenation(graph, "poses that were given as exact", float("nan"), 0, None)
    share = max(1, 2 * options.most_keys(len(logs)) // len(logs))
    rest = list(logs)
    while True:
        last = all(len(log) <= share for log in rest)
        first = [log_head(log, share) for log in rest]
        grown = extend_graph(graph, first, motion, camera[4:], guesses, options.rigid_within, places)
        mode = optimize(grown, camera, options, looseness=1.0 if last else DRAFT_TOLERANCE)
        if mode.reason == NO_POSE:
            unmoved = at_given_poses(grown, camera, options)
            if last:
                return unmoved
            graph = unmoved.graph
        elif mode.reason:
            return Rejuvenation(graph, mode.reason, float("nan"), mode.iterations, None)
        elif last:
            return sample_particles(grown, mode, camera, num_particles, rng, options, looks)
        else:
            graph = relinearised_and_reduced(grown, mode, camera, options, rng)
        rest = [log.since(int(graph.latest[i]) + 1) for i, log in enumerate(rest)]


def at_given_poses(graph: SlamGraph, camera: FloatArray, options: SmoothingOptions) -> Rejuvenation:
    """Tell that there is no pose to seek yet; all that was measured is kept, for robots may move later.

    Args:
        graph: With all that the logs hold; its landmarks are where the filter has them, which knows the poses as well.
        camera, options: As of `rejuvenate`.
    """
    return Rejuvenation(reduce_keyframes(graph, camera, options), NO_POSE, float("nan"), 0, None)


def relinearised_and_reduced(
    graph: SlamGraph, mode: MapEstimate, camera: FloatArray, options: SmoothingOptions, rng: np.random.Generator
) -> SlamGraph:
    """Return the graph at its mode; if it has too many keys some are joined, those whose motions scatter least.

    Args:
        graph: Which has the mode.
        mode: Of use, with an empty `reason`.
        camera, options: As of `rejuvenate`.
        rng: Source of draws, where these are the cheaper way to see what scatters.
    """
    if graph.num_keys <= options.most_keys(len(graph.last_keys)):
        return relinearise(graph, mode)
    spreads = sample_transition_variances(graph, mode, rng) if mode.crowded else mode.spreads()
    return reduce_keyframes(relinearise(graph, mode, spreads), camera, options, mode.sightings)


def sample_particles(
    grown: SlamGraph,
    mode: MapEstimate,
    camera: FloatArray,
    num_particles: int,
    rng: np.random.Generator,
    options: SmoothingOptions,
    looks: LandmarkDescriptors | None = None,
) -> Rejuvenation:
    """Draw particles about the mode of a graph.

    Args:
        grown: The graph with all that the logs hold.
        mode: Of it, of use.
        camera, num_particles, rng, options, looks: As of `rejuvenate`.
    """
    draws = sample_paths(grown, mode, num_particles, rng)
    chosen, ess = draws, draws.sample_size
    needed = options.least_ess * num_particles
    if needed > ess >= needed / options.more_draws:
        many = sample_paths(grown, mode, options.more_draws * num_particles, rng)
        chosen = many.taken(systematic(many.weights, rng, num_particles))
        ess = min(many.sample_size, float(num_particles))
    graph = reduce_keyframes(relinearise(grown, mode, draws.spreads), camera, options, mode.sightings)
    if not ess >= needed:
        return Rejuvenation(graph, f"an effective sample size of {ess:.1f}", ess, mode.iterations, None)
    if looks is not None and len(looks.ids):
        duplicates = find_duplicates(grown, mode, draws, _descriptors(grown, looks), looks.gate)
        if len(duplicates):
            graph = without_unused_frames(without_duplicates(graph, duplicates))
    return Rejuvenation(graph, "", ess, mode.iterations, _particles(grown, mode, chosen))


def _descriptors(graph: SlamGraph, looks: LandmarkDescriptors) -> NDArray[np.float32]:
    """Return descriptors (l, d) by row of the graph's landmarks, NaN where there is none."""
    at = np.minimum(np.searchsorted(looks.ids, graph.landmark_ids), len(looks.ids) - 1)
    result = looks.descriptors[at]
    result[looks.ids[at] != graph.landmark_ids] = np.nan
    return result


def _particles(graph: SlamGraph, mode: MapEstimate, draws: PathSamples) -> Particles:
    """Gather what particles hold."""
    weights, tiles, ids, landmarks = draws.weights, draws.tiles, graph.landmark_ids, mode.landmarks
    counts, in_view = np.zeros(len(ids), dtype=np.int64), np.zeros(len(ids), dtype=np.bool_)
    np.add.at(counts, mode.sightings.landmarks, mode.sightings.counts)
    in_view[graph.point_landmarks] = True
    if not counts.all():
        seen = counts > 0
        tiles, ids, landmarks, in_view, counts = tiles[seen], ids[seen], landmarks[seen], in_view[seen], counts[seen]
    poses, starts = draws.poses[graph.last_keys], draws.poses[graph.first_keys]
    means = mode.poses[graph.last_keys]
    covariances = np.zeros((len(means), 3, 3))
    (sought,) = (mode.columns[graph.last_keys] >= 0).nonzero()
    joint = mode.covariance(graph.last_keys[sought])
    off, densities = (poses - means[:, :, None])[sought].reshape(-1, poses.shape[2]), np.empty(len(weights))
    for place, robot in enumerate(sought):
        covariances[robot] = joint[3 * place : 3 * place + 3, 3 * place : 3 * place + 3]
    if not _kernels.weigh_deviations(joint, off, densities):
        raise np.linalg.LinAlgError("the joint covariance of the robots' poses is not positive definite")
    frame, start_scatters = np.zeros((3, 3)), np.zeros((len(means), 3, 3))
    (in_sight,) = in_view.nonzero()
    held = fix_gauge(tiles, in_sight, landmarks, poses, means, weights)
    if held is not None:
        transform_tiles(tiles, held.motions)
        poses, frame = held.poses, held.scatter
    for index in (mode.columns[graph.first_keys] >= 0).nonzero()[0].tolist():
        own = starts[index : index + 1]
        if held is not None:
            move(own, held.motions, own)
        at = mode.poses[graph.first_keys[index]], means[index]
        start_scatters[index] = fix_start(own[0], poses[index], *at, weights)
    for array in (poses, starts, means):
        array[:, 2] = wrap_angle(array[:, 2])
    return Particles(
        poses, starts, np.log(np.maximum(weights, 1e-300)), densities, ids, tiles, counts, means, covariances, frame,
        start_scatters,
    )  # fmt: skip


SLICE_TOLERANCE = 100.0  # times the tolerance: slices without draws need not end a descent that the next goes on with
STEPS = 2  # of Gauss and Newton in a slice: the second as a rule tells that the first has ended the descent
LAST_STEPS = 3  # of Gauss and Newton in the slice that draws: the graph was at its mode but for the last few keys


class Draft(NamedTuple):
    """A graph in the middle of a descent.

    Attributes:
        graph: Its poses and landmarks are where the descent has got to.
        damping: Of the next step.
        steps: Done so far.
    """

    graph: SlamGraph
    damping: float = 0.0
    steps: int = 0


class Smoother(NamedTuple):
    """What all slices need.

    Attributes:
        motion: Noise of the odometry.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: What decides the rest.
        rng: Source of the draws.
    """

    motion: OdometryModel
    camera: FloatArray
    options: SmoothingOptions
    rng: np.random.Generator

    def add_logs(
        self, graph: SlamGraph, logs: Sequence[LogArrays], guesses: Sequence[InitialPoses], places: LandmarkPositions
    ) -> SlamGraph | Draft | str:
        """Take in all rows of the logs, which are few, and do the first steps.

        Args:
            graph: At its mode.
            logs: Per robot, of the steps after `graph.latest`.
            guesses: Per robot where it may be after some of these steps.
            places: Where the filter holds landmarks to be, see `extend_graph`.

        Returns:
            As of `optimise_slice`.
        """
        grown = extend_graph(graph, logs, self.motion, self.camera[4:], guesses, self.options.rigid_within, places)
        return self.optimise_slice(Draft(graph=grown))

    def optimise_slice(self, draft: Draft) -> SlamGraph | Draft | str:
        """Do the next steps of a descent.

        Args:
            draft: How it stands.

        Returns:
            The graph if that ended the descent, how it now stands if not, or what is wrong.
        """
        mode = optimize(draft.graph, self.camera, self.options, STEPS, draft.damping, SLICE_TOLERANCE)
        return self._after(draft, mode)

    def draw(
        self,
        graph: SlamGraph,
        logs: Sequence[LogArrays],
        guesses: Sequence[InitialPoses],
        places: LandmarkPositions,
        num_particles: int,
        looks: LandmarkDescriptors,
    ) -> Rejuvenation | SlamGraph | Draft | str:
        """Take in the logs' last rows, and draw particles, if so few steps end the descent.

        Args:
            graph, logs, guesses, places: As of `take_in`.
            num_particles: M.
            looks: For landmarks that turn out to be one.

        Returns:
            What came of the draws, or else as of `optimise_slice`.
        """
        grown = extend_graph(graph, logs, self.motion, self.camera[4:], guesses, self.options.rigid_within, places)
        draft = Draft(graph=grown)
        mode = optimize(grown, self.camera, self.options, LAST_STEPS)
        if not mode.reason:
            return sample_particles(grown, mode, self.camera, num_particles, self.rng, self.options, looks)
        if mode.reason == NO_POSE:
            return at_given_poses(grown, self.camera, self.options)
        return self._after(draft, mode)

    def without_measurements(self, graph: SlamGraph, logs: Sequence[LogArrays]) -> SlamGraph:
        """Return the graph after all rows of the logs, of which only the odometry is believed."""
        blind = [replace(log, ids=np.full_like(log.ids, REJECTED)) for log in logs]
        return extend_graph(graph, blind, self.motion, self.camera[4:], rigid_within=self.options.rigid_within)

    def _after(self, draft: Draft, mode: MapEstimate) -> SlamGraph | Draft | str:
        """Return what a step came to, as of `optimise_slice`."""
        if not mode.reason:
            return relinearised_and_reduced(draft.graph, mode, self.camera, self.options, self.rng)
        if mode.reason == NO_POSE:
            return at_given_poses(draft.graph, self.camera, self.options).graph
        steps = draft.steps + mode.iterations
        if not mode.unfinished:
            return mode.reason
        if steps >= self.options.max_iterations:
            return f"no convergence in {steps} iterations"
        return Draft(graph=relinearise(draft.graph, mode), damping=mode.damping, steps=steps)
