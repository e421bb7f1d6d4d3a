"""The filter beside GTSAM: iSAM2 online and a batch optimiser on the same measurements, matches and noise.

python -m studies.beside_gtsam --quick
"""

import os
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields
from functools import lru_cache, partial
from itertools import product
from pathlib import Path
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray, argument_error
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import compose, inverse, wrap_angle
from slam_backend.metrics import nees
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.models.odometry import OdometryModel
from slam_backend.trajectory import Trajectory
from training.commands.study import run_program
from training.experiments.config import ExperimentConfig, first_seed, option
from training.experiments.study import Column, ResultTable, Study
from training.experiments.trial_store import FAILED
from training.replay.config import KITTI, MRCLAM, VICTORIA, MrclamConfig, find_log
from training.replay.core import SingleFilter, make_filters
from training.replay.log import Log, RobotLog
from training.replay.metrics import score_positions, true_poses
from training.replay.readers import read_kitti, read_mrclam, read_victoria
from vslam_env.belief.readings import Readings

Method = Literal["filter", "isam2", "batch"]
METHODS: tuple[Method, ...] = ("filter", "isam2", "batch")
LEAST_SIGMA = 1e-4  # [m, rad]; lower limit of claimed standard deviations: robots at their start know their pose
LEAST_BIAS = 1e-3  # of biases that are not modelled: smaller ones make the equations ill-conditioned

# ---------------------------------------------------------------------- trials


class Config(ExperimentConfig):
    """Real logs below the folder VSLAM_DATA, and episodes of one robot."""

    logs: tuple[str, ...] = option(
        ("victoria", "mrclam:1", "mrclam:2", "mrclam:3", "mrclam:4", "mrclam:5", "mrclam4:3", "kitti"),
        "Real logs; mrclam:ROBOT: data set 7, mrclam4:3: robot 3 of data set 4.",
        shown="all",
    )  # fmt: skip
    duration: float | None = option(None, "Duration of each real log [s].", shown="all", gt=0.0, hint="Give seconds.")
    presets: tuple[Literal["standard", "hard"], ...] = option(("standard", "hard"), "Presets of episodes.")
    worlds: tuple[str, ...] = option(("office", "maze", "loops", "hall"), "World families of episodes.")
    seeds: int = option(4, "Number of episodes of each preset and world.", ge=0, hint="Use 0 for real logs alone.")
    seed: int = first_seed()
    seconds: float = option(120.0, "Simulated time of an episode [s].", gt=0.0, hint="Give seconds.")


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """One method on one log or episode."""

    log: str  # Name of a real log; the preset of an episode
    world: str  # World family of an episode; empty for a real log
    seed: int  # Seed of filter and episode
    method: Method


def trials(config: Config) -> list[Trial]:
    """Return all trials, with those on the same readings in succession."""
    real = [Trial(log=log, world="", seed=config.seed, method=method) for log, method in product(config.logs, METHODS)]
    seeds = range(config.seed, config.seed + config.seeds)
    return real + [
        Trial(log=preset, world=world, seed=seed, method=method)
        for preset, world, seed, method in product(config.presets, config.worlds, seeds, METHODS)
    ]


def log_of(config: Config, trial: Trial) -> Log:
    """Return the readings of a trial."""
    name, _, number = trial.log.partition(":")
    if trial.world:
        return episode_log(config, trial)
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


def episode_log(config: Config, trial: Trial) -> Log:
    """Return the readings of one robot that explores a world, with true identities."""
    from studies.bounds.episodes import record_episode
    from training.bench.exploration.players import parted
    from vslam_env import preset_config, vslam_v1

    player = parted("frontier@continuous")
    chosen = preset_config(trial.log).replace(
        world=trial.world, num_robots=1, max_seconds=config.seconds, action_type=player.action_type
    )
    env = vslam_v1.parallel_env(config=chosen, observation_keys=player.observation_keys)
    episode = record_episode(env, player.make(env, 600.0), trial.seed)
    env.close()
    times = np.array(episode.record.times)
    filter_options = chosen.belief.filter
    robot = RobotLog(
        odometry=np.vstack([np.zeros(3), episode.odometry[0]]),
        measurements=list(map(_real, episode.readings, episode.true_ids)),
        identities=[ids[0][ids[0] >= 0] for ids in episode.true_ids],
        truth=Trajectory(times, episode.true_paths[0]),
    )  # fmt: skip
    options = {field.name: getattr(filter_options, field.name) for field in fields(FilterOptions)}
    return Log(times=times, robots=[robot], options=options, title=trial.world)


