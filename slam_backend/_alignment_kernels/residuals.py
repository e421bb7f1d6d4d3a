"""What a motion between two maps leaves of each match, in units of its covariance, and which matches it fits.

A table holds one row of 18 numbers for each candidate match: the position in map a (3), the position in map b (3), and
the upper triangles (xx, xy, xz, yy, yz, zz) of the covariances in a (6) and in b (6), each in its own frame.
"""

import math

import numpy as np

from slam_backend._jit import device, jit
from slam_backend.errors import BoolArray, FloatArray, IntArray

MATCH_COLUMNS = 18


@device
@jit
def residual(
    table: FloatArray, i: int, cos: float, sin: float, tx: float, ty: float, floor: float
) -> tuple[float, float, float, float, float, float]:
    """Return (D, rx, ry, wxx, wxy, wyy) of one candidate under p_a = R p_b + t.

    S = Sigma_a + R Sigma_b R^T + floor I. The height is eliminated first, so that a 2x2 system remains: (rx, ry) is
    the planar residual given the height's, w the inverse of its covariance, and D = r^T S^-1 r in all three axes.
    """
    rx = table[i, 0] - cos * table[i, 3] + sin * table[i, 4] - tx
    ry = table[i, 1] - sin * table[i, 3] - cos * table[i, 4] - ty
    rz = table[i, 2] - table[i, 5]
    bxx, bxy, bxz, byy, byz = table[i, 12], table[i, 13], table[i, 14], table[i, 15], table[i, 16]
    sxx = table[i, 6] + cos * cos * bxx - 2.0 * cos * sin * bxy + sin * sin * byy + floor  # Eqs. 16-17, corrected
    sxy = table[i, 7] + cos * sin * (bxx - byy) + (cos * cos - sin * sin) * bxy
    syy = table[i, 9] + sin * sin * bxx + 2.0 * cos * sin * bxy + cos * cos * byy + floor
    sxz = table[i, 8] + cos * bxz - sin * byz
    syz = table[i, 10] + sin * bxz + cos * byz
    wzz = 1.0 / (table[i, 11] + table[i, 17] + floor)
    kx, ky = sxz * wzz, syz * wzz
    rx -= kx * rz
    ry -= ky * rz
    sxx -= kx * sxz
    sxy -= kx * syz
    syy -= ky * syz
    scale = 1.0 / (sxx * syy - sxy * sxy)
    wxx, wxy, wyy = scale * syy, -scale * sxy, scale * sxx
    distance = rz * rz * wzz + wxx * rx * rx + 2.0 * wxy * rx * ry + wyy * ry * ry
    return distance, rx, ry, wxx, wxy, wyy


@jit
def squared_distances(table: FloatArray, pose: FloatArray, floor: float) -> FloatArray:
    """Return the squared Mahalanobis residuals (k,) of all candidates under `pose` (3,) = a_from_b."""
    cos, sin = math.cos(pose[2]), math.sin(pose[2])
    result = np.empty(len(table))
    for i in range(len(table)):
        result[i] = residual(table, i, cos, sin, pose[0], pose[1], floor)[0]
    return result


@device
@jit
def support(table: FloatArray, pose: FloatArray, floor: float, gate: float, members: BoolArray) -> tuple[int, float]:
    """Mark the candidates within `gate`; return their number and the score, sum of 1 - D / gate over them."""
    cos, sin, tx, ty = math.cos(pose[2]), math.sin(pose[2]), pose[0], pose[1]
    count, score = 0, 0.0
    for i in range(len(table)):
        members[i] = False
        rx = table[i, 0] - cos * table[i, 3] + sin * table[i, 4] - tx
        ry = table[i, 1] - sin * table[i, 3] - cos * table[i, 4] - ty
        # No direction's variance exceeds the traces' sum: most outliers are told by this alone.
        largest = table[i, 6] + table[i, 9] + table[i, 11] + table[i, 12] + table[i, 15] + table[i, 17] + floor
        if rx * rx + ry * ry <= gate * largest:
            distance = residual(table, i, cos, sin, tx, ty, floor)[0]
            if distance <= gate:
                members[i] = True
                count += 1
                score += 1.0 - distance / gate
    return count, score


@jit
def own_support(table: FloatArray, poses: FloatArray, claimed: BoolArray, floor: float, gate: float) -> IntArray:
    """Return how many candidates each of `poses` (h, 3) has within `gate`, those that are `claimed` (k,) left out."""
    found = np.zeros(len(poses), np.int64)
    members = np.zeros(len(table), np.bool_)
    rest = table[~claimed]
    for h in range(len(poses)):
        found[h] = support(rest, poses[h], floor, gate, members)[0]
    return found
