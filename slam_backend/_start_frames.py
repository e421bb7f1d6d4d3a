"""The compiled change of frame of all particles' poses: from the map frame to where the robot started in each."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray

AT_ORIGIN, KNOWN, SPREAD = 0, 1, 2  # what starts of particles can be


@jit
def start_kind(starts: Any, count: int, best: int, start: Any) -> int:
    """Tell whether the starts (3, P) of `count` particles are all the origin, all the same, or differ.

    The start of particle `best` is written to `start` (3,).
    """
    at_origin = same = True
    for axis in range(3):
        start[axis] = starts[axis, best]
        for m in range(count):
            at_origin &= starts[axis, m] == 0.0
            same &= starts[axis, m] == starts[axis, 0]
    return AT_ORIGIN if at_origin else KNOWN if same else SPREAD


@jit
def seen_from_starts(starts: Any, means: Any, covariances: Any, count: int) -> tuple[FloatArray, FloatArray]:
    """Return each particle's pose estimate as seen from its own start pose.

    Args:
        starts: (3, P) float64 [m, m, rad], map frame. Where the robot started in each particle.
        means: (3, P) float64 [m, m, rad], map frame.
        covariances: (6, P) float64: xx, xy, xt, yy, yt, tt of each, map frame.
        count: Particles; the lanes beyond mean nothing.

    Returns:
        Means (3, P) and covariances (6, P) in the start frames, zeros beyond `count`.
    """
    seen, spread = np.zeros(means.shape), np.zeros(covariances.shape)
    for m in range(count):
        c, s = math.cos(starts[2, m]), math.sin(starts[2, m])
        dx, dy = means[0, m] - starts[0, m], means[1, m] - starts[1, m]
        seen[0, m], seen[1, m] = c * dx + s * dy, c * dy - s * dx
        seen[2, m] = (means[2, m] - starts[2, m] + math.pi) % (2.0 * math.pi) - math.pi
        xx, xy, yy = covariances[0, m], covariances[1, m], covariances[3, m]
        spread[0, m] = c * c * xx + 2.0 * c * s * xy + s * s * yy
        spread[1, m] = c * s * (yy - xx) + (c * c - s * s) * xy
        spread[3, m] = s * s * xx - 2.0 * c * s * xy + c * c * yy
        spread[2, m] = c * covariances[2, m] + s * covariances[4, m]
        spread[4, m] = c * covariances[4, m] - s * covariances[2, m]
        spread[5, m] = covariances[5, m]
    return seen, spread
