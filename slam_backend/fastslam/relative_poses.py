"""`TeamPoses`: where the robots of a team believe themselves and each other to be, each in its own start frame."""

from functools import lru_cache

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray

# Columns of `TeamPoses.beliefs`: the first of three, three, one, nine, and of one for each robot of the team.
OWN, START, ESS, COVARIANCE, SIGMAS = 0, 3, 6, 7, 16


class TeamPoses:
    """What some robots of a team believe, each in its own start frame: a row for each of them.

    Of a robot out of contact others know where it was when contact was lost. The arrays begin unwritten.

    Args:
        num_rows: n, as a rule the K robots of the team.
        num_robots: K; None: n.

    Attributes:
        poses: (n, K, 3) float64 [m, m, rad]. Where each believes robot j to be; NaN if its filter does not know j.
        beliefs: (n, 16 + K) float64. All that follows, which are views of it: kernels pay for each array.
        own: (n, 3) float64 [m, m, rad]. Where each robot believes itself to be: also one of its `poses`.
        starts: (n, 3) float64 [m, m, rad]. The motion from the map frame of its filter to its own start frame, in the
            most probable particle.
        ess: (n,) float64. Effective sample size of its filter, as a share of M.
        covariances: (n, 3, 3) float64 [m, m, rad]. Of `own`.
        sigmas: (n, K) float64 [m]. One sigma of the positions of `poses`, averaged over directions; likewise.
    """

    __slots__ = ("beliefs", "covariances", "ess", "own", "poses", "sigmas", "starts")

    def __init__(self, num_rows: int, num_robots: int | None = None) -> None:
        known = num_rows if num_robots is None else num_robots
        self.__setstate__((np.empty((num_rows, known, 3)), np.empty((num_rows, SIGMAS + known))))

    def __getstate__(self) -> tuple[FloatArray, FloatArray]:
        """Return what copies begin with; their views are of their own beliefs."""
        return self.poses, self.beliefs

    def __setstate__(self, state: tuple[FloatArray, FloatArray]) -> None:
        """Hold poses and beliefs, and all views of these."""
        self.poses, self.beliefs = poses, beliefs = state
        self.own: FloatArray = beliefs[:, OWN : OWN + 3]
        self.starts: FloatArray = beliefs[:, START : START + 3]
        self.ess: FloatArray = beliefs[:, ESS]
        self.covariances: FloatArray = beliefs[:, COVARIANCE:SIGMAS].reshape(len(poses), 3, 3)
        self.sigmas: FloatArray = beliefs[:, SIGMAS:]


@lru_cache(maxsize=256)
def membership_table(robots: tuple[int, ...], live: tuple[int, ...]) -> IntArray:
    """Return the robots (n,) of a filter, and below each 1 if it goes by it, as kernels take them; only looked at."""
    return np.array([robots, [robot in live for robot in robots]], np.int64)
