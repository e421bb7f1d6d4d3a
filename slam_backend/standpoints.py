"""`Standpoints`: where the robots of a team believe themselves and each other to be, each in its own start frame."""

from functools import lru_cache
from typing import NamedTuple, Self

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray


class Standpoints(NamedTuple):
    """Arrays over the K robots of a team; row i is what robot i believes, in its own start frame.

    Of a robot out of contact others know where it was when contact was lost.

    Attributes:
        poses: (K, K, 3) float64 [m, m, rad]. Where robot i believes robot j to be; NaN if its filter does not know j.
        sigmas: (K, K) float64 [m]. One sigma of these positions, averaged over directions; likewise.
        own: (K, 3) float64 [m, m, rad]. Where each robot believes itself to be: the diagonal of `poses`.
        covariances: (K, 3, 3) float64 [m, m, rad]. Of these.
        starts: (K, 3) float64 [m, m, rad]. The motion from the map frame of its filter to its own start frame, in the
            most probable particle.
        ess: (K,) float64. Effective sample size of its filter, as a share of M.
    """

    poses: FloatArray
    sigmas: FloatArray
    own: FloatArray
    covariances: FloatArray
    starts: FloatArray
    ess: FloatArray

    @classmethod
    def unwritten(cls, num_robots: int) -> Self:
        """Return room for K robots."""
        k = num_robots
        shapes = (k, k, 3), (k, k), (k, 3), (k, 3, 3), (k, 3), (k,)
        return cls(*map(np.empty, shapes))


@lru_cache(maxsize=256)
def filter_rows(robots: tuple[int, ...], live: tuple[int, ...]) -> tuple[IntArray, BoolArray]:
    """Return the robots (n,) of a filter, and which of them (n,) go by it, as kernels take them."""
    rows = np.array(robots, np.int64), np.array([robot in live for robot in robots], np.bool_)
    for array in rows:
        array.setflags(write=False)
    return rows
