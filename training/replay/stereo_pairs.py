"""Spatial alignment of two local visual maps of one room, each from a single stereo pair (EuRoC)."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from slam_backend.core.image_files import read_grey_image
from slam_backend.core.text_files import data_lines, line_error, parse_numbers, read_text
from slam_backend.core.validation import FloatArray, argument_error
from slam_backend.frontend import DESCRIPTOR_TYPES, CornerOptions, FrontEndOptions, StereoFrame, StereoFrontEnd
from slam_backend.frontend.images import Image
from slam_backend.frontend.odometry import CameraMotion, camera_motion
from slam_backend.geometry3d import rotation_angle
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.models.camera import ROBOT_FROM_CAMERA, StereoCamera
from slam_backend.readers.calibration import Rectified, Rectifier
from slam_backend.readers.stereo_files import StereoFiles, find_pairs, load_rig, truth_file
from training.experiments.config import Descriptor
from training.experiments.study import Column, ResultTable

FILES = StereoFiles()
POSES_FILE = "poses_dev.txt"
PAIRS = 2  # places
CORNERS = 1500
SIGMA_PX, SIGMA_DISPARITY_PX = 0.5, 0.3
ITERATIONS = 2000


@dataclass(frozen=True, slots=True, eq=False)
class RoomPairs:
    """Two stereo pairs of one room."""

    images: tuple[tuple[Image, Image], tuple[Image, Image]]  # Raw left and right image of each place
    rectifier: Rectifier | Rectified  # Rectification of the stereo rig
    # Body pose in the world at each place, (4, 4) float64 [m]; None if unknown
    poses: tuple[FloatArray, FloatArray] | None


@dataclass(frozen=True, slots=True, eq=False)
class PairsResult:
    """Alignment of two local maps."""

    images: tuple[Image, Image]  # Rectified left image of each place
    frames: tuple[StereoFrame, StereoFrame]  # Points of each place
    motion: CameraMotion | None  # Transform from the second camera to the first; None if not found
    error_m: float  # Error of the translation [m]; NaN if unknown
    error_deg: float  # Error of the rotation [degrees]; NaN if unknown
    true_m: float  # Distance between the places [m]; NaN if unknown
    true_deg: float  # Angle between them [degrees]; NaN if unknown
    # Map of the points of each place: x ahead of the left camera, y to the left, z up
    maps: tuple[LandmarkMap, LandmarkMap]


def load_pairs(path: str | Path, files: StereoFiles = FILES) -> RoomPairs:
    """Read two pairs, their calibration and, if present, their poses.

    Args:
        files: File names within the folder. `truth` has two rows of an image, a quaternion w x y z and a position, or
            of a 3 x 4 matrix; None: `poses_dev.txt`, if present.

    Raises:
        ValueError: If a file is missing or malformed, or there are not exactly two pairs; the message names it.
    """
    left, right = find_pairs(path, files)
    if len(left) != PAIRS:
        got = f"a folder with {len(left)}"
        raise argument_error("path", "two stereo pairs", got, "Replay a drive with `vslam replay stereo`.")
    images = [(read_grey_image(one), read_grey_image(other)) for one, other in zip(left, right, strict=True)]
    height, width = images[0][0].shape
    file, usual = truth_file(path, files), Path(path) / POSES_FILE
    file = usual if file is None and usual.is_file() else file
    return RoomPairs(
        images=(images[0], images[1]), rectifier=load_rig(path, files.calibration, (width, height)),
        poses=None if file is None else _read_poses(file),
    )  # fmt: skip


def align_pairs(log: RoomPairs, descriptor: Descriptor, max_range: float = 12.0, seed: int = 0) -> PairsResult:
    """Measure both pairs, match their points by appearance, and estimate the motion between the cameras."""
    rectifier, size = log.rectifier, log.rectifier.camera
    camera = rectifier.pair.camera(
        size.width, size.height, max_range=max_range, sigma_px=SIGMA_PX, sigma_disparity_px=SIGMA_DISPARITY_PX
    )
    seen = FrontEndOptions(descriptor=descriptor, corners=CornerOptions(most=CORNERS))
    eye = StereoFrontEnd(camera, seen, rectifier.pair.centre_px)
    rectified = [rectifier.rectify(*pair) for pair in log.images]
    first, second = (eye.measure(*pair) for pair in rectified)
    # Distant views have less similar descriptors; RANSAC rejects wrong matches.
    gate = 2.0 * DESCRIPTOR_TYPES[descriptor].gate
    rng = np.random.default_rng(seed)
    motion = camera_motion(first.measurements, second.measurements, camera, gate, rng, ITERATIONS)
    error, apart = (np.nan, np.nan), (np.nan, np.nan)
    if log.poses is not None:
        world = [pose @ rectifier.body_from_camera for pose in log.poses]
        true: FloatArray = np.asarray(np.linalg.solve(world[0], world[1]), dtype=np.float64)
        apart = _size(true[:3, 3], true[:3, :3])
        if motion is not None:
            error = _size(motion.translation - true[:3, 3], motion.rotation.T @ true[:3, :3])
    images, maps = (rectified[0][0], rectified[1][0]), (_map_of(first, camera), _map_of(second, camera))
    return PairsResult(images, (first, second), motion, *error, *apart, maps)


def _size(translation: FloatArray, rotation: FloatArray) -> tuple[float, float]:
    """Return the length [m] and the angle [degrees] of a motion."""
    return float(np.linalg.norm(translation)), float(np.degrees(rotation_angle(rotation)))


def _map_of(frame: StereoFrame, camera: StereoCamera) -> LandmarkMap:
    """Return the points of a pair as a map in robot axes at the left camera."""
    points, turn = frame.measurements.points, ROBOT_FROM_CAMERA
    return LandmarkMap(points @ turn.T, turn @ camera.covariance(points) @ turn.T, frame.measurements.descriptors)


def row_of(descriptor: str, result: PairsResult) -> dict[str, Any]:
    """Return the row of a descriptor."""
    motion = result.motion
    return {
        "descriptor": descriptor,
        **{f"points_{place}": len(frame.measurements) for place, frame in enumerate(result.frames)},
        "matches": 0 if motion is None else len(motion.pairs),
        "inliers": 0 if motion is None else int(motion.inliers.sum()), "error_m": result.error_m,
        "error_deg": result.error_deg, "true_m": result.true_m, "true_deg": result.true_deg,
    }  # fmt: skip


TABLE = ResultTable(
    name="motion", title="Motion between the two places", by=("descriptor",),
    columns=(
        Column("points_0", "points", digits=0), Column("points_1", "points at the second place", digits=0),
        Column("matches", digits=0), Column("inliers", digits=0), Column("error_m"), Column("error_deg", digits=2),
    ),
)  # fmt: skip


def _read_poses(file: Path) -> tuple[FloatArray, FloatArray]:
    """Read two poses: image, quaternion w x y z, position x y z; or a 3 x 4 matrix, optionally after a time."""
    poses = []
    for number, line in data_lines(read_text(file, kind="a file of two poses")):
        values = parse_numbers(line.split())
        if values is None or len(values) not in (8, 12, 13) or not np.isfinite(values).all():
            raise line_error("path", "8 or 12 finite numbers", line, file, number)
        row = np.array(values)
        pose = np.eye(4)
        if len(row) > 8:
            pose[:3] = row[-12:].reshape(3, 4)
            poses.append(pose)
            continue
        pose[:3, :3] = Rotation.from_quat(row[[2, 3, 4, 1]]).as_matrix()
        pose[:3, 3] = row[5:]
        poses.append(pose)
    if len(poses) != PAIRS:
        raise argument_error("path", f"{file.name} with two poses", f"a file of {len(poses)}", f"Check {str(file)!r}.")
    return poses[0], poses[1]
