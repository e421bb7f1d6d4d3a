"""Paths drawn straight about the mode are bent: scattered motion by motion, so that far ends swing on arcs.

Where headings are uncertain, the poses of a path scatter on a banana, which no Gaussian of coordinates is. What is
nearly Gaussian are the motions between poses (Long et al., The Banana Distribution Is Gaussian, RSS 2012).
"""

import math

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray, IntArray


@jit
def bend(mode: FloatArray, previous: IntArray, offsets: FloatArray) -> FloatArray:
    """Return paths (k, 3, M) whose motions differ from those of the mode as offsets say to first order.

    With r_b the first-order change of the motion from the previous pose a to b that the offsets of a and b make, and
    m_b the motion of the mode, a path is x_b = x_a * (m_b + r_b). Both steps, offsets to r and r to x, are triangular
    in the order of the keys with rotations on the diagonal: volumes, and so densities, stay as they are. Offsets of
    zero give the mode.

    Args:
        mode: (k, 3) [m, m, rad], map frame.
        previous: (k,) the key that each one's motion comes from, -1 where its pose is given. No circles.
        offsets: (k, 3, M) [m, m, rad] from the mode, map frame; zeros where a pose is given.
    """
    k, m = len(mode), offsets.shape[2]
    paths = np.empty(offsets.shape)
    is_done = np.zeros(k, dtype=np.bool_)
    line = np.empty(k, dtype=np.int64)
    for key in range(k):
        top, at = 0, key
        while at >= 0 and not is_done[at]:  # up to what is known, and back
            is_done[at] = True
            line[top] = at
            top += 1
            at = previous[at]
        for place in range(top - 1, -1, -1):
            b = line[place]
            a = previous[b]
            if a < 0:
                for i in range(m):
                    for axis in range(3):
                        paths[b, axis, i] = mode[b, axis] + offsets[b, axis, i]
                continue
            c, s = math.cos(mode[a, 2]), math.sin(mode[a, 2])
            dx, dy, turn = mode[b, 0] - mode[a, 0], mode[b, 1] - mode[a, 1], mode[b, 2] - mode[a, 2]
            ahead, left = c * dx + s * dy, c * dy - s * dx
            for i in range(m):
                ox, oy = offsets[b, 0, i] - offsets[a, 0, i], offsets[b, 1, i] - offsets[a, 1, i]
                own_ahead = ahead + c * ox + s * oy + left * offsets[a, 2, i]
                own_left = left + c * oy - s * ox - ahead * offsets[a, 2, i]
                cos, sin = math.cos(paths[a, 2, i]), math.sin(paths[a, 2, i])
                paths[b, 0, i] = paths[a, 0, i] + cos * own_ahead - sin * own_left  # (8), x
                paths[b, 1, i] = paths[a, 1, i] + sin * own_ahead + cos * own_left  # (8), y
                paths[b, 2, i] = paths[a, 2, i] + turn + offsets[b, 2, i] - offsets[a, 2, i]
    return paths
