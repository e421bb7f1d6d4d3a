"""Compiled inner loops of the smoother: forms of sightings, normal equations, their factor, many paths at a time."""

from slam_backend.smoother._kernels.factors import FREE, condense, sum_pose_information
from slam_backend.smoother._kernels.graph_reduction import drop_unused, recent_key_mask, reduce_keyframes
from slam_backend.smoother._kernels.keyframes import add_log, close_keyframe, find_initial_poses, rename
from slam_backend.smoother._kernels.marginal_covariances import scatter_of_links
from slam_backend.smoother._kernels.normal_equations import count, form, gather, step
from slam_backend.smoother._kernels.sampling import (
    LANES,
    POSE_ROWS,
    draw,
    normalise,
    odometry_log_density,
    replay,
    to_lanes,
    weigh_deviations,
)
from slam_backend.smoother._kernels.sparse_cholesky import covariance, factorise, lay_out, minimum_degree, neighbours

__all__ = [
    "FREE",
    "LANES",
    "POSE_ROWS",
    "add_log",
    "close_keyframe",
    "condense",
    "count",
    "covariance",
    "draw",
    "drop_unused",
    "factorise",
    "find_initial_poses",
    "form",
    "gather",
    "lay_out",
    "minimum_degree",
    "neighbours",
    "normalise",
    "odometry_log_density",
    "recent_key_mask",
    "reduce_keyframes",
    "rename",
    "replay",
    "scatter_of_links",
    "step",
    "sum_pose_information",
    "to_lanes",
    "weigh_deviations",
]  # fmt: skip
