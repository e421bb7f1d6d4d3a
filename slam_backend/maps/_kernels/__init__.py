"""The compiled inner loops of map alignment: residuals of matches, the motion that fits them, the search for it."""

from slam_backend.maps._kernels.overlap import deformed_fraction
from slam_backend.maps._kernels.ransac import search
from slam_backend.maps._kernels.registration import (
    MATCH_COLUMNS,
    drop_unverified,
    gauss_newton_step,
    information,
    largest_influence,
    own_support,
    reduced_chi2,
    refine,
    squared_distances,
)

__all__ = [
    "MATCH_COLUMNS",
    "deformed_fraction",
    "drop_unverified",
    "gauss_newton_step",
    "information",
    "largest_influence",
    "own_support",
    "reduced_chi2",
    "refine",
    "search",
    "squared_distances",
]  # fmt: skip
