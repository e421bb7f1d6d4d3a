"""The compiled searches over the known part of a grid: where a disc fits, the cheapest ways, frontiers, candidates."""

from vslam_env.navigation._planning_kernels.candidates import (
    SAME_GOAL,
    fill_slots,
    update_slots,
)
from vslam_env.navigation._planning_kernels.dijkstra import (
    GOAL_CELLS,
    UNREACHED,
    dijkstra,
    nearest_open,
    part_within,
    shorten_path,
)
from vslam_env.navigation._planning_kernels.frontiers import FrontierColumns, compute_frontiers
from vslam_env.navigation._planning_kernels.path_lengths import lines_of_sight, path_lengths

__all__ = [
    "GOAL_CELLS",
    "SAME_GOAL",
    "UNREACHED",
    "FrontierColumns",
    "compute_frontiers",
    "dijkstra",
    "fill_slots",
    "lines_of_sight",
    "nearest_open",
    "part_within",
    "path_lengths",
    "shorten_path",
    "update_slots",
]  # fmt: skip
