"""Image front end: 3-D points with descriptors from rectified stereo pairs."""

from slam_backend.frontend.corners import CornerOptions, Corners, grid_order, harris_corners
from slam_backend.frontend.descriptors import DESCRIPTOR_TYPES, DESCRIPTORS
from slam_backend.frontend.stereo import MATCH_CHECKS, FrontEndOptions, StereoFrame, StereoFrontEnd, StereoMatches
from slam_backend.frontend.usurf import usurf_descriptors

__all__ = [
    "DESCRIPTORS",
    "DESCRIPTOR_TYPES",
    "MATCH_CHECKS",
    "CornerOptions",
    "Corners",
    "FrontEndOptions",
    "StereoFrame",
    "StereoFrontEnd",
    "StereoMatches",
    "grid_order",
    "harris_corners",
    "usurf_descriptors",
]
