"""Metrics of an episode, with the names used in `metrics.json`."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from slam_backend.geometry import compose, transform_points
from slam_backend.metrics import align_se2, ate, map_rmse
from training.episodes.runner import EpisodeRecord, is_false_merge
from training.episodes.tables import consistency_rows, pair_rows


def score_episode(record: EpisodeRecord) -> dict[str, Any]:
    """Return the metrics of an episode.

    Per robot: `ate_aligned_m`, `ate_start_m` and the same for dead reckoning; `dead_reckoning_end_percent`, its final
    position error relative to the path length; `path_m`; the `map_error`, `map_rmse_m`, `map_recall` and
    `map_precision` of the map, as in the environment's infos; `map_rmse_start_m`, equal to `map_rmse_m`; and
    `map_rmse_aligned_m`, the RMSE after the best SE(2) fit of the matched landmarks, NaN if there are fewer than two.
    `team` has the means over the robots for which a metric is known.

    All metrics except the aligned ones use each robot's start frame, placed by its true start pose without fitting.
    (In a replay, `map_rmse_m`, `map_recall` and `map_precision` are after the fit.) Robots count from 0.
    """
    robots = [_score_robot(record, robot) for robot in range(len(record.infos))]
    return {
        "robots": robots, "team": {key: _mean([robot[key] for robot in robots]) for key in robots[0] if key != "robot"},
        "merges": [
            merge_row(
                merge.tick, merge.time, merge.robots_a, merge.robots_b, merge.landmarks, merge.error_m, merge.error_deg,
                merge.undone,
            )
            for merge in record.merges
        ],
        "attempts": record.attempts, "refusals": pair_rows(record.pairs, record.groups), "groups": record.groups,
        "coverage": float(record.coverage[-1]), "duration_s": float(record.times[-1]), "complete": record.complete,
        "consistency": consistency_rows(range(len(robots)), record.consistency),
    }  # fmt: skip


def merge_row(
    step: int, time: float, robots_a: Sequence[int], robots_b: Sequence[int], landmarks: int, error_m: float,
    error_deg: float, undone: float | None,
) -> dict[str, Any]:  # fmt: skip
    """Return one entry of `merges`, the same for runs and replays.

    `step` counts filter steps, which are the ticks of a run; `landmarks` is the number of shared landmarks; `false` is
    None if the errors are NaN, `undone_s` is None if the merge was not undone.
    """
    return {
        "step": step, "time_s": round(time, 3), "robots_a": list(robots_a), "robots_b": list(robots_b),
        "landmarks": landmarks, "error_m": error_m, "error_deg": error_deg,
        "false": is_false_merge(error_m, error_deg) if np.isfinite(error_m) else None,
        "undone_s": None if undone is None else round(undone, 3),
    }  # fmt: skip


def _mean(values: list[float]) -> float:
    """Return the mean of the finite values, NaN if there are none."""
    known = [value for value in values if np.isfinite(value)]
    return float(np.mean(known)) if known else float("nan")


def _aligned_rmse(record: EpisodeRecord, robot: int) -> float:
    """Return the RMS error [m] of the matched landmarks of a map after their best SE(2) fit."""
    means, truths = record.maps[robot].moved(record.true_poses[robot, 0]).means, record.true_landmarks
    claims = record.map_claims[robot]
    estimates, matches = map_rmse(means, truths, claims=claims).matched.T
    if len(estimates) < 2:
        return float("nan")
    fit = align_se2(truths[matches, :2], means[estimates, :2])
    return float(np.sqrt(np.mean(np.sum((transform_points(fit, means[estimates]) - truths[matches]) ** 2, axis=1))))


def _score_robot(record: EpisodeRecord, robot: int) -> dict[str, float]:
    """Return the metrics of one robot."""
    truth, info = record.true_poses[robot], record.infos[robot]
    estimated, reckoned = (compose(truth[0], path[robot]) for path in (record.estimated, record.reckoned))
    own, odometry = ate(estimated, truth), ate(reckoned, truth)
    length = float(info["distance"])
    end_error = float(np.hypot(*(reckoned[-1] - truth[-1])[:2]))
    return {
        "robot": robot, "ate_aligned_m": own.aligned, "ate_start_m": own.start,
        "dead_reckoning_ate_aligned_m": odometry.aligned, "dead_reckoning_ate_start_m": odometry.start,
        "dead_reckoning_end_percent": 100.0 * end_error / length if length > 0.0 else 0.0, "path_m": length,
        "map_rmse_m": float(info["map_rmse"]), "map_rmse_start_m": float(info["map_rmse"]),
        "map_rmse_aligned_m": _aligned_rmse(record, robot), "map_recall": float(info["map_recall"]),
        "map_precision": float(info["map_precision"]), "map_error": float(info["map_error"]),
    }  # fmt: skip
