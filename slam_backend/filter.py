"""`FastSlam`: a Rao-Blackwellized particle filter over the paths of K robots, with one EKF per landmark and particle.

Sections 2 and 4 of the paper, with its errata. Robots are taken in turn (Algorithm 1): each moves, matches what it sees
to the map that the robots before it have just updated, weighs the particles and updates the landmarks; then the joint
particles are resampled.
"""

import copy
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend import _kernels
from slam_backend._step_input import check_step
from slam_backend.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.errors import FloatArray, IntArray, bad_argument, check_array, check_choice, check_int, check_seed
from slam_backend.filter_options import FilterOptions
from slam_backend.geometry import between, compose, rotate_covariances, rotation, wrap_angle
from slam_backend.landmark_map import LandmarkMap
from slam_backend.measurements import Measurements
from slam_backend.motion import OdometryModel
from slam_backend.reports import PoseEstimate, StepReport
from slam_backend.resampling import RESAMPLING, effective_sample_size

UPPER = np.triu_indices(3)  # where the six stored elements of a covariance stand in the full matrix
UNPACK = np.array([[0, 1, 2], [1, 3, 4], [2, 4, 5]])


class FastSlam:
    """Visual FastSLAM for one robot, or jointly for several that share a map frame.

    Args:
        num_robots: K. Each particle holds K poses and one map (Eq. 19).
        seed: Of the filter's own random stream: an int, a `numpy.random.SeedSequence` or a Generator.
        initial_poses: (K, 3) [m, m, rad], map frame. None: all at the origin.
        num_particles, camera, motion, proposal, resampling, resample_threshold, position_gate, descriptor_gate,
        dead_zone, dead_radius, recovery_position, recovery_heading, descriptor_sigma, ambiguity,
        new_landmark_density, one_to_one: See `FilterOptions`.

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
        )
        self._set_up(num_robots, options, seed)
        if initial_poses is not None:
            cure = "Give one pose (x, y, theta) per robot."
            self._poses[:] = check_array("initial_poses", initial_poses, (num_robots, 3), cure)[:, None, :]
            self._poses[..., 2] = wrap_angle(self._poses[..., 2])
            self._start_poses[:] = self._poses
            self._pose_means[:] = self._poses

    @classmethod
    def from_options(
        cls, num_robots: int, options: FilterOptions, seed: int | np.random.SeedSequence | np.random.Generator = 0
    ) -> "FastSlam":
        """Build a filter from ready-made options."""
        self = cls.__new__(cls)
        self._set_up(num_robots, options, seed)
        return self

    def _set_up(self, num_robots: int, options: FilterOptions, seed: Any) -> None:
        k = check_int("num_robots", num_robots, 1, "Use at least one robot.")
        m = options.num_particles
        self.options = options
        self._rng = np.random.default_rng(check_seed(seed))
        self._poses = np.zeros((k, m, 3))  # x_t^[m] of each robot, map frame
        self._start_poses = np.zeros((k, m, 3))  # where each robot started, map frame; spreads at a merge
        self._pose_means = np.zeros((k, m, 3))  # N(x^, P^) of each particle before sampling
        self._pose_covariances = np.zeros((k, m, 3, 3))
        self._log_weights = np.full(m, -np.log(m))  # since the last resampling, normalised
        self._path_log_weights = np.zeros(m)  # Eq. 12: accumulated along the ancestral line
        self._landmarks = np.zeros((0, 9, m))  # (x, y, z, Sxx, Sxy, Sxz, Syy, Syz, Szz) of slot and particle, map frame
        self._present = np.zeros((0, m), dtype=np.bool_)
        self._counts = np.zeros((0, m), dtype=np.int64)
        self._descriptors = np.zeros((0, 0), dtype=np.float32)  # of the measurement that created the slot
        self._ids = np.zeros(0, dtype=np.int64)  # stable name of the slot's landmark, -1 = free
        self._identities = np.zeros(0, dtype=np.int64)  # the caller's word for it, -1 = none
        self._next_id = 0
        self._steps = 0
        self._estimates = [self._mixture(robot, np.exp(self._log_weights)) for robot in range(k)]
        camera = options.camera
        self._camera = np.array(
            [camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px, *camera.mount]
        )

    # ------------------------------------------------------------------ what it knows

    @property
    def num_robots(self) -> int:
        """K."""
        return len(self._poses)

    @property
    def num_particles(self) -> int:
        """M."""
        return int(self._poses.shape[1])

    @property
    def num_landmarks(self) -> int:
        """Landmarks that at least one particle holds."""
        return int(np.count_nonzero(self._ids >= 0))

    @property
    def map_size(self) -> int:
        """Landmarks that the most probable particle holds: the length of `map()`."""
        return int(np.count_nonzero(self._present[:, self.best_particle]))

    @property
    def descriptor_size(self) -> int:
        """Length of the descriptors in the map, 0 before the first one."""
        return int(self._descriptors.shape[1])

    @property
    def weights(self) -> FloatArray:
        """(M,) weights, summing to 1. A copy."""
        return np.asarray(np.exp(self._log_weights))

    @property
    def best_particle(self) -> int:
        """Index of the most probable particle, by accumulated log-weight (Eq. 12)."""
        return int(np.argmax(self._path_log_weights))

    def pose(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose over all particles, map frame.

        They are those of the mixture of N(x^, P^) before sampling, which scatters less than the samples.
        """
        return self._estimates[self._check_robot(robot)]

    def particles(self, robot: int = 0) -> tuple[FloatArray, FloatArray]:
        """Return poses (M, 3), map frame, and normalised log-weights (M,) of a robot. Copies."""
        return self._poses[self._check_robot(robot)].copy(), self._log_weights.copy()

    def start_pose(self, robot: int = 0) -> FloatArray:
        """Return (3,) where the robot started, map frame, by the most probable particle. A copy."""
        return np.array(self._start_poses[self._check_robot(robot), self.best_particle])

    def pose_from_start(self, robot: int = 0) -> PoseEstimate:
        """Return the mean and covariance of a robot's pose in its own start frame.

        Each particle's pose is seen from where the robot started in that particle, so that what the filter does not
        know of the start, after a merge, does not blur it.
        """
        starts = self._start_poses[self._check_robot(robot)]
        if (starts == starts[0]).all():
            estimate = self._estimates[robot]
            pose = between(starts[0], estimate.mean)
            return PoseEstimate(pose, rotate_covariances(-starts[0, 2], estimate.covariance))
        turn = np.zeros((len(starts), 3, 3))
        turn[:, :2, :2], turn[:, 2, 2] = rotation(-starts[:, 2]), 1.0
        covariances = turn @ self._pose_covariances[robot] @ turn.transpose(0, 2, 1)
        return _mixture(between(starts, self._pose_means[robot]), covariances, self.weights)

    def particles_from_start(self, robot: int = 0) -> FloatArray:
        """Return a robot's poses (M, 3), each seen from where it started in that particle."""
        return between(self._start_poses[self._check_robot(robot)], self._poses[robot])

    def map(self, estimate: Literal["best", "mixture"] = "best") -> LandmarkMap:
        """Return the map in the map frame, landmarks by ascending id.

        Args:
            estimate: "best": means and conditional covariances of the most probable particle (Eq. 12). "mixture":
                mean and covariance over all particles that hold the landmark, path uncertainty included,
                sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T) (Sec. 3.2, see ERRATA); the landmarks are those of the most
                probable particle.
        """
        check_choice("estimate", estimate, ("best", "mixture"))
        best = self.best_particle
        slots = np.flatnonzero(self._present[:, best])
        slots = slots[np.argsort(self._ids[slots])]
        if estimate == "best":
            values = self._landmarks[slots, :, best]
            means, covariances = values[:, :3], values[:, 3:][:, UNPACK]
        else:
            values = self._landmarks[slots]
            weights = np.exp(self._log_weights) * self._present[slots]
            weights /= np.maximum(weights.sum(axis=1, keepdims=True), 1e-300)
            mixed = np.einsum("ncm,nm->nc", values, weights)
            means = mixed[:, :3]
            offsets = values[:, :3] - means[:, :, None]
            covariances = mixed[:, 3:][:, UNPACK] + np.einsum("nim,njm,nm->nij", offsets, offsets, weights)
        return LandmarkMap._trusted(
            means, covariances, self._descriptors[slots], self._counts[slots, best], self._ids[slots]
        )

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
        size = self._descriptors.shape[1]
        moves, frames, names, exact = check_step(self.num_robots, size, odometry, measurements, identities, poses)
        log_likelihood = np.zeros(self.num_particles)
        slots: list[IntArray] = []
        distances: list[FloatArray] = []
        measured = False
        for robot in range(self.num_robots):
            frame, name = frames[robot], names[robot]
            if frame is not None and name is not None and (name < 0).any():
                keep = np.flatnonzero(name >= 0)
            else:
                keep = np.arange(0 if frame is None else len(frame))
            found, distance = self._step_robot(robot, moves[robot], frame, name, exact[robot], keep, log_likelihood)
            slots.append(found)
            distances.append(distance)
            measured |= len(keep) > 0
        self._steps += 1
        # Eqs. 3, 11, 12 and Algorithm 1, l. 9, in logarithms; the weights of before are kept unless resampled.
        self._path_log_weights += log_likelihood
        self._log_weights += log_likelihood
        self._log_weights -= self._log_weights.max()
        self._log_weights -= np.log(np.exp(self._log_weights).sum())
        weights = np.exp(self._log_weights)
        ess = effective_sample_size(weights)
        self._estimates = [self._mixture(robot, weights) for robot in range(self.num_robots)]
        report = self._report(slots, distances, ess, measured)
        if report.resampled:
            self._resample(weights)
        return report

    def _step_robot(
        self,
        robot: int,
        move: FloatArray | None,
        frame: Measurements | None,
        names: IntArray | None,
        exact: FloatArray | None,
        keep: IntArray,
        log_likelihood: FloatArray,
    ) -> tuple[IntArray, FloatArray]:
        """Take one robot's turn; return slots (n, M) and squared distances (n, M) of all its measurements."""
        m = self.num_particles
        size = 0 if frame is None else len(frame)
        associations = np.full((size, m), _kernels.REJECTED, dtype=np.int64)
        distances = np.full((size, m), np.nan)
        if move is None and not len(keep) and exact is None:
            return associations, distances
        options = self.options
        if frame is None or not len(keep):
            points, noises, descriptors = np.empty((0, 3)), np.empty((0, 6)), np.empty((0, 0), dtype=np.float32)
            given = True
        else:
            points = frame.points[keep] @ ROBOT_FROM_CAMERA.T
            given = frame.covariances is not None
            noises = np.zeros((len(keep), 6))
            if frame.covariances is not None:
                noises[:] = (ROBOT_FROM_CAMERA @ frame.covariances[keep] @ ROBOT_FROM_CAMERA.T)[:, *UPPER]
            descriptors = frame.descriptors[keep]
        kept_names = None if names is None else names[keep]
        starts, slots, squares = self._candidates(descriptors, kept_names, len(keep))
        new_slots = self._reserve(len(keep), descriptors, kept_names)
        known = np.full(len(keep), names is not None)
        log_p0 = float(np.log(options.new_landmark_density))
        found = np.full((len(keep), m), _kernels.REJECTED, dtype=np.int64)
        at = np.full((len(keep), m), np.nan)
        poses = self._poses[robot]
        sigmas = np.zeros(3) if move is None else options.motion.sigmas(move)
        if exact is not None:
            poses[:] = compose(self._start_poses[robot], exact)
            move, sigmas = None, np.zeros(3)
        normals = self._rng.standard_normal((m, 3))
        recovery = np.zeros(3)
        if exact is None:
            recovery[:2], recovery[2] = options.recovery_position, options.recovery_heading
        if options.proposal == "fastslam1":
            if move is not None:
                poses[:] = compose(poses, move + normals * sigmas)  # Eq. 4
            _kernels.update_fastslam1(
                poses, self._landmarks, self._present, self._counts, points, noises, given, self._camera,
                starts, slots, known, new_slots, options.position_gate, log_p0, options.one_to_one,
                found, at, log_likelihood,
            )
            self._pose_means[robot] = poses
            self._pose_covariances[robot] = 0.0
        else:
            _kernels.update_fastslam2(
                poses, np.zeros(3) if move is None else move, sigmas, normals,
                self._landmarks, self._present, self._counts, points, noises, given, self._camera,
                starts, slots, squares / options.descriptor_sigma**2, known, new_slots,
                options.position_gate, options.dead_zone, options.dead_radius, options.ambiguity, recovery, log_p0,
                found, at, log_likelihood, self._pose_means[robot], self._pose_covariances[robot],
            )
        self._release(new_slots)
        associations[keep] = found
        distances[keep] = at
        return associations, distances

    def _candidates(
        self, descriptors: NDArray[np.float32], names: IntArray | None, num: int
    ) -> tuple[IntArray, IntArray, FloatArray]:
        """Return per measurement the slots that may have caused it: by the caller's names, else within E0."""
        if num == 0 or not len(self._ids):
            return np.zeros(num + 1, dtype=np.int64), np.empty(0, dtype=np.int64), np.empty(0)
        if names is not None:
            rows, slots = np.nonzero((names[:, None] == self._identities[None, :]) & (self._ids >= 0)[None, :])
            gate = np.inf
        else:
            gate = self.options.descriptor_gate**2
            # |a - b|^2 = |a|^2 + |b|^2 - 2 a.b: one product for all particles; the kernel settles the last digits
            squares = (
                np.einsum("bd,bd->b", descriptors, descriptors)[:, None]
                + np.einsum("nd,nd->n", self._descriptors, self._descriptors)[None, :]
                - 2.0 * descriptors @ self._descriptors.T
            )
            rows, slots = np.nonzero((squares <= gate * 1.001 + 1e-3) & (self._ids >= 0)[None, :])
        return _kernels.sort_candidates(rows, slots, descriptors, self._descriptors, gate, num)

    def _reserve(self, num: int, descriptors: NDArray[np.float32], names: IntArray | None) -> IntArray:
        """Name `num` free slots after the measurements that may start landmarks in them."""
        free = np.flatnonzero(self._ids < 0)
        if len(free) < num:
            self._grow(max(64, len(self._ids), num), descriptors.shape[1])
            free = np.flatnonzero(self._ids < 0)
        slots = free[:num]
        if num:
            self._descriptors[slots] = descriptors
            self._identities[slots] = -1 if names is None else names
            self._ids[slots] = self._next_id + np.arange(num)
        return slots

    def _grow(self, extra: int, size: int) -> None:
        m = self.num_particles
        self._landmarks = np.concatenate([self._landmarks, np.zeros((extra, 9, m))])
        self._present = np.concatenate([self._present, np.zeros((extra, m), dtype=np.bool_)])
        self._counts = np.concatenate([self._counts, np.zeros((extra, m), dtype=np.int64)])
        old = self._descriptors if len(self._ids) else np.zeros((0, size), dtype=np.float32)
        self._descriptors = np.concatenate([old, np.zeros((extra, size), dtype=np.float32)])
        self._ids = np.concatenate([self._ids, np.full(extra, -1, dtype=np.int64)])
        self._identities = np.concatenate([self._identities, np.full(extra, -1, dtype=np.int64)])

    def _release(self, slots: IntArray) -> None:
        """Give back the slots that no particle uses; the others keep their new ids."""
        used = self._present[slots].any(axis=1)
        self._ids[slots[~used]] = -1
        kept = slots[used]
        self._ids[kept] = self._next_id + np.arange(len(kept))
        self._next_id += len(kept)

    def _report(self, slots: list[IntArray], distances: list[FloatArray], ess: float, measured: bool) -> StepReport:
        best = self.best_particle
        associations, created, matched = [], [], []
        ids = np.append(self._ids, -1)  # the last one is for REJECTED
        num_new = 0
        for found, distance in zip(slots, distances, strict=True):
            chosen = found[:, best]
            associations.append(ids[chosen])
            is_new = (found >= 0) & np.isnan(distance)
            made = np.full(len(found), -1, dtype=np.int64)
            for b in np.flatnonzero(is_new.any(axis=1)):
                made[b] = self._ids[found[b, int(np.argmax(is_new[b]))]]
            created.append(made)
            num_new += int(np.count_nonzero(is_new[:, best]))
            matched.append(distance[:, best])
        nis = np.concatenate(matched)
        nis = nis[~np.isnan(nis)]
        return StepReport(
            associations=tuple(associations),
            created=tuple(created),
            num_new=num_new,
            ess=ess,
            nis=float(nis.mean()) if len(nis) else float("nan"),
            resampled=measured and ess <= self.options.resample_threshold * self.num_particles * (1.0 + 1e-12),
        )

    def _resample(self, weights: FloatArray) -> None:
        """Draw the particles anew in proportion to their weights; all that a particle holds is copied with it."""
        ancestors = RESAMPLING[self.options.resampling](weights, self._rng)
        # `take` keeps arrays contiguous, where a slice with indices would not: kernels are compiled once.
        self._poses = np.take(self._poses, ancestors, axis=1)
        self._start_poses = np.take(self._start_poses, ancestors, axis=1)
        self._pose_means = np.take(self._pose_means, ancestors, axis=1)
        self._pose_covariances = np.take(self._pose_covariances, ancestors, axis=1)
        self._path_log_weights = self._path_log_weights[ancestors]
        self._log_weights = np.full(len(ancestors), -np.log(len(ancestors)))
        self._landmarks = np.take(self._landmarks, ancestors, axis=2)
        self._present = np.take(self._present, ancestors, axis=1)
        self._counts = np.take(self._counts, ancestors, axis=1)
        self._ids[~self._present.any(axis=1)] = -1  # held by no survivor

    def _mixture(self, robot: int, weights: FloatArray) -> PoseEstimate:
        return _mixture(self._pose_means[robot], self._pose_covariances[robot], weights)

    def _check_robot(self, robot: int) -> int:
        if isinstance(robot, bool) or not isinstance(robot, (int, np.integer)) or not 0 <= robot < self.num_robots:
            raise bad_argument("robot", f"an index from 0 to {self.num_robots - 1}", robot, "Count robots from 0.")
        return int(robot)

    def reorder(self, order: IntArray) -> None:
        """Renumber the robots: robot i becomes the one that was `order[i]`; (K,) a permutation."""
        for name in ("_poses", "_start_poses", "_pose_means", "_pose_covariances"):
            setattr(self, name, getattr(self, name)[order])
        self._estimates = [self._estimates[robot] for robot in order]

    # ------------------------------------------------------------------ snapshots

    _STATE = (
        "_poses", "_start_poses", "_pose_means", "_pose_covariances", "_log_weights", "_path_log_weights", "_landmarks",
        "_present", "_counts", "_descriptors", "_ids", "_identities", "_next_id", "_steps", "_estimates",
    )  # fmt: skip

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the filter goes on, its random stream included. Shares nothing with it."""
        state = {name: copy.deepcopy(getattr(self, name)) for name in self._STATE}
        return state | {"options": self.options, "rng": copy.deepcopy(self._rng.bit_generator.state)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on exactly as the filter that gave `state`.

        Raises:
            ValueError: If `state` is not one of `get_state`.
        """
        missing = [name for name in (*self._STATE, "options", "rng") if name not in state]
        if missing:
            raise bad_argument("state", "a dict from FastSlam.get_state", f"no {missing[0]!r}", "Pass it unchanged.")
        self._set_up(len(state["_poses"]), state["options"], 0)
        for name in self._STATE:
            setattr(self, name, copy.deepcopy(state[name]))
        self._rng.bit_generator.state = copy.deepcopy(state["rng"])


def _mixture(means: FloatArray, covariances: FloatArray, weights: FloatArray) -> PoseEstimate:
    """Return mean and covariance of a weighted mixture of Gaussian poses: means (M, 3), covariances (M, 3, 3)."""
    theta = float(np.arctan2(weights @ np.sin(means[:, 2]), weights @ np.cos(means[:, 2])))
    mean = np.array([weights @ means[:, 0], weights @ means[:, 1], wrap_angle(theta)])
    offsets = means - mean
    offsets[:, 2] = wrap_angle(offsets[:, 2])
    covariance = (offsets * weights[:, None]).T @ offsets
    covariance += np.tensordot(weights, covariances, axes=1)
    return PoseEstimate(mean, 0.5 * (covariance + covariance.T))
