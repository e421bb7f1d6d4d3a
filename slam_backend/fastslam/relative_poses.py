"""Relative pose estimates of the robots of a team, each robot's in its own start frame."""

from functools import lru_cache

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray

# Columns of `TeamPoses.beliefs`: the first of three, three, one, nine, and of one for each robot of the team.
OWN, START, ESS, COVARIANCE, SIGMAS = 0, 3, 6, 7, 16


class TeamPoses:
    """Pose estimates by some robots, each in its own start frame: a row for each of them.

    The pose of a robot out of contact is its last one before contact was lost. The arrays are initially unset.

    Args:
        num_rows: n, usually the K robots of the team.
        num_robots: K; None: n.

    Attributes:
        poses: (n, K, 3) float64 [m, m, rad]. Each robot's estimate of the pose of robot j; NaN if its filter lacks j.
        beliefs: (n, 16 + K) float64. Array of all the following views: kernels are faster with fewer arrays.
        own: (n, 3) float64 [m, m, rad]. Each robot's estimate of its own pose, also one of its `poses`.
        starts: (n, 3) float64 [m, m, rad]. Motion from the map frame of the robot's filter to its own start frame, in
            the most probable particle.
        ess: (n,) float64. Effective sample size of the robot's filter, as a share of M.
        covariances: (n, 3, 3) float64 [m, m, rad]. Covariances of `own`.
        sigmas: (n, K) float64 [m]. Standard deviations of the positions of `poses`, averaged over directions; NaN as
            there.
    """

    __slots__ = ("beliefs", "covariances", "ess", "own", "poses", "sigmas", "starts")

    def __init__(self, num_rows: int, num_robots: int | None = None) -> None:
        known = num_rows if num_robots is None else num_robots
        self.__setstate__((np.empty((num_rows, known, 3)), np.empty((num_rows, SIGMAS + known))))

    def __getstate__(self) -> tuple[FloatArray, FloatArray]:
        """Return the two arrays; the views of copies refer to their own arrays."""
        return self.poses, self.beliefs

    def __setstate__(self, state: tuple[FloatArray, FloatArray]) -> None:
        """Set the two arrays and all views."""
        self.poses, self.beliefs = poses, beliefs = state
        self.own: FloatArray = beliefs[:, OWN : OWN + 3]
        self.starts: FloatArray = beliefs[:, START : START + 3]
        self.ess: FloatArray = beliefs[:, ESS]
        self.covariances: FloatArray = beliefs[:, COVARIANCE:SIGMAS].reshape(len(poses), 3, 3)
        self.sigmas: FloatArray = beliefs[:, SIGMAS:]


@lru_cache(maxsize=256)
def membership_table(robots: tuple[int, ...], active_robots: tuple[int, ...]) -> IntArray:
    """Return the robots (n,) of a filter, and below each whether it uses it (1) or not (0), for kernels; shared."""
    return np.array([robots, [robot in active_robots for robot in robots]], np.int64)
