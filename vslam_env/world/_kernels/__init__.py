"""Compiled geometry of sight: what rays hit, which landmarks cameras see, and whether they can be seen at all."""

from vslam_env.world._kernels.landmark_visibility import GROUP, detect, observable_anywhere, rows_in_view
from vslam_env.world._kernels.ray_casting import EPSILON, cast_scans, walls_in_wedge

__all__ = ["EPSILON", "GROUP", "cast_scans", "detect", "observable_anywhere", "rows_in_view", "walls_in_wedge"]
