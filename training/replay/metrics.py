"""Metrics of a replay against the true paths and landmarks of its log."""

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
from training.episodes.metrics import merge_row
from training.episodes.tables import consistency_rows, pair_rows
from training.replay.mrclam import Replay
from training.replay.truth_check import wrong_landmark_notes


@dataclass(frozen=True, slots=True, eq=False)
class PathScore:
    """Path of one robot against the true path, where it is known."""

    known: BoolArray  # (T,) bool. Steps at which the true pose is known.
    truth: FloatArray  # (known steps, 3) float64 [m, m, rad], world frame
    world_from_start: FloatArray  # (3,) True start pose
    ate_start: float  # ATE from the true start pose, without fitting [m]
    ate_aligned: float  # ATE after SE(2) alignment of the whole path [m]
    world_from_path: FloatArray  # (3,) Alignment of the path
    reckoned_start: float  # `ate_start` of dead reckoning [m]
    reckoned_aligned: float  # `ate_aligned` of dead reckoning [m]
    world_from_reckoned: FloatArray  # (3,) Alignment of dead reckoning


@dataclass(frozen=True, slots=True, eq=False)
class AlignedMap:
    """Map aligned to the true landmarks by its claims."""

    world_from_map: FloatArray  # (3,) float64 [m, m, rad]. Fit over the most-seen landmark of each true one.
    landmarks: LandmarkMap  # The map in the world frame
    claims: IntArray  # (N,) int64. Row in `MrclamLog.positions` of each landmark.
    score: MapScore  # RMS error, recall and precision after the fit, in the plane


def score_path(replay: Replay, robot: int, truth: Trajectory | None) -> PathScore | None:
    """Score the path of a robot, counted from 0; None if fewer than two steps have a true pose."""
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
        known=known, truth=true, world_from_start=starts[0], ate_start=errors[0].start, ate_aligned=errors[0].aligned,
        world_from_path=fits[0], reckoned_start=errors[1].start, reckoned_aligned=errors[1].aligned,
        world_from_reckoned=fits[1],
    )  # fmt: skip


def align_to_truth(landmarks: LandmarkMap, claims: IntArray, log: MrclamLog) -> AlignedMap | None:
    """Align a map with claims (N,), rows of `MrclamLog.positions`, to the true landmarks.

    Returns:
        The aligned map; None if it claims fewer than two different landmarks, or the log has no true ones.
    """
    if log.positions is None:
        return None
    barcodes, most_seen = _most_seen(landmarks, claims)
    if len(barcodes) < 2:
        return None
    fit = align_se2(log.positions[barcodes], landmarks.means[most_seen, :2])
    moved = landmarks.moved(fit)
    return AlignedMap(fit, moved, claims, map_rmse(_flat(moved.means), _flat(log.positions), claims))


def _most_seen(landmarks: LandmarkMap, claims: IntArray) -> tuple[IntArray, IntArray]:
    """Return the true landmarks (n,) that a map claims, ascending, and the index of the most-seen landmark of each."""
    by_count = np.argsort(-landmarks.counts, kind="stable")
    barcodes, first = np.unique(claims[by_count], return_index=True)
    return barcodes, by_count[first]


def truth_notes(replay: Replay, log: MrclamLog) -> tuple[str, ...]:
    """Return lines about true landmarks that contradict all others, in most of the groups' maps."""
    if log.positions is None:
        return ()
    maps = []
    for landmark_map, claims in ((replay.maps[group[0]], replay.claims[group[0]]) for group in replay.groups):
        barcodes, rows = _most_seen(landmark_map, claims)
        maps.append(dict(zip(barcodes.tolist(), landmark_map.means[rows], strict=True)))
    return tuple(wrong_landmark_notes(log.positions, maps, log.subjects.tolist()))


