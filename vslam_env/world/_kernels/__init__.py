"""Compiled geometry of sight: what rays hit, which landmarks cameras see, and whether they can be seen at all."""

from vslam_env.world._kernels.landmark_visibility import choose_detected, detect, observable_anywhere, visible
from vslam_env.world._kernels.ray_casting import cast_scans, rays_at, walls_in_wedge

__all__ = ["cast_scans", "choose_detected", "detect", "observable_anywhere", "rays_at", "visible", "walls_in_wedge"]
