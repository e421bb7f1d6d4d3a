"""Rejuvenation of a filter: when the smoother runs, what it reads, and how its samples replace the particles."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.blas import single_threaded_blas
from slam_backend.core.jit import in_place
from slam_backend.core.read_only import with_constants, with_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam import _kernels
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.particle_maps import ParticleMaps, present_slots, write_summary
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import compose, inverse, rotate_covariances
from slam_backend.maps.landmark_map import MapSummaryRows
from slam_backend.smoother.graph import SlamGraph, mean_pose, scattered
from slam_backend.smoother.graph_building import InitialPoses, LandmarkPositions, log_head, merge_graphs
from slam_backend.smoother.graph_reduction import reduce_keyframes
from slam_backend.smoother.log_arrays import LogArrays
from slam_backend.smoother.optimizer import NO_POSE
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.reassociation import LandmarkTable, RejectedMeasurements, reassociate
from slam_backend.smoother.rejuvenation import Draft, LandmarkDescriptors, Particles, Rejuvenation, Smoother, rejuvenate


def landmark_positions(maps: ParticleMaps, best: int) -> LandmarkPositions:
    """Return where the most probable particle holds its landmarks to be."""
    rows = MapSummaryRows.allocate(len(maps.ids))
    num = write_summary(maps, best, 1, rows, 0)
    return LandmarkPositions(rows.counts_and_ids[:num, 1].copy(), rows.positions[:num, :3].copy())


def landmark_table(maps: ParticleMaps, best: int) -> LandmarkTable:
    """Return what the most probable particle knows of the landmarks that no caller has named."""
    slots = maps.used_slots()
    slots = slots[maps.identities[slots] < 0]
    values, counts = maps.of_particle(best, slots)
    held = counts > 0
    slots, values = slots[held], values[held]
    return LandmarkTable(maps.ids[slots], values[:, :3], values[:, 3:], counts[held], maps.descriptors[slots])


def landmark_descriptors(maps: ParticleMaps, gate: float) -> LandmarkDescriptors:
    """Return the appearance of landmarks that no caller has named; beyond the gate two do not look alike."""
    slots = maps.used_slots()
    slots = slots[maps.identities[slots] < 0]
    return LandmarkDescriptors(maps.ids[slots], maps.descriptors[slots], gate)


def log_tails(logs: Sequence[RobotLog], graph: SlamGraph, until: SlamGraph | None = None) -> list[LogArrays]:
    """Return what the logs hold after a graph's last steps, up to another's."""
    new = [log.arrays(int(latest) + 1) for log, latest in zip(logs, graph.latest, strict=True)]
    if until is None:
        return new
    ends = [np.searchsorted(log.steps, last, side="right") for log, last in zip(new, until.latest, strict=True)]
    return [log_head(log, int(end)) for log, end in zip(new, ends, strict=True)]


def max_pending_steps(logs: Sequence[RobotLog], graph: SlamGraph) -> int:
    """Return how many steps after the last ones of a graph the log has that holds most of them."""
    return max(log.num_since(step + 1) for log, step in zip(logs, graph.latest.tolist(), strict=True))


XX, YY, ZZ = 3, 6, 8  # the diagonal of a landmark's covariance, in the rows of a tile


def write_maps(maps: ParticleMaps, best: int, particles: Particles, walk: float) -> None:
    """Give all particles the landmarks of their paths: those that the most probable one held and a sighting supports.

    What only others held was a mistake, as far as is known: the log's association is that of the most probable. Names,
    descriptors and odds stay; where a landmark's odds differ between particles, all get the mean of those that held it.
    To the smoother landmarks stand still; that they may move until they are seen the next time is added here.

    Args:
        maps: Of the filter, changed.
        best: Its most probable particle.
        particles: The new ones.
        walk: Variance [m^2] along each axis, see `FilterOptions.landmark_walk`.
    """
    slots = present_slots(maps, best, 1)
    order, names = particles.ids.argsort(), maps.ids[slots]
    _, of_slots, at = np.intersect1d(names, particles.ids[order], assume_unique=True, return_indices=True)
    slots, rows = slots[of_slots], order[at]
    odds = maps.dense_odds(slots)
    if odds is not None:
        held = maps.dense(slots)[1] > 0
        mean = (odds * held).sum(axis=1) / np.maximum(held.sum(axis=1), 1)
        odds = mean[:, None]
    maps.load_metadata(
        particles.counts[rows, None], maps.descriptors[slots], maps.ids[slots], maps.identities[slots], maps.next_id,
        odds, maps.last_seen[slots],
    )  # fmt: skip
    write_tiles(particles.tiles, rows, walk, maps.blocks)


@in_place
def write_tiles(tiles: FloatArray, rows: IntArray, walk: float, blocks: FloatArray) -> None:
    """Write some landmarks of new particles, with a variance [m^2] along each axis added to theirs.

    Args:
        tiles: (l, P / lanes, 9, lanes) means and covariances.
        rows: (n,) rows of the landmarks there.
        walk: Variance.
        blocks: (>= n, P / lanes, 9, lanes) values, of which the first are written.
    """
    for n in range(len(rows)):
        for b in range(tiles.shape[1]):
            tile, block = tiles[rows[n], b], blocks[n, b]
            for row in range(9):
                added = walk if row in (XX, YY, ZZ) else 0.0
                for lane in range(tiles.shape[3]):
                    block[row, lane] = tile[row, lane] + added  # (7) of docs/explanation/smoothing.md


def joint_graph(
    own: SlamGraph, other: SlamGraph, starts: Sequence[FloatArray], frames: tuple[FloatArray, FloatArray],
    renamed: IntArray, camera: FloatArray, options: SmoothingOptions,
) -> tuple[SlamGraph, FloatArray]:  # fmt: skip
    """Return the graph of both groups' robots, and the motion (3,) [m, m, rad] from b's frame to a's.

    Args:
        own, other: Graphs of groups a and b, in their frames.
        starts: Three arrays (K, 3, M): where the robots of a, of b, and of both, a's first, started; in a's frame, in
            b's, in a's.
        frames: Two covariances (3, 3) of what a's and b's particles do not show of their maps' frames.
        renamed: (n, 2) rows (name in b, name in the joint map).
        camera: (7,) as kernels take it.
        options: How many keys; in slices either graph is first thinned to its share where both have too many.
    """
    robots = len(starts[2])
    if options.slice_steps is not None and own.num_keys + other.num_keys > options.most_keys(robots):
        own, other = (_thinned(graph, robots, camera, options) for graph in (own, other))
    robot = int(np.flatnonzero(other.parents[other.first_keys] < 0)[0])  # one that defines b's frame
    start = starts[2][len(starts[0]) + robot]
    began = other.poses[
        other.first_keys[robot]
    ].copy()  # can be written: `add_gauge_covariance` is compiled for such arrays alone
    motion = compose(mean_pose(start), inverse(began))
    spreads = scattered(start)[None], np.zeros((1, 3, 3))
    for frame, pose, spread in zip(frames, (mean_pose(start), began), spreads, strict=True):
        _kernels.add_gauge_covariance(frame, pose[None], spread)
    spread = spreads[0][0] + rotate_covariances(float(motion[2]), spreads[1][0])
    return merge_graphs(own, other, motion, renamed, spread), motion


def _thinned(graph: SlamGraph, robots: int, camera: FloatArray, options: SmoothingOptions) -> SlamGraph:
    """Return a graph with no more than its share of all robots' keys."""
    share = len(graph.last_keys) / robots
    keys, fresh = max(2, int(share * options.most_keys(robots))), max(1, int(share * options.recent_keys))
    return reduce_keyframes(graph, camera, replace(options, max_keys=keys, further_keys=0, recent_keys=fresh))


