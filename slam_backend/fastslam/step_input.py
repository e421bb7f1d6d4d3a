"""Validated input of one filter step, packed into one table.

Input is checked before any state changes: a refused step has no effect. The table holds the measurements of all robots
in robot axes, as the kernels read them.
"""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np

from slam_backend.core.read_only import Act, as_read_only, map_arrays, with_read_only
from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray, argument_error, check_array
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels import EXACT_POSE, NO_READING
from slam_backend.models.camera import MAX_POINT_DISTANCE, StereoCamera
from slam_backend.models.measurements import Measurements, TeamMeasurements
from slam_backend.state import (
    BOOL,
    FLOAT32,
    FLOAT64,
    INT64,
    LARGEST,
    MAX_DESCRIPTOR,
    MAX_DISTANCE,
    MAX_LANDMARKS,
    Array,
    Dict,
    Each,
    Int,
    Record,
    Sizes,
    State,
    with_state,
)


@with_state(
    kind=Int(0, EXACT_POSE), begin=Int(), end=Int(), has_covariances=Int(0, 1), has_names=Int(0, 1),
    num_given=Int(-1, MAX_LANDMARKS),
)  # fmt: skip
class RobotInput(NamedTuple):
    """Input of one robot: a row of the table that kernels read, see `_kernels.layout`.

    Attributes:
        kind: Kind of motion.
        begin, end: First and last row of its used measurements among all n.
        has_covariances, has_names: 1 where the measurements have covariances, and names; else 0.
        num_given: Number of measurements given, used or not; -1 without a frame.
    """

    kind: int
    begin: int
    end: int
    has_covariances: int
    has_names: int
    num_given: int


NO_INPUT = RobotInput(NO_READING, 0, 0, 0, 0, -1)
MASKS = Dict(Int(0, "K"), Array(BOOL, "*"))


def check_rows(inputs: Sequence[RobotInput], masks: Mapping[int, BoolArray], n: int) -> None:
    """Refuse inputs of robots whose measurements do not lie among n, robot by robot, and masks of others."""
    last = 0
    for one in inputs:
        if not (last <= one.begin <= one.end <= n or one.begin == one.end == 0):
            raise ValueError("rows of other measurements")
        last = max(last, one.end)
    for robot, mask in masks.items():
        one = inputs[robot]
        if len(mask) != max(one.num_given, 0) or np.count_nonzero(mask) != one.end - one.begin:
            raise ValueError("a mask of other measurements")


