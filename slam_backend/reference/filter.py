"""Reference implementation of the particle filter over the paths of K robots, Algorithm 1 line by line in Python.

Random numbers are drawn in this order: one normal triple per particle for each robot that moved or measured, then the
resampling.
"""

from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import (
    FloatArray,
    IntArray,
    argument_error,
    check_array,
    check_choice,
    check_int,
    check_kind,
    check_seed,
)
from slam_backend.fastslam.options import MAX_ROBOTS, FilterOptions
from slam_backend.fastslam.reports import PoseEstimate, StepReport
from slam_backend.fastslam.step_input import validate_step
from slam_backend.geometry import compose, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.measurements import Measurements
from slam_backend.reference.existence import update_existence
from slam_backend.reference.fastslam1 import update_fastslam1
from slam_backend.reference.fastslam2 import update_fastslam2
from slam_backend.reference.measurement_model import Frame, Landmark
from slam_backend.reference.odometry_bias import OdometryBias
from slam_backend.reference.particles import NEW, Candidates, Particle, RobotStep, RobotUpdate, descendants, report_of
from slam_backend.reference.pose_gaussian import GaussianPose, wrapped
from slam_backend.resampling import RESAMPLING


class ReferenceFastSlam:
    """Slow reference of `FastSlam`: the same decisions, and the same numbers up to rounding, from the same seed.

    Args:
        num_robots: K.
        options: Options of the filter, as for `FastSlam`, without rejuvenation.
        seed: Seed of the random stream.
        initial_poses: (K, 3) [m, m, rad], map frame. None: all at the origin.

    Raises:
        ValueError: If an argument is out of its range; the text names it.

    >>> slam = ReferenceFastSlam(1, FilterOptions(num_particles=7, rejuvenate_every=None))
    >>> slam.step([None], [Measurements([[0.0, 0.0, 2.0]], [[1.0, 0.0]])]).num_new
    1
    >>> slam.map().means.round(3).tolist()
    [[2.0, 0.0, 0.0]]
    """

    def __init__(
        self,
        num_robots: int,
        options: FilterOptions,
        seed: int | np.random.SeedSequence | np.random.Generator = 0,
        initial_poses: ArrayLike | None = None,
    ) -> None:
        k = check_int("num_robots", num_robots, 1, "Use at least one robot.", MAX_ROBOTS)
        check_kind("options", options, FilterOptions)
        if options.rejuvenate_every is not None:
            hint = 'The reference has no smoother; use rejuvenate_every=None, or FastSlam(..., backend="compiled").'
            raise argument_error("options.rejuvenate_every", "None", options.rejuvenate_every, hint)
        given = np.zeros((k, 3)) if initial_poses is None else initial_poses
        starts = check_array("initial_poses", given, (k, 3), "Give one pose (x, y, theta) per robot.")
        poses = [wrapped(start) for start in starts]
        self.options = options
        self.rng = np.random.default_rng(check_seed(seed))
        weight = -np.log(options.num_particles)
        self.particles = [
            Particle(list(poses), [GaussianPose.known(pose) for pose in poses], list(poses), [np.zeros(3)] * k, weight)
            for _ in range(options.num_particles)
        ]
        self.biases = [OdometryBias.prior(options.motion.bias_covariance) for _ in range(k)]
        self.is_blind = [False] * k  # whether each robot moved without measuring since its pose was last sampled
        self.descriptors: dict[int, FloatArray] = {}  # by landmark, from its first measurement
        self.identities: dict[int, int] = {}
        self.next_id = 0
        self._descriptor_size = 0
        self._estimates = [self._mixture(robot) for robot in range(k)]

    # ------------------------------------------------------------------ estimates

    @property
    def weights(self) -> FloatArray:
        """(M,) weights, summing to 1."""
        return np.exp([particle.log_weight for particle in self.particles])

    @property
    def best_particle(self) -> int:
        """Index of the most probable particle, by accumulated log-weight (Eq. 12)."""
        return int(np.argmax([particle.path_log_weight for particle in self.particles]))

    def pose(self, robot: int = 0) -> PoseEstimate:
        """Return mean and covariance of a robot's pose, map frame, over all particles before sampling."""
        return self._estimates[robot]

    def map(self, estimate: Literal["best", "mixture"] = "best") -> LandmarkMap:
        """Return the landmarks of the most probable particle, map frame, by ascending id.

        Args:
            estimate: "best": values of that particle. "mixture": mean and covariance over all particles with them.
        """
        check_choice("estimate", estimate, ("best", "mixture"))
        return self._map_of(self.particles[self.best_particle], estimate)

    def _map_of(self, best: Particle, estimate: str) -> LandmarkMap:
        """Return the landmarks of one particle, with estimates as in `map`."""
        if not best.landmarks:
            return LandmarkMap.empty(self._descriptor_size)
        return landmark_map(best, self.particles if estimate == "mixture" else [best], self.descriptors)

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
            odometry, measurements, identities, poses: Arguments of `FastSlam.step`, one entry per robot.

        Returns:
            Data association and statistics, as from `FastSlam.step`.

        Raises:
            ValueError: If an argument is ill-formed; the filter is then unchanged.
        """
        k = len(self.is_blind)
        validate_step(k, self._descriptor_size, self.options.camera, odometry, measurements, identities, poses)
        moves, names, exact = _arrays(odometry, k), _arrays(identities, k, np.int64), _arrays(poses, k)
        records = []
        for robot, frame in enumerate(measurements):
            records.append(self._step_robot(robot, moves[robot], frame, names[robot], exact[robot]))
            if self.options.existence is not None and frame is not None:
                best = self.particles[self.best_particle]  # weights change after the last robot
                model, camera = self.options.existence, self.options.camera
                update_existence(self.particles, best, robot, records[robot], model, camera)
        for record in records:  # Algorithm 1, l. 9, in logarithms, on top of the previous weights
            for particle, value in zip(self.particles, record.log_likelihoods, strict=True):
                particle.path_log_weight += value  # Eq. 12, along the ancestral line
                particle.log_weight += value  # Eqs. 3, 11
        log_weights = np.array([particle.log_weight for particle in self.particles])
        log_weights -= log_weights.max()  # first, so that rounding is relative to the differences
        log_weights -= np.log(np.sum(np.exp(log_weights)))
        for particle, log_weight in zip(self.particles, log_weights, strict=True):
            particle.log_weight = float(log_weight)
        self._estimates = [self._mixture(robot) for robot in range(k)]
        report = self._report(records, self.best_particle)
        if report.resampled:
            self._resample()
        return report

    def _step_robot(
        self,
        robot: int,
        move: FloatArray | None,
        seen: Measurements | None,
        names: IntArray | None,
        exact: FloatArray | None,
    ) -> RobotStep:
        """Process one robot's step (l. 6-8) in all particles."""
        size = 0 if seen is None else len(seen)
        record = RobotStep(size, len(self.particles))
        kept = [b for b in range(size) if names is None or names[b] >= 0]
        if move is None and exact is None and not kept:
            return record
        frame = Frame(seen, kept, None if names is None else [int(names[b]) for b in kept], self.options.camera)
        possible = self._candidates(frame)
        normals = self.rng.standard_normal((len(self.particles), 3))
        bias = self._move_bias(robot, move, exact)
        turns = [  # l. 13
            self._turn(particle, robot, frame, possible, move, exact, normals[m], bias)
            for m, particle in enumerate(self.particles)
        ]
        lasting = self._name_new(turns, frame)
        for m, turn in enumerate(turns):
            record.associations[kept, m] = [lasting.get(name, name) for name in turn.chosen]
            record.distances[kept, m] = turn.distances
            record.log_likelihoods[m] = turn.log_likelihood
        record.created[kept] = [lasting.get(NEW - b, -1) for b in range(len(kept))]
        self._correct_biases(robot, turns, normals, bias)
        self.is_blind[robot] = self.options.proposal == "fastslam2" and not kept and exact is None
        if kept:
            self._descriptor_size = frame.descriptors.shape[1]
            record.measured = True
        return record

    def _candidates(self, frame: Frame) -> Candidates:
        """Return the candidate landmarks of all particles for each measurement (l. 20)."""
        held = sorted({name for particle in self.particles for name in particle.landmarks})
        if not held:
            return [[] for _ in range(len(frame))]
        descriptors = np.array([self.descriptors[name] for name in held])
        result: Candidates = []
        for b in range(len(frame)):
            squares = np.sum((descriptors - frame.descriptors[b]) ** 2, axis=1)
            if frame.identities is None:
                possible = [e <= self.options.descriptor_gate**2 for e in squares]
            else:
                possible = [self.identities[name] == frame.identities[b] for name in held]
            result.append(sorted((float(e), name) for e, name, ok in zip(squares, held, possible, strict=True) if ok))
        return result

    def _turn(
        self,
        particle: Particle,
        robot: int,
        frame: Frame,
        possible: Candidates,
        move: FloatArray | None,
        exact: FloatArray | None,
        normals: FloatArray,
        bias: OdometryBias | None,
    ) -> RobotUpdate:
        """Process one robot's step in one particle."""
        options = self.options
        sampled = particle.poses[robot]
        prior = particle.posteriors[robot] if self.is_blind[robot] else GaussianPose.known(sampled)
        if exact is not None:
            sampled = compose(particle.starts[robot], exact)
            prior = GaussianPose.known(sampled)
        elif move is not None:
            sigmas = options.motion.sigmas(move)
            if bias is not None:
                move = move - bias.jacobian @ particle.biases[robot]
                sampled = compose(sampled, move + bias.root @ normals)
                prior = prior.moved(move, sigmas, bias.spread)
            else:
                sampled = compose(sampled, move + sigmas * normals)  # l. 14, Eq. 4
                prior = prior.moved(move, sigmas)
        particle.predicted = prior
        candidates = [[one for one in every if one[1] in particle.landmarks] for every in possible]
        if options.proposal == "fastslam1":
            turn = update_fastslam1(particle.landmarks, sampled, frame, candidates, options)
        elif len(frame):
            is_exact = exact is not None
            turn = update_fastslam2(particle.landmarks, prior, frame, candidates, normals, options, is_exact)
        else:
            turn = RobotUpdate(prior, sampled, [], [], 0.0)
        particle.posteriors[robot], particle.poses[robot] = turn.posterior, turn.pose
        return turn

    def _move_bias(self, robot: int, move: FloatArray | None, exact: FloatArray | None) -> OdometryBias | None:
        """Predict a robot's odometry bias over its motion; return None if it has none, or its pose is exact."""
        bias = self.biases[robot]
        if not self.is_blind[robot] or exact is not None:
            bias.cross = np.zeros((3, 3))
        if not self.options.motion.is_biased or exact is not None:
            return None
        moved, sigmas = np.zeros(3) if move is None else move, np.zeros(3)
        if move is not None:
            sigmas = self.options.motion.sigmas(move)
        bias.move(moved, self.options.motion.bias_jacobians(moved[None])[0], sigmas)
        return bias

    def _correct_biases(
        self, robot: int, turns: list[RobotUpdate], normals: FloatArray, bias: OdometryBias | None
    ) -> None:
        """Correct the biases of all particles by the poses or motions that were sampled."""
        if bias is None or (self.options.proposal == "fastslam2" and not turns[0].chosen):
            return
        if self.options.proposal == "fastslam1":
            bias.learn_from_draws()
            for particle, draws in zip(self.particles, normals, strict=True):
                particle.biases[robot] = particle.biases[robot] + bias.gain @ draws
            return
        information = bias.learn_from_pose(self.particles[0].predicted)
        for particle, turn in zip(self.particles, turns, strict=True):
            step = bias.correction(particle.predicted, turn.pose, information)
            particle.biases[robot] = particle.biases[robot] + step

    def _name_new(self, turns: list[RobotUpdate], frame: Frame) -> dict[int, int]:
        """Give permanent names to the landmarks that at least one particle has started, one per measurement."""
        lasting = {}
        for b in range(len(frame)):
            if any(turn.chosen[b] == NEW - b for turn in turns):
                lasting[NEW - b] = self.next_id
                self.descriptors[self.next_id] = frame.descriptors[b]
                self.identities[self.next_id] = -1 if frame.identities is None else frame.identities[b]
                self.next_id += 1
        for particle in self.particles:
            particle.landmarks = {lasting.get(name, name): one for name, one in particle.landmarks.items()}
        return lasting

    # ------------------------------------------------------------------ all particles

    def _mixture(self, robot: int) -> PoseEstimate:
        """Return a robot's pose over all particles, map frame."""
        return pose_mixture([particle.posteriors[robot] for particle in self.particles], self.weights)

    def _report(self, records: list[RobotStep], best: int) -> StepReport:
        """Return the report of this step for particle `best`."""
        return report_of(records, best, self.weights, self.options.resample_threshold)

    def _resample(self) -> None:
        """Resample the particles in proportion to their weights, with their poses and maps."""
        ancestors = RESAMPLING[self.options.resampling](self.weights, self.rng)
        self.particles = descendants(self.particles, ancestors)


