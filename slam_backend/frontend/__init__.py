"""The image front end: a rectified stereo pair becomes 3-D points with descriptors; no simulator inside."""

from slam_backend.frontend.corners import CornerOptions, Corners, harris_corners, spread_order
from slam_backend.frontend.descriptors import DESCRIPTORS, KINDS
from slam_backend.frontend.stereo import GUARDS, FrontEndOptions, StereoFrame, StereoFrontEnd, StereoMatches
from slam_backend.frontend.usurf import usurf_descriptors

__all__ = [
    "DESCRIPTORS",
    "GUARDS",
    "KINDS",
    "CornerOptions",
    "Corners",
    "FrontEndOptions",
    "StereoFrame",
    "StereoFrontEnd",
    "StereoMatches",
    "harris_corners",
    "spread_order",
    "usurf_descriptors",
]
