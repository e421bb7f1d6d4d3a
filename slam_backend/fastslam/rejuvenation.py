"""Rejuvenation of a filter: schedule and inputs of the smoother, and replacement of the particles by its samples."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.read_only import as_read_only, with_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.particle_maps import ParticleMaps, present_slots, write_summary
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import compose, inverse, rotate_covariances
from slam_backend.maps.landmark_map import MapSummaryRows
from slam_backend.smoother.graph import SlamGraph, mean_pose, scattered
from slam_backend.smoother.graph_building import InitialPoses, LandmarkPositions, log_head
from slam_backend.smoother.joint_graphs import merge_thinned
from slam_backend.smoother.log_arrays import LogArrays
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.reassociation import LandmarkTable, RejectedMeasurements, reassociate
from slam_backend.smoother.rejuvenation import Draft, Particles, Rejuvenation, Smoother
from slam_backend.smoother.relocalisation import alignment_options
from slam_backend.smoother.sampling import PathLandmarks
from slam_backend.state import MAX_INT, Dict, Each, Flag, Int, Maybe, Record, Sizes, State


def landmark_positions(maps: ParticleMaps, best: int) -> LandmarkPositions:
    """Return the landmark positions in the most probable particle."""
    rows = MapSummaryRows.allocate(len(maps.ids))
    num = write_summary(maps, best, 1, rows, 0)
    return LandmarkPositions(rows.counts_and_ids[:num, 1].copy(), rows.positions[:num, :3].copy())


def landmark_table(maps: ParticleMaps, best: int) -> LandmarkTable:
    """Return the landmarks of the most probable particle that have no caller's name."""
    slots = maps.used_slots()
    slots = slots[maps.identities[slots] < 0]
    values, counts = maps.of_particle(best, slots)
    held = counts > 0
    slots, values = slots[held], values[held]
    return LandmarkTable(maps.ids[slots], values[:, :3], values[:, 3:], counts[held], maps.descriptors[slots])


def log_tails(logs: Sequence[RobotLog], graph: SlamGraph, until: SlamGraph | None = None) -> list[LogArrays]:
    """Return the entries of the logs after a graph's last steps, up to those of another."""
    new = [log.arrays(int(latest) + 1) for log, latest in zip(logs, graph.latest, strict=True)]
    if until is None:
        return new
    ends = [np.searchsorted(log.steps, last, side="right") for log, last in zip(new, until.latest, strict=True)]
    return [log_head(log, int(end)) for log, end in zip(new, ends, strict=True)]


def max_pending_steps(logs: Sequence[RobotLog], graph: SlamGraph) -> int:
    """Return the largest number of steps in a log after a graph's last ones."""
    return max(log.num_since(step + 1) for log, step in zip(logs, graph.latest.tolist(), strict=True))


class NewLandmarks(NamedTuple):
    """Landmarks of new particles: those of the most probable one so far that a sighting supports.

    Landmarks of other particles only are dropped: the log holds the data association of the most probable one. Names,
    descriptors and odds stay; where a landmark's odds differ between particles, all get the mean of those that hold it.
    The smoother assumes static landmarks; their random walk until the next sighting is added here. Positions are
    computed where they are written.

    Attributes:
        counts: (n, 1) int64. Number of measurements of each landmark, the same in all particles.
        descriptors: (n, d) float32.
        ids, identities, last_seen: (n,) int64, see `MapStore`; by ascending id.
        next_id: Name of the next landmark.
        odds: (n, 1) float64, or None if existence is not estimated.
        landmarks: Positions, and covariances given the paths.
        rows: (n,) rows of the landmarks in `landmarks`.
        walk: Variance [m^2] along each axis, see `FilterOptions.landmark_walk`.
    """

    counts: IntArray
    descriptors: NDArray[np.float32]
    ids: IntArray
    identities: IntArray
    last_seen: IntArray
    next_id: int
    odds: FloatArray | None
    landmarks: PathLandmarks
    rows: IntArray
    walk: float

    @classmethod
    def of(cls, maps: ParticleMaps, best: int, particles: Particles, walk: float) -> Self:
        """Return the landmarks of new particles; arrays are copies.

        Args:
            maps: Maps of the filter so far.
            best: Index of its most probable particle.
            particles: The new particles.
            walk: See the class.
        """
        slots = present_slots(maps, best, 1)
        order, names = particles.ids.argsort(), maps.ids[slots]
        _, of_slots, at = np.intersect1d(names, particles.ids[order], assume_unique=True, return_indices=True)
        slots, rows = slots[of_slots], order[at]
        odds = None if maps.log_odds_prior is None else mean_odds(*maps.odds_and_counts(slots))
        return cls(
            particles.counts[rows, None], maps.descriptors[slots], maps.ids[slots], maps.identities[slots],
            maps.last_seen[slots], maps.next_id, odds, particles.landmarks, rows, walk,
        )  # fmt: skip

    def write(self, maps: ParticleMaps) -> None:
        """Replace all landmarks of all particles by these."""
        maps.load_metadata(
            self.counts, self.descriptors, self.ids, self.identities, self.next_id, self.odds, self.last_seen
        )  # fmt: skip
        self.landmarks.write(self.rows, self.walk, maps.blocks)  # the walk: (7) of docs/reference/smoother.md


