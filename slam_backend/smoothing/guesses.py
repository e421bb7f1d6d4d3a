"""`Guesses`: where a robot was thought to be, as a descent takes them to start from."""

from typing import NamedTuple

import numpy as np

from slam_backend.errors import FloatArray, IntArray
from slam_backend.smoothing._kernels import look_up


class Guesses(NamedTuple):
    """Poses of a robot after some steps.

    Attributes:
        steps: (n,) int64, ascending.
        poses: (n, 3) float64 [m, m, rad], map frame.
    """

    steps: IntArray
    poses: FloatArray

    @classmethod
    def none(cls) -> "Guesses":
        """Return those of a robot of which nobody says anything."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)))

    def with_later(self, steps: IntArray, poses: FloatArray) -> "Guesses":
        """Return these and others of later steps (m,), (m, 3)."""
        return Guesses(np.concatenate([self.steps, steps]), np.concatenate([self.poses, poses]))

    def after(self, step: int) -> "Guesses":
        """Return those of the steps after one; views."""
        first = self.steps.searchsorted(step, side="right")
        return Guesses(self.steps[first:], self.poses[first:])

    def at(self, steps: IntArray) -> FloatArray:
        """Return the poses (m, 3) after steps (m,), ascending; NaN where nobody says."""
        poses = np.empty((len(steps), 3))
        look_up(self.steps, self.poses, steps, poses)
        return poses
