"""State of a filter, and the operations that change it: step, resampling, rejuvenation and merge."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.packed_symmetric import UNPACK_INDEX, UPPER
from slam_backend.core.state_checks import restore_generator
from slam_backend.core.validation import BoolArray, FloatArray, Int32Array, IntArray, check_int, check_seed
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels import EXACT_POSE, NO_READING, NUM_MEASURED, NUM_NOTED, add_gauge_covariance
from slam_backend.fastslam._kernels.records import ROBOT, WEIGHT
from slam_backend.fastslam._kernels.run_log import guesses_of
from slam_backend.fastslam.consistency import ConsistencyTest
from slam_backend.fastslam.estimates import pose_mixtures
from slam_backend.fastslam.existence import ExistenceUpdate
from slam_backend.fastslam.options import MAX_ROBOTS, FilterOptions, pack_options, packed_camera, robot_batches
from slam_backend.fastslam.particle_maps import ParticleMaps, zeros_aligned
from slam_backend.fastslam.rejuvenation import NewLandmarks, RejuvenationScheduler
from slam_backend.fastslam.reports import PoseEstimates, RejuvenationReport
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.fastslam.state_checks import KEPT
from slam_backend.fastslam.step_input import RobotRows, StepInput
from slam_backend.geometry import compose, rotation, wrap_angle
from slam_backend.resampling import RESAMPLING
from slam_backend.smoother.rejuvenation import Particles

LONGEST = 32  # largest number of pending steps
ROOM = 16 * LONGEST  # initial capacity for measurements


class PendingSteps:
    """Buffer of steps that are not in the logs yet; kernels write into its arrays.

    Args:
        num_robots: Number of robots of the filter, K.

    Attributes:
        steps: Numbers of the T buffered steps.
        noted: (`LONGEST`, K, 10) float64. Entry of each step and robot, the first T are in use; see `_kernels.layout`.
        measured: (>= n, 10) float64. Measurements of all steps, robot by robot.
        num_measured: n.
    """

    __slots__ = ("measured", "noted", "num_measured", "steps")

    def __init__(self, num_robots: int) -> None:
        self.steps: list[int] = []
        self.noted = np.empty((LONGEST, num_robots, NUM_NOTED))
        self.measured = np.empty((ROOM, NUM_MEASURED))
        self.num_measured = 0

    def reserve(self, used: int) -> None:
        """Provide capacity for `used` more measurements."""
        needed = self.num_measured + used
        if needed > len(self.measured):
            wider = np.empty((2 * needed, NUM_MEASURED))
            wider[: self.num_measured] = self.measured[: self.num_measured]
            self.measured = wider

    def clear(self) -> None:
        """Drop all steps."""
        self.steps.clear()
        self.num_measured = 0

    def flush(self, logs: Sequence[RobotLog], smoother: RejuvenationScheduler | None) -> None:
        """Move the steps into the logs of K robots, and the estimated poses to the smoother, if there is one.

        A step without motion and measurement of a robot gets no row in its log.
        """
        steps = np.array(self.steps)
        noted, measured = self.noted[: len(steps)], self.measured[: self.num_measured]
        for robot, log in enumerate(logs):
            log.extend(robot, steps, noted, measured)
            if smoother is not None:
                smoother.add_initial_poses(robot, *guesses_of(robot, steps, noted))
        self.clear()


def record_rejected(
    smoother: RejuvenationScheduler, step: int, inputs: StepInput, robots: RobotRows, associations: IntArray
) -> None:
    """Pass the rejected measurements of a step to the smoother, without those that have identities."""
    associated, _ = associations
    for robot, row in robots.active:
        _, begin, end, _, named, _ = inputs.inputs[row]
        if not named:
            smoother.add_rejected(robot, step, associated[begin:end], inputs.descriptors[begin:end])


class StepSummary(NamedTuple):
    """Outcome of a step without the association of each measurement.

    Attributes:
        long_unseen: Number of measurements matched to landmarks not seen for long.
        created, new, matched, rejected, ess, nis: See `StepReport`.
        needs_resampling: Whether the effective sample size fell below the threshold of resampling.
    """

    long_unseen: int
    created: int
    new: int
    matched: int
    rejected: int
    ess: float
    nis: float
    needs_resampling: bool


class FilterState:
    """State of a filter of K robots with M particles, padded to P lanes; lanes beyond M are unused.

    Poses are in the map frame. `poses`, `starts`, `means`, `covariances` and the weights are views of the two arrays
    that the kernels take.

    Args:
        num_robots: K. All robots start at the origin of the map frame.
        options: Assumptions and decision rules of the filter.
        seed: An int, a `numpy.random.SeedSequence` or a Generator.
        num_particles: M; None: that of `options`.

    Attributes:
        options: Options of the filter.
        num_particles: M.
        pose_arrays: (6, K, 3, P) float64: `poses`, `starts`, `means`, `biases`, and in the last two `covariances`.
        weight_arrays: (4, P) float64: `log_weights`, `path_log_weights`, `weights`, and the increments of a step.
        bias_covariances: (2, K, 3, 3) float64. Covariance of each robot's odometry bias given its path, the same in all
            particles; and covariance of pose (rows, robot axes) and bias where N(x^, P^) was only propagated.
        propagated_only: (K,) int64. 1 where N(x^, P^) was only propagated since the last match, else 0.
        gauge_covariance: (3, 3) float64 [m, m, rad]. Covariance of a motion of the whole map that the particles do not
            represent, as their frame was fixed when they were sampled from smoothed paths; estimates include it.
        start_covariances: (K, 3, 3) float64 [m, m, rad], start frames. Covariance of each robot's start pose that the
            particles do not represent; poses in the start frame include it.
        maps: Landmarks of all particles.
        estimates: Poses of all robots over all particles; updated in each step.
        best: Index of the most probable particle, by accumulated log-weight (Eq. 12).
        starts_at_origin: Whether all robots started at the origin, as in a filter without merges.
        next_step: Number of the next step.
        consistency: Running consistency test.
        existence: Update of the landmarks' log-odds of existence, or None.
        rejuvenation: Schedule and graph of the smoother, or None.
        rng: Random stream of the filter.

    Raises:
        ValueError: If `num_robots` or `seed` is out of its range.
    """

    def __init__(self, num_robots: int, options: FilterOptions, seed: Any, num_particles: int | None = None) -> None:
        k = check_int("num_robots", num_robots, 1, "Use at least one robot.", MAX_ROBOTS)
        m = options.num_particles if num_particles is None else num_particles
        existence = options.existence
        self.options = options
        self.num_particles = m
        self.rng = np.random.default_rng(check_seed(seed))
        self.packed_options = pack_options(options)
        self.packed_camera = packed_camera(options.camera)
        self.existence = None if existence is None else ExistenceUpdate(existence, options.camera)
        self.rejuvenation = None if options.rejuvenate_every is None else RejuvenationScheduler(options, k)
        self.maps = ParticleMaps(m, None if existence is None else existence.log_odds_prior)
        padded = self.maps.padded
        self.pose_arrays: FloatArray = zeros_aligned((6, k, 3, padded), np.float64)
        self.weight_arrays: FloatArray = zeros_aligned((4, padded), np.float64)
        self.log_weights[:] = -np.log(m)
        self.weights[:] = 1.0 / m
        self.bias_covariances: FloatArray = np.zeros((2, k, 3, 3))
        self.bias_covariances[0] = options.motion.bias_covariance
        self.propagated_only: IntArray = np.zeros(k, np.int64)
        self.gauge_covariance: FloatArray = np.zeros((3, 3))
        self.start_covariances: FloatArray = np.zeros((k, 3, 3))
        self.starts_at_origin = True
        self.best = 0
        self.next_step = 0
        self.consistency = ConsistencyTest()
        self.estimates = self._mixtures()
        self._batches = robot_batches(k, existence is not None)  # robots of each kernel call: one by one with existence
        self._logs = [RobotLog() for _ in range(k)]
        self._pending = PendingSteps(k)
        self._associations: Int32Array = np.empty((0, padded), np.int32)  # work space of `update_fastslam2`
        self._mahalanobis_sq: FloatArray = np.empty((0, padded))

    def start_at(self, poses: FloatArray) -> None:
        """Set the start poses (K, 3) [m, m, rad], map frame, without uncertainty."""
        self.poses[:] = poses[:, :, None]
        self.poses[:, 2] = wrap_angle(self.poses[:, 2])
        self.starts[:] = self.means[:] = self.poses
        self._refresh_starts()
        self.estimates = self._mixtures()

    @property
    def num_robots(self) -> int:
        """Number of robots, K."""
        return int(self.pose_arrays.shape[1])

    @property
    def poses(self) -> FloatArray:
        """Poses x_t^[m] of the robots, (K, 3, P) [m, m, rad]."""
        return np.asarray(self.pose_arrays[ROBOT.poses])

    @property
    def starts(self) -> FloatArray:
        """Start poses of the robots, (K, 3, P) [m, m, rad]; they spread at a merge."""
        return np.asarray(self.pose_arrays[ROBOT.starts])

    @property
    def means(self) -> FloatArray:
        """Means of N(x^, P^), each particle's pose before sampling, (K, 3, P) [m, m, rad]."""
        return np.asarray(self.pose_arrays[ROBOT.means])

    @property
    def biases(self) -> FloatArray:
        """Means of the robots' odometry biases given the paths, (K, 3, P) [m/m, rad/m, rad/rad]."""
        return np.asarray(self.pose_arrays[ROBOT.biases])

    @property
    def covariances(self) -> FloatArray:
        """Covariances of N(x^, P^), (K, 6, P), upper triangles."""
        return self.pose_arrays[ROBOT.covariances :].reshape(self.num_robots, 6, -1)

    @property
    def log_weights(self) -> FloatArray:
        """Log-weights since the last resampling, normalised, (M,)."""
        return np.asarray(self.weight_arrays[WEIGHT.log_weights, : self.num_particles])

    @property
    def path_log_weights(self) -> FloatArray:
        """Log-weights accumulated along the ancestral line (Eq. 12), (M,)."""
        return np.asarray(self.weight_arrays[WEIGHT.path_log_weights, : self.num_particles])

    @property
    def weights(self) -> FloatArray:
        """Weights after the last step, summing to 1, (M,)."""
        return np.asarray(self.weight_arrays[WEIGHT.weights, : self.num_particles])

    @property
    def _held_starts(self) -> BoolArray:
        """Whether each start pose has a covariance that the particles do not represent, (K,)."""
        return np.asarray(self.start_covariances[:, 2, 2] > 0.0)

    def _mixtures(self) -> PoseEstimates:
        """Return the robots' pose estimates over all particles, map frame. Fresh arrays."""
        return pose_mixtures(self.means, self.covariances, self.weights)

    def _refresh_starts(self) -> None:
        """Recompute `starts_at_origin` from the start poses."""
        self.starts_at_origin = not self.starts[:, :, : self.num_particles].any()

    def _refresh_best_particle(self) -> None:
        """Recompute `best` from the accumulated weights."""
        self.best = int(self.path_log_weights.argmax())

    # ------------------------------------------------------------------ one step

    def update(self, inputs: StepInput, robots: RobotRows, associations: IntArray) -> StepSummary:
        """Move all robots, match their measurements, weigh and update (Algorithm 1, l. 6-8).

        A robot without input draws no random number.

        Args:
            inputs: Input of these robots, and perhaps of others.
            robots: Rows of these robots in `inputs`.
            associations: (2, n) int64, written: data association of their measurements, see `Associations`.
        """
        maps, pending = self.maps, self._pending
        active = used = 0
        for robot, row in robots.active:
            kind, begin, end, _, _, _ = inputs.inputs[row]
            active, used = active + (kind != NO_READING), used + end - begin
            if kind == EXACT_POSE:
                self._set_exact_pose(robot, inputs.moves[row])
        if used:
            maps.reserve(used, inputs.descriptors.shape[1])
            if len(self._associations) < len(inputs.measurements):
                shape = 2 * len(inputs.measurements), maps.padded
                self._associations, self._mahalanobis_sq = np.empty(shape, np.int32), np.empty(shape)
        if len(pending.steps) == LONGEST:
            pending.flush(self._logs, self.rejuvenation)
        pending.reserve(used)
        now = 0 if self.rejuvenation is None else self.rejuvenation.steps + 1
        normals = self.rng.standard_normal((active, maps.num_particles, 3))
        means, covariances = self.estimates
        deleted: list[IntArray] = []
        fastslam1 = None if self.options.proposal == "fastslam2" else 1
        for low, high, is_over in self._batches:
            summary = _kernels.step_robots(
                low, high, is_over, now, self.packed_options, robots.array, inputs.inputs_table, inputs.moves, normals,
                self.pose_arrays, self.bias_covariances, self.propagated_only, self.weight_arrays,
                self.gauge_covariance, maps.values, maps.counts, maps.odds, maps.table, maps.maps, maps.users,
                maps.free_rows, maps.tops, maps.descriptors, maps.heads, inputs.measurements,
                inputs.descriptors, inputs.names,
                self._associations, self._mahalanobis_sq, associations, means, covariances,
                pending.noted[len(pending.steps)], pending.measured, pending.num_measured, fastslam1,
            )  # fmt: skip
            if self.existence is not None and not is_over and (row := robots.rows[low]) >= 0:
                _, begin, end, _, _, count = inputs.inputs[row]
                if count >= 0:
                    _, started = associations  # by slot, until the step is over
                    found, new_slots = self._associations[begin:end], started[begin:end]
                    deleted.append(self.existence.update(maps, self.poses[low], self.best, found, new_slots))
        self.best, long_unseen, created, new, matched, rejected, ess, nis, needs_resampling = summary
        pending.steps.append(self.next_step)
        pending.num_measured += used
        if used:
            self.consistency.update(self.next_step, nis, ess / self.num_particles, used, used - new - matched)
        if rejected and self.rejuvenation is not None:
            record_rejected(self.rejuvenation, self.next_step, inputs, robots, associations)
        self.next_step += 1
        for slots in deleted:  # last, as the ids are needed until here
            maps.release(slots)
        return StepSummary(long_unseen, created, new, matched, rejected, ess, nis, needs_resampling)

    def _set_exact_pose(self, robot: int, pose: FloatArray) -> None:
        """Set a robot's pose in all particles to an exact one (3,) [m, m, rad] in its own start frame."""
        count = self.num_particles
        self.poses[robot, :, :count] = compose(self.starts[robot, :, :count].T.copy(), pose).T
        self.gauge_covariance.fill(0.0)
        self.start_covariances[robot] = 0.0

    def resample(self) -> None:
        """Resample the particles in proportion to their weights."""
        ancestors = RESAMPLING[self.options.resampling](self.weights, self.rng, self.num_particles)
        self.best = self.maps.resample(ancestors, self.pose_arrays, self.weight_arrays)

    def rejuvenate(self, smoother: RejuvenationScheduler) -> RejuvenationReport | None:
        """Sample the particles from the smoothed paths, if due; return None if there is nothing to report."""
        if smoother.is_idle(self.logs):
            return None
        starts = self.starts[:, :, : self.num_particles]
        result = smoother.run(
            self.logs, starts, self._held_starts, self.maps, self.best, self.packed_camera, self.rng
        )  # fmt: skip
        if result is None:
            return None
        if result.particles is not None:
            self._replace_particles(result.particles)
        return RejuvenationReport(result.reason, result.ess, result.iterations, result.graph.num_keys)

    def _replace_particles(self, new: Particles) -> None:
        """Replace the M particles by samples of smoothed paths, with landmarks of the most probable particle so far."""
        m = self.num_particles
        NewLandmarks.of(self.maps, self.best, new, self.options.landmark_walk).write(self.maps)
        self.poses[:, :, :m], self.starts[:, :, :m], self.biases[:, :, :m] = new.poses, new.starts, new.biases
        self.bias_covariances[0], self.bias_covariances[1] = new.bias_covariances, 0.0
        self._refresh_starts()
        self.means[:] = self.poses
        self.covariances.fill(0.0)
        self.gauge_covariance[:], self.start_covariances[:] = new.frame, new.start_scatters
        self.propagated_only.fill(0)
        self.log_weights[:], self.path_log_weights[:] = new.log_weights, new.log_densities
        self._refresh_best_particle()
        self.weights[:] = np.exp(new.log_weights)
        self.estimates.means[:], self.estimates.covariances[:] = new.means, new.covariances

    @property
    def logs(self) -> list[RobotLog]:
        """Log of each robot, up to date."""
        self.update_logs()
        return self._logs

    def update_logs(self) -> None:
        """Bring the logs up to date, and what the smoother knows of them."""
        if self._pending.steps:
            self._pending.flush(self._logs, self.rejuvenation)

    # ------------------------------------------------------------------ merging

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i is the former `order[i]`; (K,) a permutation."""
        for array in (
            self.poses,
            self.starts,
            self.means,
            self.biases,
            self.covariances,
            *self.bias_covariances,
            self.start_covariances,
            self.propagated_only,
        ):
            array[:] = array[order]
        self._logs = [self.logs[robot] for robot in order]
        self.estimates = PoseEstimates(*(of_all[order] for of_all in self.estimates))
        if self.rejuvenation is not None:
            self.rejuvenation.reorder(order)

    @classmethod
    def joined(
        cls, a: "FilterState", from_a: IntArray, b: "FilterState", from_b: IntArray, motion: FloatArray,
        evidence: FloatArray, rng: np.random.Generator,
    ) -> "FilterState":  # fmt: skip
        """Return the state of both groups' robots, a's first, in a's map frame, without landmarks yet.

        Args:
            a, b: State of each group.
            from_a, from_b: (M,) particles of each group that form the joint particles.
            motion: (M, 3) [m, m, rad], frame a from frame b, of each joint particle.
            evidence: (M,) log-weight of each pair.
            rng: Generator that seeds the joint filter's own stream.
        """
        count, k = len(motion), a.num_robots
        same = a.options.num_particles == count
        options = a.options if same else replace(a.options, num_particles=count)
        joint = cls(k + b.num_robots, options, np.random.default_rng(rng.integers(2**63, size=4)))
        for target, of_a, of_b in zip(joint.pose_arrays[:3], a.pose_arrays, b.pose_arrays, strict=False):
            target[:k, :, :count] = of_a[:, :, from_a]
            target[k:, :, :count] = compose(motion, of_b[:, :, from_b].transpose(0, 2, 1)).transpose(0, 2, 1)
        joint._refresh_starts()
        turn = np.zeros((count, 3, 3))
        turn[:, :2, :2], turn[:, 2, 2] = rotation(motion[:, 2]), 1.0
        spread_b = b.covariances[:, :, from_b].transpose(0, 2, 1)[..., UNPACK_INDEX]
        moved = turn @ spread_b @ turn.transpose(0, 2, 1)
        joint.covariances[:k, :, :count] = a.covariances[:, :, from_a]
        joint.covariances[k:, :, :count] = moved[..., *UPPER].transpose(0, 2, 1)
        joint.biases[:k, :, :count], joint.biases[k:, :, :count] = a.biases[:, :, from_a], b.biases[:, :, from_b]
        joint.bias_covariances[:] = np.concatenate([a.bias_covariances, b.bias_covariances], axis=1)
        joint.propagated_only[:] = np.concatenate([a.propagated_only, b.propagated_only])
        joint.gauge_covariance[:] = a.gauge_covariance
        joint.start_covariances[:] = np.concatenate([a.start_covariances, b.start_covariances])
        joint.path_log_weights[:] = a.path_log_weights[from_a] + b.path_log_weights[from_b] + evidence
        return joint

    def finish_join(self, a: "FilterState", b: "FilterState", renamed: IntArray) -> None:
        """Join the step counts, warnings, logs and smoothers of two groups, once the joint map is loaded.

        Args:
            a, b: State of each group.
            renamed: (n, 2) int64 rows (id in b, id in the joint map) of all of b's landmarks.
        """
        self._refresh_best_particle()
        self.next_step = max(a.next_step, b.next_step)
        self.consistency = ConsistencyTest.joined(a.consistency, b.consistency)
        self.estimates = self._mixtures()
        if self.gauge_covariance.any():
            add_gauge_covariance(self.gauge_covariance, *self.estimates)
        self._logs = [log.copy() for log in a.logs] + [log.renamed(renamed[:, 0], renamed[:, 1]) for log in b.logs]
        if self.rejuvenation is not None and a.rejuvenation is not None and b.rejuvenation is not None:
            starts = [state.starts[:, :, : state.num_particles] for state in (a, b, self)]
            frames = a.gauge_covariance, b.gauge_covariance
            held = a._held_starts, b._held_starts
            self.rejuvenation.join(a.rejuvenation, b.rejuvenation, starts, held, frames, renamed, self.packed_camera)

    # ------------------------------------------------------------------ snapshots

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the filter, its random stream included; shared parts are read-only."""
        logs = tuple(log.get_state() for log in self.logs)  # first, as it also updates the smoother
        state: dict[str, Any] = {name: getattr(self, name).copy() for name in KEPT}
        state |= {"steps": self.next_step, "estimates": self.estimates.copy(), "maps": self.maps.get_state()}
        state |= {"logs": logs, "consistency": self.consistency.get_state()}
        if self.rejuvenation is not None:
            state["rejuvenation"] = self.rejuvenation.get_state()
        return state | {"options": self.options, "rng": copy.deepcopy(self.rng.bit_generator.state)}

    @classmethod
    def restored(cls, state: Mapping[str, Any], previous: "FilterState") -> "FilterState":
        """Return a state from a validated snapshot, in the arrays of `previous` if they fit."""
        shapes = [state[name].shape == getattr(previous, name).shape for name in ("poses", "weights")]
        if state["options"] == previous.options and all(shapes):
            self = previous
        else:
            self = cls(len(state["poses"]), state["options"], 0, len(state["weights"]))
        for name in KEPT:
            getattr(self, name)[:] = state[name]
        self._refresh_starts()
        self._refresh_best_particle()
        self.maps.set_state(state["maps"])
        self._pending.clear()
        for log, logged in zip(self._logs, state["logs"], strict=True):
            log.set_state(logged)
        if self.rejuvenation is not None:
            self.rejuvenation.set_state(state["rejuvenation"])
        self.consistency.set_state(state["consistency"])
        self.next_step, self.estimates = state["steps"], state["estimates"].copy()
        self.rng = restore_generator(state["rng"])  # a new one: the old one may be shared or of another kind
        return self
