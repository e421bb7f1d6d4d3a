"""`TeamMetrics`: metrics of a team at one moment, computed with the ground truth."""

from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray

Row = TypeVar("Row", covariant=True)  # of numbers, one for each robot


class RobotMetrics(NamedTuple, Generic[Row]):
    """Metrics of all robots, one row per metric, in the order in which they are written; see `TeamMetrics`."""

    map_errors: Row
    map_rmses: Row
    map_recalls: Row
    map_precisions: Row
    accurate_recalls: Row
    pose_errors: Row
    heading_errors: Row
    pose_sigmas: Row
    found: Row
    distances: Row
    error_integrals: Row


class RobotCounts(NamedTuple):
    """Counts of all robots; see `TeamMetrics`."""

    collisions: tuple[int, ...]
    bytes_sent: tuple[int, ...]


class TeamMetrics(NamedTuple):
    """Metrics of a team at one moment, computed with the ground truth.

    Attributes:
        per_robot: Metrics of each robot, row by row.
        counts: Counts of each robot since the reset.
        coverage: Share of the free floor that the team has seen.
        merges: Number of merges since the reset.
        time: Simulated time since the reset [s].
    """

    per_robot: RobotMetrics[Sequence[float]]
    counts: RobotCounts
    coverage: float
    merges: int
    time: float

    @property
    def map_errors(self) -> FloatArray:
        """(K,) float64 [m]. E of each robot's map."""
        return np.array(self.per_robot.map_errors)

    @property
    def map_rmses(self) -> FloatArray:
        """(K,) float64 [m]. Of the landmarks that each holds; the cutoff of the map error where it holds none."""
        return np.array(self.per_robot.map_rmses)

    @property
    def map_recalls(self) -> FloatArray:
        """(K,) float64. Share of the landmarks that each holds, wherever it has them."""
        return np.array(self.per_robot.map_recalls)

    @property
    def map_precisions(self) -> FloatArray:
        """(K,) float64. Share of the landmarks in each map that are matched; of duplicates one is."""
        return np.array(self.per_robot.map_precisions)

    @property
    def accurate_recalls(self) -> FloatArray:
        """(K,) float64. Share of the landmarks that each holds closer than 0.5 m to where they are."""
        return np.array(self.per_robot.accurate_recalls)

    @property
    def pose_errors(self) -> FloatArray:
        """(K,) float64 [m]."""
        return np.array(self.per_robot.pose_errors)

    @property
    def heading_errors(self) -> FloatArray:
        """(K,) float64 [rad], at least 0."""
        return np.array(self.per_robot.heading_errors)

    @property
    def pose_sigmas(self) -> FloatArray:
        """(K,) float64 [m]. One sigma of the position in its own start frame, as each believes."""
        return np.array(self.per_robot.pose_sigmas)

    @property
    def discovered(self) -> FloatArray:
        """(K,) float64. Share of the free floor that each was nearest to when the team first saw it."""
        return np.array(self.per_robot.found)

    @property
    def distances(self) -> FloatArray:
        """(K,) float64 [m]. Way that each has gone since the reset."""
        return np.array(self.per_robot.distances)

    @property
    def error_integrals(self) -> FloatArray:
        """(K,) float64 [m s]. E of each robot's map, summed over the ticks since the reset, times their length.

        Zeros unless the reward has the term `running_cost`: maps are then scored at every tick.
        """
        return np.array(self.per_robot.error_integrals)

    @property
    def collisions(self) -> IntArray:
        """(K,) int64. Ticks since the reset in which each robot was kept from moving as commanded."""
        return np.array(self.counts.collisions, np.int64)

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) int64. Since the reset."""
        return np.array(self.counts.bytes_sent, np.int64)