def motion_error(
    motion: FloatArray, maps: Sequence[LandmarkMap], claims: Sequence[IntArray], log: MrclamLog
) -> tuple[float, float] | None:
    """Return the errors of the transform between two maps [m, rad]; None if a map cannot be aligned to the truth.

    The true transform relates the fits of the two maps to the true landmarks. The true start poses do not define it,
    because errors of the first steps rotate each map about its start.
    """
    fits = [align_to_truth(held, named, log) for held, named in zip(maps, claims, strict=True)]
    if fits[0] is None or fits[1] is None:
        return None
    true = between(fits[0].world_from_map, fits[1].world_from_map)
    middle = maps[1].means[:, :2].mean(axis=0)  # the error is measured at the landmarks, not at a distant origin
    offset = transform_points(motion, middle) - transform_points(true, middle)
    return float(np.hypot(*offset)), abs(float(wrap_angle(motion[2] - true[2])))


def summarise(replay: Replay, log: MrclamLog, paths: Sequence[PathScore | None]) -> dict[str, Any]:
    """Return the content of `metrics.json`; unknown values are NaN.

    Robots have the numbers of the log in `robot`, `groups` and `merges`. `map_rmse_m` = `map_rmse_aligned_m`,
    `map_recall` and `map_precision` are after the best SE(2) fit of the map; `map_rmse_start_m` and `map_error` use the
    true start pose, without fitting.
    """
    numbers = [robot.robot for robot in log.robots]
    none = float("nan") if log.positions is None else 0.0  # recall of a map that cannot be aligned
    named = [[numbers[robot] for robot in group] for group in replay.groups]
    nan = float("nan")
    robots = []
    for robot, path in enumerate(paths):
        own_map, claims = replay.maps[robot], replay.claims[robot]
        aligned = align_to_truth(own_map, claims, log)
        start_error, start_rmse = _start_frame_errors(own_map, claims, path, log) if path else (nan, nan)
        rmse, recall, precision = nan, none, none
        if aligned:
            rmse, recall, precision = aligned.score.rmse, aligned.score.recall, aligned.score.precision
        robots.append({
            "robot": numbers[robot], "ate_aligned_m": path.ate_aligned if path else nan,
            "ate_start_m": path.ate_start if path else nan,
            "dead_reckoning_ate_aligned_m": path.reckoned_aligned if path else nan,
            "dead_reckoning_ate_start_m": path.reckoned_start if path else nan, "map_rmse_m": rmse,
            "map_rmse_aligned_m": rmse, "map_rmse_start_m": start_rmse, "map_recall": recall,
            "map_precision": precision, "map_error": start_error,
        })  # fmt: skip
    merges = []
    for merge in replay.merges:
        maps, named_by = (merge.map_a, merge.map_b), (merge.claims_a, merge.claims_b)
        error = motion_error(merge.event.alignment.transform, maps, named_by, log)
        one, other = ([numbers[robot] for robot in side] for side in (merge.event.robots_a, merge.event.robots_b))
        off = (error[0], float(np.rad2deg(error[1]))) if error else (nan, nan)
        shared = len(merge.event.alignment.inliers)
        merges.append(merge_row(merge.event.step, merge.time, one, other, shared, *off, merge.undone))
    duration = float(replay.times[-1] - replay.times[0])
    return {
        "robots": robots, "merges": merges, "groups": named, "coverage": nan,
        "attempts": replay.attempts, "refusals": pair_rows(replay.pairs, replay.groups, numbers),
        "rejuvenations": replay.rejuvenations, "duration_s": duration,
        "notes": (*log.notes, *truth_notes(replay, log)),
        "consistency": consistency_rows(numbers, replay.consistency),
    }  # fmt: skip


def _start_frame_errors(
    landmarks: LandmarkMap, claims: IntArray, path: PathScore, log: MrclamLog
) -> tuple[float, float]:
    """Return map error and RMSE [m] with the true start pose, without fitting; NaN if unknown."""
    if log.positions is None:
        return float("nan"), float("nan")
    means, truths = _flat(landmarks.moved(path.world_from_start).means), _flat(log.positions)
    return map_error(means, claims, truths), map_rmse(means, truths, claims).rmse


def _flat(points: FloatArray) -> FloatArray:
    """Return points (n, 2) or (n, 3) as (n, 3) with height 0: the log has no heights."""
    return np.column_stack([points[:, :2], np.zeros(len(points))])
