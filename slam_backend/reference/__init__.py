"""The filter once more, written for readers: one particle, one landmark, one 3 x 3 matrix at a time.

`PlainFastSlam` decides and computes what `slam_backend.FastSlam` does, which is held against it, and is hundreds of
times slower.
"""

from slam_backend.reference.filter import PlainFastSlam

__all__ = ["PlainFastSlam"]
