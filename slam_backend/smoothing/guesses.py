"""`Guesses`: where a robot was thought to be, as a descent takes them to start from."""

from typing import NamedTuple

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray, IntArray


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


@jit
def look_up(known: IntArray, poses: FloatArray, steps: IntArray, found: FloatArray) -> None:
    """Write the pose of each step, NaN if it is not known.

    Args:
        known, poses: (n,) ascending, (n, 3).
        steps: (m,) ascending.
        found: (m, 3), result.
    """
    at = 0
    for t in range(len(steps)):
        while at < len(known) and known[at] < steps[t]:
            at += 1
        if at < len(known) and known[at] == steps[t]:
            found[t] = poses[at]
        else:
            found[t] = np.nan
