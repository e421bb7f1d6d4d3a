"""The readings of several robots in one table, with their measurements in the axes that kernels take."""

from collections.abc import Mapping, Sequence

import numpy as np

from slam_backend import _kernels
from slam_backend.errors import BoolArray, Float32Array, FloatArray, IntArray
from slam_backend.input_log import StepInput, Turn
from slam_backend.measurements import Measurements, TeamMeasurements

NO_COVARIANCES = np.zeros((0, 3, 3))
NO_COVARIANCES.setflags(write=False)
NO_SIGHTINGS = np.zeros((0, 9))
NO_SIGHTINGS.setflags(write=False)
NO_DESCRIPTORS = np.zeros((0, 0), dtype=np.float32)
NO_DESCRIPTORS.setflags(write=False)
NO_NAMES = np.zeros(0, dtype=np.int64)

Span = tuple[int, int, bool, bool, int]  # of one robot: its `Turn` without what it did
# One robot's points, covariances or None, descriptors, names or None.
Used = tuple[FloatArray, FloatArray | None, Float32Array, IntArray | None]
# Of all robots their spans; masks, sightings, descriptors and names as in `StepInput`.
Seen = tuple[list[Span], dict[int, BoolArray], FloatArray, Float32Array, IntArray]


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
    turns: list[Turn] = []
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
    table: IntArray = np.array(turns, dtype=np.int64)
    table.setflags(write=False)
    moves.setflags(write=False)
    return StepInput(turns, table, moves, masks, sightings, descriptors, names, frozenset(silent))


def seen_by_team(frames: TeamMeasurements) -> Seen:
    """Return what a team's frames hold, which have no names."""
    spans, begin = [], 0
    for end in frames.ends:
        spans.append((begin, end, False, False, end - begin))
        begin = end
    return spans, {}, _sightings(frames.points, NO_COVARIANCES), frames.descriptors, NO_NAMES


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
    """Return sightings, descriptors and names of all measurements, one robot's after the other's.

    Only names may be written, whatever came in: kernels are compiled for one kind of array.
    """
    if not used:
        return NO_SIGHTINGS, NO_DESCRIPTORS, NO_NAMES
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
    for array in (points, covariances, descriptors):
        array.setflags(write=False)
    return _sightings(points, covariances), descriptors, NO_NAMES if names is None else names


def _sightings(points: FloatArray, covariances: FloatArray) -> FloatArray:
    """Return points (n, 3) and their covariances (n, 3, 3), or none (0, 3, 3), in robot axes; see `StepInput`."""
    sightings = np.empty((len(points), 9))
    _kernels.to_robot_axes(points, covariances, sightings)
    sightings.setflags(write=False)
    return sightings
