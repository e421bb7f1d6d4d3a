"""The compiled loops that write range readings, discs and other grids into the evidence of a `SeenGrid`.

A grid comes as four arrays: `evidence` (300, 300) int8, `cells` (300, 300) uint8, which holds what the evidence says of
each cell, `changes`, which `occupancy.py` describes, and the `bounds` (4,) int32 of what is known. Rows go with y and
columns with x, and the start pose is the middle.
"""

from vslam_env.navigation._grid_kernels.occupancy import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    MOST_CHANGES,
    OCCUPIED,
    UNKNOWN,
    known_bounds,
    merge_grid,
)
from vslam_env.navigation._grid_kernels.scan_update import (
    directions_of,
    good_angles,
    good_ranges,
    scan_workspace,
    update_from_scan,
)
from vslam_env.navigation._grid_kernels.team_update import clear_disc, mark_bump, update_grids

__all__ = [
    "CELL",
    "FREE",
    "GRID_SIZE",
    "HALF_WIDTH",
    "MOST_CHANGES",
    "OCCUPIED",
    "UNKNOWN",
    "clear_disc",
    "directions_of",
    "good_angles",
    "good_ranges",
    "known_bounds",
    "mark_bump",
    "merge_grid",
    "scan_workspace",
    "update_from_scan",
    "update_grids",
]  # fmt: skip
