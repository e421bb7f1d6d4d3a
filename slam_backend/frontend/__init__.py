"""The image front end: a rectified stereo pair becomes 3-D points with descriptors; no simulator inside."""

from slam_backend.frontend.usurf import usurf_descriptors

__all__ = ["usurf_descriptors"]