@with_state(
    inputs=Each(Record(RobotInput), "K"),
    inputs_table=Array(INT64, "K 6", -1),
    moves=Array(FLOAT64, "K 3", -MAX_DISTANCE, MAX_DISTANCE),
    masks=MASKS,
    measurements=Array(FLOAT64, "n 9", -math.inf, math.inf, nan=True),
    descriptors=Array(FLOAT32, "n d", -MAX_DESCRIPTOR, MAX_DESCRIPTOR),
    names=Array(INT64, "*", -1),
    inactive=Each(Int(0, "K"), kind=frozenset),
)
class StepInput(NamedTuple):
    """Validated input of N robots in one step; filters do not write to it.

    Kernels are compiled for writable arrays; buffered inputs are read-only.

    Attributes:
        inputs: Input of each robot.
        inputs_table: (N, 6) int64. `inputs` as an array.
        moves: (N, 3) [m, m, rad] odometry, or exact poses in the robots' own start frames.
        masks: Used measurements (n_i,) bool by robot; only robots with measurements named -1, which are not used.
        measurements: (n, 9) [m, m^2] measurements of all robots, robot by robot, in robot axes: points (3) relative to
            the camera centre, and covariances (6), upper triangles by rows, where given.
        descriptors: (n, d) float32.
        names: (n,) the caller's names, or (0,) if no robot has any.
        inactive: Robots without input. An empty frame is an input: it reports that nothing was in view.
    """

    inputs: Sequence[RobotInput]
    inputs_table: IntArray
    moves: FloatArray
    masks: Mapping[int, BoolArray]
    measurements: FloatArray
    descriptors: Float32Array
    names: IntArray
    inactive: frozenset[int]

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse inputs whose measurements, names and masks do not fit together."""
        inputs, measurements, names = parts["inputs"], parts["measurements"], parts["names"]
        check_rows(inputs, parts["masks"], len(measurements))
        if [list(one) for one in inputs] != parts["inputs_table"].tolist():
            raise ValueError("a table that differs from the inputs")
        if not (np.abs(measurements[:, :3]) <= MAX_DISTANCE).all():
            raise ValueError("a point out of range")
        for _, begin, end, has_covariances, has_names, _ in inputs:
            if has_names and len(names) != len(measurements):
                raise ValueError("names of other measurements")
            if has_covariances and not (np.abs(measurements[begin:end]) <= LARGEST).all():
                raise ValueError("a covariance out of range")
        if len(names) not in (0, len(measurements)):
            raise ValueError("names of other measurements")

    def with_arrays(self, act: Act) -> Self:
        """Return the input with `act` applied to each array; itself if that changes nothing."""
        before = self[1:-1]  # `inputs` and `inactive` hold none
        after = map_arrays(before, act)
        return self if after is before else type(self)._make((self.inputs, *after, self.inactive))

    def with_copies(self) -> Self:
        """Return a copy with writable arrays, as kernels need."""
        return self.with_arrays(np.ndarray.copy)


class RobotRows(NamedTuple):
    """Rows of a filter's K robots in a `StepInput`.

    Attributes:
        rows: Row of each robot; -1: no input, the robot stands still and sees nothing.
        active: Pairs (index among the K robots, row) of the robots with input.
        array: (K,) int64. `rows`, as kernels take them; not written to.
    """

    rows: tuple[int, ...]
    active: tuple[tuple[int, int], ...]
    array: IntArray


@lru_cache(maxsize=256)
def rows_of(rows: tuple[int, ...]) -> RobotRows:
    """Return the `RobotRows` of these rows."""
    active = tuple((robot, row) for robot, row in enumerate(rows) if row >= 0)
    return RobotRows(rows, active, np.array(rows, np.int64))


class InputBuffer:
    """Buffer of the inputs of all robots, step by step."""

    STATE = State(steps=Dict(Int(), Record(StepInput)))

    def __init__(self) -> None:
        self._steps: dict[int, StepInput] = {}

    def __len__(self) -> int:
        """Return the number of buffered steps."""
        return len(self._steps)

    def record(self, step: int, inputs: StepInput) -> None:
        """Add the inputs of a step, later than all before; the caller does not write to them afterwards."""
        self._steps[step] = with_read_only(inputs)

    def read(self, step: int) -> StepInput:
        """Return the inputs of a buffered step; read-only."""
        return self._steps[step]

    def forget_before(self, step: int) -> None:
        """Remove the steps before this one."""
        while self._steps and (oldest := next(iter(self._steps))) < step:  # in order of time
            del self._steps[oldest]


NO_MEASUREMENTS = np.zeros((0, 9))
NO_DESCRIPTORS = np.zeros((0, 0), dtype=np.float32)
NO_NAMES = np.zeros(0, dtype=np.int64)
KINDS = *map(np.dtype, (np.float64, np.float32, np.int64)), 2, 2, 1  # dtypes and dimensions of `TeamMeasurements`


def _robot_inputs(table: IntArray) -> list[RobotInput]:
    """Return the rows of a table by name."""
    return list(map(RobotInput._make, table.tolist()))


Span = tuple[int, int, bool, bool, int]  # a `RobotInput` without the kind of motion
# One robot's points, covariances or None, descriptors, names or None.
Used = tuple[FloatArray, FloatArray | None, Float32Array, IntArray | None]
# Spans of all robots; masks, measurements, descriptors and names as in `StepInput`.
Seen = tuple[list[Span], dict[int, BoolArray], FloatArray, Float32Array, IntArray]


def has_kernel_dtypes(frames: TeamMeasurements) -> bool:
    """Return whether the frames of a team are arrays with the dtypes and dimensions that kernels take."""
    points, descriptors, offsets = frames
    if not (type(points) is np.ndarray and type(descriptors) is np.ndarray and type(offsets) is np.ndarray):
        return False
    return (points.dtype, descriptors.dtype, offsets.dtype, points.ndim, descriptors.ndim, offsets.ndim) == KINDS


def pack_team_input(
    k: int, size: int, odometry: Any, frames: TeamMeasurements, farthest_move: float, farthest_point: float
) -> StepInput | None:
    """Return the inputs of k robots if all have valid odometry and frames; None: check them robot by robot.

    Args:
        k, size, odometry, frames: Arguments of `validate_step`; it accepts all that is accepted here.
        farthest_move, farthest_point: Limits of the odometry [m, rad] and of points [m], see `_kernels.read_team`.
    """
    if type(odometry) is not np.ndarray or odometry.dtype != np.float64 or odometry.shape != (k, 3):
        return None
    points, descriptors, offsets = frames
    if not has_kernel_dtypes(frames):
        return None
    count, own_size = descriptors.shape
    if len(offsets) != k or points.shape != (count, 3) or (size and own_size != size):
        return None
    moves, copied = odometry.copy(), descriptors.copy()
    table, sightings = np.empty((k, 6), np.int64), np.empty((count, 9))
    limits = farthest_move, farthest_point, MAX_DESCRIPTOR
    if not _kernels.read_team(moves, points, copied, offsets, *limits, table, sightings):
        return None
    return StepInput(_robot_inputs(table), table, moves, {}, sightings, copied, NO_NAMES, frozenset())


def pack_step_input(
    moves: FloatArray, moved: Sequence[bool], exact: Mapping[int, FloatArray], spans: Sequence[Span],
    masks: Mapping[int, BoolArray], sightings: FloatArray, descriptors: Float32Array, names: IntArray,
) -> StepInput:  # fmt: skip
    """Return the inputs of N robots in one step.

    Args:
        moves: (N, 3) odometry of the robots that moved; the caller does not write to it afterwards.
        moved: (N,) whether each robot moved.
        exact: Exact poses by robot.
        spans, masks, sightings, descriptors, names: Measurements, see `Seen`.
    """
    inputs: list[tuple[int, ...]] = []
    inactive: list[int] = []
    for robot, (begin, end, covered, named, count) in enumerate(spans):
        if robot in exact:
            kind, moves[robot] = _kernels.EXACT_POSE, exact[robot]
        elif moved[robot]:
            kind = _kernels.MOVED
        else:
            kind = _kernels.STATIONARY if end > begin else _kernels.NO_READING
            if count < 0:
                inactive.append(robot)
        inputs.append((kind, begin, end, covered, named, count))
    table = np.array(inputs, dtype=np.int64)
    return StepInput(_robot_inputs(table), table, moves, masks, sightings, descriptors, names, frozenset(inactive))


def pack_measurements(frames: Sequence[Measurements | None], names: Sequence[IntArray | None]) -> Seen:
    """Return the measurements in the robots' frames, None without a frame, with the names given, if any."""
    spans: list[Span] = []
    masks: dict[int, BoolArray] = {}
    used: list[Used] = []
    begin = end = 0
    for robot, (frame, called) in enumerate(zip(frames, names, strict=True)):
        count = -1 if frame is None else len(frame.points)
        if frame is not None and count:
            one: Used = frame.points, frame.covariances, frame.descriptors, called
            if called is not None and called.min() < 0:
                masks[robot] = as_read_only(called >= 0)
                one = _masked(*one, masks[robot])
            used.append(one)
            end += len(one[0])
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


