"""Input of one step: checked before anything changes, packed into one table, kept until every filter has taken it.

A refused step leaves no trace. The table holds the measurements of all robots in robot axes, as the kernels read them.
"""

import math
from collections.abc import Mapping, Sequence
from functools import lru_cache
from typing import Any, NamedTuple, Self

import numpy as np

from slam_backend.core.read_only import Act, as_read_only, map_arrays, with_constants, with_read_only
from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray, argument_error, check_array
from slam_backend.fastslam import _kernels
from slam_backend.fastslam._kernels import NO_READING
from slam_backend.models.camera import MAX_POINT_DISTANCE, StereoCamera
from slam_backend.models.measurements import LARGEST_DESCRIPTOR, Measurements, TeamMeasurements

# Of one robot: what it did, where its used measurements begin and end among all n, whether these come with covariances,
# and with names; and how many it was given, used or not, -1 where it has no frame. `_kernels.layout` names the numbers.
RobotInput = Sequence[int]
NO_INPUT = (NO_READING, 0, 0, 0, 0, -1)


class StepInput(NamedTuple):
    """What N robots read in one step, checked, as filters take it; it is not written to.

    Kernels are compiled for arrays that can be written; those that are kept are read-only.

    Attributes:
        inputs: Of each robot.
        inputs_table: (N, 6) int64. The same.
        moves: (N, 3) [m, m, rad] odometry of those that moved, poses in their own start frames of those that were told
            theirs.
        masks: By robot which of its measurements are used (n_i,) bool; only of robots that the caller gave some named
            -1, which are not.
        measurements: (n, 9) [m, m^2] all robots' measurements, one robot's after the other's, in robot axes: points (3)
            relative to the camera centre, and their covariances (6), upper triangles by rows, where they have any.
        descriptors: (n, d).
        names: (n,) the caller's names, or (0,) where no robot has any.
        inactive: Robots of which there is nothing to take in. An empty frame is something: it says that nothing was
            there to see.
    """

    inputs: Sequence[RobotInput]
    inputs_table: IntArray
    moves: FloatArray
    masks: Mapping[int, BoolArray]
    measurements: FloatArray
    descriptors: Float32Array
    names: IntArray
    inactive: frozenset[int]

    def with_arrays(self, act: Act) -> Self:
        """Return the same with `act` done to each array; itself if that changes nothing."""
        before = self[1:-1]  # turns and silent hold none
        after = map_arrays(before, act)
        return self if after is before else type(self)._make((self.inputs, *after, self.inactive))

    def with_copies(self) -> Self:
        """Return the same with arrays of its own, which kernels take."""
        return self.with_arrays(np.ndarray.copy)


class RobotRows(NamedTuple):
    """Where the readings of a filter's K robots stand in a `StepInput`.

    Attributes:
        rows: Of each robot there; -1: it is not heard, and stands still, unseeing.
        active: Of each that is: which of the K robots it is, and its row.
        array: (K,) int64. `rows`, as kernels take them; not written to.
    """

    rows: tuple[int, ...]
    active: tuple[tuple[int, int], ...]
    array: IntArray


@lru_cache(maxsize=256)
def rows_of(rows: tuple[int, ...]) -> RobotRows:
    """Return the seats in these rows."""
    heard = tuple((robot, row) for robot, row in enumerate(rows) if row >= 0)
    return RobotRows(rows, heard, np.array(rows, np.int64))


