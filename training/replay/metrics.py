"""A replay is scored against the true paths and landmarks of its log."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import between, compose, inverse, transform_points, wrap_angle
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.metrics import MapScore, align_se2, ate, map_error, map_rmse
from slam_backend.readers.mrclam import MrclamLog
from slam_backend.trajectory import Trajectory
from training.episodes.attempt_tables import pair_rows
from training.episodes.consistency_table import consistency_rows
from training.episodes.metrics import merge_row
from training.replay.mrclam import Merge, Replay


@dataclass(frozen=True, slots=True, eq=False)
class PathScore:
    """One robot's path against the truth, where there is one.

    Attributes:
        known: (T,) bool. Steps at which the true pose is known.
        truth: (known steps, 3) float64 [m, m, rad], world frame.
        world_from_start: (3,) The start frame put at the true start pose.
        ate_start: [m] With that pose, without fitting.
        ate_aligned: [m] After SE(2) alignment of the whole path.
        world_from_path: (3,) That alignment.
        reckoned_start: [m] As `ate_start`, of dead reckoning.
        reckoned_aligned: [m] As `ate_aligned`, of dead reckoning.
        world_from_reckoned: (3,) Its alignment.
    """

    known: BoolArray
    truth: FloatArray
    world_from_start: FloatArray
    ate_start: float
    ate_aligned: float
    world_from_path: FloatArray
    reckoned_start: float
    reckoned_aligned: float
    world_from_reckoned: FloatArray


@dataclass(frozen=True, slots=True, eq=False)
class AlignedMap:
    """A map fitted to the true landmarks that its own claim to be.

    Attributes:
        world_from_map: (3,) float64 [m, m, rad]. The fit, over one landmark per true one: the one seen most.
        landmarks: The map in the world frame.
        claims: (N,) int64. Row in `MrclamLog.positions` of each landmark.
        score: RMS error, recall and precision after the fit, in the plane.
    """

    world_from_map: FloatArray
    landmarks: LandmarkMap
    claims: IntArray
    score: MapScore


def score_path(replay: Replay, robot: int, truth: Trajectory | None) -> PathScore | None:
    """Score the path of a robot, counted from 0; None if fewer than two of its steps have a true pose."""
    if truth is None:
        return None
    known = (replay.times >= truth.times[0]) & (replay.times <= truth.times[-1])
    if np.count_nonzero(known) < 2:
        return None
    true = truth.at(replay.times[known])
    paths = [values[robot][known] for values in (replay.paths, replay.reckoned)]
    starts = [compose(true[0], inverse(path[0])) for path in paths]
    errors = [ate(compose(start, path), true) for start, path in zip(starts, paths, strict=True)]
    fits = [align_se2(true[:, :2], path[:, :2]) for path in paths]
    return PathScore(
        known=known,
        truth=true,
        world_from_start=starts[0],
        ate_start=errors[0].start,
        ate_aligned=errors[0].aligned,
        world_from_path=fits[0],
        reckoned_start=errors[1].start,
        reckoned_aligned=errors[1].aligned,
        world_from_reckoned=fits[1],
    )


def align_to_truth(landmarks: LandmarkMap, claims: IntArray, log: MrclamLog) -> AlignedMap | None:
    """Fit a map with claims (N,), rows of `MrclamLog.positions`, to the true landmarks.

    Returns:
        The fitted map; None if it claims fewer than two different landmarks, or the log has no true ones.
    """
    if log.positions is None:
        return None
    by_count = np.argsort(-landmarks.counts, kind="stable")
    barcodes, first = np.unique(claims[by_count], return_index=True)
    if len(barcodes) < 2:
        return None
    most_seen = by_count[first]
    fit = align_se2(log.positions[barcodes], landmarks.means[most_seen, :2])
    moved = landmarks.moved(fit)
    return AlignedMap(fit, moved, claims, map_rmse(_flat(moved.means), _flat(log.positions), claims))


def merge_error(merge: Merge, log: MrclamLog) -> tuple[float, float] | None:
    """Return how far a merge's motion is off [m, rad]; None if one of the maps cannot be fitted to the truth.

    The true motion between two maps is that between their fits to the true landmarks. The true start poses do not
    give it, because each map is turned about its start by what its first steps got wrong.
    """
    fit_a = align_to_truth(merge.map_a, merge.claims_a, log)
    fit_b = align_to_truth(merge.map_b, merge.claims_b, log)
    if fit_a is None or fit_b is None:
        return None
    true = between(fit_a.world_from_map, fit_b.world_from_map)
    found = merge.event.alignment.transform
    middle = merge.map_b.means[:, :2].mean(axis=0)  # where the landmarks lie matters, not a far origin
    offset = transform_points(found, middle) - transform_points(true, middle)
    return float(np.hypot(*offset)), abs(float(wrap_angle(found[2] - true[2])))


def summarise(replay: Replay, log: MrclamLog, paths: Sequence[PathScore | None]) -> dict[str, Any]:
    """Return the content of `metrics.json`; what cannot be known is NaN.

    Robots carry the numbers of the log, in `robot`, `groups` and `merges` alike. `map_rmse_m` = `map_rmse_aligned_m`,
    `map_recall` and `map_precision` are after the best SE(2) fit of the map; `map_rmse_start_m` and `map_error` put the
    start frame at the true start pose, without any fitting.
    """
    numbers = [robot.robot for robot in log.robots]
    none = float("nan") if log.positions is None else 0.0  # share of the true landmarks that a map without a fit holds
    named = [[numbers[robot] for robot in group] for group in replay.groups]
    nan = float("nan")
    robots = []
    for robot, path in enumerate(paths):
        own_map, claims = replay.maps[robot], replay.claims[robot]
        aligned = align_to_truth(own_map, claims, log)
        start_error, start_rmse = _start_frame_errors(own_map, claims, path, log) if path else (nan, nan)
        robots.append(
            {
                "robot": numbers[robot],
                "ate_aligned_m": path.ate_aligned if path else nan,
                "ate_start_m": path.ate_start if path else nan,
                "dead_reckoning_ate_aligned_m": path.reckoned_aligned if path else nan,
                "dead_reckoning_ate_start_m": path.reckoned_start if path else nan,
                "map_rmse_m": aligned.score.rmse if aligned else nan,
                "map_rmse_aligned_m": aligned.score.rmse if aligned else nan,
                "map_rmse_start_m": start_rmse,
                "map_recall": aligned.score.recall if aligned else none,
                "map_precision": aligned.score.precision if aligned else none,
                "map_error": start_error,
            }
        )
    merges = []
    for merge in replay.merges:
        error = merge_error(merge, log)
        merges.append(
            merge_row(
                merge.event.step,
                merge.time,
                [numbers[robot] for robot in merge.event.robots_a],
                [numbers[robot] for robot in merge.event.robots_b],
                len(merge.event.alignment.inliers),
                error[0] if error else nan,
                float(np.rad2deg(error[1])) if error else nan,
                merge.undone,
            )
        )
    duration = float(replay.times[-1] - replay.times[0])
    return {
        "robots": robots, "merges": merges, "groups": named, "coverage": nan,
        "attempts": replay.attempts, "refusals": pair_rows(replay.pairs, replay.groups, numbers),
        "rejuvenations": replay.rejuvenations, "duration_s": duration,
        "notes": log.notes,
        "consistency": consistency_rows(numbers, replay.consistency),
    }  # fmt: skip


def _start_frame_errors(
    landmarks: LandmarkMap, claims: IntArray, path: PathScore, log: MrclamLog
) -> tuple[float, float]:
    """Return map error and RMSE [m] with the start frame at the true start pose, without fitting; NaN if unknown."""
    if log.positions is None:
        return float("nan"), float("nan")
    means, truths = _flat(landmarks.moved(path.world_from_start).means), _flat(log.positions)
    return map_error(means, claims, truths), map_rmse(means, truths, claims).rmse


def _flat(points: FloatArray) -> FloatArray:
    """Return points (n, 2) or (n, 3) as (n, 3) at height 0: the log knows no heights."""
    return np.column_stack([points[:, :2], np.zeros(len(points))])
