"""Credits of landmarks: which robot was the first of the team to hold each one well by its own measurement."""

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.state import BOOL, FLOAT64, Array, State


class RecallCredits:
    """Shares of the true landmarks that robots were the first to hold well by their own measurements.

    A landmark is credited once in an episode: to the robot whose own map holds it accurately when the map is scored and
    that measured it since the last score, in equal parts if there are several. Duplicates, false points and merges
    therefore earn no credit.

    Args:
        num_robots: Number of robots K.
        num_landmarks: Number of observable landmarks N.

    Attributes:
        shares: (K,) float64. Share of the observable landmarks credited to each robot.
    """

    STATE = State(
        shares=Array(FLOAT64, "K", 0.0, 1.0), credited=Array(BOOL, "LANDMARKS"), measured=Array(BOOL, "K LANDMARKS")
    )  # fmt: skip

    def __init__(self, num_robots: int, num_landmarks: int) -> None:
        self.shares: FloatArray = np.zeros(num_robots)
        self._credited = np.zeros(num_landmarks, np.bool_)
        self._measured = np.zeros((num_robots, num_landmarks), np.bool_)

    def record(self, robot: int, landmarks: IntArray) -> None:
        """Record the observable landmarks (n,) int64 that a robot measured; negative numbers are ignored."""
        self._measured[robot, landmarks[landmarks >= 0]] = True

    def update(self, accurate: BoolArray) -> None:
        """Credit landmarks.

        Args:
            accurate: (K, N) bool. True for landmarks that the map of the robot holds accurately.
        """
        first = accurate & self._measured & ~self._credited
        claimants = first.sum(axis=0)
        self.shares += (first / np.maximum(claimants, 1)).sum(axis=1) / len(self._credited)
        self._credited |= claimants > 0
        self._measured[:] = False
