"""Replay of a KITTI drive in the plane, with tracked stereo features as landmarks."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.geometry import between, compose
from slam_backend.readers.kitti import KittiLog, make_camera, motion_noise, to_filter_steps
from slam_backend.trajectory import Trajectory
from training.replay.config import KittiConfig
from training.replay.single_robot import (
    PLANAR_GATE,
    OneReplay,
    PositionScore,
    end_errors,
    metrics_of,
    path_length,
    replay_one,
    score_paths,
)

# The number of a track is its descriptor, so that tracks are never confused. Unlike given identities, this keeps the
# gate active: tracks on other cars are rejected, and a rejected track never creates a second landmark.
OWN_TRACK = 0.5
NEW_LANDMARK_GATE = 1e9
# Points on other cars can outnumber static ones: contradicting tracks do not widen the pose.
RECOVERY_POSITION = 0.0
LOOP_AFTER = 100.0  # path length before a place counts as revisited [m]
LOOP_WITHIN = 10.0  # maximum distance between two poses at one place [m]
SEGMENTS = range(100, 801, 100)  # lengths of KITTI's segments [m], from every `SEGMENT_EVERY`th pose
SEGMENT_EVERY = 10


@dataclass(frozen=True, slots=True, eq=False)
class DriveScore:
    """Paths of the left camera against the true path, in the plane; pairs are (estimate, odometry)."""

    truth: FloatArray  # (n, 3) float64 [m, m, rad]. True poses at the first n steps.
    # Twice (T, 3) float64 [m, m, rad], start frame. Camera poses at each step.
    paths: tuple[FloatArray, FloatArray]
    scores: tuple[PositionScore, PositionScore]  # Scores of both
    # Steps (earlier, later) at which the car was nearest to an earlier place; None if it never returned
    loop: tuple[int, int] | None
    loop_error: float  # Error [m] of the estimated motion between these two steps; NaN if there are none
    drifts: tuple[float, float]  # Mean errors of the motions over segments; see `mean_drift`
    ends: tuple[float, float]  # Errors at the last true pose, from the true start, no fit [m]

    @property
    def length(self) -> float:
        """Length of the true path [m]."""
        return path_length(self.truth)


def replay(log: KittiLog, config: KittiConfig, on_step: Callable[[float], None] = lambda done: None) -> OneReplay:
    """Run a filter on a drive; poses are of the inertial unit."""
    camera = make_camera(log, config.sigma_px, config.sigma_disparity_px)
    readings = to_filter_steps(log, camera)
    options = FilterOptions(
        num_particles=config.particles, camera=camera, motion=motion_noise(log), proposal=config.estimator,
        rejuvenate_every=config.rejuvenate_every or None, position_gate=PLANAR_GATE,
        new_landmark_gate=NEW_LANDMARK_GATE,
        recovery_position=RECOVERY_POSITION, descriptor_gate=OWN_TRACK,
    )  # fmt: skip
    slam = FastSlam.from_options(1, options, config.seed)
    read = zip(readings.odometry, readings.measurements, strict=True)
    return replay_one(slam, readings.times, read, on_step)


def score(result: OneReplay, log: KittiLog) -> DriveScore | None:
    """Score a replay against the true path of the camera; None without ground truth."""
    mount = np.array([*log.mount[:2], 0.0])
    paths = compose(result.path, mount), compose(result.reckoned, mount)
    return None if log.truth is None else score_drive(paths, log.truth)


def score_drive(paths: tuple[FloatArray, FloatArray], trajectory: Trajectory) -> DriveScore:
    """Score the camera's paths (T, 3) [m, m, rad], start frame, of estimate and odometry, against the true path."""
    truth = trajectory.poses[: len(paths[0])]
    one, other = score_paths(paths, truth)
    loop, error = find_loop(truth), float("nan")
    if loop is not None:
        motions = [between(path[loop[0]], path[loop[1]]) for path in (paths[0], truth)]
        error = float(np.hypot(*(motions[0] - motions[1])[:2]))
    drifts, ends = (mean_drift(paths[0], truth), mean_drift(paths[1], truth)), end_errors(paths, truth)
    return DriveScore(truth, paths, (one, other), loop, error, drifts, (ends[0], ends[1]))


def drive_metrics(scored: DriveScore | None, odometry: str) -> dict[str, float]:
    """Return the metrics of a drive by their names in `metrics.json`, NaN without ground truth."""
    length, ends, drifts = (
        (scored.length, scored.ends, scored.drifts) if scored else (np.nan, (np.nan,) * 2, (np.nan,) * 2)
    )
    return {
        "true_path_m": length, "end_error_m": ends[0], "end_error_percent": 100.0 * ends[0] / length,
        f"{odometry}_end_error_m": ends[1], "mean_drift": drifts[0], f"{odometry}_mean_drift": drifts[1],
    }  # fmt: skip


def mean_drift(path: FloatArray, truth: FloatArray) -> float:
    """Return the mean error of the estimated motion over segments of the true path, relative to their lengths.

    Segments have 100, 200, ..., 800 m, with equal weights (Geiger, Lenz, Urtasun, CVPR 2012).

    Args:
        truth: (n, 3) float64 [m, m, rad]. True poses at the first n <= T steps, any frame.

    Returns:
        The relative error; NaN if the true path is shorter than 100 m.
    """
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    errors = [np.empty(0)]
    for length in SEGMENTS:
        first = np.arange(0, len(truth), SEGMENT_EVERY)
        last = np.searchsorted(driven, driven[first] + length)
        first, last = first[last < len(truth)], last[last < len(truth)]
        off = between(between(truth[first], truth[last]), between(path[first], path[last]))
        errors.append(np.hypot(off[:, 0], off[:, 1]) / length)
    errors_together = np.concatenate(errors)
    return float(errors_together.mean()) if len(errors_together) else float("nan")


def find_loop(truth: FloatArray) -> tuple[int, int] | None:
    """Return the steps (earlier, later) of the closest revisit in (n, 3) poses; None if the car never returned."""
    driven = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(truth[:, :2], axis=0).T))])
    apart = np.hypot(*(truth[:, None, :2] - truth[None, :, :2]).transpose(2, 0, 1))
    apart[driven[None, :] - driven[:, None] < LOOP_AFTER] = np.inf
    earlier, later = np.unravel_index(int(np.argmin(apart)), apart.shape)
    return (int(earlier), int(later)) if apart[earlier, later] <= LOOP_WITHIN else None


def summarise(result: OneReplay, scored: DriveScore | None) -> dict[str, Any]:
    """Return the content of `metrics.json`; unknown values are NaN, including errors of the map."""
    figures = drive_metrics(scored, "dead_reckoning") | {"loop_error_m": scored.loop_error if scored else float("nan")}
    return metrics_of(result, scored.scores if scored else None, figures)
