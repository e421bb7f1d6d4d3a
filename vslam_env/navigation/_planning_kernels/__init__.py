"""The compiled searches over the known part of a grid: where a disc fits, the cheapest ways, frontiers, candidates."""

from vslam_env.navigation._planning_kernels.candidates import SAME_GOAL, fill_slots, pair_distances, update_slots
from vslam_env.navigation._planning_kernels.dijkstra import (
    UNREACHED,
    dijkstra,
    nearest_open,
    parents_of,
    shorten_path,
)
from vslam_env.navigation._planning_kernels.frontiers import HEADING, LENGTH, NUM_COLUMNS, SIZE, XY, compute_frontiers

__all__ = [
    "HEADING",
    "LENGTH",
    "NUM_COLUMNS",
    "SAME_GOAL",
    "SIZE",
    "UNREACHED",
    "XY",
    "compute_frontiers",
    "dijkstra",
    "fill_slots",
    "nearest_open",
    "pair_distances",
    "parents_of",
    "shorten_path",
    "update_slots",
]  # fmt: skip
