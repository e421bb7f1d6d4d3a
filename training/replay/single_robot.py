"""Replay of the log of one robot with one filter, and scores of its path at known positions."""

import math
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

if TYPE_CHECKING:  # numerical modules are imported when the command runs, so that --help is fast
    from slam_backend.fastslam.reports import RejuvenationReport

NUMBER = re.compile(r"\d+(\.\d+)?")

MOST_STAGES = 75  # maps of a replay over time, for its playback

# A planar measurement has two degrees of freedom: 99.9 % of correct matches have a smaller squared Mahalanobis
# distance.
PLANAR_GATE = 13.8


class RejuvenationCount:
    """Counts of rejuvenation attempts by outcome."""

    def __init__(self) -> None:
        self._reasons: Counter[str] = Counter()

    def add(self, report: "RejuvenationReport | None") -> None:
        """Count an attempt; None: there was none. Reasons that differ only in numbers are counted together."""
        if report is not None:
            self._reasons[NUMBER.sub("n", report.reason)] += 1

    def to_mapping(self) -> dict[str, Any]:
        """Return the number of rejuvenations, `drawn`, and the numbers of refusals by reason, `refused`."""
        refused = {reason: count for reason, count in sorted(self._reasons.items()) if reason}
        return {"drawn": self._reasons[""], "refused": refused}


@dataclass(frozen=True, slots=True, eq=False)
class OneReplay:
    """Estimates of one filter over T steps."""

    times: FloatArray  # (T,) float64 [s]. Times of the steps by the log's clock.
    path: FloatArray  # (T, 3) float64 [m, m, rad]. Pose estimates at the time of each step, start frame.
    reckoned: FloatArray  # (T, 3) float64 [m, m, rad]. Dead reckoning, start frame.
    landmarks: LandmarkMap  # Final map, start frame
    stages: tuple[tuple[int, LandmarkMap], ...]  # Steps, and the maps after them, start frame; the last step included
    matched: int  # Number of measurements matched by the most probable particle
    created: int  # Number of landmarks created by it
    rejected: int  # Number of measurements rejected by it
    rejuvenations: Mapping[str, Any]  # Rejuvenations, see `RejuvenationCount.to_mapping`
    consistency: Consistency  # Consistency of the filter
    seconds: float  # Computing time of the filter [s]

    @property
    def speed(self) -> float:
        """Seconds of log per second of computing."""
        return float(self.times[-1] - self.times[0]) / self.seconds


@dataclass(frozen=True, slots=True, eq=False)
class PositionScore:
    """Errors of a path at n known positions."""

    start: float  # RMS distance from the known start pose, without fitting [m]
    aligned: float  # RMS distance [m] after the SE(2) alignment of the whole path
    world_from_path: FloatArray  # (3,) float64 [m, m, rad]. Alignment of the path.
    errors: FloatArray  # (n,) float64 [m]. Distances after alignment.


def replay_one(
    slam: FastSlam,
    times: FloatArray,
    steps: Iterable[tuple[FloatArray, Measurements | None]],
    on_step: Callable[[float], None] = lambda done: None,
    describe: Callable[[Measurements, FloatArray], Measurements] = lambda frame, pose: frame,
    on_report: Callable[[StepReport], None] = lambda report: None,
) -> OneReplay:
    """Run a filter of one robot on a log.

    Args:
        steps: T pairs: motion since the previous step (3,) [m, m, rad], unused in the first pair, and measurements.
            The time that this iterator takes is not counted.
        describe: Function that adapts measurements for the filter, given the predicted pose (3,), start frame.
    """
    path, odometry = np.zeros((len(times), 3)), np.zeros((len(times), 3))
    matched, created, rejected, seconds = 0, 0, 0, 0.0
    rejuvenations = RejuvenationCount()
    stages: list[tuple[int, LandmarkMap]] = []
    for step, (move, frame) in enumerate(steps):
        odometry[step] = move if step else 0.0
        started = time.perf_counter()
        adapted = None if frame is None else describe(frame, compose(slam.pose().mean, odometry[step]))
        report = slam.step([odometry[step] if step else None], [adapted])
        path[step] = slam.pose().mean
        seconds += time.perf_counter() - started
        matched += report.num_matched
        created += report.num_new
        rejected += report.num_rejected
        rejuvenations.add(report.rejuvenation)
        if is_stage(step, len(times)):
            stages.append((step, slam.map()))
        on_report(report)
        on_step((step + 1) / len(times))
    return OneReplay(
        times=times, path=path, reckoned=dead_reckoning(np.zeros(3), odometry[1:]), landmarks=slam.map(),
        stages=tuple(stages), matched=matched, created=created, rejected=rejected,
        rejuvenations=rejuvenations.to_mapping(),
        consistency=slam.consistency, seconds=seconds,
    )  # fmt: skip


