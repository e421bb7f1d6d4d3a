"""The compiled loops over what a camera sees on a grid: looks at walls, gains of views, candidates, and pictures."""

from vslam_env.navigation._view_kernels.features import NUM_DESCRIBED, describe_candidates, write_goals
from vslam_env.navigation._view_kernels.global_picture import (
    COARSE,
    NUM_COARSE,
    write_global_grid,
    write_global_grids,
)
from vslam_env.navigation._view_kernels.looks import MOST_LOOKS, paint_looks
from vslam_env.navigation._view_kernels.renewal import renew_candidates
from vslam_env.navigation._view_kernels.view_gains import NUM_GAINS

__all__ = [
    "COARSE",
    "MOST_LOOKS",
    "NUM_COARSE",
    "NUM_DESCRIBED",
    "NUM_GAINS",
    "describe_candidates",
    "paint_looks",
    "renew_candidates",
    "write_global_grid",
    "write_global_grids",
    "write_goals",
]  # fmt: skip
