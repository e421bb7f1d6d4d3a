"""The filter beside GTSAM: iSAM2 online and a batch optimiser on the same measurements, matches and noise.

python -m studies.filters.beside_gtsam --quick
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.geometry import compose, inverse, wrap_angle
from slam_backend.metrics import align_se2, nees
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.trajectory import Trajectory
from studies.bounds.episodes import RecordedEpisode, record_episode, replay
from studies.filters.losses import LEAST_SIGMA, errors_of, median_nees
from training.bench.exploration.players import parted
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, RobotCount, first_seed, option
from training.experiments.study import Column, ResultTable, Study
from training.experiments.trial_store import FAILED
from training.replay.config import KITTI, MRCLAM, VICTORIA, MrclamConfig, find_log
from training.replay.core import SingleFilter, make_filters
from training.replay.log import Log
from training.replay.metrics import score_positions, true_poses
from training.replay.readers import read_kitti, read_mrclam, read_victoria
from vslam_env import preset_config, vslam_v1

Method = Literal["filter", "isam2", "batch"]
METHODS: tuple[Method, ...] = ("filter", "isam2", "batch")
LEAST_BIAS = 1e-3  # of biases that are not modelled: smaller ones make the equations ill-conditioned

# ---------------------------------------------------------------------- trials


class Config(ExperimentConfig):
    """Real logs below the folder VSLAM_DATA, which are of one robot, and episodes."""

    logs: tuple[str, ...] = option(
        ("victoria", "mrclam:1", "mrclam:2", "mrclam:3", "mrclam:4", "mrclam:5", "mrclam4:3", "kitti"),
        "Real logs; mrclam:ROBOT is of data set 7, mrclam4:3 of data set 4.",
        shown="all",
    )  # fmt: skip
    duration: float | None = option(None, "Duration of each real log [s].", shown="all", gt=0.0, hint="Give seconds.")
    presets: tuple[Literal["standard", "hard"], ...] = option(("standard", "hard"), "Presets of episodes.")
    worlds: tuple[str, ...] = option(("office", "maze", "loops", "hall"), "World families of episodes.")
    robots: tuple[RobotCount, ...] = option(
        (1,), "Numbers of robots; real logs are left out without 1.", hint="Use 1 to 8 robots."
    )
    seeds: int = option(4, "Number of episodes of each combination.", ge=0, hint="Use 0 for real logs alone.")
    seed: int = first_seed()
    seconds: float = option(120.0, "Simulated time of an episode [s].", gt=0.0, hint="Give seconds.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One method on one log or episode."""

    log: str  # Name of a real log; the preset of an episode
    world: str  # World family of an episode; empty for a real log
    robots: int  # K
    seed: int  # Seed of filter and episode
    method: Method


def trials(config: Config) -> list[Trial]:
    """Return all trials, with those on the same readings in succession."""
    logs = config.logs if 1 in config.robots else ()
    real = [
        Trial(log=log, world="", robots=1, seed=config.seed, method=method) for log, method in product(logs, METHODS)
    ]
    seeds = range(config.seed, config.seed + config.seeds)
    combined = product(config.presets, config.worlds, config.robots, seeds, METHODS)
    return real + [
        Trial(log=preset, world=world, robots=robots, seed=seed, method=method)
        for preset, world, robots, seed, method in combined
    ]


def log_of(config: Config, trial: Trial) -> Log:
    """Return the readings of a trial on a real log."""
    name, _, number = trial.log.partition(":")
    if name == "mrclam" and number.isdecimal():
        place = find_log(None, MRCLAM, "the folder of MR.CLAM data set 7")
        return read_mrclam(place, robots=(int(number),), duration=config.duration, alone=True)
    if trial.log == "mrclam4:3":
        place = find_log(None, MRCLAM.with_name("MRCLAM_Dataset4"), "the folder of MR.CLAM data set 4")
        truth = find_log(None, Path("mrclam_extra_gt", "D4_robot3", "Groundtruth.csv"), "the true poses of its robot 3")
        return read_mrclam(place, robots=(3,), duration=config.duration, truth=truth)
    if trial.log == "victoria":
        return read_victoria(find_log(None, VICTORIA, "the folder of Victoria Park"), duration=config.duration)
    if trial.log == "kitti":
        return read_kitti(find_log(None, KITTI, "the folder of tracked features"), duration=config.duration)
    raise argument_error("logs", "victoria, kitti, mrclam:ROBOT or mrclam4:3", trial.log, "Name one of them.")