def _arrays(values: Sequence[ArrayLike | None] | None, k: int, dtype: Any = np.float64) -> list[NDArray[Any] | None]:
    """Return one kind of input of k robots as arrays, None where missing."""
    given = [None] * k if values is None else values
    return [None if value is None else np.asarray(value, dtype) for value in given]


def pose_mixture(beliefs: Sequence[GaussianPose], weights: FloatArray) -> PoseEstimate:
    """Return mean and covariance of a weighted mixture of Gaussian poses; headings are averaged on the circle.

    Args:
        beliefs: M Gaussians, all in one frame.
        weights: (M,) float64, summing to 1.
    """
    means = np.array([belief.mean for belief in beliefs])
    theta = np.arctan2(weights @ np.sin(means[:, 2]), weights @ np.cos(means[:, 2]))
    mean = np.array([weights @ means[:, 0], weights @ means[:, 1], wrap_angle(theta)])
    covariance = np.zeros((3, 3))
    for belief, weight in zip(beliefs, weights, strict=True):
        offset = belief.mean - mean
        offset[2] = wrap_angle(offset[2])
        covariance += weight * (belief.covariance + np.outer(offset, offset))
    return PoseEstimate(mean, covariance)


def landmark_mixture(landmarks: Sequence[Landmark], weights: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return the mixture of the particles' estimates of one landmark (Sec. 3.2, see `docs/reference/errata.md`).

    Args:
        landmarks: Landmark in each of the n particles that hold it.
        weights: (n,) float64, weights of these particles; they are scaled to sum to 1.

    Returns:
        Mean mu (3,) [m] and covariance (3, 3) [m^2], sum w_m (Sigma_m + (mu_m - mu)(mu_m - mu)^T), map frame.
    """
    shares = weights / weights.sum()
    mean: FloatArray = sum((share * one.mean for share, one in zip(shares, landmarks, strict=True)), np.zeros(3))
    covariance = np.zeros((3, 3))
    for share, one in zip(shares, landmarks, strict=True):
        covariance += share * (one.covariance + np.outer(one.mean - mean, one.mean - mean))
    return mean, covariance


def landmark_map(best: Particle, holders: Sequence[Particle], descriptors: Mapping[int, FloatArray]) -> LandmarkMap:
    """Return the landmarks of one particle, each as the mixture over some particles.

    Args:
        best: Particle with at least one landmark; its landmarks and counts are returned.
        holders: Particles of the mixture, `best` among them.
        descriptors: (d,) by landmark.

    Returns:
        The landmarks by ascending id, map frame.
    """
    names = sorted(best.landmarks)
    found = []
    for name in names:
        sharers = [particle for particle in holders if name in particle.landmarks]
        weights = np.exp([particle.log_weight for particle in sharers])
        found.append(landmark_mixture([particle.landmarks[name] for particle in sharers], weights))
    means, covariances = zip(*found, strict=True)
    rows = np.array([descriptors[name] for name in names], np.float32)
    counts = [best.landmarks[name].count for name in names]
    return LandmarkMap(np.array(means), np.array(covariances), rows, np.array(counts), np.array(names))
