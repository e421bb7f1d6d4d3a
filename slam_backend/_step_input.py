"""The readings of one step, checked before anything is changed, so that a refused step leaves no trace."""

from typing import Any

import numpy as np

from slam_backend import _kernels
from slam_backend.camera import StereoCamera
from slam_backend.errors import FloatArray, bad_argument, check_array
from slam_backend.input_log import RobotInput
from slam_backend.measurements import Measurements

FARTHEST_MOVE = 1e4  # [m, rad]; no robot moves so far between two steps
FARTHEST_POINT = 1e4  # [m]; no camera measures so far; at a million times this, covariances overflow
FLATTEST = 1e4  # depth over breadth of a stereo point's covariance; flatter ones lose their digits
FARTHEST_POSE = 1e6  # [m, rad]; no robot goes so far from its start


def check_step(
    k: int, size: int, camera: StereoCamera, odometry: Any, measurements: Any, identities: Any, poses: Any
) -> list[RobotInput]:
    """Return the arguments of `FastSlam.step` for k robots, checked, robot by robot.

    Args:
        k: Number of robots.
        size: Length of the map's descriptors, 0 if there are none yet.
        camera: Of the robots.
        odometry, measurements, identities, poses: As in `FastSlam.step`.

    Raises:
        ValueError: If one is ill-formed; the text names it.
    """
    none = [None] * k
    for name, value in (
        ("odometry", odometry),
        ("measurements", measurements),
        ("identities", identities),
        ("poses", poses),
    ):
        if value is None and name in ("identities", "poses"):
            continue
        if isinstance(value, Measurements) or not hasattr(value, "__len__") or len(value) != k:
            got = f"a sequence of {len(value)}" if hasattr(value, "__len__") else value
            got = "a bare frame" if isinstance(value, Measurements) else got
            raise bad_argument(name, f"a sequence with one entry per robot ({k})", got, "Use None for no reading.")
    identities = none if identities is None else identities
    poses = none if poses is None else poses
    inputs = []
    for robot in range(k):
        move, frame, identity, pose = odometry[robot], measurements[robot], identities[robot], poses[robot]
        if move is not None:
            move = _check_move(robot, move)
        if frame is not None:
            if not isinstance(frame, Measurements):
                raise bad_argument(f"measurements[{robot}]", "Measurements or None", frame, "Wrap the arrays.")
            if len(frame):
                size = _check_frame(robot, frame, size, camera)
        if identity is not None:
            wanted = (0 if frame is None else len(frame),)
            if type(identity) is np.ndarray and identity.dtype == np.int64 and identity.shape == wanted:
                identity = np.array(identity)
            else:
                cure = "Name each measurement."
                identity = check_array(f"identities[{robot}]", identity, wanted, cure, dtype=np.int64)
        if pose is not None:
            pose = _check_pose(robot, pose)
        inputs.append(RobotInput(move, frame, identity, pose))
    return inputs


def _check_move(robot: int, move: Any) -> FloatArray:
    """Return a robot's odometry as a checked array."""
    if type(move) is np.ndarray and move.dtype == np.float64 and move.shape == (3,):
        x, y, turn = move.tolist()
        far = FARTHEST_MOVE
        if -far <= x <= far and -far <= y <= far and -far <= turn <= far:  # NaN is not
            return np.asarray(move.copy())
    cure = "Give the motion (dx, dy, dtheta) in the previous robot frame, or None."
    checked = check_array(f"odometry[{robot}]", move, (3,), cure)
    if np.abs(checked).max() > FARTHEST_MOVE:
        cure = "Check the units: metres and radians since the robot's last step."
        raise bad_argument(f"odometry[{robot}]", f"numbers within +-{FARTHEST_MOVE:g}", move, cure)
    return checked


def _check_pose(robot: int, pose: Any) -> FloatArray:
    """Return a robot's exact pose as a checked array."""
    cure = "Give (x, y, theta) in the robot's own start frame, or None."
    checked = check_array(f"poses[{robot}]", pose, (3,), cure)
    if np.abs(checked).max() > FARTHEST_POSE:
        cure = "Check the units: metres and radians from the robot's start."
        raise bad_argument(f"poses[{robot}]", f"numbers within +-{FARTHEST_POSE:g}", pose, cure)
    return checked


def _check_frame(robot: int, frame: Measurements, size: int, camera: StereoCamera) -> int:
    """Check one frame against the map's descriptor size (0 = any) and the camera model; return its descriptor size."""
    if size not in (0, frame.descriptors.shape[1]):
        raise bad_argument(
            f"measurements[{robot}].descriptors",
            f"vectors of size {size} as in the map",
            f"shape {frame.descriptors.shape}",
            "Use one kind of descriptor throughout a run.",
        )
    nearest, farthest = _kernels.extent(frame.points)
    limit = FARTHEST_POINT
    if frame.covariances is None:
        limit = min(limit, FLATTEST * camera.baseline * camera.sigma_px / camera.sigma_disparity_px)
    if farthest > limit:
        cure = "Check the units, metres, and drop points without disparity."
        raise bad_argument(f"measurements[{robot}].points", f"numbers within +-{limit:g}", farthest, cure)
    if frame.covariances is None and nearest < _kernels.MIN_DEPTH:
        raise bad_argument(
            f"measurements[{robot}].points",
            f"depths Z >= {_kernels.MIN_DEPTH} m",
            nearest,
            "Drop points at or behind the camera, or give covariances.",
        )
    return int(frame.descriptors.shape[1])
