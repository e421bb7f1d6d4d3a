"""The compiled searches over the known part of a grid: where a disc fits, the cheapest ways, frontiers, candidates."""

from vslam_env.navigation._planning_kernels.candidates import (
    SAME_GOAL,
    fill_slots,
    update_slots,
)
from vslam_env.navigation._planning_kernels.dijkstra import UNREACHED, dijkstra, nearest_open, shorten_path
from vslam_env.navigation._planning_kernels.frontiers import FrontierColumns, compute_frontiers
from vslam_env.navigation._planning_kernels.path_lengths import lines_of_sight, path_lengths

__all__ = [
    "SAME_GOAL",
    "UNREACHED",
    "FrontierColumns",
    "compute_frontiers",
    "dijkstra",
    "fill_slots",
    "lines_of_sight",
    "nearest_open",
    "path_lengths",
    "shorten_path",
    "update_slots",
]  # fmt: skip
