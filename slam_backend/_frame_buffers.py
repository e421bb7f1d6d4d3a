"""Working space of a filter's step: room for what becomes of the robots' measurements."""

import numpy as np
from numpy.typing import NDArray

from slam_backend import _kernels
from slam_backend._kernels import LANES
from slam_backend._map_store import aligned
from slam_backend.errors import FloatArray

MEASUREMENTS = 8  # of one robot for which there is room from the start
CANDIDATES = 64  # of one frame for which there is working space; more get their own each time


class FrameBuffers:
    """Arrays that are used again at each step.

    Args:
        num_robots: K.
        padded: P, number of particles rounded up to whole blocks.

    Attributes:
        found: (n', P) int32. Slot to which each particle gave each measurement, -1 = none.
        distances: (n', P) squared Mahalanobis distances of matches, else NaN.
        space: Of the kernels.
    """

    def __init__(self, num_robots: int, padded: int) -> None:
        self._padded = padded
        records = CANDIDATES * _kernels.CANDIDATE_ROWS
        self.space: FloatArray = aligned(((_kernels.WORK_ROWS + records) * LANES,), np.float64)
        self.make_room(MEASUREMENTS * num_robots)

    def make_room(self, most: int) -> None:
        """Provide for so many measurements in a step."""
        self.found: NDArray[np.int32] = np.zeros((most, self._padded), dtype=np.int32)
        self.distances: FloatArray = np.zeros((most, self._padded))
