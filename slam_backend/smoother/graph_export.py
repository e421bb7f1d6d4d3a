"""Smoothed graph of all steps of a filter's logs, for other optimisers.

The filter's own graph has condensed its old measurements. Here all steps are smoothed once more from the logs, with
their data association, and each measurement becomes an edge of a planar graph whose optimum is the estimate:

- Measurements of a landmark from one key are one edge: the point in the frame of the robot. Its covariance is the 2 x 2
  block, x and y, of the covariance of their sum, so that each edge forgets that others share the landmark's height.
  Its value is c + C g with the landmark c in the robot's frame, that covariance C, and the slope g of the measurements'
  log-likelihood at the estimate: for a planar sensor this is the measured point.
- Weights of the robust kernel at the estimate are part of the covariances.
- Odometry is corrected for its estimated bias.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error
from slam_backend.geometry import wrap_angle
from slam_backend.models.odometry import OdometryModel
from slam_backend.pose_graph import Factors, PoseGraph, rotated
from slam_backend.smoother._kernels import NONE
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import extend_graph, log_head
from slam_backend.smoother.graph_reduction import relinearise
from slam_backend.smoother.log_arrays import EXACT, ODOMETRY, REJECTED, LogArrays
from slam_backend.smoother.optimizer import NO_POSE, MapEstimate, linearise, optimize
from slam_backend.smoother.options import SmoothingOptions

SLICE = 100  # least steps that are added between two optimisations
GROWTH = 0.1  # share of the steps so far that are added at once
LOOSE = 100.0  # factor on the tolerance of optimisations before the last
EXACTLY = 1e-9  # tolerance of the last one
ITERATIONS = 100


def smoothed_graph(
    graph: SlamGraph, logs: Sequence[LogArrays], motion: OdometryModel, camera: FloatArray, options: SmoothingOptions,
    covariances: bool,
) -> PoseGraph:  # fmt: skip
    """Return the smoothed planar graph of all robots.

    Args:
        graph: Graph at the robots' starts.
        logs: Complete log of each robot.
        motion: Assumed noise of the odometry.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Kernel, and scale of the noise.
        covariances: Whether marginal covariances are computed.

    Raises:
        ValueError: If there is no step, poses were given as exact, odometry has no noise, or no optimum is found.
    """
    if not any(map(len, logs)):
        raise argument_error("graph", "a filter after its first step", "no step", "Call step() first.")
    if any((log.kinds == EXACT).any() for log in logs):
        raise argument_error("graph", "odometry", "a pose that was given as exact", "There is nothing to smooth.")
    if motion.is_noiseless:
        raise argument_error("graph", "odometry with noise", "no noise", "Give the filter a motion model with noise.")
    graph, steps = _grown(graph, logs, motion, camera, options)
    exact = replace(options, tolerance=EXACTLY, max_iterations=ITERATIONS)
    mode = optimize(graph, camera, exact)
    if mode.reason == NO_POSE:
        raise argument_error("graph", "a robot that has moved", "no motion", "Call step() with odometry first.")
    if mode.reason:
        raise argument_error("graph", "a run that can be smoothed", f"a failure: {mode.reason}", "Smooth a longer run.")
    linearise(mode.sightings, graph, mode.poses, mode.landmarks, camera, exact)
    return _planar(graph, mode, steps, covariances)


def _grown(
    graph: SlamGraph, logs: Sequence[LogArrays], motion: OdometryModel, camera: FloatArray, options: SmoothingOptions
) -> tuple[SlamGraph, IntArray]:
    """Return the graph with all steps near its optimum, and the step of each key.

    New steps begin at the odometry from the smoothed ones, so that no initial pose is far from the optimum.
    """
    firsts = [int(log.steps[0]) if len(log) and log.kinds[0] != ODOMETRY else -1 for log in logs]
    steps = np.where(graph.robots >= 0, np.array(firsts)[np.maximum(graph.robots, 0)], -1)
    last = max(int(log.steps[-1]) for log in logs if len(log))
    done = -1
    while done < last:
        done += max(SLICE, int(GROWTH * done))
        parts = [_between(log, int(latest), done) for log, latest in zip(logs, graph.latest, strict=True)]
        steps = np.concatenate([steps, *map(_key_steps, parts)])
        graph = extend_graph(graph, parts, motion, camera[4:])
        assert len(steps) == graph.num_keys
        mode = optimize(graph, camera, options, looseness=LOOSE)
        if np.isfinite(mode.poses).all() and np.isfinite(mode.landmarks).all():
            graph = relinearise(graph, mode)
    return graph, steps


def _between(log: LogArrays, after: int, until: int) -> LogArrays:
    """Return the steps of a log after one step, up to another."""
    rest = log.since(after + 1)
    return log_head(rest, int(np.searchsorted(rest.steps, until, side="right")))


def _key_steps(log: LogArrays) -> IntArray:
    """Return the steps that become keys, as `add_keyframes` makes them: those that moved and measured, and the last."""
    used = np.add.reduceat(np.append(log.ids != REJECTED, False).astype(np.int64), log.starts[:-1])
    used[np.diff(log.starts) == 0] = 0
    moved, keys = False, []
    for row, kind in enumerate(log.kinds.tolist()):
        moved |= kind == ODOMETRY
        if moved and (used[row] or row == len(log) - 1):
            keys.append(int(log.steps[row]))
            moved = False
    return np.array(keys, dtype=np.int64)


def _planar(graph: SlamGraph, mode: MapEstimate, steps: IntArray, covariances: bool) -> PoseGraph:
    """Return the planar graph about an estimate, with sightings linearised there."""
    (kept,) = (graph.robots >= 0).nonzero()
    kept = kept[np.argsort(graph.robots[kept], kind="stable")]  # by robot, in order of time
    row = np.full(graph.num_keys, NONE)
    row[kept] = np.arange(len(kept))
    robots = graph.robots[kept]
    parents = graph.parents[kept]
    (linked,) = ((parents >= 0) & (graph.robots[parents] >= 0)).nonzero()
    (loose,) = ((parents >= 0) & (graph.robots[parents] == NONE)).nonzero()
    odometry, noises = _corrected(graph, mode.poses)[kept], graph.odometry_covariances[kept]
    noises = rotated(noises, -odometry[:, 2])  # from axes of the first pose to those of the second
    seen = mode.sightings
    information = _matrices(seen.information)
    planar = np.linalg.inv(information)[:, :2, :2]
    planar = 0.5 * (planar + planar.transpose(0, 2, 1))
    points = seen.linearisation_points[:, :2] + (planar @ seen.gradients[:, :2, None])[:, :, 0]
    poses = mode.poses[kept].copy()
    poses[:, 2] = wrap_angle(poses[:, 2])
    odometry[:, 2] = wrap_angle(odometry[:, 2])
    marginals = _marginals(graph, mode, kept) if covariances else (None, None)
    return PoseGraph(
        poses=poses,
        robots=robots,
        pose_ids=np.arange(len(kept)) - np.searchsorted(robots, robots),
        times=steps[kept].astype(np.float64),
        landmarks=mode.landmarks[:, :2],
        landmark_ids=graph.landmark_ids,
        motions=Factors(np.column_stack([row[parents[linked]], linked]), odometry[linked], noises[linked]),
        sightings=Factors(np.column_stack([row[seen.keys], seen.landmarks]), points, planar),
        pose_priors=Factors(loose, odometry[loose], noises[loose]),
        fixed=parents < 0,
        pose_covariances=marginals[0],
        landmark_covariances=marginals[1],
    )


def _corrected(graph: SlamGraph, poses: FloatArray) -> FloatArray:
    """Return the odometry (k, 3) of all keys less what the estimated biases add to it."""
    biases = graph.biases_of_odometry()
    if not len(biases):
        return graph.odometry.copy()
    values = np.where((biases >= 0)[:, None], poses[biases], 0.0)
    return np.asarray(graph.odometry - (graph.bias_jacobians @ values[:, :, None])[:, :, 0])


def _matrices(upper: FloatArray) -> FloatArray:
    """Return symmetric matrices (n, 3, 3) of upper triangles by rows (n, 6)."""
    return upper[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def _marginals(graph: SlamGraph, mode: MapEstimate, keys: IntArray) -> tuple[FloatArray, FloatArray]:
    """Return the marginal covariances of poses (n, 3, 3) by key (n,), 0 if fixed, and of landmarks (l, 2, 2)."""
    poses, landmarks = np.zeros((len(keys), 3, 3)), np.zeros((len(graph.landmark_ids), 2, 2))
    system = mode.system
    assert system is not None
    for at, column in enumerate(mode.columns[keys].tolist()):
        if column >= 0:
            poses[at] = system.covariance(np.array([column]))
    for at in range(len(landmarks)):
        landmarks[at] = system.covariance(np.array([3 * (system.num_poses + at)]))[:2, :2]
    return poses, landmarks


def starts_graph(starts: FloatArray, held: BoolArray, motion: OdometryModel, present: SlamGraph | None) -> SlamGraph:
    """Return the graph at the starts of the robots, with the names by which landmarks go now.

    Args:
        starts: (K, 3, M) [m, m, rad], map frame. Start poses in all particles.
        held: (K,) See `SlamGraph.at_uncertain_starts`.
        motion: Model with the prior of the biases.
        present: Graph of the filter's smoother, if there is one.
    """
    graph = SlamGraph.at_uncertain_starts(starts, held, motion)
    return graph if present is None else graph.with_columns(merged_ids=present.merged_ids)
