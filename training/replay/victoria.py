"""Replay of the Victoria Park log: unlabelled trees, matched by position, with GPS as ground truth."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import compose, transform_points
from slam_backend.metrics import align_se2
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.models.measurements import Measurements
from slam_backend.readers.victoria import SENSOR, VictoriaLog, to_filter_steps
from slam_backend.trajectory import Trajectory
from training.replay.config import VictoriaConfig
from training.replay.single_robot import PLANAR_GATE, OneReplay, PositionScore, metrics_of, replay_one, score_positions

# Trees are metres apart: a measurement within 1.5 m of a known tree, or not far beyond its gate, is not a new one.
NEW_LANDMARK_GATE = 40.0
NEW_LANDMARK_RADIUS = 1.5
# Density of clutter: one unmapped object in 10 m x 10 m x the 1 m that a planar sensor does not resolve.
NEW_LANDMARK_DENSITY = 0.01
# By default, contradicting trees widen the pose at once. Here bushes and pedestrians contradict the map now and then,
# while the odometry is good: the pose is not widened.
RECOVERY_POSITION = 0.0
# Distance from a measurement within which a tree, as first measured, is a candidate for data association [m].
SEARCH_RADIUS = 25.0
NO_WEIGHT = 1e6  # standard deviation of the descriptors [m]: they do not affect weights
KNOWN_START = 30.0  # path length that determines the start heading [m]: a GPS fix has no heading


@dataclass(frozen=True, slots=True, eq=False)
class VictoriaScore:
    """Paths of the antenna against the GPS fixes during the replay."""

    fixes: FloatArray  # (g, 2) float64 [m]. Positions, east and north.
    # Twice (T, 2) float64 [m], start frame. Antenna positions of estimate and dead reckoning at each step.
    paths: tuple[FloatArray, FloatArray]
    scores: tuple[PositionScore, PositionScore]  # Scores of both at the fixes


def replay(log: VictoriaLog, config: VictoriaConfig, on_step: Callable[[float], None] = lambda done: None) -> OneReplay:
    """Run a filter on a log; poses are of the rear axle."""
    readings = to_filter_steps(log, config.sensor)
    options = FilterOptions(
        num_particles=config.particles, camera=StereoCamera(mount=SENSOR), motion=config.motion,
        proposal=config.estimator, rejuvenate_every=config.rejuvenate_every or None, position_gate=PLANAR_GATE,
        new_landmark_gate=NEW_LANDMARK_GATE, new_landmark_radius=NEW_LANDMARK_RADIUS,
        new_landmark_density=NEW_LANDMARK_DENSITY,
        recovery_position=RECOVERY_POSITION, descriptor_gate=SEARCH_RADIUS, descriptor_sigma=NO_WEIGHT,
    )  # fmt: skip
    slam = FastSlam.from_options(1, options, config.seed)
    read = zip(readings.odometry, readings.measurements, strict=True)
    return replay_one(slam, readings.times, read, on_step, describe_by_place)


def describe_by_place(frame: Measurements, pose: FloatArray) -> Measurements:
    """Return the measurements with each tree's position as its descriptor, given the predicted rear-axle pose (3,).

    All trees have the same appearance. A filter compares a measurement with all landmarks of similar descriptors, which
    is expensive in a park full of trees; positions as descriptors limit this to the neighbourhood, without any weight.
    """
    ahead = frame.points @ ROBOT_FROM_CAMERA.T + np.array(SENSOR)
    return Measurements(frame.points, transform_points(pose, ahead)[:, :2].astype(np.float32), frame.covariances)


def score(result: OneReplay, log: VictoriaLog) -> VictoriaScore | None:
    """Score a replay at the GPS fixes, which are of the antenna beside the laser; None if there are fewer than two."""
    if log.gps is None:
        return None
    during = (log.gps[:, 0] >= result.times[0]) & (log.gps[:, 0] <= result.times[-1])
    if np.count_nonzero(during) < 2:
        return None
    stamps, fixes = log.gps[during, 0], log.gps[during, 1:]
    antenna = np.array([*SENSOR[:2], 0.0])
    paths = [compose(poses, antenna) for poses in (result.path, result.reckoned)]
    scores = []
    for path in paths:
        points = Trajectory(result.times, path).at(stamps)[:, :2]
        travelled = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points, axis=0).T))])
        first = np.flatnonzero(travelled <= KNOWN_START)
        scores.append(score_positions(points, fixes, align_se2(fixes[first], points[first])))
    return VictoriaScore(fixes, (paths[0][:, :2], paths[1][:, :2]), (scores[0], scores[1]))


def summarise(result: OneReplay, scored: VictoriaScore | None) -> dict[str, Any]:
    """Return the content of `metrics.json`; true positions of the trees are unknown, so that errors of the map are NaN.

    `ate_start_m` uses the start pose from a fit of the first 30 m of the path to the fixes. `gps` has the distances to
    the fixes after the SE(2) alignment of the whole path; some fixes are outliers. It is None without
    fixes.
    """
    often = int(np.count_nonzero(result.landmarks.counts >= 10))
    if scored is None:
        return metrics_of(result, None, {}, gps=None, landmarks_seen_ten_times=often)
    errors = scored.scores[0].errors
    gps = {
        "fixes": len(scored.fixes), "rms_m": scored.scores[0].aligned, "median_m": float(np.median(errors)),
        "percentile_95_m": float(np.quantile(errors, 0.95)), "worst_m": float(errors.max()),
    }  # fmt: skip
    return metrics_of(result, scored.scores, {}, gps=gps, landmarks_seen_ten_times=often)
