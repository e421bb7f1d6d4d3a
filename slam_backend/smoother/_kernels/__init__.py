"""Compiled inner loops of the smoother: forms of sightings, normal equations, their factor, many paths at a time."""

from slam_backend.smoother._kernels.factors import FREE, condense, seek_poses
from slam_backend.smoother._kernels.graph_reduction import coarsen, drop_unused, look_at_keys
from slam_backend.smoother._kernels.keyframes import look_up, rename, settle, take_in
from slam_backend.smoother._kernels.marginal_covariances import scatter_of_links
from slam_backend.smoother._kernels.normal_equations import count, form, gather, step
from slam_backend.smoother._kernels.sampling import (
    LANES,
    POSE_ROWS,
    draw,
    normalise,
    odometry_of_paths,
    replay,
    to_lanes,
    weigh_deviations,
)
from slam_backend.smoother._kernels.sparse_cholesky import covariance, factorise, lay_out, minimum_degree, neighbours

__all__ = [
    "FREE", "LANES", "POSE_ROWS", "coarsen", "condense", "count", "covariance", "draw", "drop_unused", "factorise",
    "form", "gather", "lay_out", "look_at_keys", "look_up", "minimum_degree", "neighbours", "normalise",
    "odometry_of_paths", "rename", "replay", "scatter_of_links", "seek_poses", "settle", "step", "take_in", "to_lanes",
    "weigh_deviations",
]  # fmt: skip
