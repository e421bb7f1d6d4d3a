"""The readings of one step, checked before anything is changed, so that a refused step leaves no trace."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from slam_backend import _kernels
from slam_backend._step_table import are_kinds, in_one_table, read_by_team, seen_by_each
from slam_backend.camera import FARTHEST_POINT, StereoCamera
from slam_backend.errors import FloatArray, IntArray, bad_argument, check_array
from slam_backend.input_log import StepInput
from slam_backend.measurements import LARGEST_DESCRIPTOR, Measurements, TeamMeasurements

FARTHEST_MOVE = 1e4  # [m, rad]; no robot moves so far between two steps
FARTHEST_POSE = 1e6  # [m, rad]; no robot goes so far from its start


def check_step(
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
            inputs = read_by_team(k, size, odometry, measurements, FARTHEST_MOVE, limit)
            if inputs is not None:
                return inputs
        measurements = _cut_out(measurements)
    moves, moved = _check_moves(odometry, k)
    exact = {} if poses is None else _check_poses(poses, k)
    frames = _one_each("measurements", measurements, k)
    names = [None] * k if identities is None else list(_one_each("identities", identities, k))
    for robot in range(k):
        if (frame := frames[robot]) is not None:
            size = _check_frame(robot, frame, size, limit)
        if names[robot] is not None:
            names[robot] = _check_names(robot, names[robot], 0 if frame is None else len(frame))
    return in_one_table(moves, moved, exact, *seen_by_each(frames, names))


def _cut_out(frames: TeamMeasurements) -> list[Measurements]:
    """Return each robot's frame of those of a team, or raise unless they fit together."""
    if not are_kinds(frames) or frames.points.shape[1] != 3:
        expected = "points (n, 3) float64, descriptors (n, d) float32 and ends (K,) int64"
        got = ", ".join(f"{np.shape(array)} {getattr(array, 'dtype', type(array).__name__)}" for array in frames)
        raise bad_argument("measurements", expected, got, "Give arrays of these types, or a frame per robot.")
    ends, count = frames.ends.tolist(), len(frames.points)
    if not ends or ends[0] < 0 or ends[-1] != count or len(frames.descriptors) != count or ends != sorted(ends):
        got = f"ends {ends} of {count} points and {len(frames.descriptors)} descriptors"
        cure = "Say per robot where its points end."
        raise bad_argument("measurements", "a descriptor per point, and rising ends up to the last one", got, cure)
    largest = float(np.abs(frames.descriptors).max(initial=0.0))
    if not largest <= LARGEST_DESCRIPTOR:
        expected = f"numbers within +-{LARGEST_DESCRIPTOR:g}"
        raise bad_argument("measurements.descriptors", expected, largest, "Scale them, best to unit length.")
    return frames.of_each()


def _one_each(name: str, value: Any, k: int) -> Any:
    """Return a sequence that has one entry for each of k robots."""
    if (type(value) is tuple or type(value) is list) and len(value) == k:
        return value
    if isinstance(value, Measurements) or not hasattr(value, "__len__") or len(value) != k:
        got = f"a sequence of {len(value)}" if hasattr(value, "__len__") else value
        got = "a bare frame" if isinstance(value, Measurements) else got
        raise bad_argument(name, f"a sequence with one entry per robot ({k})", got, "Use None for no reading.")
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
        if math.hypot(*own.tolist()) <= FARTHEST_MOVE:
            return own
    cure = "Give the motion (dx, dy, dtheta) in the previous robot frame, or None."
    checked = check_array(f"odometry[{robot}]", move, (3,), cure)
    if np.abs(checked).max() > FARTHEST_MOVE:
        cure = "Check the units: metres and radians since the robot's last step."
        raise bad_argument(f"odometry[{robot}]", f"numbers within +-{FARTHEST_MOVE:g}", move, cure)
    return checked


def _check_poses(poses: Any, k: int) -> dict[int, FloatArray]:
    """Return the exact poses of k robots as checked arrays, by robot; none of those that have none."""
    exact: dict[int, FloatArray] = {}
    for robot, pose in enumerate(_one_each("poses", poses, k)):
        if pose is not None:
            cure = "Give (x, y, theta) in the robot's own start frame, or None."
            exact[robot] = check_array(f"poses[{robot}]", pose, (3,), cure)
            if np.abs(exact[robot]).max() > FARTHEST_POSE:
                cure = "Check the units: metres and radians from the robot's start."
                raise bad_argument(f"poses[{robot}]", f"numbers within +-{FARTHEST_POSE:g}", pose, cure)
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
        raise bad_argument(f"measurements[{robot}]", "Measurements or None", frame, "Wrap the arrays.")
    own_size = frame.descriptors.shape[1]
    if own_size != size and len(frame):
        if size:
            raise bad_argument(
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
    limit = limit if frame.covariances is None else FARTHEST_POINT
    if not farthest <= limit:
        cure = "Check the units, metres, and drop points without disparity."
        raise bad_argument(f"measurements[{robot}].points", f"numbers within +-{limit:g}", farthest, cure)
    if frame.covariances is None and nearest < _kernels.MIN_DEPTH:
        raise bad_argument(
            f"measurements[{robot}].points",
            f"depths Z >= {_kernels.MIN_DEPTH} m",
            nearest,
            "Drop points at or behind the camera, or give covariances.",
        )
