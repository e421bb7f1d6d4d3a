"""`FastSlam`: a Rao-Blackwellized particle filter over the paths of K robots, with one EKF per landmark and particle.

Sections 2 and 4 of the paper, with its errata. Robots are taken in turn (Algorithm 1): each moves, matches what it sees
to the map that the robots before it have just updated, weighs the particles and updates the landmarks; then the joint
particles are resampled.
"""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from slam_backend import _kernels
from slam_backend._best_map import best_map, best_outline
from slam_backend._existence_step import ExistenceStep
from slam_backend._frame_buffers import FrameBuffers, Turn
from slam_backend._particle_maps import ParticleMaps, aligned
from slam_backend._rejuvenated_maps import write_maps
from slam_backend._rejuvenation_step import RejuvenationStep
from slam_backend._start_frames import AT_ORIGIN, KNOWN, seen_from_starts, start_kind
from slam_backend._step_input import check_step
from slam_backend.adaptation import AdaptiveParticles, next_num_particles
from slam_backend.camera import StereoCamera
from slam_backend.errors import FloatArray, IntArray, bad_argument, check_array, check_choice, check_int, check_seed
from slam_backend.existence import ExistenceModel
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import between, compose, rotate_covariances, wrap_angle
from slam_backend.landmark_map import LandmarkMap, MapOutline
from slam_backend.measurements import Measurements
from slam_backend.motion import OdometryModel
from slam_backend.reports import PoseEstimate, RejuvenationReport, StepReport
from slam_backend.resampling import RESAMPLING
from slam_backend.run_log import RobotLog
from slam_backend.smoothing.options import SmoothingOptions

UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])
NOTHING = np.zeros(3)
NO_NAMES = np.zeros(0, dtype=np.int64)


