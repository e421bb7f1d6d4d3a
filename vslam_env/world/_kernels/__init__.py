"""Compiled geometry of sight: what rays hit, which landmarks cameras see, and whether they can be seen at all."""

from vslam_env.world._kernels.landmark_visibility import GROUP, detect, observable_anywhere
from vslam_env.world._kernels.ray_casting import EPSILON, cast_scans, walls_in_wedge
from vslam_env.world._kernels.uniform_stream import NO_STREAM, jump_table, stream_state

__all__ = [
    "EPSILON",
    "GROUP",
    "NO_STREAM",
    "cast_scans",
    "detect",
    "jump_table",
    "observable_anywhere",
    "stream_state",
    "walls_in_wedge",
]
