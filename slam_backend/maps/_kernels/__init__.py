"""The compiled inner loops of map alignment: residuals of matches, the motion that fits them, the search for it."""

from slam_backend.maps._kernels.match_table import mirrored, planar_points, planar_variances, table_of
from slam_backend.maps._kernels.overlap import moved_away
from slam_backend.maps._kernels.ransac import search
from slam_backend.maps._kernels.registration import (
    CHANCE_EXCESS,
    MEDIAN_CHI2_3,
    drop_unverified,
    gauss_newton_step,
    information,
    largest_influence,
    own_support,
    refine,
    squared_distances,
)

__all__ = [
    "CHANCE_EXCESS", "MEDIAN_CHI2_3", "drop_unverified", "gauss_newton_step", "information", "largest_influence",
    "mirrored", "moved_away", "own_support", "planar_points", "planar_variances", "refine", "search",
    "squared_distances", "table_of",
]  # fmt: skip
