"""The compiled searches over the known part of a grid: where a disc fits, the cheapest ways, frontiers."""

from vslam_env.navigation._planning_kernels.costmap import PAD
from vslam_env.navigation._planning_kernels.dijkstra import (
    GOAL_CELLS,
    UNREACHED,
    dijkstra,
    nearest_open,
    part_within,
    shorten_path,
)
from vslam_env.navigation._planning_kernels.frontiers import FrontierColumns, frontiers_reached
from vslam_env.navigation._planning_kernels.path_lengths import lines_of_sight, path_lengths

__all__ = [
    "GOAL_CELLS",
    "PAD",
    "UNREACHED",
    "FrontierColumns",
    "dijkstra",
    "frontiers_reached",
    "lines_of_sight",
    "nearest_open",
    "part_within",
    "path_lengths",
    "shorten_path",
]  # fmt: skip
