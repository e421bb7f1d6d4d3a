"""Compiled inner loops of the smoother: forms of sightings, normal equations, their factor, many paths at a time."""

from slam_backend.smoother._kernels.factors import condense
from slam_backend.smoother._kernels.graph_reduction import add_sightings, merge_keys
from slam_backend.smoother._kernels.keyframes import add_keyframes
from slam_backend.smoother._kernels.normal_equations import form, step
from slam_backend.smoother._kernels.odometry_bias import condition_bias
from slam_backend.smoother._kernels.records import (
    BIAS,
    FREE,
    LEVER,
    NONE,
    CholeskyFactor,
    Condensed,
    EquationBlocks,
    Frames,
    Keys,
    LandmarkFactors,
    Landmarks,
    Log,
    Points,
    SymbolicFactor,
)
from slam_backend.smoother._kernels.sampling import (
    LANES,
    POSE_ROWS,
    draw,
    normalise,
    odometry_log_density,
    place_landmarks,
    replay,
    to_lanes,
    weigh_deviations,
)
from slam_backend.smoother._kernels.sparse_cholesky import covariance, factorise, lay_out

__all__ = [
    "BIAS",
    "FREE",
    "LANES",
    "LEVER",
    "NONE",
    "POSE_ROWS",
    "CholeskyFactor",
    "Condensed",
    "EquationBlocks",
    "Frames",
    "Keys",
    "LandmarkFactors",
    "Landmarks",
    "Log",
    "Points",
    "SymbolicFactor",
    "add_keyframes",
    "add_sightings",
    "condense",
    "condition_bias",
    "covariance",
    "draw",
    "factorise",
    "form",
    "lay_out",
    "merge_keys",
    "normalise",
    "odometry_log_density",
    "place_landmarks",
    "replay",
    "step",
    "to_lanes",
    "weigh_deviations",
]  # fmt: skip
