"""`FastSlam`: a Rao-Blackwellized particle filter over the paths of K robots, with one EKF per landmark and particle.

The filter implements Sections 2 and 4 of the paper, with its errata. Robots are processed in turn (Algorithm 1): each
one moves, matches its measurements to the map as updated by the robots before it, weighs the particles and updates the
landmarks. Then the joint particles are resampled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import (
    BoolArray,
    FloatArray,
    Int32Array,
    IntArray,
    argument_error,
    check_array,
    check_choice,
    check_int,
    check_seed,
    known_names,
    with_fields_of,
)
from slam_backend.diagnosis import Cause, diagnose_run
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels import EXACT_POSE, NO_READING, add_gauge_covariance
from slam_backend.fastslam._kernels.records import ROBOT, WEIGHT, StepSummary
from slam_backend.fastslam.consistency import Consistency, ConsistencyTest
from slam_backend.fastslam.estimates import map_mixture, pose_mixtures
from slam_backend.fastslam.existence import ExistenceUpdate
from slam_backend.fastslam.options import (
    MAX_ROBOTS,
    FilterOptions,
    kernel_options,
    packed_camera,
    robot_batches,
)
from slam_backend.fastslam.particle_maps import (
    CompactMaps,
    ParticleMaps,
    best_map,
    padded_lanes,
    present_slots,
    write_summary,
    zeros_aligned,
)
from slam_backend.fastslam.pending_steps import LONGEST, PendingSteps, record_rejected
from slam_backend.fastslam.rejuvenation import NewLandmarks, RejuvenationScheduler, check_rejected, landmark_table
from slam_backend.fastslam.relative_poses import TeamPoses, membership_table
from slam_backend.fastslam.reports import (
    Associations,
    BiasEstimate,
    PoseEstimate,
    PoseEstimates,
    RejuvenationReport,
    Relocalisation,
    StepReport,
)
from slam_backend.fastslam.run_log import RobotLog, last_step
from slam_backend.fastslam.step_input import MAX_POSE, RobotRows, StepInput, rows_of, validate_step
from slam_backend.geometry import between, compose, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap, MapSummary, MapSummaryRows, unchecked_map
from slam_backend.models.measurements import Measurements
from slam_backend.pose_graph import PoseGraph
from slam_backend.reference.filter import ReferenceFastSlam
from slam_backend.resampling import RESAMPLING
from slam_backend.smoother.graph_export import smoothed_graph, starts_graph
from slam_backend.smoother.rejuvenation import Particles
from slam_backend.state import (
    FLOAT64,
    INT64,
    MAX_DISTANCE,
    Array,
    Child,
    Each,
    Generator,
    Int,
    Maybe,
    Options,
    Record,
    Sizes,
    Snapshot,
    State,
    accepted,
    restore,
    take,
)

LEAST = float(np.finfo(np.float64).min)  # lower limit of log-weights
NO_WEIGHTS = np.empty(0)  # unused where all particles start at the same pose


@known_names
class FastSlam:
    """Visual FastSLAM for one robot, or jointly for several that share a map frame.

    `slam_backend.reference` is the same filter to read: one particle and one landmark at a time.

    Args:
        num_robots: K. Each particle holds K poses and one map (Eq. 19).
        seed: Seed of the filter's own random stream: an int, a `numpy.random.SeedSequence` or a Generator.
        initial_poses: (K, 3) [m, m, rad], map frame. None: all at the origin.
        backend: "compiled", or "reference": the filter to read, which has `step`, `pose`, `particles` and `map` only,
            without rejuvenation, and is hundreds of times slower.
        **options: Fields of `FilterOptions`.

    Arrays of particles are padded to P lanes; lanes beyond M are unused. Poses are in the map frame.

    Attributes:
        options: Assumptions and decision rules of the filter.
        best_particle: Index of the most probable particle, by accumulated log-weight (Eq. 12).
        pose_arrays: (6, K, 3, P) float64: `poses`, `starts`, `means`, `biases`, and in the last two `covariances`.
        weight_arrays: (4, P) float64: `log_weights`, `path_log_weights`, `mixture_weights`, and a step's increments.
        bias_covariances: (2, K, 3, 3) float64. Covariance of each robot's odometry bias given its path, the same in all
            particles; and covariance of pose (rows, robot axes) and bias where N(x^, P^) was only propagated.
        propagated_only: (K,) int64. 1 where N(x^, P^) was only propagated since the last match, else 0.
        gauge_covariance: (3, 3) float64 [m, m, rad]. Covariance of a motion of the whole map that the particles do not
            represent, as their frame was fixed when they were sampled from smoothed paths; estimates include it.
        start_covariances: (K, 3, 3) float64 [m, m, rad], start frames. Covariance of each robot's start pose that the
            particles do not represent; poses in the start frame include it.
        maps: Landmarks of all particles.
        estimates: Poses of all robots over all particles; updated in each step.
        starts_at_origin: Whether all robots started at the origin, as in a filter without merges.
        next_step: Number of the next step.
        rejuvenation: Schedule and graph of the smoother, or None.
        may_smooth: Whether a step may give time to the smoother.
        rng: Random stream of the filter.

    Raises:
        ValueError: If an argument is out of its range; the text names it.

    Example:
        >>> slam = FastSlam(num_particles=7, seed=1)
        >>> frame = Measurements([[0.0, 0.0, 2.0]], [[1.0, 0.0]])
        >>> slam.step([None], [frame]).num_new          # the first frame, at the start pose
        1
        >>> slam.map().means.round(3).tolist()          # two metres ahead: x of the map frame
        [[2.0, 0.0, 0.0]]
    """

    STATE = State(
        options=Options(FilterOptions),
        mixture_weights=Array(FLOAT64, "M", 0.0, 1.0),
        log_weights=Array(FLOAT64, "M", LEAST),
        path_log_weights=Array(FLOAT64, "M", LEAST),
        poses=Array(FLOAT64, "K 3 P", -MAX_DISTANCE, MAX_DISTANCE, used="M"),
        starts=Array(FLOAT64, "K 3 P", -MAX_DISTANCE, MAX_DISTANCE, used="M"),
        means=Array(FLOAT64, "K 3 P", -MAX_DISTANCE, MAX_DISTANCE, used="M"),
        biases=Array(FLOAT64, "K 3 P", -MAX_DISTANCE, MAX_DISTANCE, used="M"),
        covariances=Array(FLOAT64, "K 6 P", used="M"),
        gauge_covariance=Array(FLOAT64, "3 3"),
        start_covariances=Array(FLOAT64, "K 3 3"),
        bias_covariances=Array(FLOAT64, "2 K 3 3"),
        propagated_only=Array(INT64, "K", 0, 1),
        estimate_means=Array(FLOAT64, "K 3", -MAX_DISTANCE, MAX_DISTANCE),
        estimate_covariances=Array(FLOAT64, "K 3 3"),
        next_step=Int(),
        maps=Record(CompactMaps),
        logs=Each(Child(RobotLog), "K", list),  # before the smoother, which learns of pending steps from them
        rejuvenation=Maybe(Child(RejuvenationScheduler)),
        consistency=Child(ConsistencyTest),
        rng=Generator(),
    )

    @with_fields_of(FilterOptions)
    def __init__(
        self,
        num_robots: int = 1,
        *,
        seed: int | np.random.SeedSequence | np.random.Generator = 0,
        initial_poses: ArrayLike | None = None,
        backend: Literal["compiled", "reference"] = "compiled",
        **options: Any,
    ) -> None:
        if check_choice("backend", backend, ("compiled", "reference")) == "reference":
            chosen = FilterOptions(**{"rejuvenate_every": None} | options)
            self._reference: ReferenceFastSlam | None = ReferenceFastSlam(num_robots, chosen, seed, initial_poses)
            return
        self._allocate(num_robots, FilterOptions(**options), seed)
        if initial_poses is not None:
            hint = "Give one pose (x, y, theta) per robot."
            self._start_at(check_array("initial_poses", initial_poses, (num_robots, 3), hint, within=MAX_POSE))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Refuse what the readable filter does not have."""
            if self.__dict__.get("_reference") is None:
                raise AttributeError(f"'FastSlam' has no attribute '{name}'")
            raise AttributeError(
                'the readable filter has step, pose, particles and map() only: use FastSlam(..., backend="compiled")'
            )

    @classmethod
    def from_options(
        cls, num_robots: int, options: FilterOptions, seed: int | np.random.SeedSequence | np.random.Generator = 0
    ) -> "FastSlam":
        """Build a filter from ready-made options, all robots at the origin of the map frame.

        Args:
            num_robots: K.
            options: Assumptions and decision rules of the filter.
            seed: Seed of the random stream, see the class.

        Raises:
            ValueError: If `num_robots` or `seed` is out of its range.
        """
        self = cls.__new__(cls)
        self._allocate(num_robots, options, seed)
        return self

    def _allocate(self, num_robots: int, options: FilterOptions, seed: Any, num_particles: int | None = None) -> None:
        """Provide the arrays and parts of a filter, robots at the origin; None: as many particles as `options` say."""
        self._reference = None
        k = check_int("num_robots", num_robots, 1, "Use at least one robot.", MAX_ROBOTS)
        m = options.num_particles if num_particles is None else num_particles
        existence = options.existence
        self.options = options
        self.rng = np.random.default_rng(check_seed(seed))
        self._kernel_options = kernel_options(options)
        self.packed_camera = packed_camera(options.camera)
        self._existence = None if existence is None else ExistenceUpdate(existence, options.camera)
        self.rejuvenation = None if options.rejuvenate_every is None else RejuvenationScheduler(options, k)
        self.maps = ParticleMaps(m, None if existence is None else existence.log_odds_prior)
        padded = self.maps.padded
        self.pose_arrays: FloatArray = zeros_aligned((6, k, 3, padded), np.float64)
        self.weight_arrays: FloatArray = zeros_aligned((4, padded), np.float64)
        self.log_weights[:] = -np.log(m)
        self.mixture_weights[:] = 1.0 / m
        self.bias_covariances: FloatArray = np.zeros((2, k, 3, 3))
        self.bias_covariances[0] = options.motion.bias_covariance
        self.propagated_only: IntArray = np.zeros(k, np.int64)
        self.gauge_covariance: FloatArray = np.zeros((3, 3))
        self.start_covariances: FloatArray = np.zeros((k, 3, 3))
        self.starts_at_origin = True
        self.best_particle = 0
        self.next_step = 0
        self._consistency = ConsistencyTest()
        self.estimates = self._mixtures()
        self._batches = robot_batches(k, existence is not None)  # robots of each kernel call: one by one with existence
        self._robot_logs = [RobotLog() for _ in range(k)]
        self._pending = PendingSteps(k)
        self._associations: Int32Array = np.empty((0, padded), np.int32)  # work space of `update_fastslam2`
        self._mahalanobis_sq: FloatArray = np.empty((0, padded))
        self.may_smooth = True

    def _start_at(self, poses: FloatArray) -> None:
        """Set the start poses (K, 3) [m, m, rad], map frame, without uncertainty."""
        self.poses[:] = poses[:, :, None]
        self.poses[:, 2] = wrap_angle(self.poses[:, 2])
        self.starts[:] = self.means[:] = self.poses
        self._refresh_starts()
        self.estimates = self._mixtures()

    # ------------------------------------------------------------------ arrays of all particles

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
    def mixture_weights(self) -> FloatArray:
        """Weights after the last step, before resampling, summing to 1, (M,): those of `estimates`."""
        return np.asarray(self.weight_arrays[WEIGHT.weights, : self.num_particles])

    @property
    def _held_starts(self) -> BoolArray:
        """Whether each start pose has a covariance that the particles do not represent, (K,)."""
        return np.asarray(self.start_covariances[:, 2, 2] > 0.0)

    def _mixtures(self) -> PoseEstimates:
        """Return the robots' pose estimates over all particles, map frame. Fresh arrays."""
        return pose_mixtures(self.means, self.covariances, self.mixture_weights)

    def _refresh_starts(self) -> None:
        """Recompute `starts_at_origin` from the start poses."""
        self.starts_at_origin = not self.starts[:, :, : self.num_particles].any()

    def _refresh_best_particle(self) -> None:
        """Recompute `best_particle` from the accumulated weights."""
        self.best_particle = int(self.path_log_weights.argmax())

    # ------------------------------------------------------------------ one step

    def step(
        self,
        odometry: Sequence[ArrayLike | None],
        measurements: Sequence[Measurements | None],
        identities: Sequence[ArrayLike | None] | None = None,
        poses: Sequence[ArrayLike | None] | None = None,
    ) -> StepReport:
        """Move the robots, match their measurements, weigh, update, and resample if needed.

        Args:
            odometry: One (3,) [m, m, rad] per robot, motion (dx, dy, dtheta) since its last step in its previous frame,
                x ahead, y and dtheta to the left; None: it stood still.
            measurements: One frame per robot, or None.
            identities: One (n_i,) int per robot, the caller's own names of the measured landmarks, -1 for a measurement
                to be rejected; data association follows these names alone. None: association by gates and
                descriptors; without appearance all descriptors are equal, such as `np.ones((n, 1))`.
            poses: One (3,) [m, m, rad] per robot, its exact pose in its own start frame; odometry is ignored.

        Returns:
            Data association and statistics of the step.

        Raises:
            ValueError: If an argument is ill-formed; the filter is then unchanged.
        """
        if self._reference is not None:
            return self._reference.step(odometry, measurements, identities, poses)
        count, size = self.num_robots, self.descriptor_size
        inputs = validate_step(count, size, self.options.camera, odometry, measurements, identities, poses)
        return self.step_checked(inputs, rows_of(tuple(range(count))), *Associations.allocate(inputs))

    def step_checked(
        self,
        inputs: StepInput,
        robot_rows: RobotRows,
        associations: Associations,
        associations_buffer: IntArray,
        step: int | None = None,
    ) -> StepReport:
        """Do a step, as `step`, with inputs from `validate_step`.

        Args:
            inputs: Input of these robots, and perhaps of others; not changed.
            robot_rows: Rows of these robots in `inputs`.
            associations: Data association of `inputs`.
            associations_buffer: Writable array of `associations`, see `Associations.allocate`; the rows of these robots
                are written.
            step: Number of the step in the logs; None: the next one.
        """
        if step is not None:
            self.next_step = step
        used = self._make_room(inputs, robot_rows)
        summary = self._update_robots(inputs, robot_rows, associations_buffer)
        self._record(inputs, robot_rows, used, associations_buffer, summary)
        if summary.needs_resampling:
            self.resample()
        report = StepReport(
            all_associations=associations,
            rows=robot_rows.rows,
            num_created=summary.created,
            num_new=summary.new,
            num_matched=summary.matched,
            num_rejected=summary.rejected,
            ess=summary.ess,
            nis=summary.nis,
            resampled=summary.needs_resampling,
        )
        if (smoother := self.rejuvenation) is not None:
            smoother.record_step(summary.new + summary.matched, summary.long_unseen)
            is_busy = self.may_smooth and not smoother.is_waiting(self.next_step - 1)
            if is_busy and (news := self._smooth(smoother)) is not None:
                return report._replace(rejuvenation=news)
        return report

    def _make_room(self, inputs: StepInput, robots: RobotRows) -> int:
        """Provide capacity for the used measurements of a step, and return how many they are."""
        maps, pending = self.maps, self._pending
        used = sum(inputs.inputs[row].end - inputs.inputs[row].begin for _, row in robots.active)
        if used:
            maps.reserve(used, inputs.descriptors.shape[1])
            if len(self._associations) < len(inputs.measurements):
                shape = 2 * len(inputs.measurements), maps.padded
                self._associations, self._mahalanobis_sq = np.empty(shape, np.int32), np.empty(shape)
        if len(pending.steps) == LONGEST:
            pending.flush(self._robot_logs, self.rejuvenation)
        pending.reserve(used)
        return used

    def _update_robots(self, inputs: StepInput, robots: RobotRows, associations: IntArray) -> StepSummary:
        """Predict, associate, weigh and update: all robots in turn (Algorithm 1, l. 6-9), see `step_robots`.

        A robot without input draws no random number.

        Args:
            inputs: Input of these robots, and perhaps of others.
            robots: Rows of these robots in `inputs`.
            associations: (2, n) int64, written: data association of their measurements, see `Associations`.
        """
        maps, pending, active = self.maps, self._pending, 0
        for robot, row in robots.active:
            active += inputs.inputs[row].kind != NO_READING
            if inputs.inputs[row].kind == EXACT_POSE:
                self._set_exact_pose(robot, inputs.moves[row])
        now = 0 if self.rejuvenation is None else self.rejuvenation.steps + 1
        normals = self.rng.standard_normal((active, maps.num_particles, 3))
        deleted: list[IntArray] = []
        robot_arrays = (
            self.pose_arrays, self.weight_arrays, self.bias_covariances, self.propagated_only, self.gauge_covariance,
            *self.estimates,
        )  # fmt: skip
        given = (
            robots.array, inputs.inputs_table, inputs.moves, normals, inputs.measurements, inputs.descriptors,
            inputs.names,
        )  # fmt: skip
        results = (
            self._associations, self._mahalanobis_sq, associations, pending.noted[len(pending.steps)], pending.measured
        )  # fmt: skip
        for low, high, is_over in self._batches:
            part = low, high, is_over, now, pending.num_measured
            fields = _kernels.step_robots(part, self._kernel_options, robot_arrays, tuple(maps.arrays), given, results)
            if self._existence is not None and not is_over and (row := robots.rows[low]) >= 0:
                own = inputs.inputs[row]
                if own.num_given >= 0:
                    _, started = associations  # by slot, until the step is over
                    found, new_slots = self._associations[own.begin : own.end], started[own.begin : own.end]
                    deleted.append(self._existence.update(maps, self.poses[low], self.best_particle, found, new_slots))
        for slots in deleted:  # last, as the ids are needed until here
            maps.release(slots)
        return StepSummary(*fields)

    def _record(
        self, inputs: StepInput, robots: RobotRows, used: int, associations: IntArray, summary: StepSummary
    ) -> None:
        """Record a step: for the log, for the test of consistency, and its rejected measurements for the smoother."""
        self.best_particle = summary.best
        self._pending.steps.append(self.next_step)
        self._pending.num_measured += used
        if used:
            unmatched = used - summary.new - summary.matched
            self._consistency.update(self.next_step, summary.nis, summary.ess / self.num_particles, used, unmatched)
        if summary.rejected and self.rejuvenation is not None:
            record_rejected(self.rejuvenation, self.next_step, inputs, robots, associations)
        self.next_step += 1

    def _set_exact_pose(self, robot: int, pose: FloatArray) -> None:
        """Set a robot's pose in all particles to an exact one (3,) [m, m, rad] in its own start frame."""
        count = self.num_particles
        self.poses[robot, :, :count] = compose(self.starts[robot, :, :count].T.copy(), pose).T
        self.gauge_covariance.fill(0.0)
        self.start_covariances[robot] = 0.0

    def resample(self) -> None:
        """Resample the particles in proportion to their weights."""
        ancestors = RESAMPLING[self.options.resampling](self.mixture_weights, self.rng, self.num_particles)
        self.best_particle = self.maps.resample(ancestors, self.pose_arrays, self.weight_arrays)

    # ------------------------------------------------------------------ rejuvenation

    def rejuvenate(self) -> RejuvenationReport:
        """Sample the particles from the posterior of whole paths now, whether or not `rejuvenate_every` is set.

        If it is not set, all steps so far are smoothed from the log, and the smoother is discarded.

        Returns:
            The outcome; if it has a reason, the particles are unchanged.
        """
        smoother = self.rejuvenation
        if smoother is None:
            smoother = RejuvenationScheduler(replace(self.options, rejuvenate_every=1), self.num_robots)
        smoother.request()
        while (report := self._smooth(smoother)) is None:
            pass
        return report

    @property
    def can_rejuvenate(self) -> bool:
        """Whether the filter has a smoother, and no pose that was given as exact disables it."""
        if self.rejuvenation is None:
            return False
        self.update_logs()  # which says whether poses were given as exact
        return not self.rejuvenation.is_disabled

    def request_rejuvenation(self) -> None:
        """Request a rejuvenation as soon as possible, in slices if the smoother works incrementally."""
        if self.rejuvenation is not None:
            self.rejuvenation.request()

    @property
    def rejuvenation_requested(self) -> bool:
        """Whether `request_rejuvenation` was called and the rejuvenation is still outstanding."""
        return self.rejuvenation is not None and self.rejuvenation.requested

    def _smooth(self, smoother: RejuvenationScheduler) -> RejuvenationReport | None:
        """Sample the particles from the smoothed paths, if due; return None if there is nothing to report."""
        if smoother.is_idle(self.logs):
            return None
        starts = self.starts[:, :, : self.num_particles]
        result = smoother.run(
            self.logs, starts, self._held_starts, self.maps, self.best_particle, self.packed_camera, self.rng
        )  # fmt: skip
        if result is None:
            return None
        if result.particles is not None:
            self._replace_particles(result.particles)
        found = None
        if (moved := result.relocated) is not None and result.particles is not None:
            x, y, heading = moved.shift.tolist()
            found = Relocalisation(moved.robot, (x, y, heading), len(moved.pairs), moved.outcome)
            self._consistency.add_relocalisation(self.next_step - 1, found)
        return RejuvenationReport(result.reason, result.ess, result.iterations, result.graph.num_keys, found)

    def _replace_particles(self, new: Particles) -> None:
        """Replace the M particles by samples of smoothed paths, with landmarks of the most probable particle so far."""
        m = self.num_particles
        NewLandmarks.of(self.maps, self.best_particle, new, self.options.landmark_walk).write(self.maps)
        self.poses[:, :, :m], self.starts[:, :, :m], self.biases[:, :, :m] = new.poses, new.starts, new.biases
        self.bias_covariances[0], self.bias_covariances[1] = new.bias_covariances, 0.0
        self._refresh_starts()
        self.means[:] = self.poses
        self.covariances.fill(0.0)
        self.gauge_covariance[:], self.start_covariances[:] = new.frame, new.start_scatters
        self.propagated_only.fill(0)
        self.log_weights[:], self.path_log_weights[:] = new.log_weights, new.log_densities
        self._refresh_best_particle()
        self.mixture_weights[:] = np.exp(new.log_weights)
        self.estimates.means[:], self.estimates.covariances[:] = new.means, new.covariances

    def update_logs(self) -> None:
        """Bring the logs up to date, and what the smoother knows of them."""
        if self._pending.steps:
            self._pending.flush(self._robot_logs, self.rejuvenation)

    # ------------------------------------------------------------------ estimates

    @property
    def state(self) -> "FastSlam":
        """The filter itself: alias for code of version 0.3, where the parts of a filter belonged to its state."""
        return self

    @property
    def num_robots(self) -> int:
        """Number of robots, K."""
        return int(self.pose_arrays.shape[1])

    @property
    def num_particles(self) -> int:
        """Number of particles, M."""
        return self.maps.num_particles

    @property
    def num_landmarks(self) -> int:
        """Number of landmarks that at least one particle holds."""
        return int(np.count_nonzero(self.maps.ids >= 0))

    @property
    def map_size(self) -> int:
        """Number of landmarks that the most probable particle holds: the length of `map()`."""
        slots = np.flatnonzero(self.maps.ids >= 0)
        return int(np.count_nonzero(self.maps.of_particle(self.best_particle, slots)[1]))

    @property
    def map_capacity(self) -> int:
        """Largest number of landmarks that fit in the allocated arrays."""
        return int(self.maps.table.shape[1])

    @property
    def descriptor_size(self) -> int:
        """Length of the descriptors in the map, 0 before the first one."""
        return int(self.maps.descriptors.shape[1])

    @property
    def consistency(self) -> Consistency:
        """Consistency of the filter in its frames so far, with advice if it is inconsistent."""
        return self._consistency.report()

    def diagnose(self, robot: int = 0) -> tuple[Cause, ...]:
        """Return the likely mistakes in the set-up of a robot's readings so far, by `slam_backend.diagnosis`.

        Landmarks without identities that all look alike are said to be so, last.
        """
        own, options = self.logs[self._check_robot(robot)].arrays(), self.options
        named = (self.maps.identities[self.maps.used_slots()] >= 0).any()
        known = None if named else landmark_table(self.maps, self.best_particle)
        return diagnose_run(own, options.camera, options.motion, known, options.descriptor_gate)

    def log(self, robot: int = 0) -> RobotLog:
        """Return a copy of a robot's log: odometry, measured points and their data association."""
        return self.logs[self._check_robot(robot)].copy()

    @property
    def nbytes(self) -> int:
        """Memory of the particles [bytes]: mostly (72 + 4) per particle and landmark."""
        of_particles = self.pose_arrays, self.log_weights, self.path_log_weights
        return self.maps.nbytes + sum(array.nbytes for array in of_particles)

    @property
    def weights(self) -> FloatArray:
        """(M,) weights, summing to 1. A copy."""
        return np.asarray(np.exp(self.log_weights))

    def pose(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] over all particles, map frame. Copies.

        They are those of the mixture of N(x^, P^) before sampling, which has less variance than the samples.
        """
        if self._reference is not None:
            return self._reference.pose(robot)
        return self.estimates.of(self._check_robot(robot))

    def particles(self, robot: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return a robot's poses (M, 3) [m, m, rad], map frame, and the normalised log-weights (M,). Copies."""
        if self._reference is not None:
            particles = self._reference.particles
            return np.array([p.poses[robot] for p in particles]), np.array([p.log_weight for p in particles])
        return self._columns(self.poses[self._check_robot(robot)]), self.log_weights.copy()

    def start_pose(self, robot: int = 0) -> FloatArray:
        """Return the start pose (3,) [m, m, rad] of a robot, map frame, in the most probable particle. A copy."""
        return np.array(self.starts[self._check_robot(robot), :, self.best_particle])

    def pose_from_start(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] in its own start frame. Copies.

        Each particle's pose is taken relative to the robot's start pose in the same particle, so that the uncertainty
        of the start after a merge does not enter.
        """
        index, every = self._check_robot(robot), tuple(range(self.num_robots))
        team_poses = TeamPoses(len(every))
        self.write_team_poses(every, every, 1.0, team_poses)
        return PoseEstimate(team_poses.own[index].copy(), team_poses.covariances[index].copy())

    def write_team_poses(
        self, robots: tuple[int, ...], active_robots: tuple[int, ...], ess: float, team_poses: TeamPoses
    ) -> None:
        """Write the poses of the robots in `active_robots`; `robots` are the team's indices of all, `ess` is copied."""
        weights = NO_WEIGHTS if self.starts_at_origin else self.weights
        _kernels.write_team_poses(
            self.pose_arrays, self.start_covariances, weights, self.best_particle, *self.estimates,
            membership_table(robots, active_robots), team_poses.poses, team_poses.beliefs,
        )  # fmt: skip
        for robot in robots:
            if robot in active_robots:
                team_poses.ess[robot] = ess

    def particles_from_start(self, robot: int = 0) -> FloatArray:
        """Return a robot's poses (M, 3) [m, m, rad], each relative to its start pose in the same particle."""
        starts = self._columns(self.starts[self._check_robot(robot)])
        return between(starts, self._columns(self.poses[robot]))

    def _columns(self, rows: FloatArray) -> FloatArray:
        """Return (M, c) of padded rows (c, P). A copy."""
        return rows[:, : self.num_particles].T.copy()

    def odometry_bias(self, robot: int = 0) -> BiasEstimate:
        """Return mean and covariance of a robot's odometry bias over all particles, zeros if the model has none."""
        index, count = self._check_robot(robot), self.num_particles
        means = self.biases[index, :, :count]
        mean = means @ self.weights
        off = means - mean[:, None]
        return BiasEstimate(mean, (off * self.weights) @ off.T + self.bias_covariances[0, index])

    def map(self, estimate: Literal["best", "mixture"] = "best", min_count: int = 1) -> LandmarkMap:
        """Return the map [m, m^2] in the map frame, landmarks by ascending id. A copy.

        Args:
            estimate: "best": means and conditional covariances of the most probable particle (Eq. 12). "mixture":
                mean and covariance over all particles that hold the landmark, path uncertainty included,
                sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T) (Sec. 3.2, see `docs/reference/errata.md`); the landmarks
                are those of the most probable particle.
            min_count: Landmarks that the most probable particle measured fewer times are left out.

        Raises:
            ValueError: If `estimate` is neither.
        """
        check_choice("estimate", estimate, ("best", "mixture"))
        if self._reference is not None and min_count == 1:
            return self._reference.map(estimate)
        maps, best = self.maps, self.best_particle
        if estimate == "best":
            return unchecked_map(*best_map(maps, best, min_count))
        return unchecked_map(*map_mixture(maps, best, self.log_weights, self.gauge_covariance, min_count))

    def descriptors(self) -> NDArray[np.float32]:
        """Return the descriptors (n, d) of the landmarks of `map()`. A copy."""
        return np.asarray(self.maps.descriptors[present_slots(self.maps, self.best_particle, 1)])

    def map_summary(self, min_count: int = 1) -> MapSummary:
        """Return the summary of `map(min_count=min_count)`, much faster. Fresh arrays."""
        rows = MapSummaryRows.allocate(self.map_capacity)
        return rows.part(0, write_summary(self.maps, self.best_particle, min_count, rows, 0))

    def existence(self) -> tuple[IntArray, FloatArray]:
        """Return the ids (n,) of the landmarks of `map()`, ascending, and the probability (n,) that each exists.

        Raises:
            ValueError: If the filter was built without `existence`.
        """
        if self._existence is None:
            hint = "Build the filter with existence=ExistenceModel()."
            raise argument_error("existence", "a filter that estimates it", "a filter that does not", hint)
        maps, best = self.maps, self.best_particle
        slots = maps.used_slots()
        slots = slots[maps.of_particle(best, slots)[1] > 0]
        return maps.ids[slots], 1.0 / (1.0 + np.exp(-maps.odds_of_particle(best, slots)))

    def graph(self, covariances: bool = True) -> PoseGraph:
        """Return the smoothed poses of all robots, the landmarks and what links them, in the map frame.

        All steps of the logs are smoothed, with the data association of the most probable particle; the filter does not
        change. Poses are the starts, all steps with matched or new measurements, and the last ones; `times` are steps.
        Optimising the graph elsewhere leaves it as it is: `slam_backend.smoother.graph_export` describes the edges.
        `write_graph` writes it for other programs, and `PoseGraph.trajectory` returns the path of a robot.

        Args:
            covariances: Whether marginal covariances are computed; they take most of the time.

        Raises:
            ValueError: If there is no step yet, poses were given as exact, odometry has no noise, or the run cannot be
                smoothed.
        """
        present = None if self.rejuvenation is None else self.rejuvenation.graph
        options, starts = self.options, self.starts[:, :, : self.num_particles]
        begun = starts_graph(starts, self._held_starts, options.motion, present)
        logs = [log.arrays() for log in self.logs]
        return smoothed_graph(begun, logs, options.motion, self.packed_camera, options.smoothing, covariances)

    def _check_robot(self, robot: int) -> int:
        """Return the index of a robot, or raise if it is out of range."""
        if isinstance(robot, bool) or not isinstance(robot, (int, np.integer)) or not 0 <= robot < self.num_robots:
            raise argument_error("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")
        return int(robot)

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
        self._robot_logs = [self.logs[robot] for robot in order]
        self.estimates = PoseEstimates(*(of_all[order] for of_all in self.estimates))
        if self.rejuvenation is not None:
            self.rejuvenation.reorder(order)

    def finish_join(self, a: "FastSlam", b: "FastSlam", renamed: IntArray) -> None:
        """Join the step counts, warnings, logs and smoothers of two groups, once the joint map is loaded.

        Args:
            a, b: Filter of each group.
            renamed: (n, 2) int64 rows (id in b, id in the joint map) of all of b's landmarks.
        """
        self._refresh_starts()
        self._refresh_best_particle()
        self.next_step = max(a.next_step, b.next_step)
        self._consistency = ConsistencyTest.joined(a._consistency, b._consistency)
        self.estimates = self._mixtures()
        if self.gauge_covariance.any():
            add_gauge_covariance(self.gauge_covariance, *self.estimates)
        self._robot_logs = [log.copy() for log in a.logs] + [
            log.renamed(renamed[:, 0], renamed[:, 1]) for log in b.logs
        ]
        if self.rejuvenation is not None and a.rejuvenation is not None and b.rejuvenation is not None:
            starts = [slam.starts[:, :, : slam.num_particles] for slam in (a, b, self)]
            frames = a.gauge_covariance, b.gauge_covariance
            held = a._held_starts, b._held_starts
            self.rejuvenation.join(a.rejuvenation, b.rejuvenation, starts, held, frames, renamed, self.packed_camera)

    # ------------------------------------------------------------------ snapshots

    @property
    def logs(self) -> list[RobotLog]:
        """Log of each robot, up to date."""
        self.update_logs()
        return self._robot_logs

    @logs.setter
    def logs(self, logs: list[RobotLog]) -> None:
        self._robot_logs = logs

    @property
    def estimate_means(self) -> FloatArray:
        """Means of `estimates`, (K, 3) [m, m, rad]."""
        return self.estimates.means

    @property
    def estimate_covariances(self) -> FloatArray:
        """Covariances of `estimates`, (K, 3, 3) [m, m, rad]."""
        return self.estimates.covariances

    @property
    def _maps(self) -> CompactMaps:
        """Content of `maps`."""
        return self.maps.compact()

    @_maps.setter
    def _maps(self, content: CompactMaps) -> None:
        self.maps.load(content)

    def get_state(self) -> Snapshot:
        """Return the complete state of the filter, its random stream included."""
        self.update_logs()
        return take(self)

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `get_state`; the filter then continues identically.

        Raises:
            ValueError: If `state` is not from `get_state`.
        """
        restore(self, accepted(FastSlam, "state", state))

    @classmethod
    def from_state(cls, state: Snapshot) -> "FastSlam":
        """Build a filter with a state from `get_state`."""
        slam = cls.from_options(len(state["poses"]), state["options"])
        restore(slam, state)
        return slam

    def make_room(self, state: Snapshot) -> None:
        """Provide arrays and parts for the sizes and options of a state, without pending steps."""
        k, m = len(state["poses"]), len(state["mixture_weights"])
        if (k, m) != (self.num_robots, self.num_particles) or state["options"] != self.options:
            self._allocate(k, state["options"], 0, m)
        self._pending.clear()

    def rebuild(self) -> None:
        """Compute what follows from the weights and the start poses."""
        self._refresh_starts()
        self._refresh_best_particle()

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse parts that do not fit together: options, sizes, logs, and what the smoother knows of them."""
        options, maps, rejuvenation = parts["options"], parts["maps"], parts["rejuvenation"]
        k, m = sizes["K"], sizes["M"]
        kernel_options(options)
        if options.existence is not None:
            ExistenceUpdate(options.existence, options.camera)
        if not 1 <= k <= MAX_ROBOTS or m < 1 or sizes["P"] != padded_lanes(m):
            raise ValueError(f"{k} robots and {sizes['P']} lanes of {m} particles")
        if not abs(float(parts["mixture_weights"].sum()) - 1.0) < 1e-6:
            raise ValueError("weights that do not sum to 1")
        if max(map(last_step, parts["logs"])) >= parts["next_step"]:
            raise ValueError(f"next_step {parts['next_step']} that is logged already")
        if (options.existence is None) != (maps.odds is None):
            raise ValueError("odds without an existence model, or none with one")
        if (options.rejuvenate_every is None) != (rejuvenation is None):
            raise ValueError("a smoother without rejuvenate_every, or none with it")
        if rejuvenation is not None:
            for rejected, log in zip(rejuvenation["rejected"], parts["logs"], strict=True):
                check_rejected(rejected, log, maps.descriptors.shape[1])