TURNED_SIGNS = np.array([1.0, -1.0, -1.0, 1.0, 1.0, 1.0])  # of covariances, by the turn into the robot's axes


def _joined(used: Sequence[Used]) -> tuple[FloatArray, Float32Array, IntArray]:
    """Return sightings, descriptors and names of all measurements, robot by robot."""
    if not used:
        return NO_MEASUREMENTS, NO_DESCRIPTORS, NO_NAMES
    points, covariances, _, names = used[0]
    descriptors = np.concatenate([one[2] for one in used])
    if len(used) > 1:
        given = named = False
        for _, spreads, _, called in used:
            given |= spreads is not None
            named |= called is not None
        points = np.concatenate([one[0] for one in used])
        if given:
            covariances = np.concatenate([np.zeros((len(one[0]), 3, 3)) if one[1] is None else one[1] for one in used])
        if named:
            names = np.concatenate([np.zeros(len(own[0]), np.int64) if own[3] is None else own[3] for own in used])
    sightings = np.zeros((len(points), 9))  # in the robot's axes: x ahead, y left, z up
    sightings[:, 0], sightings[:, 1], sightings[:, 2] = points[:, 2], -points[:, 0], -points[:, 1]
    if covariances is not None:
        sightings[:, 3:] = covariances[:, (2, 2, 2, 0, 0, 1), (2, 0, 1, 0, 1, 1)] * TURNED_SIGNS
    return sightings, descriptors, NO_NAMES if names is None else names


