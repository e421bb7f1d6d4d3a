"""How far robots are from where they believe to be."""

import math

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray


@jit
def pose_errors(starts: FloatArray, estimated: FloatArray, true: FloatArray) -> FloatArray:
    """Return how far estimated poses, laid at the true starts, are from the true ones.

    Args:
        starts: (K, 3) float64 [m, m, rad], world frame. True start poses.
        estimated: (K, 3) float64 [m, m, rad], own start frames.
        true: (K, 3) float64 [m, m, rad], world frame.

    Returns:
        (K, 2) float64: distance [m], and difference of the headings in [0, pi] [rad].
    """
    errors = np.empty((len(true), 2))
    for k in range(len(true)):
        c, s = math.cos(starts[k, 2]), math.sin(starts[k, 2])
        dx = starts[k, 0] + c * estimated[k, 0] - s * estimated[k, 1] - true[k, 0]
        dy = starts[k, 1] + s * estimated[k, 0] + c * estimated[k, 1] - true[k, 1]
        turn = starts[k, 2] + estimated[k, 2] - true[k, 2]
        errors[k, 0], errors[k, 1] = math.hypot(dx, dy), abs((turn + math.pi) % (2.0 * math.pi) - math.pi)
    return errors
