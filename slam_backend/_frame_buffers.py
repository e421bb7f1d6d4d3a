"""Working space of a filter's step: the robots' readings in the form that the kernels take, and room for results."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend import _kernels
from slam_backend._kernels import LANES
from slam_backend._map_store import aligned
from slam_backend.errors import FloatArray, IntArray
from slam_backend.measurements import Measurements

CANDIDATES = 64  # of one frame for which there is working space; more get their own each time
EMPTY = Measurements.empty(0)
NO_COVARIANCES = np.zeros((0, 3, 3))
NO_COVARIANCES.setflags(write=False)


class Turn(NamedTuple):
    """One robot's part in a step.

    Attributes:
        size: Number of measurements that the caller gave.
        keep: (n,) which of them are used: those that the caller did not name -1. None: all.
        points: (n, 3) used measurements relative to the camera centre, robot axes.
        noises: (n, 6) their covariances, robot axes; zeros unless `given`.
        given: Whether the caller gave covariances.
        descriptors: (n, d).
        names: (n,) the caller's names, or None.
        found: (n, P) slot to which each particle gave each measurement, -1 = none. Valid until the next step.
        distances: (n, P) squared Mahalanobis distances of matches, else NaN. Likewise.
        new_slots: (n,) slot of the landmark that a measurement started, -1 = none.
    """

    size: int
    keep: IntArray | None
    points: FloatArray
    noises: FloatArray
    given: bool
    descriptors: NDArray[np.float32]
    names: IntArray | None
    found: NDArray[np.int32]
    distances: FloatArray
    new_slots: IntArray


class FrameBuffers:
    """Arrays that are used again at each step.

    Args:
        padded: P, number of particles rounded up to whole blocks.
    """

    def __init__(self, padded: int) -> None:
        self.padded = padded
        self.used = 0  # measurements of this step so far
        self._all = True  # that the caller gave
        self.log_likelihood: FloatArray = np.zeros(padded)
        self.work: FloatArray = aligned((_kernels.WORK_ROWS * LANES,), np.float64)
        self.records: FloatArray = aligned((CANDIDATES, _kernels.CANDIDATE_ROWS * LANES), np.float64)
        self._found: NDArray[np.int32] = np.zeros((0, padded), dtype=np.int32)
        self._distances: FloatArray = np.zeros((0, padded))
        self._new_slots: IntArray = np.zeros(0, dtype=np.int64)
        self._rows: IntArray = np.zeros(0, dtype=np.int64)

    def start(self, most: int) -> None:
        """Begin a step with at most `most` measurements."""
        self.used, self._all = 0, True
        self.log_likelihood.fill(0.0)
        if most > len(self._found):
            self._found = np.zeros((2 * most, self.padded), dtype=np.int32)
            self._distances = np.zeros((2 * most, self.padded))
            self._new_slots = np.zeros(2 * most, dtype=np.int64)
            self._rows = np.arange(2 * most)

    def outcome(self, turns: Sequence[Turn]) -> tuple[NDArray[np.int32], FloatArray, IntArray, IntArray]:
        """Return what became of the measurements of all turns of a step, one after the other.

        Returns:
            `found`, `distances` and `new_slots` of the turns, and which of all measurements that the caller gave these
            are (n,).
        """
        used, rows = self.used, self._rows[: self.used]
        if not self._all:
            firsts = np.cumsum([0] + [turn.size for turn in turns])
            kept = (np.arange(turn.size) if turn.keep is None else turn.keep for turn in turns)
            rows = np.concatenate([first + own for first, own in zip(firsts[:-1], kept, strict=True)])
        return self._found[:used], self._distances[:used], self._new_slots[:used], rows

    def take(self, frame: Measurements | None, names: IntArray | None) -> Turn:
        """Return a robot's readings as the kernels take them, with room for what becomes of them.

        Args:
            frame: What it measured; None: nothing.
            names: (n,) int64 the caller's names of that, -1 for what is to be rejected; None: unknown.
        """
        if frame is None:
            frame = EMPTY
        points, covariances, descriptors = frame.points, frame.covariances, frame.descriptors
        size = len(points)
        keep: IntArray | None = None
        if names is not None and size and names.min() < 0:
            self._all, keep = False, np.flatnonzero(names >= 0)
            points, descriptors, names = points[keep], descriptors[keep], names[keep]
            covariances = None if covariances is None else covariances[keep]
            for array in (points, descriptors, covariances):
                if array is not None:
                    array.setflags(write=False)  # as those of a frame: kernels are compiled once
        first, num = self.used, len(points)
        turned, noises = np.empty((num, 3)), np.empty((num, 6))
        _kernels.to_robot_axes(points, NO_COVARIANCES if covariances is None else covariances, turned, noises)
        self.used = last = first + num
        return Turn(
            size, keep, turned, noises, covariances is not None, descriptors, names,
            self._found[first:last], self._distances[first:last], self._new_slots[first:last],
        )  # fmt: skip