MAX_MOVE = 1e4  # limit of the odometry between two steps [m, rad]
MAX_POSE = 1e6  # limit of poses in a start frame [m, rad]


def validate_step(
    k: int, size: int, camera: StereoCamera, odometry: Any, measurements: Any, identities: Any, poses: Any
) -> StepInput:
    """Return the arguments of `FastSlam.step` for k robots, checked.

    Args:
        k: Number of robots.
        size: Length of the map's descriptors, 0 if there are none yet.
        camera: Camera of the robots.
        odometry, measurements, identities, poses: Arguments of `FastSlam.step`.

    Raises:
        ValueError: If one is ill-formed; the text names it.
    """
    limit = camera.farthest_usable
    if isinstance(measurements, TeamMeasurements):
        if identities is None and poses is None:
            inputs = pack_team_input(k, size, odometry, measurements, MAX_MOVE, limit)
            if inputs is not None:
                return inputs
        measurements = _split_by_robot(measurements)
    moves, moved = _check_moves(odometry, k)
    exact = {} if poses is None else _check_poses(poses, k)
    frames = _one_each("measurements", measurements, k)
    names = [None] * k if identities is None else list(_one_each("identities", identities, k))
    for robot in range(k):
        if (frame := frames[robot]) is not None:
            size = _check_frame(robot, frame, size, limit)
        if names[robot] is not None:
            names[robot] = _check_names(robot, names[robot], 0 if frame is None else len(frame))
    return pack_step_input(moves, moved, exact, *pack_measurements(frames, names))


def _split_by_robot(frames: TeamMeasurements) -> list[Measurements]:
    """Split the frames of a team by robot, or raise unless their arrays match."""
    if not has_kernel_dtypes(frames) or frames.points.shape[1] != 3:
        expected = "points (n, 3) float64, descriptors (n, d) float32 and offsets (K,) int64"
        got = ", ".join(f"{np.shape(array)} {getattr(array, 'dtype', type(array).__name__)}" for array in frames)
        raise argument_error("measurements", expected, got, "Give arrays of these types, or a frame per robot.")
    offsets, count = frames.offsets.tolist(), len(frames.points)
    ascending = bool(offsets) and offsets[0] >= 0 and offsets[-1] == count and offsets == sorted(offsets)
    if not ascending or len(frames.descriptors) != count:
        got = f"offsets {offsets} of {count} points and {len(frames.descriptors)} descriptors"
        expected = "a descriptor per point, and ascending offsets up to the number of points"
        raise argument_error("measurements", expected, got, "Give the end of each robot's points.")
    largest = float(np.abs(frames.descriptors).max(initial=0.0))
    if not largest <= MAX_DESCRIPTOR:
        expected = f"numbers within +-{MAX_DESCRIPTOR:g}"
        raise argument_error("measurements.descriptors", expected, largest, "Scale them, preferably to unit length.")
    return frames.per_robot()


def _one_each(name: str, value: Any, k: int) -> Any:
    """Return a sequence that has one entry for each of k robots."""
    if (type(value) is tuple or type(value) is list) and len(value) == k:
        return value
    if isinstance(value, Measurements) or not hasattr(value, "__len__") or len(value) != k:
        got = f"a sequence of {len(value)}" if hasattr(value, "__len__") else value
        got = "a bare frame" if isinstance(value, Measurements) else got
        raise argument_error(name, f"a sequence with one entry per robot ({k})", got, "Use None for no reading.")
    return value