def _real(readings: Sequence[Readings], true_ids: Sequence[IntArray]) -> Measurements:
    """Return the first robot's measurements of landmarks, without false points."""
    frame, real = readings[0].measurements, true_ids[0] >= 0
    covariances = None if frame.covariances is None else frame.covariances[real]
    return Measurements(frame.points[real], frame.descriptors[real], covariances)


# ---------------------------------------------------------------------- filter


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """Estimate of a robot's path: poses at their own time, or of all readings."""

    path: FloatArray  # (T, 3) float64 [m, m, rad], start frame
    covariances: FloatArray  # (T, 3, 3) float64; NaN where they were not computed
    step_ms: float  # Mean processor time of a step [ms]


@dataclass(frozen=True, slots=True, eq=False)
class Used:
    """Readings of a robot as the filter used them."""

    odometry: FloatArray  # (T, 3) float64 [m, m, rad]; the first is not used
    frames: list[Measurements | None]  # Measurements of each step
    labels: list[IntArray]  # Landmark (n,) of each measurement; negative: not used
    motion: OdometryModel  # Assumed noise of the odometry
    camera: StereoCamera  # Camera, and its assumed noise where measurements have no covariances


@lru_cache(maxsize=1)
def filtered(config: Config, trial_log: str, world: str, seed: int) -> tuple[Log, Used, Estimate]:
    """Run the filter on a log; return the log, its readings with the filter's associations, and the estimate."""
    log = log_of(config, Trial(log=trial_log, world=world, seed=seed, method="filter"))
    robot, steps = log.robots[0], len(log.times)
    single = Log(times=log.times, robots=log.robots[:1], options=log.options) if log.team is not None else log
    slam: Any = make_filters(single, MrclamConfig(path="", seed=seed))
    assert isinstance(slam, SingleFilter)
    path, covariances = np.zeros((steps, 3)), np.zeros((steps, 3, 3))
    moves, frames, labels, seconds = np.zeros((steps, 3)), [], [], 0.0
    for step, (move, frame) in enumerate(robot.steps()):
        names = None if robot.identities is None or not log.identified else robot.identities[step]
        begin = time.process_time()
        pose = slam.filter.pose().mean
        described = frame and log.source.describe(frame, partial(compose, pose, move if step else np.zeros(3)))
        report = slam.filter.step([move if step else None], [described], None if names is None else [names])
        estimate = slam.filter.pose()
        seconds += time.process_time() - begin
        path[step], covariances[step], moves[step] = estimate.mean, estimate.covariance, move
        frames.append(frame)
        labels.append(np.asarray(np.maximum(report.associations[0], report.created[0])))
    options = slam.filter.options
    return (
        log,
        Used(moves, frames, labels, options.motion, options.camera),
        Estimate(path, covariances, 1e3 * seconds / steps),
    )


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
    """Factors of GTSAM: `Pose2` keys for the steps, landmarks, and an odometry bias if the model has one.

    Landmarks are `Point2` where measurements have covariances, which are those of planar logs, and else `Point3`.
    """

    def __init__(self, readings: Used) -> None:
        import gtsam

        self.gtsam, self.readings = gtsam, readings
        self.bias = gtsam.symbol("b", 0)
        camera = readings.camera
        self.pixels = gtsam.noiseModel.Diagonal.Sigmas(
            np.array([camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px])
        )
        self.known: set[int] = set()

    def pose(self, step: int) -> int:
        """Return the key of a pose."""
        return int(self.gtsam.symbol("x", step))

    def step(self, step: int, before: FloatArray) -> tuple[Any, Any]:
        """Return the factors of a step and the initial values of its new variables, given the pose before (3,)."""
        gtsam, readings = self.gtsam, self.readings
        factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        pose = before
        if step:
            pose = compose(before, readings.odometry[step])
            factors.add(self._motion(step))
        else:
            exact = gtsam.noiseModel.Isotropic.Sigma(3, LEAST_SIGMA)
            factors.add(gtsam.PriorFactorPose2(self.pose(0), gtsam.Pose2(), exact))
            if readings.motion.is_biased:
                sigmas = np.maximum(np.sqrt(np.diag(readings.motion.bias_covariance)), LEAST_BIAS)
                factors.add(gtsam.PriorFactorVector(self.bias, np.zeros(3), gtsam.noiseModel.Diagonal.Sigmas(sigmas)))
                values.insert(self.bias, np.zeros(3))
        values.insert(self.pose(step), gtsam.Pose2(*pose))
        frame = readings.frames[step]
        if frame is not None:
            used = readings.labels[step] >= 0
            for n in np.flatnonzero(used):
                label = int(readings.labels[step][n])
                covariance = None if frame.covariances is None else frame.covariances[n]
                ahead = readings.camera.robot_from_camera(frame.points[n])
                if covariance is None:
                    factors.add(self._sight(step, label, frame.points[n]))
                else:
                    factors.add(self._planar_sight(step, label, ahead[:2], covariance))
                if label not in self.known:
                    self.known.add(label)
                    place = compose(pose, np.array([ahead[0], ahead[1], 0.0]))
                    place[2] = ahead[2]
                    values.insert(self.landmark(label), place if covariance is None else place[:2])
        return factors, values

    def landmark(self, label: int) -> int:
        """Return the key of a landmark."""
        return int(self.gtsam.symbol("l", label))

    def _motion(self, step: int) -> Any:
        """Return the factor of an odometry reading u: the motion is u - J b, see `OdometryModel`."""
        gtsam, motion = self.gtsam, self.readings.motion
        reading = self.readings.odometry[step]
        noise = gtsam.noiseModel.Diagonal.Sigmas(np.sqrt(motion.variances(reading[None])[0]))
        keys = [self.pose(step - 1), self.pose(step)]
        if not motion.is_biased:
            return gtsam.BetweenFactorPose2(*keys, gtsam.Pose2(*reading), noise)
        by_bias = motion.bias_jacobians(reading[None])[0]

        def error(this: Any, values: Any, jacobians: Any) -> FloatArray:
            first, second, bias = values.atPose2(keys[0]), values.atPose2(keys[1]), values.atVector(self.bias)
            by_first, by_second = np.zeros((3, 3), order="F"), np.zeros((3, 3), order="F")
            moved = first.between(second, by_first, by_second)
            if jacobians is not None:
                turn = np.eye(3)
                turn[:2, :2] = moved.rotation().matrix()  # tangents are in the axes of the later pose
                jacobians[0], jacobians[1], jacobians[2] = turn @ by_first, turn @ by_second, by_bias
            found = np.array([moved.x(), moved.y(), moved.theta()]) - reading + by_bias @ bias
            found[2] = wrap_angle(found[2])
            return np.asarray(found)

        return gtsam.CustomFactor(noise, [*keys, self.bias], error)

    def _planar_sight(self, step: int, label: int, ahead: FloatArray, covariance: FloatArray) -> Any:
        """Return the factor of a point (2,), robot frame, with its covariance (3, 3) in the camera frame."""
        gtsam, distance = self.gtsam, float(np.hypot(*ahead))
        x, y = ahead / distance
        polar = np.array([[-y / distance, x / distance], [x, y]]) @ ROBOT_FROM_CAMERA[:2]  # of bearing and range
        return gtsam.BearingRangeFactor2D(
            self.pose(step), self.landmark(label), gtsam.Rot2(np.arctan2(y, x)), distance,
            gtsam.noiseModel.Gaussian.Covariance(polar @ covariance @ polar.T),
        )  # fmt: skip

    def _sight(self, step: int, label: int, point: FloatArray) -> Any:
        """Return the factor of a measured point (3,), camera frame, with the noise of its pixels."""
        camera = self.readings.camera
        keys = [self.pose(step), self.landmark(label)]
        measured = camera.project(point)

        def error(this: Any, values: Any, jacobians: Any) -> FloatArray:
            pose, landmark = values.atPose2(keys[0]), values.atPoint3(keys[1])
            cos, sin = np.cos(pose.theta()), np.sin(pose.theta())
            dx, dy = landmark[0] - pose.x(), landmark[1] - pose.y()
            local = np.array([cos * dx + sin * dy, cos * dy - sin * dx, landmark[2]])
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
                jacobians[1] = by_local @ np.array([[cos, sin, 0.0], [-sin, cos, 0.0], [0.0, 0.0, 1.0]])
            return np.asarray(camera.project(seen) - measured)

        return self.gtsam.CustomFactor(self.pixels, keys, error)


