"""The compiled inner loops of map alignment: residuals of matches, the motion that fits them, the search for it."""

from slam_backend._alignment_kernels.fitting import (
    drop_unverified,
    gauss_newton_step,
    information,
    largest_influence,
    refine,
    unexplained,
)
from slam_backend._alignment_kernels.overlay import moved_share
from slam_backend._alignment_kernels.residuals import MATCH_COLUMNS, own_support, squared_distances
from slam_backend._alignment_kernels.search import search

__all__ = [
    "MATCH_COLUMNS", "drop_unverified", "gauss_newton_step", "information", "largest_influence", "moved_share",
    "own_support", "refine", "search", "squared_distances", "unexplained",
]  # fmt: skip
