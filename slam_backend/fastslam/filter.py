"""`FastSlam`: a Rao-Blackwellized particle filter over the paths of K robots, with one EKF per landmark and particle.

Sections 2 and 4 of the paper, with its errata. Robots are taken in turn (Algorithm 1): each moves, matches what it sees
to the map that the robots before it have just updated, weighs the particles and updates the landmarks; then the joint
particles are resampled.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import FloatArray, IntArray, bad_argument, check_array, check_choice, known_names
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels import IDLE, PLACED
from slam_backend.fastslam._kernels.layout import CREATED
from slam_backend.fastslam.consistency import Consistency
from slam_backend.fastslam.estimates import map_mixture
from slam_backend.fastslam.existence import ExistenceModel
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.particle_maps import best_map, slots_held, write_outline
from slam_backend.fastslam.rejuvenation import RejuvenationStep
from slam_backend.fastslam.relative_poses import Standpoints, members_of
from slam_backend.fastslam.reports import Findings, PoseEstimate, RejuvenationReport, StepReport
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.fastslam.state import LONGEST, FilterArrays, FilterState, tell_refused
from slam_backend.fastslam.step_input import FARTHEST_POSE, Seats, StepInput, check_step, seats_of
from slam_backend.geometry import between, compose, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap, MapOutline, OutlineRows
from slam_backend.models.camera import StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.resampling import RESAMPLING
from slam_backend.smoother.options import SmoothingOptions

if TYPE_CHECKING:
    from slam_backend.fastslam.state import FilterState

# The most probable particle, how many landmarks not seen for long it matched, and seven numbers of a `StepReport`.
Summary = tuple[int, int, int, int, int, int, float, float, bool]


def place(arrays: FilterArrays, robot: int, exact: FloatArray) -> None:
    """Put a robot, in all particles, where it is told that it is: (3,) [m, m, rad] in its own start frame."""
    count = arrays.num_particles
    arrays._poses[robot, :, :count] = compose(arrays._starts[robot, :, :count].T.copy(), exact).T
    arrays._frame.fill(0.0)  # it is known now


def take_turns(
    slam: "FilterState", inputs: StepInput, seats: Seats, told: IntArray
) -> tuple[Summary, list[IntArray], int]:
    """Move all robots of a filter, match what they saw, weigh and update (Algorithm 1, l. 6-8), and sum it up.

    Where one did and saw nothing no random number is drawn. The step waits in the journal then.

    Args:
        slam: Its particles and their maps are changed, its estimates written.
        inputs: What these robots, and perhaps others, read.
        seats: Of its robots there.
        told: (2, n) int64, written: what becomes of their measurements, see `Findings`.

    Returns:
        What all of it came to; slots of landmarks that turned out not to exist, to be released when nothing asks for
        their ids; and the number of measurements that were used.
    """
    maps, journal = slam._maps, slam._journal
    active = used = 0
    for robot, row in seats.heard:
        act, begin, end, _, _, _ = inputs.turns[row]
        active, used = active + (act != IDLE), used + end - begin
        if act == PLACED:
            place(slam, robot, inputs.moves[row])
    if used:
        maps.make_room(used, inputs.descriptors.shape[1])
        if len(slam._found) < len(inputs.sightings):
            slam._make_room_for(len(inputs.sightings))
    if len(journal.steps) == LONGEST:
        slam._write_down()
    journal.make_room(used)
    now = 0 if slam._rejuvenation is None else slam._rejuvenation.steps + 1
    normals = slam._rng.standard_normal((active, maps.num_particles, 3))
    means, covariances = slam._estimates
    deserted: list[IntArray] = []
    for low, high, is_over in slam._spans:
        summary = _kernels.take_turns(
            low, high, is_over, now, slam._assumed, seats.array, inputs.table, inputs.moves, normals,
            slam._of_robots, slam._blind, slam._of_particles, slam._frame,
            maps.values, maps.counts, maps.odds, maps.table, maps.maps, maps.users, maps.free_rows, maps.tops,
            maps.descriptors, maps.heads, inputs.sightings, inputs.descriptors, inputs.names,
            slam._found, slam._distances, told, means, covariances,
            journal.noted[len(journal.steps)], journal.measured, journal.num_measured,
        )  # fmt: skip
        if slam._existence is not None and not is_over and (row := seats.rows[low]) >= 0:
            _, begin, end, _, _, count = inputs.turns[row]
            if count >= 0:
                found, new_slots = slam._found[begin:end], told[CREATED, begin:end]
                deserted.append(slam._existence.weigh(maps, slam._poses[low], slam._best, found, new_slots))
    journal.steps.append(slam._steps)
    journal.num_measured += used
    return summary, deserted, used


NO_WEIGHTS = np.empty(0)  # nobody asks for them where all particles start at the same place


class FilterKnowledge(FilterState):
    """All that can be asked of a filter; what names a robot raises a ValueError if there is none of that index."""

    @property
    def num_landmarks(self) -> int:
        """Landmarks that at least one particle holds."""
        return int(np.count_nonzero(self._maps.ids >= 0))

    @property
    def map_size(self) -> int:
        """Landmarks that the most probable particle holds: the length of `map()`."""
        slots = np.flatnonzero(self._maps.ids >= 0)
        return int(np.count_nonzero(self._maps.of_particle(self.best_particle, slots)[1]))

    @property
    def map_room(self) -> int:
        """Landmarks for which there is room: no particle holds more."""
        return int(self._maps.table.shape[1])

    @property
    def descriptor_size(self) -> int:
        """Length of the descriptors in the map, 0 before the first one."""
        return int(self._maps.descriptors.shape[1])

    @property
    def consistency(self) -> Consistency:
        """Whether the filter errs as little as it claims, as far as its frames tell, and what to try if not."""
        return self._consistency.report()

    def log(self, robot: int = 0) -> RobotLog:
        """Return what the robot did and measured so far: odometry, points, and the landmarks they were taken for."""
        return self._logs[self._check_robot(robot)].copy()

    @property
    def nbytes(self) -> int:
        """Memory that the particles hold [bytes]: mostly (72 + 4) per particle and landmark."""
        arrays = (self._poses, self._starts, self._means, self._covariances, self._log_weights, self._path_log_weights)
        return self._maps.nbytes + sum(array.nbytes for array in arrays)

    @property
    def weights(self) -> FloatArray:
        """(M,) weights, summing to 1. A copy."""
        return np.asarray(np.exp(self._log_weights))

    def pose(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] over all particles, map frame. Copies.

        They are those of the mixture of N(x^, P^) before sampling, which scatters less than the samples.
        """
        return self._estimates.of(self._check_robot(robot))

    def particles(self, robot: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return a robot's poses (M, 3) [m, m, rad], map frame, and the normalised log-weights (M,). Copies."""
        return self._columns(self._poses[self._check_robot(robot)]), self._log_weights.copy()

    def start_pose(self, robot: int = 0) -> FloatArray:
        """Return (3,) [m, m, rad] where the robot started, map frame, by the most probable particle. A copy."""
        return np.array(self._starts[self._check_robot(robot), :, self.best_particle])

    def pose_from_start(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose [m, m, rad] in its own start frame. Copies.

        Each particle's pose is seen from where the robot started in that particle, so that what the filter does not
        know of the start, after a merge, does not blur it.
        """
        index, every = self._check_robot(robot), tuple(range(self.num_robots))
        points = Standpoints(len(every))
        self._stand(every, every, 1.0, points)
        return PoseEstimate(points.own[index].copy(), points.covariances[index].copy())

    def _stand(self, names: tuple[int, ...], live: tuple[int, ...], ess: float, points: Standpoints) -> None:
        """Write where the robots stand, which the team calls by these names, of those that are live; `ess` as it is."""
        weights = NO_WEIGHTS if self._from_origin else np.exp(self._log_weights)
        _kernels.stand(
            self._of_robots, weights, self._best, self._from_origin, *self._estimates,
            members_of(names, live), ess, points.poses, points.beliefs,
        )  # fmt: skip

    def particles_from_start(self, robot: int = 0) -> FloatArray:
        """Return a robot's poses (M, 3) [m, m, rad], each seen from where it started in that particle."""
        starts = self._columns(self._starts[self._check_robot(robot)])
        return between(starts, self._columns(self._poses[robot]))

    def _columns(self, rows: FloatArray) -> FloatArray:
        """Return (M, c) of padded rows (c, P). A copy."""
        return rows[:, : self.num_particles].T.copy()

    def map(self, estimate: Literal["best", "mixture"] = "best", min_count: int = 1) -> LandmarkMap:
        """Return the map [m, m^2] in the map frame, landmarks by ascending id. A copy.

        Args:
            estimate: "best": means and conditional covariances of the most probable particle (Eq. 12). "mixture":
                mean and covariance over all particles that hold the landmark, path uncertainty included,
                sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T) (Sec. 3.2, see `docs/errata.md`); the landmarks are
                those of the most probable particle.
            min_count: Landmarks that the most probable particle measured fewer times are left out.

        Raises:
            ValueError: If `estimate` is neither.
        """
        check_choice("estimate", estimate, ("best", "mixture"))
        best = self.best_particle
        if estimate == "best":
            return LandmarkMap._trusted(*best_map(self._maps, best, min_count))
        return LandmarkMap._trusted(*map_mixture(self._maps, best, self._log_weights, self._frame, min_count))

    def looks(self) -> NDArray[np.float32]:
        """Return the descriptors (n, d) of the landmarks of `map()`. A copy."""
        return np.asarray(self._maps.descriptors[slots_held(self._maps, self.best_particle, 1)])

    def outline(self, min_count: int = 1) -> MapOutline:
        """Return the outline of `map(min_count=min_count)`, much faster. Fresh arrays."""
        rows = OutlineRows.unwritten(self.map_room)
        return rows.part(0, write_outline(self._maps, self._best, min_count, rows, 0))

    def existence(self) -> tuple[IntArray, FloatArray]:
        """Return the ids (n,) of the landmarks of `map()`, ascending, and the probability (n,) that each exists.

        Raises:
            ValueError: If the filter was built without `existence`.
        """
        if self._existence is None:
            cure = "Build the filter with existence=ExistenceModel()."
            raise bad_argument("existence", "a filter that keeps it", "one that does not", cure)
        slots = self._maps.used_slots()
        slots = slots[self._maps.of_particle(self.best_particle, slots)[1] > 0]
        return self._maps.ids[slots], 1.0 / (1.0 + np.exp(-self._maps.odds_of_particle(self.best_particle, slots)))

    def _dense(self) -> tuple[IntArray, FloatArray, FloatArray, IntArray]:
        """Return ids (n,), means (n, 3, M) [m], covariances (n, 6, M) [m^2] and counts (n, M), 0 where one lacks it."""
        slots = self._maps.used_slots()
        values, counts = self._maps.dense(slots)
        return self._maps.ids[slots], values[:, :3], values[:, 3:], counts.astype(np.int64)

    def _check_robot(self, robot: int) -> int:
        """Return the index of a robot that there is."""
        if isinstance(robot, bool) or not isinstance(robot, (int, np.integer)) or not 0 <= robot < self.num_robots:
            raise bad_argument("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")
        return int(robot)


@known_names
class FastSlam(FilterKnowledge):
    """Visual FastSLAM for one robot, or jointly for several that share a map frame.

    Args:
        num_robots: K. Each particle holds K poses and one map (Eq. 19).
        seed: Of the filter's own random stream: an int, a `numpy.random.SeedSequence` or a Generator.
        initial_poses: (K, 3) [m, m, rad], map frame. None: all at the origin.
        num_particles, camera, motion, proposal, resampling, resample_threshold, position_gate, descriptor_gate,
        dead_zone, dead_radius, recovery_position, recovery_heading, descriptor_sigma, ambiguity,
        new_landmark_density, one_to_one, landmark_noise, existence, rejuvenate_every, smoothing: See
        `FilterOptions`.

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
        dead_zone: float = 25.0,
        dead_radius: float = 1.0,
        recovery_position: float = 0.5,
        recovery_heading: float = 0.1,
        descriptor_sigma: float = 0.1,
        ambiguity: float = 6.0,
        new_landmark_density: float = 0.01,
        one_to_one: bool = True,
        landmark_noise: float | None = None,
        existence: ExistenceModel | None = None,
        rejuvenate_every: int | None = None,
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
            dead_zone=dead_zone,
            dead_radius=dead_radius,
            recovery_position=recovery_position,
            recovery_heading=recovery_heading,
            descriptor_sigma=descriptor_sigma,
            ambiguity=ambiguity,
            new_landmark_density=new_landmark_density,
            one_to_one=one_to_one,
            landmark_noise=landmark_noise,
            existence=existence,
            rejuvenate_every=rejuvenate_every,
            smoothing=SmoothingOptions() if smoothing is None else smoothing,
        )
        self._set_up(num_robots, options, seed)
        if initial_poses is not None:
            cure = "Give one pose (x, y, theta) per robot."
            starts = check_array("initial_poses", initial_poses, (num_robots, 3), cure, within=FARTHEST_POSE)
            self._poses[:] = starts[:, :, None]
            self._poses[:, 2] = wrap_angle(self._poses[:, 2])
            self._starts[:] = self._means[:] = self._poses
            self._look_at_starts()
            self._estimates = self._mixtures()

    @classmethod
    def from_options(
        cls, num_robots: int, options: FilterOptions, seed: int | np.random.SeedSequence | np.random.Generator = 0
    ) -> "FastSlam":
        """Build a filter from ready-made options, all robots at the origin of the map frame.

        Args:
            num_robots: K.
            options: What it assumes and how it decides.
            seed: As of the class.

        Raises:
            ValueError: If `num_robots` or `seed` is out of its range.
        """
        self = cls.__new__(cls)
        self._set_up(num_robots, options, seed)
        return self

    # ------------------------------------------------------------------ one step

    def step(
        self,
        odometry: Sequence[ArrayLike | None],
        measurements: Sequence[Measurements | None],
        identities: Sequence[ArrayLike | None] | None = None,
        poses: Sequence[ArrayLike | None] | None = None,
    ) -> StepReport:
        """Move the robots, match what they see, weigh, update, and resample if needed.

        Args:
            odometry: Per robot (3,) [m, m, rad], motion since its last step in its previous frame; None: it stood.
            measurements: Per robot its frame, or None.
            identities: Per robot (n_i,) int, the caller's own names of the landmarks measured, -1 for a measurement to
                be rejected; association then follows these names. None: association by gates and descriptors.
            poses: Per robot (3,) [m, m, rad], its pose in its own start frame, taken as exact; odometry is ignored.

        Returns:
            What was matched and created.

        Raises:
            ValueError: If an argument is ill-formed; the filter is then as before.
        """
        count, size = self.num_robots, self.descriptor_size
        inputs = check_step(count, size, self.options.camera, odometry, measurements, identities, poses)
        findings = Findings.none_yet(inputs)
        report = self._step_checked(inputs, seats_of(tuple(range(count))), findings)
        findings.close()
        return report

    def _step_checked(self, inputs: StepInput, seats: Seats, findings: Findings) -> StepReport:
        """Do what `step` does with readings that `check_step` returned.

        Args:
            inputs: What these robots, and perhaps others, read; it is not written to.
            seats: Of these robots there.
            findings: Of `inputs`; what becomes of these robots' measurements is written there.
        """
        summary, deserted, used = take_turns(self, inputs, seats, findings.told)
        self._best, long_unseen, created, new, matched, rejected, ess, nis, is_depleted = summary
        report = StepReport(findings, seats.rows, created, new, matched, rejected, ess, nis, is_depleted)
        if used:
            self._consistency.note(self._steps, nis, ess / self.num_particles, used, used - new - matched)
        if rejected and self._rejuvenation is not None:
            tell_refused(self._rejuvenation, self._steps, inputs, seats, findings.told)
        self._steps += 1
        for slots in deserted:
            self._maps.release(slots)
        if is_depleted:
            self._resample()
        if (smoother := self._rejuvenation) is not None:
            smoother.count(new + matched, long_unseen)
            is_busy = self.may_smooth and not smoother.waits(self._steps - 1)
            if is_busy and (news := self._rejuvenate(smoother)) is not None:
                return report._replace(rejuvenation=news)
        return report

    def rejuvenate(self) -> RejuvenationReport:
        """Draw the particles anew from the posterior of whole paths now, whether or not `rejuvenate_every` is set.

        Where it is not, all steps so far are smoothed from the log, and nothing is kept for the next time.

        Returns:
            What came of it; where there is a reason the particles are as before.
        """
        smoother = self._rejuvenation
        if smoother is None:
            smoother = RejuvenationStep(replace(self.options, rejuvenate_every=1), self.num_robots)
        smoother.hasten()
        while (report := self._rejuvenate(smoother)) is None:
            pass
        return report

    @property
    def smooths_in_slices(self) -> bool:
        """Whether the filter keeps a smoother that works in slices, one at a time."""
        return self._rejuvenation is not None and self.options.smoothing.slice_steps is not None

    def hasten(self) -> None:
        """Let the particles be drawn anew as soon as may be, in slices if the smoother works so; see `is_hastened`."""
        if self._rejuvenation is not None:
            self._rejuvenation.hasten()

    @property
    def is_hastened(self) -> bool:
        """Whether `hasten` was called and nothing has come of it yet."""
        return self._rejuvenation is not None and self._rejuvenation.asked

    def _rejuvenate(self, smoother: RejuvenationStep) -> RejuvenationReport | None:
        """Draw the particles anew from the posterior of whole paths, if it is time and that can be found."""
        if smoother.rests(self._logs):
            return None
        starts = self._starts[:, :, : self.num_particles]
        result = smoother.run(
            self._logs, starts, self._maps, self.best_particle, self._camera, self._rng
        )  # fmt: skip
        if result is None:
            return None
        if result.particles is not None:
            self._renew(result.particles)
        return RejuvenationReport(result.reason, result.ess, result.iterations, result.graph.num_keys)

    def _resample(self) -> None:
        """Draw the particles anew in proportion to their weights; all that a particle holds goes with it."""
        ancestors = RESAMPLING[self.options.resampling](self._weights, self._rng, self.num_particles)
        self._best = self._maps.resample(ancestors, self._of_robots, self._of_particles)