def _as_pose(pose: Any) -> FloatArray:
    return np.array([pose.x(), pose.y(), pose.theta()])


def _in_frame(pose: FloatArray, covariance: FloatArray) -> FloatArray:
    """Return a covariance of GTSAM, which is in the axes of the pose (3,), in those of the frame."""
    cos, sin = np.cos(pose[2]), np.sin(pose[2])
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
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
    path, covariances, seconds = np.zeros((len(readings.frames), 3)), np.zeros((len(readings.frames), 3, 3)), 0.0
    for step in range(len(path)):
        begin = time.process_time()
        factors, values = graph.step(step, path[step - 1] if step else np.zeros(3))
        solver.update(factors, values)
        path[step] = _as_pose(solver.calculateEstimatePose2(graph.pose(step)))
        covariances[step] = _in_frame(path[step], solver.marginalCovariance(graph.pose(step)))
        seconds += time.process_time() - begin
        every.push_back(factors)
    return Estimate(path, covariances, 1e3 * seconds / len(path)), every, solver.calculateEstimate()


@one_thread()
def batch(readings: Used, every: Any, values: Any) -> Estimate:
    """Return the estimate of GTSAM's Levenberg-Marquardt optimiser from all readings, started at those of iSAM2."""
    graph, count = Graph(readings), len(readings.frames)
    gtsam, begin = graph.gtsam, time.process_time()
    found = gtsam.LevenbergMarquardtOptimizer(every, values).optimize()
    marginals = gtsam.Marginals(every, found)
    path = np.array([_as_pose(found.atPose2(graph.pose(step))) for step in range(count)])
    covariances = [_in_frame(pose, marginals.marginalCovariance(graph.pose(step))) for step, pose in enumerate(path)]
    return Estimate(path, np.array(covariances), 1e3 * (time.process_time() - begin) / count)


