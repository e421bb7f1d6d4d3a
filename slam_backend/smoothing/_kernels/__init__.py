"""Compiled inner loops of the smoother: forms of sightings, normal equations, their factor, many paths at a time."""

from slam_backend.smoothing._kernels.coarse import coarsen
from slam_backend.smoothing._kernels.coarsening import look_at_keys
from slam_backend.smoothing._kernels.densities import normalise, weigh_deviations
from slam_backend.smoothing._kernels.drawing import draw
from slam_backend.smoothing._kernels.dropping import drop_unused
from slam_backend.smoothing._kernels.equations import form
from slam_backend.smoothing._kernels.factoring import covariance, factorise
from slam_backend.smoothing._kernels.forms import FREE, condense, seek_poses
from slam_backend.smoothing._kernels.gathering import count, gather
from slam_backend.smoothing._kernels.naming import rename, settle
from slam_backend.smoothing._kernels.ordering import lay_out, minimum_degree, neighbours
from slam_backend.smoothing._kernels.paths import LANES, POSE_ROWS, odometry_of_paths, replay, to_lanes
from slam_backend.smoothing._kernels.scattering import scatter_of_links
from slam_backend.smoothing._kernels.stepping import step
from slam_backend.smoothing._kernels.walking import look_up, take_in

__all__ = [
    "FREE", "LANES", "POSE_ROWS", "coarsen", "condense", "count", "covariance", "draw", "drop_unused", "factorise",
    "form", "gather", "lay_out", "look_at_keys", "look_up", "minimum_degree", "neighbours", "normalise",
    "odometry_of_paths", "rename", "replay", "scatter_of_links", "seek_poses", "settle", "step", "take_in", "to_lanes",
    "weigh_deviations",
]  # fmt: skip