def episode_of(config: Config, trial: Trial) -> RecordedEpisode:
    """Return the readings of robots that explore a world."""
    player = parted("frontier@continuous")
    chosen = preset_config(trial.log).replace(
        world=trial.world, num_robots=trial.robots, max_seconds=config.seconds, action_type=player.action_type
    )
    with closing(vslam_v1.parallel_env(config=chosen, observation_keys=player.observation_keys)) as env:
        return record_episode(env, player.make(env, 600.0), trial.seed)


# ---------------------------------------------------------------------- filter


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Estimate of K robots' paths: poses at their own time, or of all readings."""

    paths: FloatArray  # (K, T, 3) float64 [m, m, rad], own start frames
    covariances: FloatArray  # (K, T, 3, 3) float64
    step_ms: float  # Mean processor time of a step of all robots [ms]


@dataclass(frozen=True, slots=True, eq=False)
class Used:
    """Readings of K robots as their filters used them."""

    odometry: FloatArray  # (K, T, 3) float64 [m, m, rad]; the first is not used
    frames: Sequence[Sequence[Measurements | None]]  # Measurements by step and robot
    labels: Sequence[Sequence[IntArray]]  # Landmarks (n,) of the measurements by step and robot; negative: not used
    motion: OdometryModel  # Assumed noise of the odometry
    camera: StereoCamera  # Camera, and its assumed noise where measurements have no covariances
    # Step and groups of merges, in order, after which a label is one landmark for both groups
    merges: Sequence[tuple[int, Sequence[int], Sequence[int]]] = ()


@lru_cache(maxsize=1)
def filtered(config: Config, trial: Trial) -> tuple[Log | RecordedEpisode, Used, Estimate]:
    """Run the filters of a trial; return its source, the readings with the filters' associations, and the estimate."""
    if trial.world:
        episode = episode_of(config, trial)
        return episode, *filtered_episode(episode)
    log = log_of(config, trial)
    return log, *filtered_log(log, trial.seed)


def filtered_episode(episode: RecordedEpisode) -> tuple[Used, Estimate]:
    """Run new filters on the readings of an episode."""
    options = episode.config.belief.filter
    track = replay(episode, options)
    odometry = np.pad(episode.odometry, ((0, 0), (1, 0), (0, 0)))
    frames = [[own.measurements for own in tick] for tick in episode.readings]
    readings = Used(odometry, frames, track.labels, options.motion, options.camera, track.merges)
    return readings, Estimate(track.paths, track.covariances, track.step_ms)


def filtered_log(log: Log, seed: int) -> tuple[Used, Estimate]:
    """Run a filter on a real log."""
    robot, steps = log.robots[0], len(log.times)
    single = Log(times=log.times, robots=log.robots[:1], options=log.options) if log.team is not None else log
    slam: Any = make_filters(single, MrclamConfig(path="", seed=seed))
    assert isinstance(slam, SingleFilter)
    path, covariances = np.zeros((1, steps, 3)), np.zeros((1, steps, 3, 3))
    moves, frames, labels, seconds = np.zeros((1, steps, 3)), [], [], 0.0
    for step, (move, frame) in enumerate(robot.steps()):
        names = None if robot.identities is None or not log.identified else robot.identities[step]
        begin = time.process_time()
        pose = slam.filter.pose().mean
        described = frame and log.source.describe(frame, partial(compose, pose, move if step else np.zeros(3)))
        report = slam.filter.step([move if step else None], [described], None if names is None else [names])
        estimate = slam.filter.pose()
        seconds += time.process_time() - begin
        path[0, step], covariances[0, step], moves[0, step] = estimate.mean, estimate.covariance, move
        frames.append([frame])
        labels.append([np.asarray(np.maximum(report.associations[0], report.created[0]))])
    options = slam.filter.options
    readings = Used(moves, frames, labels, options.motion, options.camera)
    return readings, Estimate(path, covariances, 1e3 * seconds / steps)


# ---------------------------------------------------------------------- GTSAM


@contextmanager
def one_thread() -> Iterator[None]:
    """Let GTSAM begin with one thread: it would wait for Python's lock, which factors in Python need in its threads."""
    processors = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(processors)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, processors)


