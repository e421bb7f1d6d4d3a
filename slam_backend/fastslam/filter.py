"""`FastSlam`: a Rao-Blackwellized particle filter over the paths of K robots, with one EKF per landmark and particle.

The filter implements Sections 2 and 4 of the paper, with its errata. Robots are processed in turn (Algorithm 1): each
one moves, matches its measurements to the map as updated by the robots before it, weighs the particles and updates the
landmarks. Then the joint particles are resampled.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.state_checks import HINT, refuse_malformed
from slam_backend.core.validation import FloatArray, IntArray, argument_error, check_array, check_choice, known_names
from slam_backend.fastslam import _kernels
from slam_backend.fastslam.consistency import Consistency
from slam_backend.fastslam.estimates import map_mixture
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.options import REJUVENATE_EVERY, FilterOptions
from slam_backend.fastslam.particle_maps import best_map, present_slots, write_summary
from slam_backend.fastslam.rejuvenation import RejuvenationScheduler
from slam_backend.fastslam.relative_poses import TeamPoses, membership_table
from slam_backend.fastslam.reports import Associations, BiasEstimate, PoseEstimate, RejuvenationReport, StepReport
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.fastslam.state import FilterState
from slam_backend.fastslam.state_checks import check_filter, last_step
from slam_backend.fastslam.step_input import MAX_POSE, RobotRows, StepInput, rows_of, validate_step
from slam_backend.geometry import between
from slam_backend.maps.landmark_map import LandmarkMap, MapSummary, MapSummaryRows, unchecked_map
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.options import SmoothingOptions

NO_WEIGHTS = np.empty(0)  # unused where all particles start at the same pose


@known_names
class FastSlam:
    """Visual FastSLAM for one robot, or jointly for several that share a map frame.

    All arguments but these three are fields of `FilterOptions`, which describes them.

    Args:
        num_robots: K. Each particle holds K poses and one map (Eq. 19).
        seed: Seed of the filter's own random stream: an int, a `numpy.random.SeedSequence` or a Generator.
        initial_poses: (K, 3) [m, m, rad], map frame. None: all at the origin.

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

    def __init__(
        self,
        num_robots: int = 1,
        num_particles: int = 100,
        camera: StereoCamera | None = None,
        motion: OdometryModel | None = None,
        proposal: Literal["fastslam2", "fastslam1"] = "fastslam2",
        resampling: str = "systematic",
        resample_threshold: float = 0.5,
        position_gate: float = 11.34,
        descriptor_gate: float = 0.45,
        new_landmark_gate: float = 25.0,
        new_landmark_radius: float = 1.0,
        recovery_position: float = 0.5,
        recovery_heading: float = 0.1,
        descriptor_sigma: float = 0.1,
        ambiguity_margin: float = 6.0,
        new_landmark_density: float = 0.01,
        one_to_one: bool = True,
        landmark_noise: float | None = None,
        existence: ExistenceModel | None = None,
        rejuvenate_every: int | None = REJUVENATE_EVERY,
        smoothing: SmoothingOptions | None = None,
        seed: int | np.random.SeedSequence | np.random.Generator = 0,
        initial_poses: ArrayLike | None = None,
    ) -> None:
        options = FilterOptions(
            num_particles=num_particles,
            camera=StereoCamera() if camera is None else camera,
            motion=OdometryModel() if motion is None else motion,
            proposal=proposal,
            resampling=resampling,
            resample_threshold=resample_threshold,
            position_gate=position_gate,
            descriptor_gate=descriptor_gate,
            new_landmark_gate=new_landmark_gate,
            new_landmark_radius=new_landmark_radius,
            recovery_position=recovery_position,
            recovery_heading=recovery_heading,
            descriptor_sigma=descriptor_sigma,
            ambiguity_margin=ambiguity_margin,
            new_landmark_density=new_landmark_density,
            one_to_one=one_to_one,
            landmark_noise=landmark_noise,
            existence=existence,
            rejuvenate_every=rejuvenate_every,
            smoothing=SmoothingOptions() if smoothing is None else smoothing,
        )
        self.state = FilterState(num_robots, options, seed)
        self.may_smooth = True
        if initial_poses is not None:
            hint = "Give one pose (x, y, theta) per robot."
            self.state.start_at(check_array("initial_poses", initial_poses, (num_robots, 3), hint, within=MAX_POSE))

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
        return cls.from_filter_state(FilterState(num_robots, options, seed))

    @classmethod
    def from_filter_state(cls, state: FilterState) -> "FastSlam":
        """Return a filter with a given state."""
        self = cls.__new__(cls)
        self.state = state
        self.may_smooth = True
        return self

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
        state = self.state
        if step is not None:
            state.next_step = step
        long_unseen, created, new, matched, rejected, ess, nis, needs_resampling = state.update(
            inputs, robot_rows, associations_buffer
        )
        if needs_resampling:
            state.resample()
        report = StepReport(associations, robot_rows.rows, created, new, matched, rejected, ess, nis, needs_resampling)
        if (smoother := state.rejuvenation) is not None:
            smoother.record_step(new + matched, long_unseen)
            is_busy = self.may_smooth and not smoother.is_waiting(state.next_step - 1)
            if is_busy and (news := state.rejuvenate(smoother)) is not None:
                return report._replace(rejuvenation=news)
        return report

    def rejuvenate(self) -> RejuvenationReport:
        """Sample the particles from the posterior of whole paths now, whether or not `rejuvenate_every` is set.

        If it is not set, all steps so far are smoothed from the log, and the smoother is discarded.

        Returns:
            The outcome; if it has a reason, the particles are unchanged.
        """
        smoother = self.state.rejuvenation
        if smoother is None:
            smoother = RejuvenationScheduler(replace(self.options, rejuvenate_every=1), self.num_robots)
        smoother.request()
        while (report := self.state.rejuvenate(smoother)) is None:
            pass
        return report

    @property
    def can_rejuvenate(self) -> bool:
        """Whether the filter has a smoother, and no pose that was given as exact disables it."""
        if self.state.rejuvenation is None:
            return False
        self.state.update_logs()  # which says whether poses were given as exact
        return not self.state.rejuvenation.is_disabled

    def request_rejuvenation(self) -> None:
        """Request a rejuvenation as soon as possible, in slices if the smoother works incrementally."""
        if self.state.rejuvenation is not None:
            self.state.rejuvenation.request()

    @property
    def rejuvenation_requested(self) -> bool:
        """Whether `request_rejuvenation` was called and the rejuvenation is still outstanding."""
        return self.state.rejuvenation is not None and self.state.rejuvenation.requested

    # ------------------------------------------------------------------ estimates

    @property
    def options(self) -> FilterOptions:
        """Assumptions and decision rules of the filter."""
        return self.state.options

    @property
    def num_robots(self) -> int:
        """Number of robots, K."""
        return self.state.num_robots

    @property
    def num_particles(self) -> int:
        """Number of particles, M."""
        return self.state.num_particles

    @property
    def best_particle(self) -> int:
        """Index of the most probable particle, by accumulated log-weight (Eq. 12)."""
        return self.state.best

    @property
    def num_landmarks(self) -> int:
        """Number of landmarks that at least one particle holds."""
        return int(np.count_nonzero(self.state.maps.ids >= 0))

    @property
    def map_size(self) -> int:
        """Number of landmarks that the most probable particle holds: the length of `map()`."""
        slots = np.flatnonzero(self.state.maps.ids >= 0)
        return int(np.count_nonzero(self.state.maps.of_particle(self.state.best, slots)[1]))

    @property
    def map_capacity(self) -> int:
        """Largest number of landmarks that fit in the allocated arrays."""
        return int(self.state.maps.table.shape[1])

    @property
    def descriptor_size(self) -> int:
        """Length of the descriptors in the map, 0 before the first one."""
        return int(self.state.maps.descriptors.shape[1])

    @property
    def consistency(self) -> Consistency:
        """Consistency of the filter in its frames so far, with advice if it is inconsistent."""
        return self.state.consistency.report()

    def log(self, robot: int = 0) -> RobotLog:
        """Return a copy of a robot's log: odometry, measured points and their data association."""
        return self.state.logs[self._check_robot(robot)].copy()

    @property
    def nbytes(self) -> int:
        """Memory of the particles [bytes]: mostly (72 + 4) per particle and landmark."""
        state = self.state
        return state.maps.nbytes + state.pose_arrays.nbytes + state.log_weights.nbytes + state.path_log_weights.nbytes

    @property
    def weights(self) -> FloatArray:
        """(M,) weights, summing to 1. A copy."""
        return np.asarray(np.exp(self.state.log_weights))

    def pose(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] over all particles, map frame. Copies.

        They are those of the mixture of N(x^, P^) before sampling, which has less variance than the samples.
        """
        return self.state.estimates.of(self._check_robot(robot))

    def particles(self, robot: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return a robot's poses (M, 3) [m, m, rad], map frame, and the normalised log-weights (M,). Copies."""
        return self._columns(self.state.poses[self._check_robot(robot)]), self.state.log_weights.copy()

    def start_pose(self, robot: int = 0) -> FloatArray:
        """Return the start pose (3,) [m, m, rad] of a robot, map frame, in the most probable particle. A copy."""
        return np.array(self.state.starts[self._check_robot(robot), :, self.state.best])

    def pose_from_start(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] in its own start frame. Copies.

        Each particle's pose is taken relative to the robot's start pose in the same particle, so that the uncertainty
        of the start after a merge does not enter.
        """
        index, every = self._check_robot(robot), tuple(range(self.num_robots))
        points = TeamPoses(len(every))
        self.write_team_poses(every, every, 1.0, points)
        return PoseEstimate(points.own[index].copy(), points.covariances[index].copy())

    def write_team_poses(
        self, names: tuple[int, ...], active_robots: tuple[int, ...], ess: float, points: TeamPoses
    ) -> None:
        """Write the poses of the robots in `active_robots`; `names` are the team's indices of all, `ess` is copied."""
        state = self.state
        weights = NO_WEIGHTS if state.starts_at_origin else np.exp(state.log_weights)
        _kernels.write_team_poses(
            state.pose_arrays, state.start_covariances, weights, state.best, *state.estimates,
            membership_table(names, active_robots), points.poses, points.beliefs,
        )  # fmt: skip
        for robot in names:
            if robot in active_robots:
                points.ess[robot] = ess

    def particles_from_start(self, robot: int = 0) -> FloatArray:
        """Return a robot's poses (M, 3) [m, m, rad], each relative to its start pose in the same particle."""
        starts = self._columns(self.state.starts[self._check_robot(robot)])
        return between(starts, self._columns(self.state.poses[robot]))

    def _columns(self, rows: FloatArray) -> FloatArray:
        """Return (M, c) of padded rows (c, P). A copy."""
        return rows[:, : self.state.num_particles].T.copy()

    def odometry_bias(self, robot: int = 0) -> BiasEstimate:
        """Return mean and covariance of a robot's odometry bias over all particles, zeros if the model has none."""
        index, count = self._check_robot(robot), self.num_particles
        means = self.state.biases[index, :, :count]
        mean = means @ self.weights
        off = means - mean[:, None]
        return BiasEstimate(mean, (off * self.weights) @ off.T + self.state.bias_covariances[0, index])

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
        state = self.state
        if estimate == "best":
            return unchecked_map(*best_map(state.maps, state.best, min_count))
        return unchecked_map(*map_mixture(state.maps, state.best, state.log_weights, state.gauge_covariance, min_count))

    def descriptors(self) -> NDArray[np.float32]:
        """Return the descriptors (n, d) of the landmarks of `map()`. A copy."""
        return np.asarray(self.state.maps.descriptors[present_slots(self.state.maps, self.state.best, 1)])

    def map_summary(self, min_count: int = 1) -> MapSummary:
        """Return the summary of `map(min_count=min_count)`, much faster. Fresh arrays."""
        rows = MapSummaryRows.allocate(self.map_capacity)
        return rows.part(0, write_summary(self.state.maps, self.state.best, min_count, rows, 0))

    def existence(self) -> tuple[IntArray, FloatArray]:
        """Return the ids (n,) of the landmarks of `map()`, ascending, and the probability (n,) that each exists.

        Raises:
            ValueError: If the filter was built without `existence`.
        """
        if self.state.existence is None:
            hint = "Build the filter with existence=ExistenceModel()."
            raise argument_error("existence", "a filter that estimates it", "a filter that does not", hint)
        maps, best = self.state.maps, self.state.best
        slots = maps.used_slots()
        slots = slots[maps.of_particle(best, slots)[1] > 0]
        return maps.ids[slots], 1.0 / (1.0 + np.exp(-maps.odds_of_particle(best, slots)))

    def _check_robot(self, robot: int) -> int:
        """Return the index of a robot, or raise if it is out of range."""
        if isinstance(robot, bool) or not isinstance(robot, (int, np.integer)) or not 0 <= robot < self.num_robots:
            raise argument_error("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")
        return int(robot)

    # ------------------------------------------------------------------ snapshots

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i is the former `order[i]`; (K,) a permutation."""
        self.state.reorder(order)

    def get_state(self) -> dict[str, Any]:
        """Return the complete state of the filter, its random stream included. Nothing is shared."""
        return self.state.get_state()

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state from `get_state`; the filter then continues identically.

        Raises:
            ValueError: If `state` is not from `get_state`.
        """
        with refuse_malformed("state"):
            check_filter("state", state, (self.options,))
        if (last := max(map(last_step, state["logs"]))) >= state["steps"]:
            raise argument_error("state['steps']", f"an int > {last}, the last step logged", state["steps"], HINT)
        self.restore_checked(state)

    def restore_checked(self, state: Mapping[str, Any]) -> None:
        """Restore a state that was validated."""
        previous = self.state
        self.state = FilterState.restored(state, previous)
        if self.state is not previous:
            self.may_smooth = True
