"""The compiled inner loops of map alignment: residuals of matches, the motion that fits them, the search for it."""

from slam_backend.maps._kernels.overlap import moved_share
from slam_backend.maps._kernels.ransac import search
from slam_backend.maps._kernels.registration import (
    MATCH_COLUMNS,
    drop_unverified,
    gauss_newton_step,
    information,
    largest_influence,
    own_support,
    refine,
    squared_distances,
    unexplained,
)

__all__ = [
    "MATCH_COLUMNS", "drop_unverified", "gauss_newton_step", "information", "largest_influence", "moved_share",
    "own_support", "refine", "search", "squared_distances", "unexplained",
]  # fmt: skip
