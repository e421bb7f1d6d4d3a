"""The figures of an episode, by the names that `metrics.json` uses."""

from typing import Any

import numpy as np

from slam_backend.geometry import compose
from slam_backend.metrics import ate
from training.episode import EpisodeRecord


def score_episode(record: EpisodeRecord) -> dict[str, Any]:
    """Return the metrics of an episode.

    Per robot: `ate_aligned_m`, `ate_start_m` and the same of dead reckoning; `dead_reckoning_end_percent`, the error of
    its last position over the length of the path; `path_m`; the map's `map_error`, `map_rmse_m`, `map_recall`,
    `map_precision`, as the environment's infos give them. `team` holds the means over robots.

    Maps and `ate_start_m` are in each robot's own start frame, moved by its true start pose without any fitting.
    """
    robots = [_score_robot(record, robot) for robot in range(len(record.infos))]
    return {
        "robots": robots,
        "team": {key: float(np.mean([robot[key] for robot in robots])) for key in robots[0]},
        "merges": [
            {
                "time_s": merge.time,
                "tick": merge.tick,
                "robots_a": merge.robots_a,
                "robots_b": merge.robots_b,
                "inliers": merge.landmarks,
                "error_m": merge.error_m,
                "error_deg": merge.error_deg,
                "false": merge.is_false,
            }
            for merge in record.merges
        ],
        "attempts": record.attempts,
        "groups": record.groups,
        "coverage": float(record.coverage[-1]),
        "duration_s": float(record.times[-1]),
        "complete": record.complete,
    }


def _score_robot(record: EpisodeRecord, robot: int) -> dict[str, float]:
    """Return the figures of one robot."""
    truth, info = record.true_poses[robot], record.infos[robot]
    estimated, reckoned = (compose(truth[0], path[robot]) for path in (record.estimated, record.reckoned))
    own, odometry = ate(estimated, truth), ate(reckoned, truth)
    length = float(info["distance"])
    end_error = float(np.hypot(*(reckoned[-1] - truth[-1])[:2]))
    return {
        "ate_aligned_m": own.aligned,
        "ate_start_m": own.start,
        "dead_reckoning_ate_aligned_m": odometry.aligned,
        "dead_reckoning_ate_start_m": odometry.start,
        "dead_reckoning_end_percent": 100.0 * end_error / length if length > 0.0 else 0.0,
        "path_m": length,
        "map_rmse_m": float(info["map_rmse"]),
        "map_recall": float(info["map_recall"]),
        "map_precision": float(info["map_precision"]),
        "map_error": float(info["map_error"]),
    }
