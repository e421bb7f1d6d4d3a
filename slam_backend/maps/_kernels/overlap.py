"""How much of a map has left its place: laid over a later one by the motion on which most of its landmarks agree."""

import math

import numpy as np

from slam_backend.core.jit import device, jit
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.maps._kernels.registration import squared_distances

FITS = 10  # rounds of fitting a rigid motion to the landmarks within the gate
OUTSIDE = 1e-3  # weight of those beyond it; never nothing: the fit stays defined


@jit
def deformed_fraction(
    means: FloatArray, covariances: FloatArray, ids: IntArray, old_means: FloatArray, old_covariances: FloatArray,
    old_ids: IntArray, least: int, floor: float, gate: float,
) -> float:  # fmt: skip
    """Return the share of the landmarks in both maps that lie beyond the gate at the motion that the others agree on.

    Args:
        means, covariances, ids: (n, 3), (n, 3, 3) and (n,): the map as it is now.
        old_means, old_covariances, old_ids: (m, 3), (m, 3, 3) and (m,): the map as it was.
        least: With fewer landmarks in both, 1 at least, the share is 0.
        floor: Added to each variance [m^2].
        gate: Largest squared Mahalanobis residual [-].
    """
    table = _matched(means, covariances, ids, old_means, old_covariances, old_ids)
    return 0.0 if len(table) < least else _moved_away(table, floor, gate) / len(table)


@device
@jit
def _matched(
    means: FloatArray, covariances: FloatArray, ids: IntArray, old_means: FloatArray, old_covariances: FloatArray,
    old_ids: IntArray,
) -> FloatArray:  # fmt: skip
    """Return the table (k, 18) of the landmarks that both maps hold, by ascending name; a is the map as it is now."""
    table = np.empty((min(len(ids), len(old_ids)), 18))
    order, old_order = np.argsort(ids), np.argsort(old_ids)
    k, i = 0, 0
    for old in old_order:
        while i < len(order) and ids[order[i]] < old_ids[old]:
            i += 1
        if i < len(order) and ids[order[i]] == old_ids[old]:
            _write(means[order[i]], covariances[order[i]], table[k, :3], table[k, 6:12])
            _write(old_means[old], old_covariances[old], table[k, 3:6], table[k, 12:])
            k += 1
    return table[:k]


@device
@jit
def _write(mean: FloatArray, covariance: FloatArray, place: FloatArray, packed: FloatArray) -> None:
    """Write a mean (3,), and the upper triangle (6,) of its covariance (3, 3)."""
    entry = 0
    for row in range(3):
        place[row] = mean[row]
        for column in range(row, 3):
            packed[entry] = covariance[row, column]
            entry += 1


@device
@jit
def _moved_away(table: FloatArray, floor: float, gate: float) -> int:
    """Return how many landmarks lie beyond the gate at the rigid motion that those within it agree on."""
    inside = np.ones(len(table), np.bool_)
    outside = 0
    for _ in range(FITS):
        far = squared_distances(table, _rigid_motion(table, inside), floor) > gate
        outside = int(np.count_nonzero(far))
        if not np.any(far == inside):  # the next fit would be the same
            break
        inside = ~far
    return outside


@device
@jit
def _rigid_motion(table: FloatArray, inside: BoolArray) -> FloatArray:
    """Return the planar motion (3,) = a_from_b of least squares, those not `inside` (k,) with hardly a weight."""
    whole, ax, ay, bx, by = 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(len(table)):
        weight = 1.0 if inside[i] else OUTSIDE
        whole += weight
        ax, ay = ax + weight * table[i, 0], ay + weight * table[i, 1]
        bx, by = bx + weight * table[i, 3], by + weight * table[i, 4]
    ax, ay, bx, by = ax / whole, ay / whole, bx / whole, by / whole
    along, across = 0.0, 0.0
    for i in range(len(table)):
        weight = 1.0 if inside[i] else OUTSIDE
        ux, uy, vx, vy = table[i, 3] - bx, table[i, 4] - by, table[i, 0] - ax, table[i, 1] - ay
        along += weight * (ux * vx + uy * vy)
        across += weight * (ux * vy - uy * vx)
    angle = math.atan2(across, along)
    cos, sin = math.cos(angle), math.sin(angle)
    return np.array([ax - cos * bx + sin * by, ay - sin * bx - cos * by, angle])