class Graph:
    """Factors of GTSAM: `Pose2` keys for the steps, landmarks, and odometry biases if the model has them.

    Each robot has poses and copies of landmarks in its own start frame, so that its path and covariances need no other
    frame. From a merge on the copies of a landmark are one place: the start of the first robot of one group becomes a
    pose in the start frame of the other's. Landmarks are `Point2` where measurements have covariances, which are those
    of planar logs of one robot, and else `Point3`.
    """

    def __init__(self, readings: Used) -> None:
        import gtsam

        self.gtsam, self.readings = gtsam, readings
        camera = readings.camera
        self.pixels = gtsam.noiseModel.Diagonal.Sigmas(
            np.array([camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px])
        )
        self.exact = gtsam.noiseModel.Isotropic.Sigma(3, LEAST_SIGMA)
        self.known: list[set[int]] = [set() for _ in readings.odometry]  # labels with copies, by robot
        self.above: dict[int, int] = {}  # robot in whose start frame the start of a robot is a pose

    def pose(self, robot: int, step: int) -> int:
        """Return the key of a pose."""
        return int(self.gtsam.symbol("abcdefgh"[robot], step))

    def landmark(self, robot: int, label: int) -> int:
        """Return the key of a robot's copy of a landmark."""
        return int(self.gtsam.symbol("ABCDEFGH"[robot], label))

    def start(self, robot: int) -> int:
        """Return the key of a start in the start frame of the robot above."""
        return int(self.gtsam.symbol("s", robot))

    def bias(self, robot: int) -> int:
        """Return the key of an odometry bias."""
        return int(self.gtsam.symbol("x", robot))

    def step(self, step: int, before: FloatArray, estimate: Callable[[], Any]) -> tuple[Any, Any]:
        """Return the factors of a step and the initial values of its new variables.

        Args:
            before: (K, 3) float64 [m, m, rad]. The poses before, own start frames.
            estimate: Returns the values of all variables before, for merges.
        """
        factors, values = self.gtsam.NonlinearFactorGraph(), self.gtsam.Values()
        for robot, pose in enumerate(before):
            self._step_of(robot, step, pose, factors, values)
        for _, one, other in [merge for merge in self.readings.merges if merge[0] == step]:
            every = estimate()
            every.insert(values)
            self._merge(self._frames(one[0])[-1], self._frames(other[0])[-1], every, factors, values)
        return factors, values

    def _step_of(self, robot: int, step: int, pose: FloatArray, factors: Any, values: Any) -> None:
        """Add the factors of a robot's step and the initial values, given its pose before (3,)."""
        gtsam, readings = self.gtsam, self.readings
        if step:
            pose = compose(pose, readings.odometry[robot, step])
            factors.add(self._motion(robot, step))
        else:
            factors.add(gtsam.PriorFactorPose2(self.pose(robot, 0), gtsam.Pose2(), self.exact))
            if readings.motion.is_biased:
                sigmas = np.maximum(np.sqrt(np.diag(readings.motion.bias_covariance)), LEAST_BIAS)
                noise = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
                factors.add(gtsam.PriorFactorVector(self.bias(robot), np.zeros(3), noise))
                values.insert(self.bias(robot), np.zeros(3))
        values.insert(self.pose(robot, step), gtsam.Pose2(*pose))
        frame, labels = readings.frames[step][robot], readings.labels[step][robot]
        if frame is None:
            return
        for n in np.flatnonzero(labels >= 0):
            label = int(labels[n])
            covariance = None if frame.covariances is None else frame.covariances[n]
            ahead = readings.camera.robot_from_camera(frame.points[n])
            if covariance is None:
                factors.add(self._sight(robot, step, label, frame.points[n]))
            else:
                factors.add(self._planar_sight(robot, step, label, ahead[:2], covariance))
            if label not in self.known[robot]:
                place = compose(pose, np.array([ahead[0], ahead[1], 0.0]))
                place[2] = ahead[2]
                values.insert(self.landmark(robot, label), place if covariance is None else place[:2])
                holder = self._holders(self._frames(robot)[-1]).get(label)
                if holder is not None:
                    factors.add(self._same(label, holder, robot))
                self.known[robot].add(label)

    def _frames(self, robot: int) -> list[int]:
        """Return a robot and those above it; the last is the first robot of its group."""
        found = [robot]
        while found[-1] in self.above:
            found.append(self.above[found[-1]])
        return found

    def _holders(self, first: int) -> dict[int, int]:
        """Return a robot with a copy of each landmark of the group of a first robot."""
        group = [robot for robot in range(len(self.known)) if self._frames(robot)[-1] == first]
        return {label: robot for robot in reversed(group) for label in self.known[robot]}

    def _merge(self, one: int, other: int, every: Any, factors: Any, values: Any) -> None:
        """Add what merges the group of a first robot with that of another, given the values of all variables."""
        holders, others = self._holders(one), self._holders(other)
        common = sorted(holders.keys() & others.keys())
        places, copies = (
            np.array([self._place(every, label, held[label], self._frames(held[label]))[0][:2] for label in common])
            for held in (holders, others)
        )
        values.insert(self.start(other), self.gtsam.Pose2(*align_se2(places, copies)))
        self.above[other] = one
        for label in common:
            factors.add(self._same(label, holders[label], others[label]))

    def _place(self, values: Any, label: int, robot: int, frames: Sequence[int]) -> tuple[FloatArray, dict[int, Any]]:
        """Return a robot's copy (3,) of a landmark in the last of some start frames, and derivatives by their keys."""
        key = self.landmark(robot, label)
        place, slopes = values.atPoint3(key), {key: np.eye(3)}
        for start in map(self.start, frames[:-1]):
            pose = values.atPose2(start)
            turn = _turn(pose.theta())
            slopes = {each: turn @ slope for each, slope in slopes.items()}
            slopes[start] = turn @ np.array([[1.0, 0.0, -place[1]], [0.0, 1.0, place[0]], [0.0, 0.0, 0.0]])
            place = turn @ place + [pose.x(), pose.y(), 0.0]
        return place, slopes

    def _same(self, label: int, one: int, other: int) -> Any:
        """Return the factor that two robots' copies of a landmark are one place."""
        ones, others = self._frames(one), self._frames(other)
        while ones[-2:] == others[-2:]:
            ones, others = ones[:-1], others[:-1]
        keys = [
            key for robot, frames in ((one, ones), (other, others))
            for key in (self.landmark(robot, label), *map(self.start, frames[:-1]))
        ]  # fmt: skip

        def error(this: Any, values: Any, jacobians: Any) -> FloatArray:
            place, slopes = self._place(values, label, one, ones)
            copy, of_copy = self._place(values, label, other, others)
            if jacobians is not None:
                slopes |= {key: -slope for key, slope in of_copy.items()}
                for column, key in enumerate(keys):
                    jacobians[column] = slopes[key]
            return place - copy

        return self.gtsam.CustomFactor(self.exact, keys, error)

    def _motion(self, robot: int, step: int) -> Any:
        """Return the factor of an odometry reading u: the motion is u - J b, see `OdometryModel`."""
        gtsam, motion = self.gtsam, self.readings.motion
        reading = self.readings.odometry[robot, step]
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(motion.variances(reading[None])[0]))
        keys = [self.pose(robot, step - 1), self.pose(robot, step)]
        if not motion.is_biased:
            return gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*reading), noise)
        by_bias = motion.bias_jacobians(reading[None])[0]
        keys.append(self.bias(robot))

        def error(this: Any, values: Any, jacobians: Any) -> FloatArray:
            first, second, bias = values.atPose2(keys[0]), values.atPose2(keys[1]), values.atVector(keys[2])
            by_first, by_second = np.zeros((3, 3), order="F"), np.zeros((3, 3), order="F")
            moved = first.between(second, by_first, by_second)
            if jacobians is not None:
                turn = _turn(moved.theta())  # tangents are in the axes of the later pose
                jacobians[0], jacobians[1], jacobians[2] = turn @ by_first, turn @ by_second, by_bias
            found = _as_pose(moved) - reading + by_bias @ bias
            found[2] = wrap_angle(found[2])
            return np.asarray(found)

        return gtsam.CustomFactor(noise, keys, error)

    def _planar_sight(self, robot: int, step: int, label: int, ahead: FloatArray, covariance: FloatArray) -> Any:
        """Return the factor of a point (2,), robot frame, with its covariance (3, 3) in the camera frame."""
        gtsam, distance = self.gtsam, float(np.hypot(*ahead))
        x, y = ahead / distance
        polar = np.array([[-y / distance, x / distance], [x, y]]) @ ROBOT_FROM_CAMERA[:2]  # of bearing and range
        return gtsam.BearingRangeFactor2D(
            self.pose(robot, step), self.landmark(robot, label), gtsam.Rot2(np.arctan2(y, x)), distance,
            gtsam.noiseModel.Gaussian.Covariance(polar @ covariance @ polar.T),
        )  # fmt: skip

    def _sight(self, robot: int, step: int, label: int, point: FloatArray) -> Any:
        """Return the factor of a measured point (3,), camera frame, with the noise of its pixels."""
        camera = self.readings.camera
        keys = [self.pose(robot, step), self.landmark(robot, label)]
        measured = camera.project(point)

        def error(this: Any, values: Any, jacobians: Any) -> FloatArray:
            pose, landmark = values.atPose2(keys[0]), values.atPoint3(keys[1])
            turn = _turn(pose.theta()).T
            local = turn @ (landmark - [pose.x(), pose.y(), 0.0])
            seen = camera.camera_from_robot(local)
            seen[2] = max(seen[2], 0.5 * point[2])  # nearer, and behind the camera, pixels say nothing
            if jacobians is not None:
                scale = camera.focal_px / seen[2]
                by_seen = scale * np.array([
                    [1.0, 0.0, -seen[0] / seen[2]], [0.0, 1.0, -seen[1] / seen[2]],
                    [0.0, 0.0, -camera.baseline / seen[2]],
                ])  # fmt: skip
                by_local = by_seen @ ROBOT_FROM_CAMERA.T
                by_pose = np.array([[-1.0, 0.0, local[1]], [0.0, -1.0, -local[0]], [0.0, 0.0, 0.0]])
                jacobians[0] = by_local @ by_pose
                jacobians[1] = by_local @ turn
            return np.asarray(camera.project(seen) - measured)

        return self.gtsam.CustomFactor(self.pixels, keys, error)


