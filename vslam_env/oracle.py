"""The merge oracle: two groups that hold enough true landmarks in common get the true motion between their maps."""

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.geometry import between
from slam_backend.maps.alignment import Alignment

MIN_SHARED = 3
SIGMA = 1e-4  # [m, rad] what stands for certainty where a covariance is needed


def true_alignment(
    claims_a: IntArray, claims_b: IntArray, true_start_a: FloatArray, true_start_b: FloatArray
) -> Alignment | None:
    """Return the true alignment of two groups' maps, or None if they share fewer than three true landmarks.

    Args:
        claims_a: (n,) int64. True landmark of each row of map a, negative for none.
        claims_b: (m,) int64. Likewise of map b.
        true_start_a: (3,) [m, m, rad]. True start pose of a's first robot, whose start frame is the map frame.
        true_start_b: (3,) Likewise of b.
    """
    real_a, real_b = (np.where(claims >= 0, claims, -1 - np.arange(len(claims))) for claims in (claims_a, claims_b))
    # Of duplicates the first is taken; what is negative is unique in its map and must not match across maps.
    shared, rows_a, rows_b = np.intersect1d(real_a, real_b, return_indices=True)
    inliers = np.column_stack([rows_a, rows_b])[shared >= 0]
    if len(inliers) < MIN_SHARED:
        return None
    tx, ty, theta = between(true_start_a, true_start_b).tolist()
    return Alignment(True, "", tx, ty, theta, SIGMA**2 * np.eye(3), inliers, 0.0)