def mean_odds(odds: FloatArray, counts: NDArray[np.integer[Any]]) -> FloatArray:
    """Return the means (n, 1) of log-odds (n, M) over the particles whose counts (n, M) are above 0, 0 if none are."""
    held = counts > 0
    return np.asarray((odds * held).sum(axis=1) / np.maximum(held.sum(axis=1), 1))[:, None]


def joint_graph(
    graph_a: SlamGraph, graph_b: SlamGraph, starts: Sequence[FloatArray], frames: tuple[FloatArray, FloatArray],
    renamed: IntArray, camera: FloatArray, options: SmoothingOptions,
) -> tuple[SlamGraph, FloatArray]:  # fmt: skip
    """Return the graph of both groups' robots, and the motion (3,) [m, m, rad] from b's frame to a's.

    Args:
        graph_a, graph_b: Graphs of groups a and b, in their frames.
        starts: Start poses, three arrays (K, 3, M): of the robots of a, in a's frame; of b, in b's; of both, a's first,
            in a's.
        frames: Gauge covariances (3, 3) of a's and b's maps, not represented by the particles.
        renamed: (n, 2) rows (name in b, name in the joint map).
        camera, options: See `merge_thinned`.
    """
    robot = int(np.flatnonzero(graph_b.parents[graph_b.first_keys] < 0)[0])  # one that defines b's frame
    start = starts[2][len(starts[0]) + robot]
    began = graph_b.poses[graph_b.first_keys[robot]].copy()  # writable, as `add_gauge_covariance` is compiled for
    motion = compose(mean_pose(start), inverse(began))
    spreads = scattered(start)[None], np.zeros((1, 3, 3))
    for frame, pose, spread in zip(frames, (mean_pose(start), began), spreads, strict=True):
        _kernels.add_gauge_covariance(frame, pose[None], spread)
    spread = spreads[0][0] + rotate_covariances(float(motion[2]), spreads[1][0])
    return merge_thinned(graph_a, graph_b, motion, renamed, spread, camera, options), motion


MIN_CLOSURE_MATCHES = 3  # matches with landmarks not seen for long that count as a loop closure in one step
MIN_INTERVAL_FRACTION = 5  # a loop closure shortens the interval to a fifth at most
MIN_ROWS = 8  # least steps of each log in a slice, so that the work keeps up with the input


