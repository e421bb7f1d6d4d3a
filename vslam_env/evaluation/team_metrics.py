"""Metrics of a team at one tick, computed from ground truth, and what rewards may read of its beliefs."""

from collections.abc import Sequence
from typing import Any, Generic, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import FloatArray, IntArray

Row = TypeVar("Row", covariant=True)  # sequence of one number per robot


@short_repr
class RobotMetrics(NamedTuple, Generic[Row]):
    """Metrics of all robots, a row of one number per robot for each."""

    map_errors: Row
    """[m] Map error E of each robot."""
    map_rmses: Row
    """[m] RMSE of the matched landmarks; the cutoff of the map error without a match."""
    map_recalls: Row
    """Share of the true landmarks in each robot's map, whatever their error."""
    map_precisions: Row
    """Share of the landmarks in each map that are matched; of duplicates one counts."""
    accurate_recalls: Row
    """Share of the true landmarks in each robot's map with an error below 0.5 m."""
    pose_errors: Row
    """[m] Position error of each robot."""
    heading_errors: Row
    """[rad] Absolute heading error of each robot, in [0, pi]."""
    pose_sigmas: Row
    """[m] Estimated one sigma of each robot's position in its own start frame."""
    discovered: Row
    """Share of the free floor that each robot was nearest to when the team first saw it."""
    distances: Row
    """[m] True distance travelled by each robot since the reset."""
    error_integrals: Row
    """[m s] Time integral of each robot's map error E since the reset; zeros unless the reward has the term
    `running_cost`, which requires scores at every tick."""
    own_recalls: Row
    """Share of the true landmarks that each robot was the first to hold well by its own measurement, see
    `RecallCredits`; zeros unless the reward has the term `own_recall`."""


@short_repr
class RobotCounts(NamedTuple):
    """Counts of all robots since the reset."""

    collisions: tuple[int, ...]
    """Number of ticks since the reset in which each robot's motion was blocked."""
    bytes_sent: tuple[int, ...]
    """Bytes sent by each robot since the reset."""


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

    The rows of `RobotMetrics` (float64) and `RobotCounts` (int64) are attributes, too, as new arrays (K,):
    `metrics.map_errors`.

    Attributes:
        per_robot: Metrics of each robot, row by row.
        counts: Counts of each robot since the reset, row by row.
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

    def __getattr__(self, name: str) -> NDArray[Any]:
        """Return a row of the metrics or counts as an array (K,)."""
        for rows in (self.per_robot, self.counts):
            if name in rows._fields:
                return np.array(getattr(rows, name))
        raise AttributeError(f"TeamMetrics has no attribute {name!r}")
