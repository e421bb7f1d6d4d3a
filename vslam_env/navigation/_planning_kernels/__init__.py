"""The compiled searches over the known part of a grid: where a disc fits, the cheapest ways, frontiers, candidates."""

from vslam_env.navigation._planning_kernels.candidates import SAME_GOAL, refill, renew, weigh_pairs
from vslam_env.navigation._planning_kernels.dijkstra import (
    UNREACHED,
    nearest_open,
    parents_of,
    straight_path,
    ways_over,
)
from vslam_env.navigation._planning_kernels.frontiers import HEADING, LENGTH, NUM_COLUMNS, SIZE, XY, frontiers_over

__all__ = [
    "HEADING", "LENGTH", "NUM_COLUMNS", "SAME_GOAL", "SIZE", "UNREACHED", "XY", "frontiers_over", "nearest_open",
    "parents_of", "refill", "renew", "straight_path", "ways_over", "weigh_pairs",
]  # fmt: skip
