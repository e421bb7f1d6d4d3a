"""Metrics of a replay against the true paths and landmarks of its log."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import between, compose, inverse, transform_points, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.metrics import MapScore, align_se2, map_error, map_rmse
from slam_backend.trajectory import Trajectory
from training.episodes.metrics import merge_row
from training.episodes.tables import consistency_rows, pair_rows
from training.replay.core import Replay
from training.replay.log import Log

NAN = float("nan")
SEGMENTS = range(100, 801, 100)  # lengths of KITTI's segments [m], from every `SEGMENT_EVERY`th pose
SEGMENT_EVERY = 10
KNOWN_START = 30.0  # path length that determines the start heading [m] where only positions are known


@dataclass(frozen=True, slots=True, eq=False)
class PositionScore:
    """Errors of a path at n known positions."""

    start: float  # RMS distance from the known start pose, without fitting [m]
    aligned: float  # RMS distance [m] after the SE(2) alignment of the whole path
    world_from_start: FloatArray  # (3,) float64 [m, m, rad]. Known pose of the start frame.
    world_from_path: FloatArray  # (3,) float64 [m, m, rad]. Alignment of the path.
    errors: FloatArray  # (n,) float64 [m]. Distances after alignment.


@dataclass(frozen=True, slots=True, eq=False)
class PathScore:
    """Path of one robot against the true path, where it is known; pairs are (estimate, odometry)."""

    truth: FloatArray  # (n, 3) true poses [m, m, rad], or (n, 2) true positions [m], world frame
    at_truth: tuple[FloatArray, FloatArray]  # (n, 3) or (n, 2). Estimates of what is known.
    scores: tuple[PositionScore, PositionScore]

    @property
    def length(self) -> float:
        """Length of the true path [m]."""
        return path_length(self.truth)


@dataclass(frozen=True, slots=True, eq=False)
class AlignedMap:
    """Map aligned to the true landmarks by its claims."""

    world_from_map: FloatArray  # (3,) float64 [m, m, rad]. Fit over the most-seen landmark of each true one.
    landmarks: LandmarkMap  # The map in the world frame
    score: MapScore  # RMS error, recall and precision after the fit, in the plane


def paths_of(result: Replay, log: Log, robot: int, columns: int = 3) -> list[FloatArray]:
    """Return estimate and dead reckoning (T, columns), start frame, of the sensor whose true poses are known."""
    return [compose(each[robot], log.mount)[:, :columns] for each in (result.paths, result.reckoned)]


def true_poses(truth: Trajectory | FloatArray | None, times: FloatArray) -> FloatArray:
    """Return the true poses (T, 3) at some times (T,), exact at times of the truth; NaN where they are unknown."""
    poses = np.full((len(times), 3), np.nan)
    if isinstance(truth, Trajectory):
        known = (times >= truth.times[0]) & (times <= truth.times[-1])
        same = np.array_equal(times[known], truth.times[: np.count_nonzero(known)])
        poses[known] = truth.poses[: np.count_nonzero(known)] if same else truth.at(times[known])
    return poses


def score_path(result: Replay, log: Log, robot: int = 0) -> PathScore | None:
    """Score the path of a robot, counted from 0; None if fewer than two true poses or positions are known."""
    truth, paths = log.robots[robot].truth, paths_of(result, log, robot)
    if isinstance(truth, np.ndarray):
        rows = truth[(truth[:, 0] >= result.times[0]) & (truth[:, 0] <= result.times[-1])]
        known = rows[:, 1:]
        paths_then = [Trajectory(result.times, path).at(rows[:, 0])[:, :2] for path in paths]
    else:
        true = true_poses(truth, result.times)
        steps = np.flatnonzero(~np.isnan(true[:, 0]))
        known, paths_then = true[steps], [path[steps] for path in paths]
    if len(known) < 2:
        return None
    one, other = (score_positions(path, known) for path in paths_then)
    return PathScore(known, (paths_then[0], paths_then[1]), (one, other))


def score_positions(path: FloatArray, truth: FloatArray) -> PositionScore:
    """Score estimated poses (n, 3) or positions (n, 2) [m], start frame, against true ones, world frame.

    The start frame is known from the first pose, or else from a fit of the first 30 m to the positions.
    """
    points, known = path[:, :2], truth[:, :2]
    if truth.shape[1] == 3:
        start = compose(truth[0], inverse(path[0]))
    else:
        first = max(2, int(np.count_nonzero(travelled(points) <= KNOWN_START)))
        start = align_se2(known[:first], points[:first])
    fit = align_se2(known, points)
    raw, fitted = (np.hypot(*(transform_points(pose, points) - known).T) for pose in (start, fit))
    return PositionScore(float(np.sqrt(np.mean(raw**2))), float(np.sqrt(np.mean(fitted**2))), start, fit, fitted)


def path_length(path: FloatArray) -> float:
    """Return the length [m] of a path (T, 2) or (T, 3)."""
    return float(np.hypot(*np.diff(path[:, :2], axis=0).T).sum())


def travelled(points: FloatArray) -> FloatArray:
    """Return the length [m] of a path up to each of its points."""
    return np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(points[:, :2], axis=0).T))])


def mean_drift(path: FloatArray, truth: FloatArray) -> float:
    """Return the mean error of the estimated motion over segments of the true path, relative to their lengths.

    Segments have 100, 200, ..., 800 m, with equal weights (Geiger, Lenz, Urtasun, CVPR 2012).

    Args:
        path: (n, 3) float64 [m, m, rad], any frame. Estimated poses.
        truth: (n, 3) float64 [m, m, rad], any frame. True poses.

    Returns:
        The relative error; NaN if the true path is shorter than 100 m.
    """
    driven = travelled(truth)
    errors = [np.empty(0)]
    for length in SEGMENTS:
        first = np.arange(0, len(truth), SEGMENT_EVERY)
        last = np.searchsorted(driven, driven[first] + length)
        first, last = first[last < len(truth)], last[last < len(truth)]
        off = between(between(truth[first], truth[last]), between(path[first], path[last]))
        errors.append(np.hypot(off[:, 0], off[:, 1]) / length)
    errors_together = np.concatenate(errors)
    return float(errors_together.mean()) if len(errors_together) else NAN


def align_to_truth(landmarks: LandmarkMap, claims: IntArray, truth: FloatArray | None) -> AlignedMap | None:
    """Align a map with claims (N,), rows of the true positions (m, 2), to them.

    Returns:
        The aligned map; None if it claims fewer than two different landmarks, or the true ones are unknown.
    """
    if truth is None:
        return None
    named, rows = most_seen(landmarks, claims)
    if len(named) < 2:
        return None
    fit = align_se2(truth[named], landmarks.means[rows, :2])
    moved = landmarks.moved(fit)
    return AlignedMap(fit, moved, map_rmse(_flat(moved.means), _flat(truth), claims))


def most_seen(landmarks: LandmarkMap, claims: IntArray) -> tuple[IntArray, IntArray]:
    """Return the true landmarks (n,) that a map claims, ascending, and the index of the most-seen landmark of each."""
    by_count = np.argsort(-landmarks.counts, kind="stable")
    by_count = by_count[claims[by_count] >= 0]
    named, first = np.unique(claims[by_count], return_index=True)
    return named, by_count[first]


def motion_error(
    motion: FloatArray, maps: Sequence[LandmarkMap], claims: Sequence[IntArray], truth: FloatArray | None
) -> tuple[float, float] | None:
    """Return the errors of the transform between two maps [m, rad]; None if a map cannot be aligned to the truth.

    The true transform relates the fits of the two maps to the true landmarks. The true start poses do not define it,
    because errors of the first steps rotate each map about its start.
    """
    fits = [align_to_truth(own, named, truth) for own, named in zip(maps, claims, strict=True)]
    if fits[0] is None or fits[1] is None:
        return None
    true = between(fits[0].world_from_map, fits[1].world_from_map)
    middle = maps[1].means[:, :2].mean(axis=0)  # the error is measured at the landmarks, not at a distant origin
    offset = transform_points(motion, middle) - transform_points(true, middle)
    return float(np.hypot(*offset)), abs(float(wrap_angle(motion[2] - true[2])))


def summarise(result: Replay, log: Log, scores: Sequence[PathScore | None]) -> dict[str, Any]:
    """Return the content of `metrics.json`; unknown values are NaN.

    Robots have the numbers of the log in `robot`, `groups` and `merges`. `map_rmse_m` = `map_rmse_aligned_m`,
    `map_recall` and `map_precision` are after the best SE(2) fit of the map; `map_rmse_start_m` and `map_error` use the
    true start pose, without fitting.
    """
    numbers = [robot.number for robot in log.robots]
    merges = []
    for merge in result.merges:
        error = motion_error(merge.event.alignment.transform, merge.maps, merge.claims, log.landmarks)
        one, other = ([numbers[robot] for robot in side] for side in (merge.event.robots_a, merge.event.robots_b))
        off = (error[0], float(np.rad2deg(error[1]))) if error else (NAN, NAN)
        shared = len(merge.event.alignment.inliers)
        merges.append(merge_row(merge.event.step, merge.time, one, other, shared, *off, merge.undone))
    return {
        "robots": [
            {"robot": numbers[robot]} | _path_metrics(score) | _map_metrics(result, log, robot, score)
            | {"path_m": path_length(result.paths[robot])} | _end_metrics(score)
            for robot, score in enumerate(scores)
        ],
        "merges": merges, "groups": [[numbers[robot] for robot in group] for group in result.groups], "coverage": NAN,
        "attempts": result.attempts, "refusals": pair_rows(result.pairs, result.groups, numbers),
        "landmarks": sum(len(result.maps[group[0]]) for group in result.groups), "measurements": result.measurements,
        "rejuvenations": result.rejuvenations, "duration_s": float(result.times[-1] - result.times[0]),
        "notes": log.notes,
        "set_up": [
            {"robot": number, "cause": cause.name, "text": cause.text, "ratio": cause.ratio}
            for number, causes in zip(numbers, result.causes, strict=True)
            for cause in causes
        ],
        "consistency": consistency_rows(numbers, result.consistency),
    }  # fmt: skip


def _path_metrics(score: PathScore | None) -> dict[str, float]:
    """Return the errors of path and dead reckoning."""
    pairs = [(NAN, NAN)] * 2 if score is None else [(own.aligned, own.start) for own in score.scores]
    names = ("ate", pairs[0]), ("dead_reckoning_ate", pairs[1])
    return {
        f"{name}_{end}_m": value for name, pair in names for end, value in zip(("aligned", "start"), pair, strict=True)
    }


def _end_metrics(score: PathScore | None) -> dict[str, float]:
    """Return the errors at the last true pose, from the true start, without fitting, and the drifts."""
    length, ends, drifts = NAN, [NAN, NAN], [NAN, NAN]
    if score is not None and score.truth.shape[1] == 3:
        length, truth = score.length, score.truth
        starts = [compose(truth[0], inverse(path[0])) for path in score.at_truth]
        gaps = [compose(start, path[-1]) - truth[-1] for start, path in zip(starts, score.at_truth, strict=True)]
        ends = [float(np.hypot(gap[0], gap[1])) for gap in gaps]
        drifts = [mean_drift(path, truth) for path in score.at_truth]
    return {
        "true_path_m": length, "end_error_m": ends[0], "end_error_percent": 100.0 * ends[0] / (length or NAN),
        "dead_reckoning_end_error_m": ends[1], "mean_drift": drifts[0], "dead_reckoning_mean_drift": drifts[1],
    }  # fmt: skip


def _map_metrics(result: Replay, log: Log, robot: int, score: PathScore | None) -> dict[str, float]:
    """Return the errors of the map of a robot's group, after a fit and from the true start pose."""
    own, claims, truth = result.maps[robot], result.claims[robot], log.landmarks if log.has_identities else None
    none = NAN if truth is None else 0.0  # recall of a map that cannot be aligned
    error, start_rmse, rmse, recall, precision = NAN, NAN, NAN, none, none
    if aligned := align_to_truth(own, claims, truth):
        rmse, recall, precision = aligned.score.rmse, aligned.score.recall, aligned.score.precision
    if score is not None and truth is not None:
        means, truths = _flat(own.moved(score.scores[0].world_from_start).means), _flat(truth)
        error, start_rmse = map_error(means, claims, truths), map_rmse(means, truths, claims).rmse
    return {
        "map_rmse_m": rmse, "map_rmse_aligned_m": rmse, "map_rmse_start_m": start_rmse, "map_recall": recall,
        "map_precision": precision, "map_error": error,
    }  # fmt: skip


def _flat(points: FloatArray) -> FloatArray:
    """Return points (n, 2) or (n, 3) as (n, 3) with height 0: the log has no heights."""
    return np.column_stack([points[:, :2], np.zeros(len(points))])