MIN_CLOSURE_MATCHES = 3  # landmarks not seen for long that are matched in one step: a loop is closed
MIN_INTERVAL_FRACTION = 5  # after a fifth of the usual time at the earliest
MIN_ROWS = 8  # of each log in a slice, so that no more of them come while it is worked through
MAX_FAILURES = 2  # descents that fail in a row, where all is done at once, before something is given up
SCHEDULE = ("_asked", "_waited", "_read", "_closed", "_failures", "_exact", "_last_closing", "steps")


class RejuvenationScheduler:
    """The smoother of one filter, its schedule, and where the robots were thought to be since it last ran.

    Args:
        options: Of the filter, with `rejuvenate_every` set.
        num_robots: K.

    Attributes:
        steps: How many were counted.
    """

    def __init__(self, options: FilterOptions, num_robots: int) -> None:
        assert options.rejuvenate_every is not None
        self.steps = 0
        self._options = options
        self._every = options.rejuvenate_every
        self._share = max(MIN_ROWS, (options.smoothing.slice_steps or 0) // num_robots)  # steps a slice takes in
        self._noiseless = options.motion.is_noiseless
        self._graph: SlamGraph | None = None  # at its mode
        self._oldest = -1  # of the robots' newest steps there
        self._draft: Draft | None = None  # the same and a little more, on its way there
        self._asked = False  # for new particles now, whatever has been read since
        self._waited = 0  # steps since the last time
        self._read = 0  # measurements since then
        self._closed = False
        self._failures = 0  # descents in a row
        self._exact = False  # a pose was given as exact: there never will be
        self._last_closing = 0  # step in which landmarks not seen for long were matched
        self._guesses = [InitialPoses.empty() for _ in range(num_robots)]
        self._refused: list[dict[int, RejectedMeasurements]] = [{} for _ in range(num_robots)]

    # ------------------------------------------------------------------ in each step

    def add_initial_poses(self, robot: int, steps: IntArray, poses: FloatArray, is_placed: bool) -> None:
        """Remember where a robot was thought to be (n, 3) after steps (n,) in which it read something, or was told."""
        if is_placed:
            self._exact = True
            self._guesses = [InitialPoses.empty() for _ in self._guesses]
            for refused in self._refused:
                refused.clear()
        if not (self._exact or self._noiseless):
            self._guesses[robot] = self._guesses[robot].with_later(steps, poses)

    def add_rejected(self, robot: int, step: int, ids: IntArray, descriptors: NDArray[np.float32]) -> None:
        """Remember what was neither matched nor new of all that a robot measured without names: ids (n,), looks."""
        refused = [row for row, name in enumerate(ids.tolist()) if name < 0]
        if refused and not self._why_disabled:
            rows = np.array(refused)
            self._refused[robot][step] = with_read_only(RejectedMeasurements(rows, descriptors[rows]))

    def record_step(self, matched: int, long_unseen: int) -> None:
        """Count a step, what was matched or started in it, and how much of it to landmarks not seen for long."""
        self.steps += 1
        self._waited += 1
        self._read += matched
        after = self._options.smoothing.closure_after
        if after > 0 and long_unseen >= MIN_CLOSURE_MATCHES:
            self._closed |= 2 * (self.steps - self._last_closing) > after  # else it is the same one that goes on
            self._last_closing = self.steps

    def request(self) -> None:
        """Be due now, as before a merge."""
        self._asked = True

    @property
    def requested(self) -> bool:
        """Whether it was told to `hasten`, and nothing has come of it yet."""
        return self._asked

    @property
    def _why_disabled(self) -> str:
        """Why there never will be new particles; "" if there may be."""
        if self._exact:
            return "poses that were given as exact"
        return "odometry without noise" if self._noiseless else ""

    @property
    def is_due(self) -> bool:
        """Whether it is time for new particles."""
        if self._asked:
            return True
        haste = MIN_INTERVAL_FRACTION if self._closed else 1
        if haste * self._waited < self._every:
            return False
        smoothing = self._options.smoothing
        sightings = 0 if self._graph is None else self._graph.num_sightings - smoothing.free_sightings
        return haste * smoothing.effort * self._read >= sightings

    def is_waiting(self, step: int) -> bool:
        """Return whether there is nothing to do after a step, whatever the logs hold up to it; else see `rests`."""
        if self._graph is None or self._draft is not None or step - self._oldest >= self._share:
            return False
        return not self.is_due

    def is_idle(self, logs: Sequence[RobotLog]) -> bool:
        """Return whether there is nothing to do now: the rule. Else it is due, or a slice of the work can be done."""
        if self.is_due:
            return False
        if self._exact or self._noiseless or self._options.smoothing.slice_steps is None:
            return True
        if self._graph is None or self._draft is not None:
            return False
        for log, step in zip(logs, self._graph.latest.tolist(), strict=True):
            if log.last_step - step >= self._share:
                return max_pending_steps(logs, self._graph) < self._share
        return True  # there cannot be more of them, and to count costs more

    # ------------------------------------------------------------------ where there is time for it

    def run(
        self, logs: Sequence[RobotLog], starts: FloatArray, held: BoolArray, maps: ParticleMaps, best: int,
        camera: FloatArray, rng: np.random.Generator,
    ) -> Rejuvenation | None:  # fmt: skip
        """Do all that is due, or a slice of it, if it does not rest; return None if there is nothing to tell of it.

        Args:
            logs: Per robot.
            starts: (K, 3, M) where the robots started, map frame.
            held: (K,) whether these are held, see `fix_start`.
            maps: Of the present particles; only looked at.
            best: The most probable of them.
            camera: (7,) as kernels take it.
            rng: Source of the draws.
        """
        options = self._options
        graph = SlamGraph.at_uncertain_starts(starts, held) if self._graph is None else self._graph
        if self._exact or (self._graph is None and any(log.has_exact_poses for log in logs)):
            self._exact = True  # nobody may have noted it: a filter that is never rejuvenated is asked to, by a merge
        if reason := self._why_disabled:
            self._restart_interval()
            return _told(graph, reason)
        smoother = Smoother(options.motion, camera, options.smoothing, rng)
        if options.smoothing.slice_steps is None:
            return self._run_at_once(graph, self._new_log_rows(logs, graph, maps, best), smoother, maps, best)
        self._set_graph(graph)
        if (draft := self._draft) is not None:
            outcome = smoother.optimise_slice(draft)
            return self._finish_slice(draft.graph, outcome, lambda: log_tails(logs, graph, draft.graph), smoother)
        share, waiting = self._share, max_pending_steps(logs, graph)
        if waiting > 2 * share or not self.is_due:
            if waiting < share:
                return None
            taken = [log_head(log, share) for log in self._new_log_rows(logs, graph, maps, best)]
            outcome = smoother.add_logs(graph, taken, self._guesses, landmark_positions(maps, best))
            return self._finish_slice(graph, outcome, lambda: taken, smoother)
        last = self._new_log_rows(logs, graph, maps, best)
        places, looks = landmark_positions(maps, best), landmark_descriptors(maps, self._options.descriptor_gate)
        drawn = smoother.draw(graph, last, self._guesses, places, maps.num_particles, looks)
        if isinstance(drawn, Rejuvenation):
            self._restart_interval()
            self._accept(drawn.graph)
            return drawn
        return self._finish_slice(graph, drawn, lambda: last, smoother)

    def _new_log_rows(
        self, logs: Sequence[RobotLog], graph: SlamGraph, maps: ParticleMaps, best: int
    ) -> list[LogArrays]:  # fmt: skip
        """Return what the logs hold after a graph's last steps; what was refused has a name where it must be."""
        new = log_tails(logs, graph)
        if not any(self._refused):
            return new
        return reassociate(new, self._refused, self._guesses, landmark_table(maps, best), self._options)

    @single_threaded_blas
    def join(
        self, a: "RejuvenationScheduler", b: "RejuvenationScheduler", starts: Sequence[FloatArray],
        held: tuple[BoolArray, BoolArray], frames: tuple[FloatArray, FloatArray], renamed: IntArray,
        camera: FloatArray,
    ) -> None:  # fmt: skip
        """Go on as the smoothers of two groups did that are one now, and be due at the next step.

        Args:
            a, b: Theirs; they stay as they are.
            starts: Three arrays (K, 3, M): where the robots of a, of b, and of both, a's first, started; in a's frame,
                in b's, in a's.
            held: (K,) of a, of b: whether these are held, see `fix_start`.
            frames: Two covariances (3, 3) of what a's and b's particles do not show of their maps' frames.
            renamed: (n, 2) rows (name in b, name in the joint map).
            camera: (7,) as kernels take it.
        """
        own, other = (
            SlamGraph.at_uncertain_starts(where, fixed) if step._graph is None else step._graph
            for step, where, fixed in zip((a, b), starts[:2], held, strict=True)
        )
        options = self._options.smoothing
        graph, motion = joint_graph(own, other, starts, frames, renamed, camera, options)
        self._set_graph(graph)
        self._draft = None if options.slice_steps is None else Draft(graph=graph)
        self._guesses = a._guesses + [InitialPoses(steps, compose(motion, poses)) for steps, poses in b._guesses]
        self._refused = [dict(refused) for refused in (*a._refused, *b._refused)]
        self._read, self._exact = a._read + b._read, a._exact or b._exact
        self._waited = self._every

    # ------------------------------------------------------------------ what came of it

    def _run_at_once(
        self, graph: SlamGraph, logs: Sequence[LogArrays], smoother: Smoother, maps: ParticleMaps, best: int
    ) -> Rejuvenation:
        """Do all at once."""
        result = rejuvenate(
            graph, logs, smoother.motion, smoother.camera, maps.num_particles, smoother.rng, smoother.options,
            self._guesses, landmark_descriptors(maps, self._options.descriptor_gate), landmark_positions(maps, best),
        )  # fmt: skip
        self._restart_interval()
        if np.isfinite(result.ess) or result.reason == NO_POSE:
            self._accept(result.graph)
        else:
            self._failures += 1
            if self._failures == MAX_FAILURES:
                return self._reset_after_failure(graph, graph, logs, smoother, result.reason)
        return result

    def _finish_slice(
        self, tried: SlamGraph, outcome: SlamGraph | Draft | str, logs: Callable[[], Sequence[LogArrays]],
        smoother: Smoother,
    ) -> Rejuvenation | None:  # fmt: skip
        """Take note of what a slice came to; `logs` tells what it took in, if that matters."""
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
        """Do not try for ever what does not come to an end: leave out what was measured since, or begin anew."""
        if any(map(len, logs)):
            self._accept(smoother.without_measurements(graph, logs))
            return _told(tried, f"{reason}; what was measured since the last time is left out")
        self._graph = None
        return _told(tried, f"{reason}; it begins anew from the logs")

    def _set_graph(self, graph: SlamGraph) -> None:
        """Take note of a graph and of how old it is."""
        self._graph, self._oldest = graph, min(graph.latest.tolist())

    def _accept(self, graph: SlamGraph) -> None:
        """Go on from a graph at its mode."""
        self._set_graph(graph)
        self._failures = 0
        for robot, latest in enumerate(graph.latest.tolist()):
            self._guesses[robot] = self._guesses[robot].after(latest)
            for step in [step for step in self._refused[robot] if step <= latest]:
                del self._refused[robot][step]

    def _restart_interval(self) -> None:
        """Wait anew."""
        self._asked, self._waited, self._read, self._closed = False, 0, 0, False

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i becomes the one that was `order[i]`."""
        self._graph = None if self._graph is None else self._graph.reordered(order)
        if self._draft is not None:
            self._draft = self._draft._replace(graph=self._draft.graph.reordered(order))
        self._guesses = [self._guesses[robot] for robot in order]
        self._refused = [self._refused[robot] for robot in order]

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how it goes on; arrays of graphs and of what was refused are shared and read-only."""
        draft = self._draft
        return {
            "graph": None if self._graph is None else self._graph.to_mapping(),
            "draft": None if draft is None else (draft.graph.to_mapping(), draft.damping, draft.steps),
            "schedule": {name: getattr(self, name) for name in SCHEDULE},
            "guesses": tuple((steps.copy(), poses.copy()) for steps, poses in self._guesses),
            "refused": tuple(dict(refused) for refused in self._refused),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the one that gave `state`."""
        self._graph = None
        if state["graph"] is not None:
            self._set_graph(SlamGraph.of_mapping(state["graph"]))
        self._draft = None
        if state["draft"] is not None:
            graph, damping, steps = state["draft"]
            self._draft = Draft(graph=SlamGraph.of_mapping(graph), damping=damping, steps=steps)
        for name in SCHEDULE:
            setattr(self, name, state["schedule"][name])
        self._guesses = [InitialPoses(steps.copy(), poses.copy()) for steps, poses in state["guesses"]]
        self._refused = [dict(with_constants(refused)) for refused in state["refused"]]


def _told(graph: SlamGraph, reason: str) -> Rejuvenation:
    return Rejuvenation(graph, reason, float("nan"), 0, None)