def is_stage(step: int, num_steps: int) -> bool:
    """Return whether the map after a step is one of the at most `MOST_STAGES` + 1 maps for the playback."""
    return step == num_steps - 1 or step % math.ceil(num_steps / MOST_STAGES) == 0


def score_positions(points: FloatArray, truth: FloatArray, world_from_start: FloatArray) -> PositionScore:
    """Score estimated positions (n, 2) [m], start frame, against true ones (n, 2) [m], world frame.

    Args:
        world_from_start: (3,) float64 [m, m, rad]. Known pose of the start frame.
    """
    fit = align_se2(truth, points)
    raw, fitted = (np.hypot(*(transform_points(pose, points) - truth).T) for pose in (world_from_start, fit))
    return PositionScore(float(np.sqrt(np.mean(raw**2))), float(np.sqrt(np.mean(fitted**2))), fit, fitted)


def score_paths(paths: Iterable[FloatArray], truth: FloatArray) -> list[PositionScore]:
    """Score paths (T, 3), each in its own frame, against the true poses (n, 3) of the first n steps."""
    return [
        score_positions(path[: len(truth), :2], truth[:, :2], compose(truth[0], inverse(path[0]))) for path in paths
    ]


def end_errors(paths: Iterable[FloatArray], truth: FloatArray) -> list[float]:
    """Return the errors [m] of paths (T, 3) at the last of n true poses (n, 3), from the true start, not fitted."""
    last = len(truth) - 1
    ends = [compose(compose(truth[0], inverse(path[0])), path[last]) - truth[last] for path in paths]
    return [float(np.hypot(end[0], end[1])) for end in ends]


def path_length(path: FloatArray) -> float:
    """Return the length [m] of a path (T, 2) or (T, 3)."""
    return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())


def metrics_of(
    result: OneReplay, scores: tuple[PositionScore, PositionScore] | None, figures: Mapping[str, Any], **more: Any
) -> dict[str, Any]:
    """Return the content of `metrics.json`; unknown values are NaN, including errors of the map."""
    nan = float("nan")
    estimate, reckoned = ((nan, nan), (nan, nan)) if scores is None else ((s.aligned, s.start) for s in scores)
    return {
        "robots": [
            {
                "ate_aligned_m": estimate[0], "ate_start_m": estimate[1], "dead_reckoning_ate_aligned_m": reckoned[0],
                "dead_reckoning_ate_start_m": reckoned[1], "map_rmse_m": nan, "map_recall": nan, "map_precision": nan,
                "map_error": nan, "path_m": path_length(result.path), **figures,
            }
        ],
        "landmarks": len(result.landmarks), **more,
        "measurements": {"matched": result.matched, "created": result.created, "rejected": result.rejected},
        "rejuvenations": result.rejuvenations, "consistency": consistency_rows([1], [result.consistency]), "merges": [],
        "groups": [[1]], "coverage": nan, "duration_s": float(result.times[-1] - result.times[0]),
    }  # fmt: skip
