"""`TeamMetrics`: how the team stands at one moment, as the simulator knows it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray

NUM_METRICS = 11
MAP_ERRORS, ACCURATE_RECALLS, POSE_SIGMAS, DISCOVERED, DISTANCES, ERROR_INTEGRALS = 0, 4, 7, 8, 9, 10  # rows of figures
COLLISIONS, BYTES_SENT = 0, 1  # rows of counts


class TeamMetrics(NamedTuple):
    """How the team stands.

    Attributes:
        table: (11, K). What the first properties return, row by row in their order; first those of
            `vslam_env.evaluation.map_scores.score_team`.
        counts: (2, K). What `collisions` and `bytes_sent` return.
        coverage: Share of the free floor that the team has seen.
        merges: Since the reset.
        time: Since the reset [s].
    """

    table: Sequence[Sequence[float]]
    counts: tuple[tuple[int, ...], tuple[int, ...]]
    coverage: float
    merges: int
    time: float

    @property
    def map_errors(self) -> FloatArray:
        """(K,) float64 [m]. E of each robot's map."""
        return np.array(self.table[MAP_ERRORS])

    @property
    def map_rmses(self) -> FloatArray:
        """(K,) float64 [m]. Of the landmarks that each holds; the cutoff of the map error where it holds none."""
        return np.array(self.table[1])

    @property
    def map_recalls(self) -> FloatArray:
        """(K,) float64. Share of the landmarks that each holds, wherever it has them."""
        return np.array(self.table[2])

    @property
    def map_precisions(self) -> FloatArray:
        """(K,) float64. Share of the landmarks in each map that are matched; of duplicates one is."""
        return np.array(self.table[3])

    @property
    def accurate_recalls(self) -> FloatArray:
        """(K,) float64. Share of the landmarks that each holds closer than 0.5 m to where they are."""
        return np.array(self.table[ACCURATE_RECALLS])

    @property
    def pose_errors(self) -> FloatArray:
        """(K,) float64 [m]."""
        return np.array(self.table[5])

    @property
    def heading_errors(self) -> FloatArray:
        """(K,) float64 [rad], at least 0."""
        return np.array(self.table[6])

    @property
    def pose_sigmas(self) -> FloatArray:
        """(K,) float64 [m]. One sigma of the position in its own start frame, as each believes."""
        return np.array(self.table[POSE_SIGMAS])

    @property
    def discovered(self) -> FloatArray:
        """(K,) float64. Share of the free floor that each was nearest to when the team first saw it."""
        return np.array(self.table[DISCOVERED])

    @property
    def distances(self) -> FloatArray:
        """(K,) float64 [m]. Way that each has gone since the reset."""
        return np.array(self.table[DISTANCES])

    @property
    def error_integrals(self) -> FloatArray:
        """(K,) float64 [m s]. E of each robot's map, summed over the ticks since the reset, times their length.

        Zeros unless the reward has the term `running_cost`: maps are then scored at every tick.
        """
        return np.array(self.table[ERROR_INTEGRALS])

    @property
    def collisions(self) -> IntArray:
        """(K,) int64. Ticks since the reset in which each robot was kept from moving as commanded."""
        return np.array(self.counts[COLLISIONS], np.int64)

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) int64. Since the reset."""
        return np.array(self.counts[BYTES_SENT], np.int64)
