"""The compiled loops that write range readings, discs and other grids into the evidence of a `SeenGrid`.

A grid comes as four arrays: `evidence` (300, 300) int8, `cells` (300, 300) uint8, which holds what the evidence says of
each cell, `changes`, which `evidence.py` describes, and the `bounds` (4,) int32 of what is known. Rows go with y and
columns with x, and the start pose is the middle.
"""

from vslam_env.navigation._painting_kernels.absorbing import paint_grid
from vslam_env.navigation._painting_kernels.bounds import known_bounds
from vslam_env.navigation._painting_kernels.evidence import (
    CELL,
    FREE,
    GRID_SIZE,
    HALF_WIDTH,
    MOST_CHANGES,
    OCCUPIED,
    UNKNOWN,
)
from vslam_env.navigation._painting_kernels.rays import good_angles, good_ranges
from vslam_env.navigation._painting_kernels.readings import paint_bump, paint_disc, paint_readings
from vslam_env.navigation._painting_kernels.scans import paint_scan, room_to_paint
from vslam_env.navigation._painting_kernels.surveys import directions_of

__all__ = [
    "CELL", "FREE", "GRID_SIZE", "HALF_WIDTH", "MOST_CHANGES", "OCCUPIED", "UNKNOWN", "directions_of", "good_angles",
    "good_ranges", "known_bounds", "paint_bump", "paint_disc", "paint_grid", "paint_readings",
    "paint_scan", "room_to_paint",
]  # fmt: skip
