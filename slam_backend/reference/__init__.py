"""Reference implementation of the filter: one particle, one landmark, one 3 x 3 matrix at a time.

`ReferenceFastSlam` makes the decisions and computes the numbers of `slam_backend.FastSlam`, which is tested against it,
and is hundreds of times slower.
"""

from slam_backend.reference.filter import ReferenceFastSlam

__all__ = ["ReferenceFastSlam"]
