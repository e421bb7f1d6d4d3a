"""One filter lives through the log of one robot, and its path is scored against known positions."""

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from slam_backend.errors import FloatArray
from slam_backend.filter import FastSlam
from slam_backend.geometry import compose, transform_points
from slam_backend.landmark_map import LandmarkMap
from slam_backend.measurements import Measurements
from slam_backend.metrics import align_se2
from slam_backend.trajectory import dead_reckoning

# Of what moves in the plane a measurement fixes two coordinates: 99.9 % of right matches have a smaller squared
# Mahalanobis distance.
PLANAR_GATE = 13.8


@dataclass(frozen=True, slots=True, eq=False)
class OneReplay:
    """What one filter estimated. T steps.

    Attributes:
        times: (T,) float64 [s]. Of the log's clock.
        path: (T, 3) float64 [m, m, rad]. Estimated at each step from what was known then, start frame.
        reckoned: (T, 3) float64 [m, m, rad]. Dead reckoning, start frame.
        landmarks: The map at the end, start frame.
        matched: Measurements that the most probable particle matched.
        created: Landmarks that it made.
        rejected: Measurements of which it made nothing.
        seconds: What the filter took to live through the log [s].
    """

    times: FloatArray
    path: FloatArray
    reckoned: FloatArray
    landmarks: LandmarkMap
    matched: int
    created: int
    rejected: int
    seconds: float

    @property
    def speed(self) -> float:
        """Seconds of log in a second of computing."""
        return float(self.times[-1] - self.times[0]) / self.seconds


@dataclass(frozen=True, slots=True, eq=False)
class PositionScore:
    """A path against n known positions.

    Attributes:
        start: RMS distance [m] with the start frame put where it is known to be.
        aligned: RMS distance [m] after the SE(2) alignment of the whole path.
        world_from_path: (3,) float64 [m, m, rad]. That alignment.
        errors: (n,) float64 [m]. Distances after it.
    """

    start: float
    aligned: float
    world_from_path: FloatArray
    errors: FloatArray


def replay_one(
    slam: FastSlam,
    times: FloatArray,
    odometry: FloatArray,
    frames: Sequence[Measurements | None],
    on_step: Callable[[float], None] = lambda done: None,
    describe: Callable[[Measurements, FloatArray], Measurements] = lambda frame, pose: frame,
) -> OneReplay:
    """Let a filter of one robot live through a log.

    Args:
        slam: Before its first step.
        times: (T,) float64 [s].
        odometry: (T, 3) float64 [m, m, rad]. Motion since the step before; the first is not used.
        frames: T entries.
        on_step: Called after each step with the share of the log that is done, in (0, 1].
        describe: Makes of a frame and the predicted pose (3,), start frame, the frame that the filter is given.
    """
    path = np.zeros((len(times), 3))
    matched, created, rejected, seconds = 0, 0, 0, 0.0
    for step, frame in enumerate(frames):
        started = time.perf_counter()
        move = odometry[step] if step else np.zeros(3)
        told = None if frame is None else describe(frame, compose(slam.pose().mean, move))
        report = slam.step([move if step else None], [told])
        path[step] = slam.pose().mean
        seconds += time.perf_counter() - started
        matched += report.num_matched
        created += report.num_new
        rejected += report.num_rejected
        on_step((step + 1) / len(times))
    return OneReplay(
        times=times,
        path=path,
        reckoned=dead_reckoning(np.zeros(3), odometry[1:]),
        landmarks=slam.map(),
        matched=matched,
        created=created,
        rejected=rejected,
        seconds=seconds,
    )


def score_positions(points: FloatArray, truth: FloatArray, world_from_start: FloatArray) -> PositionScore:
    """Score estimated positions (n, 2) [m], start frame, against true ones (n, 2) [m], world frame.

    Args:
        points: Estimates at the times of the true ones.
        truth: True positions.
        world_from_start: (3,) float64 [m, m, rad]. Where the start frame is known to be.
    """
    fit = align_se2(truth, points)
    raw, fitted = (np.hypot(*(transform_points(pose, points) - truth).T) for pose in (world_from_start, fit))
    return PositionScore(float(np.sqrt(np.mean(raw**2))), float(np.sqrt(np.mean(fitted**2))), fit, fitted)
