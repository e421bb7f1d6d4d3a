"""The compiled loops that write range readings, discs and other grids into the evidence of an `OccupancyGrid`."""

from vslam_env.navigation._grid_kernels.occupancy import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    LARGEST_HALF_WIDTH,
    LARGEST_SIZE,
    MOST_CHANGES,
    OCCUPIED,
    UNKNOWN,
    Grid,
    cell_index,
    cells_to_middle,
    margin_of,
    merge_grid,
    reach_of_merge,
    widen_bounds,
)
from vslam_env.navigation._grid_kernels.scan_update import NUM_PAINT_ROWS, update_from_scan
from vslam_env.navigation._grid_kernels.team_update import clear_disc, mark_bump, update_grids

__all__ = [
    "CELL",
    "FREE",
    "GRID_SIZE",
    "HALF_WIDTH",
    "LARGEST_HALF_WIDTH",
    "LARGEST_SIZE",
    "MOST_CHANGES",
    "NUM_PAINT_ROWS",
    "OCCUPIED",
    "UNKNOWN",
    "Grid",
    "cell_index",
    "cells_to_middle",
    "clear_disc",
    "margin_of",
    "mark_bump",
    "merge_grid",
    "reach_of_merge",
    "update_from_scan",
    "update_grids",
    "widen_bounds",
]  # fmt: skip
