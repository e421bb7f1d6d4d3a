"""The compiled loops that write range readings, discs and other grids into the evidence of a `SeenGrid`."""

from vslam_env.navigation._grid_kernels.occupancy import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    MOST_CHANGES,
    OCCUPIED,
    UNKNOWN,
    Grid,
    merge_grid,
)
from vslam_env.navigation._grid_kernels.scan_update import NUM_PAINT_ROWS, update_from_scan
from vslam_env.navigation._grid_kernels.team_update import clear_disc, mark_bump, update_grids

__all__ = [
    "CELL",
    "FREE",
    "GRID_SIZE",
    "HALF_WIDTH",
    "MOST_CHANGES",
    "NUM_PAINT_ROWS",
    "OCCUPIED",
    "UNKNOWN",
    "Grid",
    "clear_disc",
    "mark_bump",
    "merge_grid",
    "update_from_scan",
    "update_grids",
]  # fmt: skip
