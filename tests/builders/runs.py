"""Short runs as logs and graphs, and the cost of a smoother written plainly."""

from collections.abc import Sequence
from functools import lru_cache

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.run_log import RobotLog
from slam_backend.geometry import between, inverse, transform_points, wrap_angle
from slam_backend.maps.alignment_types import AlignmentOptions
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import NO_LANDMARK_POSITIONS, InitialPoses, extend_graph
from slam_backend.smoother.log_arrays import LogArrays
from slam_backend.smoother.optimizer import MapEstimate
from slam_backend.smoother.options import SmoothingOptions
from slam_backend.smoother.reassociation import LandmarkTable
from slam_backend.smoother.rejuvenation import Draft, Rejuvenation, Smoother
from training.stereo_runs.batch_problem import BatchProblem
from training.stereo_runs.runs import RunSpec, StereoRun, simulate_run

SPEC = RunSpec(length=5.0, landmarks=120, measurements=7)
TIGHT = SmoothingOptions(kernel=0.0, tolerance=1e-12, max_iterations=50, max_keys=1000, recent_keys=1000)


@lru_cache
def small_run(robots: int = 1, seed: int = 101, length: float = 5.0) -> StereoRun:
    """Return a run of 21 steps, as a rule."""
    return simulate_run(RunSpec(robots=robots, length=length, landmarks=120, measurements=7 * robots), seed)


def camera_of(run: StereoRun) -> FloatArray:
    """Return the camera as kernels take it."""
    camera = run.spec.noise.camera
    return np.array([camera.focal_px, camera.baseline, camera.sigma_px, camera.sigma_disparity_px, *camera.mount])


def logs_of(run: StereoRun, skip: tuple[int, ...] = ()) -> list[RobotLog]:
    """Return what each robot would log; the measurements of the steps in `skip` are left out."""
    logs = []
    for robot in range(run.spec.robots):
        log = RobotLog()
        for step in range(run.num_steps):
            points = run.spec.noise.camera.robot_from_camera(run.frames[step][robot].points)
            points = points - np.array(run.spec.noise.camera.mount)
            names = run.names[step][robot]
            if step in skip:
                points, names = points[:0], names[:0]
            log.append(step, None if step == 0 else run.odometry[step, robot], points=points, ids=names)
        logs.append(log)
    return logs


def graph_of(run: StereoRun, skip: tuple[int, ...] = (), motion: OdometryModel | None = None) -> SlamGraph:
    """Return the graph of a whole run, each step a key unless it is skipped; `motion` replaces the run's own noise."""
    motion = run.spec.noise.motion if motion is None else motion
    start = SlamGraph.at_starts(run.true_paths[:, 0], motion)
    logs = [log.arrays() for log in logs_of(run, skip)]
    return extend_graph(start, logs, motion, np.array(run.spec.noise.camera.mount))


NAMELESS = LandmarkTable(
    np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 6)), np.zeros(0, np.int32), np.zeros((0, 0), np.float32)
)


def rejuvenate(
    graph: SlamGraph, logs: Sequence[LogArrays], motion: OdometryModel, camera: FloatArray, num_particles: int,
    rng: np.random.Generator, options: SmoothingOptions,
) -> Rejuvenation:  # fmt: skip
    """Add logs to a graph and draw particles: in the first slice, or after those that the descent still needs."""
    smoother = Smoother(motion, camera, options, rng, AlignmentOptions())
    result: Rejuvenation | SlamGraph | Draft | str = graph
    while not isinstance(result, Rejuvenation):
        assert not isinstance(result, str), result
        if isinstance(result, Draft):
            result = smoother.optimise_slice(result)
            continue
        rest = [log.since(int(latest) + 1) for log, latest in zip(logs, result.latest, strict=True)]
        initial_poses = [InitialPoses.empty() for _ in logs]
        result = smoother.draw(result, rest, initial_poses, NO_LANDMARK_POSITIONS, num_particles, NAMELESS)
    return result


BIASED = OdometryModel(bias_scale=0.03, bias_heading=0.02, bias_turn=0.05)  # assumed noise with a bias


def upper(mode: MapEstimate) -> FloatArray:
    """Return U with U^T U the information of all poses sought, landmarks integrated out, by columns of the mode."""
    covariance = mode.covariance(np.flatnonzero(mode.columns >= 0))
    return np.asarray(np.linalg.cholesky(np.linalg.inv(covariance)).T)


def plain_cost(run: StereoRun, paths: FloatArray, landmarks: dict[int, FloatArray]) -> float:
    """Return half the sum of squared whitened residuals of paths (K, T, 3), measured in pixels."""
    noise, total = run.spec.noise, 0.0
    camera = noise.camera
    sigmas = np.array([camera.sigma_px, camera.sigma_px, camera.sigma_disparity_px])
    for robot, path in enumerate(paths):
        for step, pose in enumerate(path):
            if step:
                off = between(path[step - 1], pose) - run.odometry[step, robot]
                off[2] = wrap_angle(off[2])
                total += 0.5 * ((off / noise.motion.sigmas(run.odometry[step, robot])) ** 2).sum()
            for point, name in zip(run.frames[step][robot].points, run.names[step][robot], strict=True):
                local = camera.camera_from_robot(transform_points(inverse(pose), landmarks[int(name)]))
                total += 0.5 * (((camera.project(local) - camera.project(point)) / sigmas) ** 2).sum()
    return float(total)


def problem_of(run: StereoRun) -> BatchProblem:
    """Return the run as batch maximum likelihood takes it."""
    return BatchProblem.of_run(run)
