"""The filter once more, written for readers: one particle, one landmark, one 3 x 3 matrix at a time.

`ReferenceFastSlam` decides and computes what `slam_backend.FastSlam` does, which is held against it, and is hundreds of
times slower.
"""

from slam_backend.reference.filter import ReferenceFastSlam

__all__ = ["ReferenceFastSlam"]
