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
        given: How many measurements the caller gave.
        masks: By robot which of its measurements are used (n_i,) bool; only of robots that the caller gave some named
            -1, which are not.
        ends: Per robot where its used measurements end among all n; they begin where those before it end.
        active: How many robots did or saw anything.
        points: (n, 3) [m], camera frame.
        covariances: (n, 3, 3) [m^2] likewise, or (0, 3, 3) where no robot has any.
        descriptors: (n, d).
        names: (n,) the caller's names, or (0,) where no robot has any.
    """

    given: int
    masks: dict[int, BoolArray]
    ends: list[int]
    active: int
    points: FloatArray
    covariances: FloatArray
    descriptors: NDArray[np.float32]
    names: IntArray


class FrameBuffers:
    """Arrays that are used again at each step.

    Args:
        num_robots: K.
        padded: P, number of particles rounded up to whole blocks.

    Attributes:
        turns: (K, 4) int64, moves: (K, 3). What each robot did, as `_kernels.take_turns` takes it.
        sightings: (n', 9) the measurements in robot axes: points (3) relative to the camera centre, and their
            covariances (6), zeros for those that have none.
        found: (n', P) int32. Slot to which each particle gave each measurement, -1 = none.
        distances: (n', P) squared Mahalanobis distances of matches, else NaN.
        space: Of the kernels.
    """

    def __init__(self, num_robots: int, padded: int) -> None:
        self._padded = padded
        self.turns: IntArray = np.zeros((num_robots, 4), dtype=np.int64)
        self.moves: FloatArray = np.zeros((num_robots, 3))
        records = CANDIDATES * _kernels.CANDIDATE_ROWS
        self.space: FloatArray = aligned(((_kernels.WORK_ROWS + records) * LANES,), np.float64)
        self._make_room(MEASUREMENTS * num_robots)

    def _make_room(self, most: int) -> None:
        """Provide for so many measurements in a step."""
        self.sightings: FloatArray = np.zeros((most, 9))
        self.found: NDArray[np.int32] = np.zeros((most, self._padded), dtype=np.int32)
        self.distances: FloatArray = np.zeros((most, self._padded))

    def take(self, inputs: Sequence[RobotInput]) -> Frames:
        """Begin a step: take what all robots read, and provide for what becomes of it."""
        masks: dict[int, BoolArray] = {}
        ends: list[int] = []
        used: list[Readings] = []  # of each robot that has measurements
        given = total = active = 0
        for robot, (move, frame, names, exact) in enumerate(inputs):
            act, covered = _kernels.IDLE, False
            if frame is not None and (size := len(frame.points)):
                given += size
                own: Readings = (frame.points, frame.covariances, frame.descriptors, names)
                if names is not None and names.min() < 0:
                    masks[robot] = mask = names >= 0
                    own = _masked(*own, mask)
                    size = len(own[0])
                if size:
                    act = _kernels.STOOD
                    used.append(own)
                    total += size
                covered = frame.covariances is not None
            if exact is not None:
                act = _kernels.PLACED
            elif move is not None:
                act, self.moves[robot] = _kernels.MOVED, move
            self.turns[robot] = act, total, covered, names is not None
            active += act != _kernels.IDLE
            ends.append(total)
        if total > len(self.found):
            self._make_room(2 * total)
        return Frames(given, masks, ends, active, *_joined(used))


def _masked(
    points: FloatArray, covariances: FloatArray | None, descriptors: NDArray[np.float32], names: IntArray | None,
    mask: BoolArray,
) -> Readings:  # fmt: skip
    """Return the readings where the mask (n,) is set."""
    return (
        points[mask],
        None if covariances is None else covariances[mask],
        descriptors[mask],
        None if names is None else names[mask],
    )


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
