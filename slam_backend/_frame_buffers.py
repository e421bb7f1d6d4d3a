"""Working space of a filter's step: the robots' readings in the form that the kernels take, and room for results."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend import _kernels
from slam_backend._kernels import LANES
from slam_backend._map_store import aligned
from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.input_log import RobotInput
from slam_backend.measurements import Measurements

MEASUREMENTS = 8  # of one robot for which there is room from the start
CANDIDATES = 64  # of one frame for which there is working space; more get their own each time
EMPTY = Measurements.empty(0)
NO_COVARIANCES = np.zeros((0, 3, 3))
NO_COVARIANCES.setflags(write=False)
NO_NAMES = np.zeros(0, dtype=np.int64)


# One robot's points, covariances or None, descriptors, names or None.
Readings = tuple[FloatArray, FloatArray | None, NDArray[np.float32], IntArray | None]


class Frames(NamedTuple):
    """What all robots of a filter measured in a step, one robot's measurements after the other's.

    Attributes:
        sizes: Per robot how many the caller gave.
        keeps: Per robot which of these are used (n_i,): those that the caller did not name -1. None: all.
        ends: Per robot where its used measurements end among all n; they begin where those before it end.
        points: (n, 3) [m], camera frame.
        covariances: (n, 3, 3) [m^2] likewise, or (0, 3, 3) where no robot has any.
        descriptors: (n, d).
        names: (n,) the caller's names, or (0,) where no robot has any.
        active: How many robots did or saw anything.
    """

    sizes: list[int]
    keeps: list[IntArray | None]
    ends: list[int]
    points: FloatArray
    covariances: FloatArray
    descriptors: NDArray[np.float32]
    names: IntArray
    active: int


class FrameBuffers:
    """Arrays that are used again at each step.

    Args:
        num_robots: K.
        padded: P, number of particles rounded up to whole blocks.

    Attributes:
        acts: (K,) int64. What each robot did, as `_kernels.take_turns` takes it; with `moves` (K, 3) its odometry.
        firsts: (K + 1,) int64. Where each robot's measurements begin among all.
        given, named: (K,) bool. Whether its measurements come with covariances, and with names.
        log_likelihood: (P,) of the step.
        points, noises: (n', 3), (n', 6) the measurements relative to the camera centre in robot axes, and their
            covariances, zeros for those that have none.
        found: (n', P) int32. Slot to which each particle gave each measurement, -1 = none.
        distances: (n', P) squared Mahalanobis distances of matches, else NaN.
        new_slots: (n',) int64. Slot of the landmark that a measurement started, -1 = none.
        work, records: Of the kernels.
    """

    def __init__(self, num_robots: int, padded: int) -> None:
        self.acts: IntArray = np.zeros(num_robots, dtype=np.int64)
        self.moves: FloatArray = np.zeros((num_robots, 3))
        self.firsts: IntArray = np.zeros(num_robots + 1, dtype=np.int64)
        self.given: BoolArray = np.zeros(num_robots, dtype=np.bool_)
        self.named: BoolArray = np.zeros(num_robots, dtype=np.bool_)
        self.log_likelihood: FloatArray = np.zeros(padded)
        self.work: FloatArray = aligned((_kernels.WORK_ROWS * LANES,), np.float64)
        self.records: FloatArray = aligned((CANDIDATES, _kernels.CANDIDATE_ROWS * LANES), np.float64)
        self._make_room(MEASUREMENTS * num_robots)

    def _make_room(self, most: int) -> None:
        """Provide for so many measurements in a step."""
        padded = len(self.log_likelihood)
        self.points: FloatArray = np.zeros((most, 3))
        self.noises: FloatArray = np.zeros((most, 6))
        self.found: NDArray[np.int32] = np.zeros((most, padded), dtype=np.int32)
        self.distances: FloatArray = np.zeros((most, padded))
        self.new_slots: IntArray = np.zeros(most, dtype=np.int64)
        self._rows: IntArray = np.arange(most)

    def take(self, inputs: Sequence[RobotInput]) -> Frames:
        """Begin a step: take what all robots read, and provide for what becomes of it."""
        self.log_likelihood.fill(0.0)
        sizes: list[int] = []
        keeps: list[IntArray | None] = []
        ends: list[int] = []
        used: list[Readings] = []  # of each robot that has measurements
        total = idle = 0
        for robot, (move, frame, names, exact) in enumerate(inputs):
            size, left, keep = 0, 0, None
            if frame is not None and len(frame.points):
                own: Readings = (frame.points, frame.covariances, frame.descriptors, names)
                size = left = len(frame.points)
                if names is not None and names.min() < 0:
                    own, keep = _without_rejected(frame.points, frame.covariances, frame.descriptors, names)
                    left = len(keep)
                if left:
                    used.append(own)
                    total += left
                self.given[robot], self.named[robot] = frame.covariances is not None, names is not None
            if exact is not None:
                self.acts[robot] = _kernels.PLACED
            elif move is not None:
                self.acts[robot], self.moves[robot] = _kernels.MOVED, move
            elif left:
                self.acts[robot] = _kernels.STOOD
            else:
                self.acts[robot] = _kernels.IDLE
                idle += 1
            sizes.append(size)
            keeps.append(keep)
            ends.append(total)
            self.firsts[robot + 1] = total
        if total > len(self.found):
            self._make_room(2 * total)
        return Frames(sizes, keeps, ends, *_joined(used), len(inputs) - idle)

    def rows_used(self, frames: Frames) -> IntArray:
        """Return which of all measurements that the caller gave are used (n,)."""
        used = len(frames.points)
        if used == sum(frames.sizes):
            return self._rows[:used]
        firsts = np.cumsum([0, *frames.sizes[:-1]])
        kept = [
            np.arange(size) if keep is None else keep for size, keep in zip(frames.sizes, frames.keeps, strict=True)
        ]
        return np.concatenate([first + own for first, own in zip(firsts, kept, strict=True)])


def _without_rejected(
    points: FloatArray, covariances: FloatArray | None, descriptors: NDArray[np.float32], names: IntArray
) -> tuple[Readings, IntArray]:
    """Return the readings that the caller did not name -1, and which these are."""
    keep = np.flatnonzero(names >= 0)
    return (points[keep], None if covariances is None else covariances[keep], descriptors[keep], names[keep]), keep


def _joined(
    used: Sequence[Readings],
) -> tuple[FloatArray, FloatArray, NDArray[np.float32], IntArray]:
    """Return points, covariances, descriptors and names of all robots that have any, one after the other.

    Only names may be written, as in a frame: kernels are compiled for one kind of array.
    """
    if not used:
        return EMPTY.points, NO_COVARIANCES, EMPTY.descriptors, NO_NAMES
    points, covariances, descriptors, names = used[0]
    if len(used) > 1:
        given = named = False
        for _, spreads, _, called in used:
            given |= spreads is not None
            named |= called is not None
        points = np.concatenate([own[0] for own in used])
        descriptors = np.concatenate([own[2] for own in used])
        if given:
            covariances = np.concatenate([np.zeros((len(own[0]), 3, 3)) if own[1] is None else own[1] for own in used])
        if named:
            names = np.concatenate([np.zeros(len(own[0]), np.int64) if own[3] is None else own[3] for own in used])
    covariances = NO_COVARIANCES if covariances is None else covariances
    if points.flags.writeable:
        for array in (points, covariances, descriptors):
            array.setflags(write=False)
    return points, covariances, descriptors, NO_NAMES if names is None else names
