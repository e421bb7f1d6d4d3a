"""How much of a map has left its place: laid over a later one by the motion on which most of its landmarks agree."""

import math

import numpy as np

from slam_backend.core.jit import jit
from slam_backend.core.validation import FloatArray
from slam_backend.maps._kernels.registration import squared_distances

FITS = 10  # rounds of fitting a rigid motion to the landmarks within the gate
OUTSIDE = 1e-3  # weight of those beyond it; never nothing: the fit stays defined


@jit
def moved_away(table: FloatArray, floor: float, gate: float) -> int:
    """Return how many landmarks lie beyond the gate at the rigid motion that those within it agree on.

    Args:
        table: (k, 18) landmarks of the map as it is now, a, and as it was, b.
        floor: Added to each variance [m^2].
        gate: Largest squared Mahalanobis residual [-].
    """
    inside = np.ones(len(table), np.bool_)
    outside = 0
    for _ in range(FITS):
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
        motion = np.array([ax - cos * bx + sin * by, ay - sin * bx - cos * by, angle])
        far = squared_distances(table, motion, floor) > gate
        outside = int(np.count_nonzero(far))
        if not np.any(far == inside):  # the next fit would be the same
            break
        inside = ~far
    return outside
