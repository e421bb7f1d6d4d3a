"""Metrics of the accuracy of maps and paths, and of the consistency of their covariances."""

from slam_backend.metrics.consistency import anees, nees, nis
from slam_backend.metrics.maps import (
    GospaResult,
    MapErrorParts,
    MapScore,
    gospa,
    map_error,
    map_error_parts,
    map_rmse,
    ospa,
)
from slam_backend.metrics.paths import AteResult, RpeResult, align_se2, ate, rpe
from slam_backend.metrics.teams import RobotScore, TeamScore, match_times, score_team

__all__ = [
    "AteResult",
    "GospaResult",
    "MapErrorParts",
    "MapScore",
    "RobotScore",
    "RpeResult",
    "TeamScore",
    "align_se2",
    "anees",
    "ate",
    "gospa",
    "map_error",
    "map_error_parts",
    "map_rmse",
    "match_times",
    "nees",
    "nis",
    "ospa",
    "rpe",
    "score_team",
]