class RejuvenationScheduler:
    """Smoother of one filter, its schedule, and initial poses of the steps since it last ran.

    Args:
        options: Options of the filter, with `rejuvenate_every` set.
        num_robots: K.

    Attributes:
        steps: Number of steps recorded.
    """

    STATE = State(
        graph=Maybe(Record(SlamGraph)),
        draft=Maybe(Record(Draft)),
        requested=Flag(),
        waited=Int(),
        read=Int(),
        closed=Flag(),
        exact=Flag(),
        last_closing=Int(),
        steps=Int(),
        initial_poses=Each(Record(InitialPoses), "K"),
        rejected=Each(Dict(Int(), Record(RejectedMeasurements)), "K", list),
    )

    def __init__(self, options: FilterOptions, num_robots: int) -> None:
        assert options.rejuvenate_every is not None
        self.steps = 0
        self._options = options
        self._every = options.rejuvenate_every
        self._noiseless = options.motion.is_noiseless
        self._graph: SlamGraph | None  # at its mode
        self._oldest: int  # least of the robots' last steps in the graph
        self._num_robots = num_robots
        self._share: int  # steps of a robot in a slice
        self._set_graph(None)
        self._draft: Draft | None = None  # the graph with new steps, before convergence
        self._requested = False  # rejuvenation requested
        self._waited = 0  # steps since the last rejuvenation
        self._read = 0  # measurements since then
        self._closed = False  # loop closure since then
        self._exact = False  # an exact pose disables rejuvenation for good
        self._last_closing = 0  # last step with matches of landmarks not seen for long
        self._initial = [InitialPoses.empty() for _ in range(num_robots)]
        self._rejected: list[dict[int, RejectedMeasurements]] = [{} for _ in range(num_robots)]

    # ------------------------------------------------------------------ in each step

    def add_initial_poses(self, robot: int, steps: IntArray, poses: FloatArray, is_placed: bool) -> None:
        """Record the estimated poses (n, 3) of a robot after steps (n,) with input; `is_placed` marks exact poses."""
        if is_placed:
            self._exact = True
            self._initial = [InitialPoses.empty() for _ in self._initial]
            for rejected in self._rejected:
                rejected.clear()
        if not (self._exact or self._noiseless):
            self._initial[robot] = self._initial[robot].with_later(steps, poses)

    def add_rejected(self, robot: int, step: int, ids: IntArray, descriptors: NDArray[np.float32]) -> None:
        """Record which of a robot's measurements without names were neither matched nor new, by their ids (n,)."""
        rejected = [row for row, name in enumerate(ids.tolist()) if name < 0]
        if rejected and not self._why_disabled:
            rows = np.array(rejected)
            self._rejected[robot][step] = with_read_only(RejectedMeasurements(rows, descriptors[rows]))

    def record_step(self, matched: int, long_unseen: int) -> None:
        """Record a step: number of measurements matched or new, and of matches with landmarks not seen for long."""
        self.steps += 1
        self._waited += 1
        self._read += matched
        after = self._options.smoothing.closure_after
        if after > 0 and long_unseen >= MIN_CLOSURE_MATCHES:
            self._closed |= 2 * (self.steps - self._last_closing) > after  # otherwise the same loop closure goes on
            self._last_closing = self.steps

    def request(self) -> None:
        """Make a rejuvenation due now, as before a merge."""
        self._requested = True

    @property
    def graph(self) -> SlamGraph | None:
        """Graph at its mode, up to the last slice of work; None before the first one."""
        return self._graph

    @property
    def requested(self) -> bool:
        """Whether `request` was called and the rejuvenation is still outstanding."""
        return self._requested

    @property
    def is_disabled(self) -> bool:
        """Whether rejuvenation is impossible for good."""
        return bool(self._why_disabled)

    @property
    def _why_disabled(self) -> str:
        """Reason why rejuvenation is impossible; "" if it is possible."""
        if self._exact:
            return "poses that were given as exact"
        return "odometry without noise" if self._noiseless else ""

    @property
    def is_due(self) -> bool:
        """Whether a rejuvenation is due."""
        if self._requested:
            return True
        haste = MIN_INTERVAL_FRACTION if self._closed else 1
        if haste * self._waited < self._every:
            return False
        smoothing = self._options.smoothing
        sightings = 0 if self._graph is None else self._graph.num_sightings - smoothing.free_sightings
        return haste * smoothing.effort * self._read >= sightings

    def is_waiting(self, step: int) -> bool:
        """Return whether nothing is due after a step for any content of the logs; a fast check before `is_idle`."""
        if self._graph is None or self._draft is not None or step - self._oldest >= self._share:
            return False
        return not self.is_due

    def is_idle(self, logs: Sequence[RobotLog]) -> bool:
        """Return whether neither a rejuvenation nor a slice of work is due now."""
        if self.is_due:
            return False
        if self._exact or self._noiseless or not self._options.smoothing.incremental:
            return True
        if self._graph is None or self._draft is not None:
            return False
        for log, step in zip(logs, self._graph.latest.tolist(), strict=True):
            if log.last_step - step >= self._share:
                return max_pending_steps(logs, self._graph) < self._share
        return True  # no log has more, and counting costs more

    # ------------------------------------------------------------------ smoothing

    def run(
        self, logs: Sequence[RobotLog], starts: FloatArray, held: BoolArray, maps: ParticleMaps, best: int,
        camera: FloatArray, rng: np.random.Generator,
    ) -> Rejuvenation | None:  # fmt: skip
        """Do one slice of what is due, or all of it if the smoother is not incremental.

        Returns:
            The outcome of a rejuvenation; None if there is nothing to report yet.

        Args:
            logs: Log of each robot.
            starts: (K, 3, M) start poses, map frame.
            held: (K,) whether each start pose has a covariance in `FastSlam.start_covariances`.
            maps: Maps of the present particles, or of the most probable one alone; not changed.
            best: Index of the most probable particle in `maps`.
            camera: (7,) as kernels take it.
            rng: Source of the draws.
        """
        options = self._options
        graph = SlamGraph.at_uncertain_starts(starts, held, options.motion) if self._graph is None else self._graph
        if self._exact or (self._graph is None and any(log.has_exact_poses for log in logs)):
            self._exact = True  # not recorded yet by the temporary scheduler of a filter without rejuvenation
        if reason := self._why_disabled:
            self._restart_interval()
            return _failed(graph, reason)
        alignment = alignment_options(options.descriptor_gate)
        smoother = Smoother(options.motion, camera, options.smoothing, rng, alignment)
        self._set_graph(graph)
        is_due = self.is_due  # before slices add the sightings that `effort` weighs
        while True:
            result = self._run_slice(logs, smoother, starts.shape[2], maps, best, is_due)
            if result is not None or options.smoothing.incremental:
                return result

    def _run_slice(
        self, logs: Sequence[RobotLog], smoother: Smoother, num_particles: int, maps: ParticleMaps, best: int,
        is_due: bool,
    ) -> Rejuvenation | None:  # fmt: skip
        """Do one slice of work; arguments as of `run`, and whether a rejuvenation is due."""
        graph = self._graph
        assert graph is not None
        if (draft := self._draft) is not None:
            outcome = smoother.optimise_slice(draft)
            return self._finish_slice(draft.graph, outcome, lambda: log_tails(logs, graph, draft.graph), smoother)
        share, waiting = self._share, max_pending_steps(logs, graph)
        if waiting > 2 * share or not is_due:  # so that few steps are left to the draw
            if waiting < share and not is_due:
                return None
            taken = [log_head(log, share) for log in self._new_log_rows(logs, graph, maps, best)]
            outcome = smoother.add_logs(graph, taken, self._initial, landmark_positions(maps, best))
            return self._finish_slice(graph, outcome, lambda: taken, smoother)
        last = self._new_log_rows(logs, graph, maps, best)
        positions, known = landmark_positions(maps, best), landmark_table(maps, best)
        drawn = smoother.draw(graph, last, self._initial, positions, num_particles, known)
        if isinstance(drawn, Rejuvenation):
            self._restart_interval()
            self._accept(drawn.graph)
            return drawn
        return self._finish_slice(graph, drawn, lambda: last, smoother)

    def _new_log_rows(
        self, logs: Sequence[RobotLog], graph: SlamGraph, maps: ParticleMaps, best: int
    ) -> list[LogArrays]:  # fmt: skip
        """Return the log entries after a graph's last steps; rejected measurements are matched again."""
        new = log_tails(logs, graph)
        if not any(self._rejected):
            return new
        return reassociate(new, self._rejected, self._initial, landmark_table(maps, best), self._options)

    @single_threaded_blas
    def join(
        self, a: "RejuvenationScheduler", b: "RejuvenationScheduler", starts: Sequence[FloatArray],
        held: tuple[BoolArray, BoolArray], frames: tuple[FloatArray, FloatArray], renamed: IntArray,
        camera: FloatArray,
    ) -> None:  # fmt: skip
        """Continue from the smoothers of two groups that have merged; a rejuvenation is due at the next step.

        Args:
            a, b: Schedulers of the groups; they do not change.
            starts: Start poses, three arrays (K, 3, M): of the robots of a, in a's frame; of b, in b's; of both, a's
                first, in a's.
            held: (K,) of a, of b: whether each start pose has a covariance in `FastSlam.start_covariances`.
            frames: Gauge covariances (3, 3) of a's and b's maps, not represented by the particles.
            renamed: (n, 2) rows (name in b, name in the joint map).
            camera: (7,) as kernels take it.
        """
        graph_a, graph_b = (
            SlamGraph.at_uncertain_starts(where, fixed, self._options.motion) if step._graph is None else step._graph
            for step, where, fixed in zip((a, b), starts[:2], held, strict=True)
        )
        options = self._options.smoothing
        graph, motion = joint_graph(graph_a, graph_b, starts, frames, renamed, camera, options)
        self._set_graph(graph)
        self._draft = Draft(graph=graph)
        self._initial = a._initial + [InitialPoses(steps, compose(motion, poses)) for steps, poses in b._initial]
        self._rejected = [dict(rejected) for rejected in (*a._rejected, *b._rejected)]
        self._read, self._exact = a._read + b._read, a._exact or b._exact
        self._waited = self._every

    # ------------------------------------------------------------------ results

    def _finish_slice(
        self, tried: SlamGraph, outcome: SlamGraph | Draft | str, logs: Callable[[], Sequence[LogArrays]],
        smoother: Smoother,
    ) -> Rejuvenation | None:  # fmt: skip
        """Process the result of a slice; `logs` returns the log entries that it added."""
        assert self._graph is not None
        self._draft = None
        if isinstance(outcome, SlamGraph):
            self._accept(outcome)
        elif isinstance(outcome, Draft):
            self._draft = outcome
        else:
            return self._reset_after_failure(self._graph, tried, logs(), smoother, outcome)
        return None

    def _reset_after_failure(
        self, graph: SlamGraph, tried: SlamGraph, logs: Sequence[LogArrays], smoother: Smoother, reason: str
    ) -> Rejuvenation:
        """Recover from a failed optimisation: drop the measurements since the last one, or restart from the logs."""
        if any(map(len, logs)):
            self._accept(smoother.without_measurements(graph, logs))
            return _failed(tried, f"{reason}; measurements since the last rejuvenation are dropped")
        self._set_graph(None)
        return _failed(tried, f"{reason}; the smoother restarts from the logs")

    def _set_graph(self, graph: SlamGraph | None) -> None:
        """Set the graph, its oldest step, and how many steps a slice takes."""
        self._graph, self._oldest = graph, -1 if graph is None else min(graph.latest.tolist())
        new = 0 if graph is None else int(self._options.smoothing.slice_share * graph.num_keys)
        self._share = max(MIN_ROWS, new // self._num_robots)

    def _accept(self, graph: SlamGraph) -> None:
        """Continue from a graph at its mode."""
        self._set_graph(graph)
        for robot, latest in enumerate(graph.latest.tolist()):
            self._initial[robot] = self._initial[robot].after(latest)
            for step in [step for step in self._rejected[robot] if step <= latest]:
                del self._rejected[robot][step]

    def _restart_interval(self) -> None:
        """Start a new interval."""
        self._requested, self._waited, self._read, self._closed = False, 0, 0, False

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i becomes the one that was `order[i]`."""
        self._graph = None if self._graph is None else self._graph.reordered(order)
        if self._draft is not None:
            self._draft = self._draft._replace(graph=self._draft.graph.reordered(order))
        self._initial = [self._initial[robot] for robot in order]
        self._rejected = [self._rejected[robot] for robot in order]

    # ------------------------------------------------------------------ snapshots

    @property
    def initial_poses(self) -> tuple[InitialPoses, ...]:
        """Initial poses of each robot; read-only views."""
        return tuple(InitialPoses(as_read_only(steps), as_read_only(poses)) for steps, poses in self._initial)

    @initial_poses.setter
    def initial_poses(self, poses: Sequence[InitialPoses]) -> None:
        self._initial = [InitialPoses(steps.copy(), each.copy()) for steps, each in poses]  # writable, as kernels need

    def rebuild(self) -> None:
        """Compute what depends on the graph."""
        self._set_graph(self._graph)

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse a draft of no graph."""
        if parts["draft"] is not None and parts["graph"] is None:
            raise ValueError("a draft without a graph")


def check_rejected(rejected: Mapping[int, RejectedMeasurements], log: Mapping[str, Any], size: int) -> None:
    """Refuse measurements that were not logged, or with descriptors of another length than d.

    Args:
        rejected: Rejected measurements of a robot by step.
        log: State of the robot's log.
        size: d.
    """
    counts: dict[int, int] = {}
    for part in reversed((*log["chunks"], log["unfinished"])) if rejected else ():
        counts |= dict(zip(part.steps.tolist(), np.diff(part.starts).tolist(), strict=True))
        if len(part) and part.steps[0] <= min(rejected):
            break
    for step, (rows, descriptors) in rejected.items():
        if descriptors.shape[1] != size or (len(rows) and rows[-1] >= counts.get(step, MAX_INT)):
            raise ValueError(f"rejected measurements of step {step} that were not logged")


def _failed(graph: SlamGraph, reason: str) -> Rejuvenation:
    return Rejuvenation(graph, reason, float("nan"), 0, None)