class FastSlam:
    """Visual FastSLAM for one robot, or jointly for several that share a map frame.

    Args:
        num_robots: K. Each particle holds K poses and one map (Eq. 19).
        seed: Of the filter's own random stream: an int, a `numpy.random.SeedSequence` or a Generator.
        initial_poses: (K, 3) [m, m, rad], map frame. None: all at the origin.
        num_particles, camera, motion, proposal, resampling, resample_threshold, position_gate, descriptor_gate,
        dead_zone, dead_radius, recovery_position, recovery_heading, descriptor_sigma, ambiguity,
        new_landmark_density, one_to_one, landmark_noise, adaptive, existence, rejuvenate_every, smoothing: See
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
        adaptive: AdaptiveParticles | None = None,
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
            adaptive=adaptive,
            existence=existence,
            rejuvenate_every=rejuvenate_every,
            smoothing=SmoothingOptions() if smoothing is None else smoothing,
        )
        self._set_up(num_robots, options, seed)
        if initial_poses is not None:
            cure = "Give one pose (x, y, theta) per robot."
            self._poses[:] = check_array("initial_poses", initial_poses, (num_robots, 3), cure)[:, :, None]
            self._poses[:, 2] = wrap_angle(self._poses[:, 2])
            self._starts[:] = self._means[:] = self._poses
            self._estimates = [self._mixture(robot) for robot in range(num_robots)]

    @classmethod
    def from_options(
        cls, num_robots: int, options: FilterOptions, seed: int | np.random.SeedSequence | np.random.Generator = 0
    ) -> "FastSlam":
        """Build a filter from ready-made options."""
        self = cls.__new__(cls)
        self._set_up(num_robots, options, seed)
        return self

    def _set_up(self, num_robots: int, options: FilterOptions, seed: Any, num_particles: int | None = None) -> None:
        k = check_int("num_robots", num_robots, 1, "Use at least one robot.")
        m = options.num_particles if num_particles is None else num_particles
        self.options = options
        self.may_smooth = True  # in the next step; filters of a team take turns
        self._rng = np.random.default_rng(check_seed(seed))
        existence = options.existence
        self._existence = None if existence is None else ExistenceStep(existence, options.camera)
        self._maps = ParticleMaps(m, None if existence is None else existence.log_odds_prior)
        self._rejuvenation = None if options.rejuvenate_every is None else RejuvenationStep(options, k)
        padded = self._maps.padded  # particles come in blocks of lanes; the last block's surplus lanes mean nothing
        self._poses = aligned((k, 3, padded), np.float64)  # x_t^[m] of each robot, map frame
        self._starts = aligned((k, 3, padded), np.float64)  # where each robot started, map frame; spreads at a merge
        self._means = aligned((k, 3, padded), np.float64)  # N(x^, P^) of each particle before sampling
        self._covariances = aligned((k, 6, padded), np.float64)
        self._blind = np.zeros(k, dtype=np.bool_)  # whether N(x^, P^) was propagated since the last sighting
        self._log_weights = np.full(m, -np.log(m))  # since the last resampling, normalised
        self._path_log_weights = np.zeros(m)  # Eq. 12: accumulated along the ancestral line
        self._weights = np.full(m, 1.0 / m)
        self._steps = 0
        self._logs = [RobotLog() for _ in range(k)]
        self._buffers = FrameBuffers(padded)
        self._estimates = [self._mixture(robot) for robot in range(k)]
        camera = options.camera
        self._camera = np.array(
            [camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px, *camera.mount]
        )
        self._recovery = np.array([options.recovery_position, options.recovery_position, options.recovery_heading])
        self._log_p0 = float(np.log(options.new_landmark_density))

    # ------------------------------------------------------------------ what it knows

    @property
    def num_robots(self) -> int:
        """K."""
        return len(self._poses)

    @property
    def num_particles(self) -> int:
        """M."""
        return self._maps.num_particles

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
    def descriptor_size(self) -> int:
        """Length of the descriptors in the map, 0 before the first one."""
        return int(self._maps.descriptors.shape[1])

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

    @property
    def best_particle(self) -> int:
        """Index of the most probable particle, by accumulated log-weight (Eq. 12)."""
        return int(self._path_log_weights.argmax())

    def pose(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose over all particles, map frame.

        They are those of the mixture of N(x^, P^) before sampling, which scatters less than the samples.
        """
        return self._estimates[self._check_robot(robot)]

    def particles(self, robot: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return poses (M, 3), map frame, and normalised log-weights (M,) of a robot. Copies."""
        return self._columns(self._poses[self._check_robot(robot)]), self._log_weights.copy()

    def start_pose(self, robot: int = 0) -> FloatArray:
        """Return (3,) where the robot started, map frame, by the most probable particle. A copy."""
        return np.array(self._starts[self._check_robot(robot), :, self.best_particle])

    def pose_from_start(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose in its own start frame.

        Each particle's pose is seen from where the robot started in that particle, so that what the filter does not
        know of the start, after a merge, does not blur it.
        """
        return self._seen_from_start(self._check_robot(robot))[0]

    def _seen_from_start(self, robot: int) -> tuple[PoseEstimate, FloatArray]:
        """Return what `pose_from_start` and `start_pose` return."""
        start, estimate = np.empty(3), self._estimates[robot]
        kind = start_kind(self._starts[robot], self.num_particles, self.best_particle, start)
        if kind == AT_ORIGIN:  # the map frame is its own start frame
            return estimate, start
        if kind == KNOWN:
            turned = rotate_covariances(-start[2], estimate.covariance)
            return PoseEstimate(between(start, estimate.mean), turned), start
        seen = seen_from_starts(self._starts[robot], self._means[robot], self._covariances[robot], self.num_particles)
        return _mixture(*seen, self.weights), start

    def particles_from_start(self, robot: int = 0) -> FloatArray:
        """Return a robot's poses (M, 3), each seen from where it started in that particle."""
        starts = self._columns(self._starts[self._check_robot(robot)])
        return between(starts, self._columns(self._poses[robot]))

    def _columns(self, rows: FloatArray) -> FloatArray:
        """Return (M, c) of padded rows (c, P). A copy."""
        return rows[:, : self.num_particles].T.copy()

    def map(self, estimate: Literal["best", "mixture"] = "best", min_count: int = 1) -> LandmarkMap:
        """Return the map in the map frame, landmarks by ascending id.

        Args:
            estimate: "best": means and conditional covariances of the most probable particle (Eq. 12). "mixture":
                mean and covariance over all particles that hold the landmark, path uncertainty included,
                sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T) (Sec. 3.2, see `docs/errata.md`); the landmarks are
                those of the most probable particle.
            min_count: Landmarks measured fewer times are left out.
        """
        check_choice("estimate", estimate, ("best", "mixture"))
        if estimate == "best":
            return LandmarkMap._trusted(*best_map(self._maps, self.best_particle, max(min_count, 1)))
        slots = self._maps.used_slots()
        counts = self._maps.of_particle(self.best_particle, slots)[1]
        slots, counts = slots[counts >= max(min_count, 1)], counts[counts >= max(min_count, 1)]
        dense, times = self._maps.dense(slots)
        weights = np.exp(self._log_weights) * (times > 0)
        weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
        mixed = np.einsum("ncm,nm->nc", dense, weights)
        means = mixed[:, :3]
        offsets = dense[:, :3] - means[:, :, None]
        covariances = mixed[:, 3:][:, UNPACK] + np.einsum("nim,njm,nm->nij", offsets, offsets, weights)
        return LandmarkMap._trusted(
            means, covariances, self._maps.descriptors[slots], counts.astype(np.int64), self._maps.ids[slots]
        )

    def outline(self, min_count: int = 1) -> MapOutline:
        """Return the outline of `map(min_count=min_count)`, much faster."""
        return best_outline(self._maps, self.best_particle, max(min_count, 1))

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
        """Return ids (n,), means (n, 3, M), covariances (n, 6, M) and counts (n, M), 0 where a particle lacks it."""
        slots = self._maps.used_slots()
        values, counts = self._maps.dense(slots)
        return self._maps.ids[slots], values[:, :3], values[:, 3:], counts.astype(np.int64)

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
        return self._step_checked(
            *check_step(
                self.num_robots, self.descriptor_size, self.options.camera, odometry, measurements, identities, poses
            )
        )

    def _step_checked(
        self,
        moves: Sequence[FloatArray | None],
        frames: Sequence[Measurements | None],
        names: Sequence[IntArray | None],
        exact: Sequence[FloatArray | None],
    ) -> StepReport:
        """Do what `step` does with readings that `check_step` returned; none of them is written to."""
        buffers = self._buffers
        buffers.start(sum(0 if frame is None else len(frame) for frame in frames))
        turns, deserted = [], []
        for robot in range(len(frames)):
            turns.append(self._take_turn(robot, moves[robot], frames[robot], names[robot], exact[robot]))
            if self._existence is not None and frames[robot] is not None:
                where, best = self._poses[robot], self.best_particle
                deserted.append(self._existence.weigh(self._maps, where, best, turns[robot]))
        self._steps += 1
        ess = _kernels.weigh(buffers.log_likelihood, self._log_weights, self._path_log_weights, self._weights)
        self._estimates = [self._mixture(robot) for robot in range(len(frames))]
        threshold = self.options.resample_threshold * self.num_particles * (1.0 + 1e-9)
        report = self._report(turns, ess, resampled=buffers.used > 0 and ess <= threshold)
        for robot, turn in enumerate(turns):
            if turn.size or moves[robot] is not None or exact[robot] is not None:
                ids = report.associations[robot]
                self._logs[robot].append(
                    self._steps - 1, moves[robot], exact[robot], turn.points,
                    ids if len(turn.keep) == turn.size else ids[turn.keep], turn.noises if turn.given else None,
                )  # fmt: skip
                if self._rejuvenation is not None:
                    self._rejuvenation.note(robot, self._steps - 1, self._estimates[robot], exact[robot] is not None)
        for slots in deserted:
            self._maps.release(slots)
        if report.resampled:
            self._resample()
        if self._rejuvenation is not None:
            self._rejuvenation.count(report.associations)
            if self.may_smooth:
                return replace(report, rejuvenation=self._rejuvenate(self._rejuvenation))
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

    def _rejuvenate(self, smoother: RejuvenationStep) -> RejuvenationReport | None:
        """Draw the particles anew from the posterior of whole paths, if it is time and that can be found."""
        m = self.num_particles
        result = smoother.run(self._logs, self._starts[:, :, :m], self._maps, self._camera, self._rng)
        if result is None:
            return None
        if (new := result.particles) is not None:
            write_maps(self._maps, self.best_particle, new, self.options.landmark_walk)
            self._poses[:, :, :m], self._starts[:, :, :m] = new.poses, new.starts
            self._means[:] = self._poses
            self._covariances.fill(0.0)
            self._blind.fill(False)
            self._log_weights[:], self._path_log_weights[:] = new.log_weights, new.log_densities
            self._weights[:] = np.exp(new.log_weights)
            self._estimates = [PoseEstimate(*of_robot) for of_robot in zip(new.means, new.covariances, strict=True)]
        return RejuvenationReport(result.reason, result.ess, result.iterations, result.graph.num_keys)

    def _take_turn(
        self,
        robot: int,
        move: FloatArray | None,
        frame: Measurements | None,
        names: IntArray | None,
        exact: FloatArray | None,
    ) -> Turn:
        """Take one robot's turn in the step: motion, association, weights, landmarks (Algorithm 1, l. 6-8)."""
        options, maps, buffers = self.options, self._maps, self._buffers
        used = buffers.take(robot, frame, names)
        num = len(used.points)
        if num == 0 and move is None and exact is None:
            return used
        poses, means, covariances = self._poses[robot], self._means[robot], self._covariances[robot]
        sigmas = NOTHING if move is None else options.motion.sigmas(move)
        move = NOTHING if move is None else move
        if exact is not None:
            poses[:, : self.num_particles] = compose(self._columns(self._starts[robot]), exact).T
            move, sigmas, self._blind[robot] = NOTHING, NOTHING, False
        normals = self._rng.standard_normal((self.num_particles, 3))
        blind = bool(self._blind[robot])
        if num == 0 and options.proposal == "fastslam2":
            if exact is None:
                _kernels.move_blind(poses, means, covariances, blind, move, sigmas, normals, buffers.work)
                self._blind[robot] = True
            else:
                means[:], covariances[:] = poses, 0.0
            return used
        if num:
            maps.make_room(num, used.descriptors.shape[1])
        named = used.names is not None
        store = (
            maps.values, maps.counts, maps.odds, maps.row_of, maps.map_of, maps.maps, maps.users,
            maps.free_rows, maps.free_slots, maps.tops, maps.ids, maps.identities, maps.descriptors, maps.heads,
        )  # fmt: skip
        names = NO_NAMES if used.names is None else used.names
        readings = (used.points, used.noises, used.given, self._camera, used.descriptors, names, named)
        results = (buffers.work, buffers.records, used.found, used.distances, used.new_slots, buffers.log_likelihood)
        if options.proposal == "fastslam1":
            _kernels.update_fastslam1(
                poses, means, covariances, exact is None, move, sigmas, normals, *store, *readings,
                options.descriptor_gate**2, options.position_gate, self._log_p0, options.landmark_walk,
                options.one_to_one, *results,
            )  # fmt: skip
        else:
            _kernels.update_fastslam2(
                poses, means, covariances, blind, move, sigmas, normals, *store, *readings,
                options.descriptor_gate**2, options.descriptor_sigma**2, options.position_gate, options.dead_zone,
                options.dead_radius, options.ambiguity, NOTHING if exact is not None else self._recovery,
                self._log_p0, options.landmark_walk, options.one_to_one, *results,
            )  # fmt: skip
            self._blind[robot] = False
        return used

    def _report(self, turns: list[Turn], ess: float, resampled: bool) -> StepReport:
        best, ids = self.best_particle, self._maps.ids
        associations, created = [], []
        num_new, num_matched, num_rejected, total, num_judged = 0, 0, 0, 0.0, 0
        for turn in turns:
            associations.append(np.empty(turn.size, dtype=np.int64))
            created.append(np.empty(turn.size, dtype=np.int64))
            new, matched, squares, judged = _kernels.summarise(
                turn.found, turn.distances, turn.new_slots, turn.keep, best, ids, associations[-1], created[-1]
            )
            num_new += new
            num_matched += matched
            num_rejected += turn.size - new - matched
            total += squares
            num_judged += judged
        return StepReport(
            associations=tuple(associations),
            created=tuple(created),
            num_new=num_new,
            num_matched=num_matched,
            num_rejected=num_rejected,
            ess=ess,
            nis=total / num_judged if num_judged else float("nan"),
            resampled=resampled,
        )

    def _resample(self) -> None:
        """Draw the particles anew in proportion to their weights; all that a particle holds goes with it."""
        count = self.num_particles
        if self.options.adaptive is not None:
            poses = np.ascontiguousarray(self._poses[:, :, :count].transpose(0, 2, 1))
            count = next_num_particles(self.options.adaptive, poses, self._weights)
        ancestors = RESAMPLING[self.options.resampling](self._weights, self._rng, count)
        if count == self.num_particles:
            held = (self._poses, self._starts, self._means, self._covariances, self._path_log_weights)
            self._maps.resample(ancestors, held)
            self._log_weights.fill(-np.log(count))
        else:
            self._become(ancestors)

    def _become(self, ancestors: IntArray) -> None:
        """Go on with as many particles as there are ancestors (M',), equally weighted."""
        self._maps = self._maps.taken(ancestors)
        for name in ("_poses", "_starts", "_means", "_covariances"):
            old = getattr(self, name)
            array = aligned((*old.shape[:2], self._maps.padded), np.float64)
            array[:, :, : len(ancestors)] = old[:, :, ancestors]
            setattr(self, name, array)
        self._path_log_weights = self._path_log_weights[ancestors]
        self._weights = np.full(len(ancestors), 1.0 / len(ancestors))
        self._log_weights = np.full(len(ancestors), -np.log(len(ancestors)))
        self._buffers = FrameBuffers(self._maps.padded)

    def _mixture(self, robot: int) -> PoseEstimate:
        return _mixture(self._means[robot], self._covariances[robot], self._weights)

    def _check_robot(self, robot: int) -> int:
        if isinstance(robot, bool) or not isinstance(robot, (int, np.integer)) or not 0 <= robot < self.num_robots:
            raise bad_argument("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")
        return int(robot)

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i becomes the one that was `order[i]`; (K,) a permutation."""
        for name in ("_poses", "_starts", "_means", "_covariances"):
            array = getattr(self, name)
            array[:] = array[order]
        self._blind = self._blind[order]
        self._logs = [self._logs[robot] for robot in order]
        self._estimates = [self._estimates[robot] for robot in order]
        if self._rejuvenation is not None:
            self._rejuvenation.reorder(order)

    # ------------------------------------------------------------------ snapshots

    _STATE = ("_poses", "_starts", "_means", "_covariances", "_blind", "_log_weights", "_path_log_weights", "_weights")

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the filter goes on, its random stream included. Shares nothing with it."""
        state: dict[str, Any] = {name: getattr(self, name).copy() for name in self._STATE}
        state |= {"steps": self._steps, "estimates": _copies(self._estimates), "maps": self._maps.get_state()}
        state["logs"] = tuple(log.get_state() for log in self._logs)
        if self._rejuvenation is not None:
            state["rejuvenation"] = self._rejuvenation.get_state()
        return state | {"options": self.options, "rng": copy.deepcopy(self._rng.bit_generator.state)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the filter that gave `state`.

        Raises:
            ValueError: If `state` is not one of `get_state`.
        """
        names = (*self._STATE, "steps", "estimates", "maps", "logs", "options", "rng")
        missing = [name for name in names if name not in state]
        if missing:
            raise bad_argument("state", "a dict from FastSlam.get_state", f"no {missing[0]!r}", "Pass it unchanged.")
        shapes = [state[name].shape == getattr(self, name).shape for name in ("_poses", "_weights")]
        same = state["options"] == self.options and all(shapes)
        if not same:
            self._set_up(len(state["_poses"]), state["options"], 0, len(state["_weights"]))
        for name in self._STATE:
            getattr(self, name)[:] = state[name]
        self._maps.set_state(state["maps"])
        for log, logged in zip(self._logs, state["logs"], strict=True):
            log.set_state(logged)
        if self._rejuvenation is not None:
            self._rejuvenation.set_state(state["rejuvenation"])
        self._steps, self._estimates = state["steps"], list(_copies(state["estimates"]))
        # A stream of its own: the old one may be the caller's, or of another kind.
        self._rng = np.random.Generator(getattr(np.random, state["rng"]["bit_generator"])(0))
        self._rng.bit_generator.state = state["rng"]


def _copies(estimates: Sequence[PoseEstimate]) -> tuple[PoseEstimate, ...]:
    return tuple(PoseEstimate(estimate.mean.copy(), estimate.covariance.copy()) for estimate in estimates)


def _mixture(means: FloatArray, covariances: FloatArray, weights: FloatArray) -> PoseEstimate:
    """Return mean and covariance of a weighted mixture of Gaussian poses: means (3, P), covariances (6, P)."""
    mean, covariance = np.empty(3), np.empty((3, 3))
    _kernels.mixture(means, covariances, weights, mean, covariance)
    return PoseEstimate(mean, covariance)
