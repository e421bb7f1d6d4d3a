"""One filter lives through the log of one robot, and its path is scored against known positions."""

import re
import time
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.consistency import Consistency
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import StepReport
from slam_backend.geometry import compose, inverse, transform_points
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.metrics import align_se2
from slam_backend.models.measurements import Measurements
from slam_backend.trajectory import dead_reckoning
from training.episodes.tables import consistency_rows

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from slam_backend.fastslam.reports import RejuvenationReport

NUMBER = re.compile(r"\d+(\.\d+)?")

# Of what moves in the plane a measurement fixes two coordinates: 99.9 % of right matches have a smaller squared
# Mahalanobis distance.
PLANAR_GATE = 13.8


class RejuvenationCount:
    """Attempts by what came of them."""

    def __init__(self) -> None:
        self._reasons: Counter[str] = Counter()

    def add(self, report: "RejuvenationReport | None") -> None:
        """Count an attempt; None: there was none. Reasons that differ in their numbers alone are one."""
        if report is not None:
            self._reasons[NUMBER.sub("n", report.reason)] += 1

    def to_mapping(self) -> dict[str, Any]:
        """Return how often particles were `drawn`, and `refused`: by reason how often they were not."""
        refused = {reason: count for reason, count in sorted(self._reasons.items()) if reason}
        return {"drawn": self._reasons[""], "refused": refused}


@dataclass(frozen=True, slots=True, eq=False)
class OneReplay:
    """What one filter estimated. T steps."""

    times: FloatArray  # (T,) float64 [s]. Of the log's clock.
    path: FloatArray  # (T, 3) float64 [m, m, rad]. Estimated at each step from what was known then, start frame.
    reckoned: FloatArray  # (T, 3) float64 [m, m, rad]. Dead reckoning, start frame.
    landmarks: LandmarkMap  # The map at the end, start frame
    matched: int  # Measurements that the most probable particle matched
    created: int  # Landmarks that it made
    rejected: int  # Measurements of which it made nothing
    rejuvenations: Mapping[str, Any]  # What came of drawing particles anew, see `RejuvenationCount.to_mapping`
    consistency: Consistency  # Whether the filter errs as little as it claims
    seconds: float  # What the filter took to live through the log [s]

    @property
    def speed(self) -> float:
        """Seconds of log in a second of computing."""
        return float(self.times[-1] - self.times[0]) / self.seconds


@dataclass(frozen=True, slots=True, eq=False)
class PositionScore:
    """A path against n known positions."""

    start: float  # RMS distance [m] with the start frame put where it is known to be
    aligned: float  # RMS distance [m] after the SE(2) alignment of the whole path
    world_from_path: FloatArray  # (3,) float64 [m, m, rad]. That alignment.
    errors: FloatArray  # (n,) float64 [m]. Distances after it.


def replay_one(
    slam: FastSlam,
    times: FloatArray,
    steps: Iterable[tuple[FloatArray, Measurements | None]],
    on_step: Callable[[float], None] = lambda done: None,
    describe: Callable[[Measurements, FloatArray], Measurements] = lambda frame, pose: frame,
    on_report: Callable[[StepReport], None] = lambda report: None,
) -> OneReplay:
    """Let a filter of one robot live through a log.

    Args:
        steps: T pairs: the motion since the step before (3,) [m, m, rad], of which the first is not used, and the
            frame. What makes them, as they are asked for, is not timed.
        describe: Makes of a frame and the predicted pose (3,), start frame, the frame that the filter is given.
    """
    path, odometry = np.zeros((len(times), 3)), np.zeros((len(times), 3))
    matched, created, rejected, seconds = 0, 0, 0, 0.0
    rejuvenations = RejuvenationCount()
    for step, (move, frame) in enumerate(steps):
        odometry[step] = move if step else 0.0
        started = time.perf_counter()
        told = None if frame is None else describe(frame, compose(slam.pose().mean, odometry[step]))
        report = slam.step([odometry[step] if step else None], [told])
        path[step] = slam.pose().mean
        seconds += time.perf_counter() - started
        matched += report.num_matched
        created += report.num_new
        rejected += report.num_rejected
        rejuvenations.add(report.rejuvenation)
        on_report(report)
        on_step((step + 1) / len(times))
    return OneReplay(
        times=times, path=path, reckoned=dead_reckoning(np.zeros(3), odometry[1:]), landmarks=slam.map(),
        matched=matched, created=created, rejected=rejected, rejuvenations=rejuvenations.to_mapping(),
        consistency=slam.consistency, seconds=seconds,
    )  # fmt: skip


def score_positions(points: FloatArray, truth: FloatArray, world_from_start: FloatArray) -> PositionScore:
    """Score estimated positions (n, 2) [m], start frame, against true ones (n, 2) [m], world frame.

    Args:
        world_from_start: (3,) float64 [m, m, rad]. Where the start frame is known to be.
    """
    fit = align_se2(truth, points)
    raw, fitted = (np.hypot(*(transform_points(pose, points) - truth).T) for pose in (world_from_start, fit))
    return PositionScore(float(np.sqrt(np.mean(raw**2))), float(np.sqrt(np.mean(fitted**2))), fit, fitted)


def score_paths(paths: Iterable[FloatArray], truth: FloatArray) -> list[PositionScore]:
    """Score paths (T, 3), each in a frame of its own, against the true poses (n, 3) of the first n steps."""
    return [
        score_positions(path[: len(truth), :2], truth[:, :2], compose(truth[0], inverse(path[0]))) for path in paths
    ]


def end_errors(paths: Iterable[FloatArray], truth: FloatArray) -> list[float]:
    """Return how far paths (T, 3) are off [m] at the last of n true poses (n, 3), from the true start, no fit."""
    last = len(truth) - 1
    ends = [compose(compose(truth[0], inverse(path[0])), path[last]) - truth[last] for path in paths]
    return [float(np.hypot(end[0], end[1])) for end in ends]


def path_length(path: FloatArray) -> float:
    """Return the length [m] of a path (T, 2) or (T, 3)."""
    return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())


def metrics_of(
    result: OneReplay, scores: tuple[PositionScore, PositionScore] | None, own: Mapping[str, Any], **more: Any
) -> dict[str, Any]:
    """Return the content of `metrics.json`; what cannot be known is NaN, as are errors of the map."""
    nan = float("nan")
    estimate, reckoned = ((nan, nan), (nan, nan)) if scores is None else ((s.aligned, s.start) for s in scores)
    return {
        "robots": [
            {
                "ate_aligned_m": estimate[0], "ate_start_m": estimate[1], "dead_reckoning_ate_aligned_m": reckoned[0],
                "dead_reckoning_ate_start_m": reckoned[1], "map_rmse_m": nan, "map_recall": nan, "map_precision": nan,
                "map_error": nan, "path_m": path_length(result.path), **own,
            }
        ],
        "landmarks": len(result.landmarks), **more,
        "measurements": {"matched": result.matched, "created": result.created, "rejected": result.rejected},
        "rejuvenations": result.rejuvenations, "consistency": consistency_rows([1], [result.consistency]), "merges": [],
        "groups": [[1]], "coverage": nan, "duration_s": float(result.times[-1] - result.times[0]),
    }  # fmt: skip