def _as_pose(pose: Any) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])


def _turn(angle: float) -> FloatArray:
    """Return the rotation (3, 3) of points about the vertical axis, and of the positions of poses."""
    cos, sin = np.cos(angle), np.sin(angle)
    return np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])


def _in_frame(pose: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return a covariance of GTSAM, which is in the axes of the pose (3,), in those of the frame."""
    turn = _turn(pose[2])
    return np.asarray(turn @ covariance @ turn.T)


@one_thread()
def isam2(readings: Used) -> tuple[Estimate, Any, Any]:
    """Return the online estimate of iSAM2, all factors, and the last values."""
    graph = Graph(readings)
    gtsam = graph.gtsam
    every = gtsam.NonlinearFactorGraph()
    parameters = gtsam.ISAM2Params()
    parameters.setRelinearizeThreshold(0.01)
    parameters.relinearizeSkip = 1
    solver = gtsam.ISAM2(parameters)
    paths, seconds = np.zeros_like(readings.odometry), 0.0
    covariances = np.zeros((*paths.shape, 3))
    for step in range(paths.shape[1]):
        begin = time.process_time()
        factors, values = graph.step(step, paths[:, max(step - 1, 0)], solver.calculateEstimate)
        solver.update(factors, values)
        for robot, path in enumerate(paths):
            key = graph.pose(robot, step)
            path[step] = _as_pose(solver.calculateEstimatePose2(key))
            covariances[robot, step] = _in_frame(path[step], solver.marginalCovariance(key))
        seconds += time.process_time() - begin
        every.push_back(factors)
    return Estimate(paths, covariances, 1e3 * seconds / paths.shape[1]), every, solver.calculateEstimate()


@one_thread()
def batch(readings: Used, every: Any, values: Any) -> Estimate:
    """Return the estimate of GTSAM's Levenberg-Marquardt optimiser from all readings, started at those of iSAM2."""
    graph, (robots, steps, _) = Graph(readings), readings.odometry.shape
    gtsam, begin = graph.gtsam, time.process_time()
    found = gtsam.LevenbergMarquardtOptimizer(every, values).optimize()
    marginals = gtsam.Marginals(every, found)
    keys = [[graph.pose(robot, step) for step in range(steps)] for robot in range(robots)]
    paths = np.array([[_as_pose(found.atPose2(key)) for key in own] for own in keys])
    covariances = [
        [_in_frame(pose, marginals.marginalCovariance(key)) for key, pose in zip(own, path, strict=True)]
        for own, path in zip(keys, paths, strict=True)
    ]
    return Estimate(paths, np.array(covariances), 1e3 * (time.process_time() - begin) / steps)


@lru_cache(maxsize=1)
def optimised(config: Config, trial: Trial) -> tuple[Estimate, Any, Any]:
    """Return what `isam2` returns for the readings of a trial."""
    return isam2(filtered(config, trial)[1])


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Estimate the paths of a trial by a method.

    Returns:
        `position_rms_m` over the robots and the steps with known truth, in own start frames, or after an SE(2) fit for
        real logs; `nees_median` (ideal 2.4) of the poses, if true headings are known; processor time `step_ms`;
        `measurements` used. If GTSAM gives up, its words as `failed` alone.
    """
    source = replace(trial, method="filter")
    truth, readings, estimate = filtered(config, source)
    if trial.method != "filter":
        try:
            estimate, every, values = optimised(config, source)
            if trial.method == "batch":
                estimate = batch(readings, every, values)
        except RuntimeError as error:
            return {FAILED: str(error).strip().splitlines()[0]}
    rms, median = scores(truth, estimate)
    return {
        "position_rms_m": rms, "nees_median": median, "step_ms": estimate.step_ms,
        "measurements": int(sum((labels >= 0).sum() for tick in readings.labels for labels in tick)),
    }  # fmt: skip


def scores(source: Log | RecordedEpisode, estimate: Estimate) -> tuple[float, float | None]:
    """Return the position RMS [m], and the median NEES of the poses if true headings are known."""
    if isinstance(source, RecordedEpisode):
        squares = (errors_of(estimate.paths, source)[..., :2] ** 2).sum(axis=-1)
        return float(np.sqrt(squares.mean())), median_nees(source, estimate.paths, estimate.covariances)
    (path,), (covariances,), truth = estimate.paths, estimate.covariances, source.robots[0].truth
    path = compose(path, np.array(source.mount))
    if isinstance(truth, np.ndarray):
        known = truth[(truth[:, 0] >= source.times[0]) & (truth[:, 0] <= source.times[-1])]
        return score_positions(Trajectory(source.times, path).at(known[:, 0])[:, :2], known[:, 1:]).aligned, None
    true = true_poses(truth, source.times)
    steps = np.flatnonzero(~np.isnan(true[:, 0]))
    true, path = true[steps], path[steps]
    score = score_positions(path, true)
    errors = path - compose(inverse(score.world_from_path), true)
    errors[:, 2] = wrap_angle(errors[:, 2])
    values = nees(errors[1:], covariances[steps[1:]] + LEAST_SIGMA**2 * np.eye(3))
    return score.aligned, float(np.median(values))


def checks(config: Config) -> Iterator[Callable[[], object]]:
    """Yield the steps that detect what cannot be played."""
    yield require_gtsam


def require_gtsam() -> None:
    """Raise unless GTSAM is installed."""
    from importlib.util import find_spec

    if find_spec("gtsam") is None:
        raise argument_error("gtsam", "the package gtsam", "no such package", "Install it: pip install gtsam.")


# ---------------------------------------------------------------------- results

STUDY = Study(
    name="beside_gtsam",
    about="""Compare the filter with GTSAM's iSAM2 and batch optimiser on the same measurements, matches and noise.

    Real logs of one robot, and episodes of one or more. All methods get the measurements that the filter used, with the
    landmarks that it associated them with, and assume the same noise; GTSAM shares landmarks among robots from the
    filters' merges on, and gets the readings of robots out of contact, too. Stereo measurements, biases of odometry and
    shared landmarks are factors written in Python, so that GTSAM's times in episodes and on KITTI are upper limits.
    """,
    config=Config,
    trial=Trial,
    trials=trials,
    play=play,
    checks=checks,
    quick={"logs": ("mrclam:1",), "duration": 60.0, "worlds": ("office",), "seeds": 1, "seconds": 30.0},
    timed=True,
    tables=(
        ResultTable(
            name="beside_gtsam", title="The filter beside GTSAM", by=("log", "world", "robots", "method"), pooled=(),
            columns=(
                Column("position_rms_m", digits=3, interval=True), Column("nees_median", "median NEES", digits=1),
                Column("step_ms", "step [ms]", digits=2), Column("measurements", digits=0),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