def _check_moves(odometry: Any, k: int) -> tuple[FloatArray, Sequence[bool]]:
    """Return the checked odometry (k, 3) of k robots, zeros if missing, and whether each robot has any."""
    moves, moved = np.zeros((k, 3)), [False] * k
    for robot, move in enumerate(_one_each("odometry", odometry, k)):
        if move is not None:
            moves[robot], moved[robot] = _check_move(robot, move), True
    return moves, moved


def _check_move(robot: int, move: Any) -> FloatArray:
    """Return a robot's odometry as a checked array, perhaps the caller's own."""
    if type(move) is np.ndarray and move.dtype == np.float64 and move.shape == (3,):
        odometry: FloatArray = move
        if math.hypot(*odometry.tolist()) <= MAX_MOVE:
            return odometry
    hint = "Give the motion (dx, dy, dtheta) in the previous robot frame, or None."
    checked = check_array(f"odometry[{robot}]", move, (3,), hint)
    if np.abs(checked).max() > MAX_MOVE:
        hint = "Check the units: metres and radians since the robot's last step."
        raise argument_error(f"odometry[{robot}]", f"numbers within +-{MAX_MOVE:g}", move, hint)
    return checked


def _check_poses(poses: Any, k: int) -> dict[int, FloatArray]:
    """Return the exact poses among those of k robots as checked arrays, by robot."""
    exact: dict[int, FloatArray] = {}
    for robot, pose in enumerate(_one_each("poses", poses, k)):
        if pose is not None:
            hint = "Give (x, y, theta) in the robot's own start frame, or None."
            exact[robot] = check_array(f"poses[{robot}]", pose, (3,), hint)
            if np.abs(exact[robot]).max() > MAX_POSE:
                hint = "Check the units: metres and radians from the robot's start."
                raise argument_error(f"poses[{robot}]", f"numbers within +-{MAX_POSE:g}", pose, hint)
    return exact


def _check_names(robot: int, names: Any, count: int) -> IntArray:
    """Return the caller's names of a robot's measurements as a checked array."""
    if type(names) is np.ndarray and names.dtype == np.int64 and names.shape == (count,):
        return np.array(names)
    hint = "Name each measurement."
    checked: IntArray = check_array(f"identities[{robot}]", names, (count,), hint, dtype=np.int64)
    return checked


def _check_frame(robot: int, frame: Any, size: int, limit: float) -> int:
    """Check a robot's frame.

    Args:
        robot: Index of the robot.
        frame: Frame, as in `FastSlam.step`.
        size: Length of the map's descriptors, 0 if there are none yet.
        limit: Limit of coordinates whose covariances come from the camera model [m].

    Returns:
        The length of the map's descriptors including this frame.
    """
    if type(frame) is not Measurements and not isinstance(frame, Measurements):
        raise argument_error(f"measurements[{robot}]", "Measurements or None", frame, "Wrap the arrays.")
    own_size = frame.descriptors.shape[1]
    if own_size != size and len(frame):
        if size:
            raise argument_error(
                f"measurements[{robot}].descriptors",
                f"vectors of size {size} as in the map",
                f"shape {frame.descriptors.shape}",
                "Use one kind of descriptor throughout a run.",
            )
        size = own_size
    nearest, farthest = frame.extent
    if not (nearest >= _kernels.MIN_DEPTH and farthest <= limit):
        _check_points(robot, frame, limit)
    return size


def _check_points(robot: int, frame: Measurements, limit: float) -> None:
    """Raise unless all points are within range, and in front of the camera if it models their covariances."""
    nearest, farthest = frame.extent
    limit = limit if frame.covariances is None else MAX_POINT_DISTANCE
    if not farthest <= limit:
        hint = "Check the units (metres), and drop points without disparity."
        raise argument_error(f"measurements[{robot}].points", f"numbers within +-{limit:g}", farthest, hint)
    if frame.covariances is None and nearest < _kernels.MIN_DEPTH:
        raise argument_error(
            f"measurements[{robot}].points",
            f"depths Z >= {_kernels.MIN_DEPTH} m",
            nearest,
            "Drop points at or behind the camera, or give covariances.",
        )
