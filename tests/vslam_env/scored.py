"""Scores of maps, asked for one team at a time."""

import numpy as np

from slam_backend.core.validation import FloatArray
from slam_backend.fastslam.relative_poses import Standpoints
from slam_backend.maps.landmark_map import TeamOutlines
from vslam_env.evaluation.map_scores import ClaimLedger
from vslam_env.evaluation.team_metrics import NUM_FIGURES, Standing


def standing_at(starts: FloatArray) -> Standpoints:
    """Return where robots with these starts (K, 3) stand: at the origin of their own frames, without doubt."""
    points = Standpoints(len(starts))
    points.poses.fill(0.0)
    points.beliefs.fill(0.0)
    points.starts[:] = starts
    return points


def scored(
    ledger: ClaimLedger, outlines: TeamOutlines, points: Standpoints, true_starts: FloatArray, true_poses: FloatArray
) -> Standing:
    """Return how a team stands of which nothing else is known."""
    robots = len(true_poses)
    figures, nothing = np.full((NUM_FIGURES, robots), np.nan), (0,) * robots
    ledger.score(outlines, points, true_starts, true_poses, figures)
    return Standing(figures.tolist(), (nothing, nothing), 0.0, 0, 0.0)
