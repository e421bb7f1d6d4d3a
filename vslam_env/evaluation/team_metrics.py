"""Metrics of a team at one tick, computed from ground truth, and what rewards may read of its beliefs."""

from collections.abc import Sequence
from typing import Generic, NamedTuple, TypeVar

import numpy as np

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray

Row = TypeVar("Row", covariant=True)  # sequence of one number per robot


@short_repr
class RobotMetrics(NamedTuple, Generic[Row]):
    """Metrics of all robots, one row per metric; `score_team` writes the first eight, `Episode` the others."""

    map_errors: Row
    map_rmses: Row
    map_recalls: Row
    map_precisions: Row
    accurate_recalls: Row
    pose_errors: Row
    heading_errors: Row
    pose_sigmas: Row
    discovered: Row
    distances: Row
    error_integrals: Row
    own_recalls: Row


@short_repr
class RobotCounts(NamedTuple):
    """Counts of all robots; see `TeamMetrics`."""

    collisions: tuple[int, ...]
    bytes_sent: tuple[int, ...]


@short_repr
class BeliefSummary(NamedTuple):
    """Belief of a robot as far as reward terms may read it, with the true landmarks that it refers to; read-only.

    Attributes:
        pose_covariance: (3, 3) float64 [m, m, rad], own start frame. Covariance of the robot's pose.
        landmark_counts: (n,) int64. Number of measurements of each confirmed landmark of the robot's map.
        landmark_covariances: (n, 3, 3) float64 [m^2], map frame of the group. Covariances of the landmarks.
        landmark_claims: (n,) int64. True landmark that each one stands for, equal for duplicates; -1: a false point,
            -2: a landmark that is not scored.
    """

    pose_covariance: FloatArray
    landmark_counts: IntArray
    landmark_covariances: FloatArray
    landmark_claims: IntArray


@short_repr
class TeamMetrics(NamedTuple):
    """Metrics of a team at one tick, computed from ground truth.

    Attributes:
        per_robot: Metrics of each robot, row by row.
        counts: Counts of each robot since the reset.
        coverage: Share of the free floor seen by the team.
        merges: Number of merges since the reset.
        time: Simulated time since the reset [s].
        beliefs: Belief of each robot; empty unless a reward term reads beliefs, see `vslam_env.reward.RewardTerm`.
    """

    per_robot: RobotMetrics[Sequence[float]]
    counts: RobotCounts
    coverage: float
    merges: int
    time: float
    beliefs: tuple[BeliefSummary, ...] = ()

    @property
    def map_errors(self) -> FloatArray:
        """(K,) float64 [m]. Map error E of each robot."""
        return np.array(self.per_robot.map_errors)

    @property
    def map_rmses(self) -> FloatArray:
        """(K,) float64 [m]. RMSE of each robot's matched landmarks; the cutoff of the map error without a match."""
        return np.array(self.per_robot.map_rmses)

    @property
    def map_recalls(self) -> FloatArray:
        """(K,) float64. Share of the true landmarks in each robot's map, whatever their error."""
        return np.array(self.per_robot.map_recalls)

    @property
    def map_precisions(self) -> FloatArray:
        """(K,) float64. Share of the landmarks in each robot's map that are matched; of duplicates one counts."""
        return np.array(self.per_robot.map_precisions)

    @property
    def accurate_recalls(self) -> FloatArray:
        """(K,) float64. Share of the true landmarks in each robot's map with an error below 0.5 m."""
        return np.array(self.per_robot.accurate_recalls)

    @property
    def pose_errors(self) -> FloatArray:
        """(K,) float64 [m]. Position error of each robot."""
        return np.array(self.per_robot.pose_errors)

    @property
    def heading_errors(self) -> FloatArray:
        """(K,) float64 [rad]. Absolute heading error of each robot."""
        return np.array(self.per_robot.heading_errors)

    @property
    def pose_sigmas(self) -> FloatArray:
        """(K,) float64 [m]. Estimated one sigma of each robot's position in its own start frame."""
        return np.array(self.per_robot.pose_sigmas)

    @property
    def discovered(self) -> FloatArray:
        """(K,) float64. Share of the free floor that each robot was nearest to when the team first saw it."""
        return np.array(self.per_robot.discovered)

    @property
    def distances(self) -> FloatArray:
        """(K,) float64 [m]. True distance travelled by each robot since the reset."""
        return np.array(self.per_robot.distances)

    @property
    def error_integrals(self) -> FloatArray:
        """(K,) float64 [m s]. Time integral of each robot's map error E since the reset.

        Zeros unless the reward has the term `running_cost`, which requires scores at every tick.
        """
        return np.array(self.per_robot.error_integrals)

    @property
    def own_recalls(self) -> FloatArray:
        """(K,) float64. Share of the true landmarks that each robot was the first to hold well by its own measurement.

        See `RecallCredits`. Zeros unless the reward has the term `own_recall`.
        """
        return np.array(self.per_robot.own_recalls)

    @property
    def collisions(self) -> IntArray:
        """(K,) int64. Number of ticks since the reset in which each robot's motion was blocked."""
        return np.array(self.counts.collisions, np.int64)

    @property
    def bytes_sent(self) -> IntArray:
        """(K,) int64. Bytes sent by each robot since the reset."""
        return np.array(self.counts.bytes_sent, np.int64)
