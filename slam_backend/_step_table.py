"""The readings of several robots in one table, with their measurements in the axes that kernels take."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend import _kernels
from slam_backend.errors import BoolArray, Float32Array, FloatArray, IntArray
from slam_backend.input_log import StepInput
from slam_backend.measurements import LARGEST_DESCRIPTOR, Measurements, TeamMeasurements

NO_SIGHTINGS = np.zeros((0, 9))
NO_DESCRIPTORS = np.zeros((0, 0), dtype=np.float32)
NO_NAMES = np.zeros(0, dtype=np.int64)
KINDS = *map(np.dtype, (np.float64, np.float32, np.int64)), 2, 2, 1  # of `TeamMeasurements`

Span = tuple[int, int, bool, bool, int]  # of one robot: its row of the table without what it did
# One robot's points, covariances or None, descriptors, names or None.
Used = tuple[FloatArray, FloatArray | None, Float32Array, IntArray | None]
# Of all robots their spans; masks, sightings, descriptors and names as in `StepInput`.
Seen = tuple[list[Span], dict[int, BoolArray], FloatArray, Float32Array, IntArray]


def are_kinds(frames: TeamMeasurements) -> bool:
    """Return whether the frames of a team are arrays of the numbers of axes and the types that kernels take."""
    points, looks, ends = frames
    if not (type(points) is np.ndarray and type(looks) is np.ndarray and type(ends) is np.ndarray):
        return False
    return (points.dtype, looks.dtype, ends.dtype, points.ndim, looks.ndim, ends.ndim) == KINDS


def read_by_team(
    k: int, size: int, odometry: Any, frames: TeamMeasurements, farthest_move: float, farthest_point: float
) -> StepInput | None:
    """Return what k robots read if all moved and looked and nothing is amiss; None: it has to be looked at one by one.

    Args:
        k, size, odometry, frames: As of `check_step`, which takes all that is taken here.
        farthest_move, farthest_point: Limits [m, rad] to the odometry and [m] to points, as of `_kernels.read_team`.
    """
    if type(odometry) is not np.ndarray or odometry.dtype != np.float64 or odometry.shape != (k, 3):
        return None
    points, descriptors, ends = frames
    if not are_kinds(frames):
        return None
    count, own_size = descriptors.shape
    if len(ends) != k or points.shape != (count, 3) or (size and own_size != size):
        return None
    moves, looks = odometry.copy(), descriptors.copy()
    table, sightings = np.empty((k, 6), np.int64), np.empty((count, 9))
    limits = farthest_move, farthest_point, LARGEST_DESCRIPTOR
    if not _kernels.read_team(moves, points, looks, ends, *limits, table, sightings):
        return None
    return StepInput(table.tolist(), table, moves, {}, sightings, looks, NO_NAMES, frozenset())


def in_one_table(
    moves: FloatArray, moved: Sequence[bool], exact: Mapping[int, FloatArray], spans: Sequence[Span],
    masks: Mapping[int, BoolArray], sightings: FloatArray, descriptors: Float32Array, names: IntArray,
) -> StepInput:  # fmt: skip
    """Return what N robots read in one step.

    Args:
        moves: (N, 3) odometry of those that moved; the caller is not to write to it any more.
        moved: (N,) which they are.
        exact: By robot the pose that it was told.
        spans, masks, sightings, descriptors, names: As of `Seen`.
    """
    turns: list[tuple[int, ...]] = []
    silent: list[int] = []
    for robot, (begin, end, covered, named, count) in enumerate(spans):
        if robot in exact:
            act, moves[robot] = _kernels.PLACED, exact[robot]
        elif moved[robot]:
            act = _kernels.MOVED
        else:
            act = _kernels.STOOD if end > begin else _kernels.IDLE
            if count < 0:
                silent.append(robot)
        turns.append((act, begin, end, covered, named, count))
    table = np.array(turns, dtype=np.int64)
    return StepInput(table.tolist(), table, moves, masks, sightings, descriptors, names, frozenset(silent))


def seen_by_each(frames: Sequence[Measurements | None], names: Sequence[IntArray | None]) -> Seen:
    """Return what the robots' frames hold, None where there is none, with the names of their measurements, if any."""
    spans: list[Span] = []
    masks: dict[int, BoolArray] = {}
    used: list[Used] = []
    begin = end = 0
    for robot, (frame, called) in enumerate(zip(frames, names, strict=True)):
        count = -1 if frame is None else len(frame.points)
        if frame is not None and count:
            own: Used = frame.points, frame.covariances, frame.descriptors, called
            if called is not None and called.min() < 0:
                masks[robot] = called >= 0
                own = _masked(*own, masks[robot])
            used.append(own)
            end += len(own[0])
        spans.append((begin, end, frame is not None and frame.covariances is not None, called is not None, count))
        begin = end
    return spans, masks, *_joined(used)


def _masked(
    points: FloatArray, covariances: FloatArray | None, descriptors: Float32Array, names: IntArray | None,
    mask: BoolArray,
) -> Used:  # fmt: skip
    """Return a robot's measurements where the mask (n,) is set."""
    return (
        points[mask],
        None if covariances is None else covariances[mask],
        descriptors[mask],
        None if names is None else names[mask],
    )


def _joined(used: Sequence[Used]) -> tuple[FloatArray, Float32Array, IntArray]:
    """Return sightings, descriptors and names of all measurements, one robot's after the other's."""
    if not used:
        return NO_SIGHTINGS, NO_DESCRIPTORS, NO_NAMES
    points, covariances, _, names = used[0]
    descriptors = np.concatenate([own[2] for own in used])
    if len(used) > 1:
        given = named = False
        for _, spreads, _, called in used:
            given |= spreads is not None
            named |= called is not None
        points = np.concatenate([own[0] for own in used])
        if given:
            covariances = np.concatenate([np.zeros((len(own[0]), 3, 3)) if own[1] is None else own[1] for own in used])
        if named:
            names = np.concatenate([np.zeros(len(own[0]), np.int64) if own[3] is None else own[3] for own in used])
    points.setflags(write=False)  # as those of a frame: the kernel is compiled for one kind of array
    sightings = np.empty((len(points), 9))
    _kernels.to_robot_axes(points, sightings)
    if covariances is not None:
        covariances.setflags(write=False)
        _kernels.noises_to_robot_axes(covariances, sightings)
    return sightings, descriptors, NO_NAMES if names is None else names
