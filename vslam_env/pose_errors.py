"""How far robots are from where they believe to be."""

import math

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray


@jit
def pose_errors(starts: FloatArray, estimated: FloatArray, true: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return how far estimated poses, laid at the true starts, are from the true ones.

    Args:
        starts: (K, 3) float64 [m, m, rad], world frame. True start poses.
        estimated: (K, 3) float64 [m, m, rad], own start frames.
        true: (K, 3) float64 [m, m, rad], world frame.

    Returns:
        (K,) float64 [m]: distances; (K,) float64 [rad]: differences of the headings in [0, pi].
    """
    distances, turns = np.empty(len(true)), np.empty(len(true))
    for k in range(len(true)):
        c, s = math.cos(starts[k, 2]), math.sin(starts[k, 2])
        dx = starts[k, 0] + c * estimated[k, 0] - s * estimated[k, 1] - true[k, 0]
        dy = starts[k, 1] + s * estimated[k, 0] + c * estimated[k, 1] - true[k, 1]
        turn = starts[k, 2] + estimated[k, 2] - true[k, 2]
        distances[k], turns[k] = math.hypot(dx, dy), abs((turn + math.pi) % (2.0 * math.pi) - math.pi)
    return distances, turns
