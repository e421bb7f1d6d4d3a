"""Working space of a filter's step: the robots' readings in the form that the kernels take, and room for results."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend import _kernels
from slam_backend._kernels import LANES
from slam_backend._particle_maps import aligned
from slam_backend.camera import ROBOT_FROM_CAMERA
from slam_backend.errors import FloatArray, IntArray
from slam_backend.measurements import Measurements

UPPER = np.triu_indices(3)  # where the six stored elements of a covariance stand in the full matrix
EMPTY = Measurements.empty(0)


class Turn(NamedTuple):
    """One robot's part in a step.

    Attributes:
        size: Number of measurements that the caller gave.
        keep: (n,) which of them are used: those that the caller did not name -1.
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
    keep: IntArray
    points: FloatArray
    noises: FloatArray
    given: bool
    descriptors: NDArray[np.float32]
    names: IntArray | None
    found: NDArray[np.int32]
    distances: FloatArray
    new_slots: IntArray


class Candidates(NamedTuple):
    """What `find_candidates` returns."""

    starts: IntArray
    slots: IntArray
    squares: FloatArray
    owners: IntArray
    same: IntArray
    unique: IntArray


class FrameBuffers:
    """Arrays that are used again at each step.

    Args:
        padded: P, number of particles rounded up to whole blocks.
    """

    def __init__(self, padded: int) -> None:
        self.padded = padded
        self.used = 0  # measurements of this step so far
        self.log_likelihood: FloatArray = np.zeros(padded)
        self.work: FloatArray = aligned((_kernels.WORK_ROWS * LANES,), np.float64)
        self.records: FloatArray = aligned((0, _kernels.CANDIDATE_ROWS * LANES), np.float64)
        self._found: NDArray[np.int32] = np.zeros((0, padded), dtype=np.int32)
        self._distances: FloatArray = np.zeros((0, padded))

    def start(self, most: int) -> None:
        """Begin a step with at most `most` measurements."""
        self.used = 0
        self.log_likelihood.fill(0.0)
        if most > len(self._found):
            self._found = np.zeros((2 * most, self.padded), dtype=np.int32)
            self._distances = np.zeros((2 * most, self.padded))

    def make_room(self, candidates: int) -> None:
        """Provide working space for so many candidates."""
        if candidates > len(self.records):
            self.records = aligned((2 * candidates, _kernels.CANDIDATE_ROWS * LANES), np.float64)

    def take(self, robot: int, frame: Measurements | None, names: IntArray | None) -> Turn:
        """Return a robot's readings as the kernels take them, with room for what becomes of them."""
        frame = EMPTY if frame is None else frame
        size = len(frame)
        points, covariances, descriptors = frame.points, frame.covariances, frame.descriptors
        keep = np.arange(size)
        if names is not None and size and names.min() < 0:
            keep = np.flatnonzero(names >= 0)
            points, descriptors, names = points[keep], descriptors[keep], names[keep]
            covariances = None if covariances is None else covariances[keep]
        num = len(points)
        noises = np.zeros((num, 6))
        if covariances is not None and num:
            noises[:] = (ROBOT_FROM_CAMERA @ covariances @ ROBOT_FROM_CAMERA.T)[:, *UPPER]
        first = self.used
        self.used += num
        return Turn(
            size=size,
            keep=keep,
            points=points @ ROBOT_FROM_CAMERA.T,
            noises=noises,
            given=covariances is not None,
            descriptors=descriptors,
            names=names,
            found=self._found[first : first + num],
            distances=self._distances[first : first + num],
            new_slots=np.full(num, _kernels.REJECTED, dtype=np.int64),
        )