class InputBuffer:
    """The readings of all robots, step by step."""

    def __init__(self) -> None:
        self._steps: dict[int, StepInput] = {}

    def __len__(self) -> int:
        """Return how many steps are kept."""
        return len(self._steps)

    @property
    def buffered(self) -> Mapping[int, StepInput]:
        """The steps that are kept, by their numbers; to be looked at."""
        return self._steps

    def record(self, step: int, inputs: StepInput) -> None:
        """Keep what all robots read in a step, later than all before; nobody is to write to it afterwards."""
        self._steps[step] = with_read_only(inputs)

    def read(self, step: int) -> StepInput:
        """Return what all robots read in a step that is kept; read-only."""
        return self._steps[step]

    def forget_before(self, step: int) -> None:
        """Forget the steps before this one."""
        while self._steps and (oldest := next(iter(self._steps))) < step:  # they stand in order of time
            del self._steps[oldest]

    def get_state(self) -> dict[str, Any]:
        """Return what is kept; inputs are read-only and shared."""
        return {"steps": dict(self._steps)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with what `get_state` returned."""
        own = self._steps
        steps: Mapping[int, StepInput] = state["steps"]
        self._steps = {
            step: inputs if own.get(step) is inputs else with_constants(inputs) for step, inputs in steps.items()
        }


NO_MEASUREMENTS = np.zeros((0, 9))
NO_DESCRIPTORS = np.zeros((0, 0), dtype=np.float32)
NO_NAMES = np.zeros(0, dtype=np.int64)
KINDS = *map(np.dtype, (np.float64, np.float32, np.int64)), 2, 2, 1  # of `TeamMeasurements`

Span = tuple[int, int, bool, bool, int]  # of one robot: its row of the table without what it did
# One robot's points, covariances or None, descriptors, names or None.
Used = tuple[FloatArray, FloatArray | None, Float32Array, IntArray | None]
# Of all robots their spans; masks, sightings, descriptors and names as in `StepInput`.
Seen = tuple[list[Span], dict[int, BoolArray], FloatArray, Float32Array, IntArray]


def has_kernel_dtypes(frames: TeamMeasurements) -> bool:
    """Return whether the frames of a team are arrays of the numbers of axes and the types that kernels take."""
    points, looks, ends = frames
    if not (type(points) is np.ndarray and type(looks) is np.ndarray and type(ends) is np.ndarray):
        return False
    return (points.dtype, looks.dtype, ends.dtype, points.ndim, looks.ndim, ends.ndim) == KINDS


def pack_team_input(
    k: int, size: int, odometry: Any, frames: TeamMeasurements, farthest_move: float, farthest_point: float
) -> StepInput | None:
    """Return what k robots read if all moved and looked and nothing is amiss; None: it has to be looked at one by one.

    Args:
        k, size, odometry, frames: As of `validate_step`, which takes all that is taken here.
        farthest_move, farthest_point: Limits [m, rad] to the odometry and [m] to points, as of `_kernels.read_team`.
    """
    if type(odometry) is not np.ndarray or odometry.dtype != np.float64 or odometry.shape != (k, 3):
        return None
    points, descriptors, ends = frames
    if not has_kernel_dtypes(frames):
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


def pack_step_input(
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
            act, moves[robot] = _kernels.EXACT_POSE, exact[robot]
        elif moved[robot]:
            act = _kernels.MOVED
        else:
            act = _kernels.STATIONARY if end > begin else _kernels.NO_READING
            if count < 0:
                silent.append(robot)
        turns.append((act, begin, end, covered, named, count))
    table = np.array(turns, dtype=np.int64)
    return StepInput(table.tolist(), table, moves, masks, sightings, descriptors, names, frozenset(silent))


def pack_measurements(frames: Sequence[Measurements | None], names: Sequence[IntArray | None]) -> Seen:
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
                masks[robot] = as_read_only(called >= 0)
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
        return NO_MEASUREMENTS, NO_DESCRIPTORS, NO_NAMES
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
    if covariances is not None:
        covariances.setflags(write=False)
    sightings = np.empty((len(points), 9))
    _kernels.to_robot_axes(points, covariances, sightings)
    return sightings, descriptors, NO_NAMES if names is None else names


MAX_MOVE = 1e4  # [m, rad]; no robot moves so far between two steps
MAX_POSE = 1e6  # [m, rad]; no robot goes so far from its start


def validate_step(
    k: int, size: int, camera: StereoCamera, odometry: Any, measurements: Any, identities: Any, poses: Any
) -> StepInput:
    """Return the arguments of `FastSlam.step` for k robots, checked.

    Args:
        k: Number of robots.
        size: Length of the map's descriptors, 0 if there are none yet.
        camera: Of the robots.
        odometry, measurements, identities, poses: As in `FastSlam.step`.

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
    """Return each robot's frame of those of a team, or raise unless they fit together."""
    if not has_kernel_dtypes(frames) or frames.points.shape[1] != 3:
        expected = "points (n, 3) float64, descriptors (n, d) float32 and ends (K,) int64"
        got = ", ".join(f"{np.shape(array)} {getattr(array, 'dtype', type(array).__name__)}" for array in frames)
        raise argument_error("measurements", expected, got, "Give arrays of these types, or a frame per robot.")
    ends, count = frames.offsets.tolist(), len(frames.points)
    if not ends or ends[0] < 0 or ends[-1] != count or len(frames.descriptors) != count or ends != sorted(ends):
        got = f"ends {ends} of {count} points and {len(frames.descriptors)} descriptors"
        cure = "Say per robot where its points end."
        raise argument_error("measurements", "a descriptor per point, and rising ends up to the last one", got, cure)
    largest = float(np.abs(frames.descriptors).max(initial=0.0))
    if not largest <= LARGEST_DESCRIPTOR:
        expected = f"numbers within +-{LARGEST_DESCRIPTOR:g}"
        raise argument_error("measurements.descriptors", expected, largest, "Scale them, best to unit length.")
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
    """Return the odometry (k, 3) of k robots, checked, and which of them have any; zeros for the others."""
    moves, moved = np.zeros((k, 3)), [False] * k
    for robot, move in enumerate(_one_each("odometry", odometry, k)):
        if move is not None:
            moves[robot], moved[robot] = _check_move(robot, move), True
    return moves, moved


def _check_move(robot: int, move: Any) -> FloatArray:
    """Return a robot's odometry as a checked array, perhaps the caller's."""
    if type(move) is np.ndarray and move.dtype == np.float64 and move.shape == (3,):
        own: FloatArray = move
        if math.hypot(*own.tolist()) <= MAX_MOVE:
            return own
    cure = "Give the motion (dx, dy, dtheta) in the previous robot frame, or None."
    checked = check_array(f"odometry[{robot}]", move, (3,), cure)
    if np.abs(checked).max() > MAX_MOVE:
        cure = "Check the units: metres and radians since the robot's last step."
        raise argument_error(f"odometry[{robot}]", f"numbers within +-{MAX_MOVE:g}", move, cure)
    return checked


def _check_poses(poses: Any, k: int) -> dict[int, FloatArray]:
    """Return the exact poses of k robots as checked arrays, by robot; none of those that have none."""
    exact: dict[int, FloatArray] = {}
    for robot, pose in enumerate(_one_each("poses", poses, k)):
        if pose is not None:
            cure = "Give (x, y, theta) in the robot's own start frame, or None."
            exact[robot] = check_array(f"poses[{robot}]", pose, (3,), cure)
            if np.abs(exact[robot]).max() > MAX_POSE:
                cure = "Check the units: metres and radians from the robot's start."
                raise argument_error(f"poses[{robot}]", f"numbers within +-{MAX_POSE:g}", pose, cure)
    return exact


def _check_names(robot: int, names: Any, count: int) -> IntArray:
    """Return the caller's names of a robot's measurements as a checked array."""
    if type(names) is np.ndarray and names.dtype == np.int64 and names.shape == (count,):
        return np.array(names)
    cure = "Name each measurement."
    checked: IntArray = check_array(f"identities[{robot}]", names, (count,), cure, dtype=np.int64)
    return checked


def _check_frame(robot: int, frame: Any, size: int, limit: float) -> int:
    """Check a robot's frame.

    Args:
        robot: Whose.
        frame: As in `FastSlam.step`.
        size: Length of the map's descriptors, 0 if there are none yet.
        limit: To coordinates [m], where the camera model is to say how uncertain they are.

    Returns:
        The length of the map's descriptors from there on.
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
    """Raise unless all points are so near that their covariances can be used, and ahead where they have none yet."""
    nearest, farthest = frame.extent
    limit = limit if frame.covariances is None else MAX_POINT_DISTANCE
    if not farthest <= limit:
        cure = "Check the units, metres, and drop points without disparity."
        raise argument_error(f"measurements[{robot}].points", f"numbers within +-{limit:g}", farthest, cure)
    if frame.covariances is None and nearest < _kernels.MIN_DEPTH:
        raise argument_error(
            f"measurements[{robot}].points",
            f"depths Z >= {_kernels.MIN_DEPTH} m",
            nearest,
            "Drop points at or behind the camera, or give covariances.",
        )