@lru_cache(maxsize=1)
def optimised(config: Config, log: str, world: str, seed: int) -> tuple[Estimate, Any, Any]:
    """Return what `isam2` returns for a log."""
    return isam2(filtered(config, log, world, seed)[1])


def play(config: Config, trial: Trial) -> dict[str, Any]:
    """Estimate the path of a log by a method.

    Returns:
        `position_rms_m` over the steps with known truth, after an SE(2) fit for real logs; `nees_median` (ideal 2.4)
        of the poses, if true headings are known; processor time `step_ms`; `measurements` used. If GTSAM gives up, its
        words as `failed` alone.
    """
    key = config, trial.log, trial.world, trial.seed
    log, readings, estimate = filtered(*key)
    if trial.method != "filter":
        try:
            estimate, every, values = optimised(*key)
            if trial.method == "batch":
                estimate = batch(readings, every, values)
        except RuntimeError as error:
            return {FAILED: str(error).strip().splitlines()[0]}
    rms, median = scores(log, estimate, fitted=not trial.world)
    return {
        "position_rms_m": rms, "nees_median": median, "step_ms": estimate.step_ms,
        "measurements": int(sum((labels >= 0).sum() for labels in readings.labels)),
    }  # fmt: skip


def scores(log: Log, estimate: Estimate, fitted: bool) -> tuple[float, float | None]:
    """Return the position RMS [m], and the median NEES of the poses if true headings are known."""
    truth = log.robots[0].truth
    if isinstance(truth, np.ndarray):
        known = truth[(truth[:, 0] >= log.times[0]) & (truth[:, 0] <= log.times[-1])]
        at = Trajectory(log.times, compose(estimate.path, np.array(log.mount))).at(known[:, 0])
        return score_positions(at[:, :2], known[:, 1:]).aligned, None
    true = true_poses(truth, log.times)
    steps = np.flatnonzero(~np.isnan(true[:, 0]))
    true, path = true[steps], compose(estimate.path, np.array(log.mount))[steps]
    score = score_positions(path, true)
    world_from_path = score.world_from_path if fitted else score.world_from_start
    errors = path - compose(inverse(world_from_path), true)
    errors[:, 2] = wrap_angle(errors[:, 2])
    values = nees(errors[1:], estimate.covariances[steps[1:]] + LEAST_SIGMA**2 * np.eye(3))
    return score.aligned if fitted else score.start, float(np.median(values))


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

    Real logs, and episodes of one robot with true identities. All methods get the measurements that the filter used,
    with the landmarks that it associated them with, and assume the same noise. Stereo measurements and biases of
    odometry are factors written in Python, so that GTSAM's times in episodes and on KITTI are upper limits.
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
            name="beside_gtsam", title="The filter beside GTSAM", by=("log", "world", "method"), pooled=(),
            columns=(
                Column("position_rms_m", digits=3, interval=True), Column("nees_median", "median NEES", digits=1),
                Column("step_ms", "step [ms]", digits=2), Column("measurements", digits=0),
            ),
        ),
    ),
)  # fmt: skip

if __name__ == "__main__":
    run_program(STUDY)
