"""Calibration of stereo pairs from KITTI and EuRoC files, and rectification of raw pairs."""

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slam_backend.core.short_repr import short_repr
from slam_backend.core.text_files import data_lines, parse_numbers, read_text
from slam_backend.core.validation import Float32Array, FloatArray, argument_error, check_array, check_float
from slam_backend.frontend.images import Image, check_image
from slam_backend.models.camera import StereoCamera

SMOOTH_ROTATION = 1e-4  # largest deviation of a rotation matrix from orthogonality


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class RectifiedPair:
    """Calibration of a rectified pair, with parallel optical axes and common rows.

    Attributes:
        focal_px: Focal length [px]; pixels are square.
        centre_px: (2,) float64 [px]. Column and row of the optical axis, the same in both cameras.
        baseline: Distance between the cameras [m].
    """

    focal_px: float
    centre_px: FloatArray
    baseline: float

    def camera(self, width: int, height: int, **changes: Any) -> StereoCamera:
        """Return the camera for images of `width` x `height` [px]; `changes` are further fields of `StereoCamera`."""
        return StereoCamera(focal_px=self.focal_px, baseline=self.baseline, width=width, height=height, **changes)


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class CameraCalibration:
    """Calibration of one pinhole camera with radial and tangential distortion.

    Attributes:
        width: Width of the image [px].
        height: Height of the image [px].
        matrix: (3, 3) float64. Intrinsics.
        distortion: (4,) or (5,) float64. k1, k2, p1, p2 and optionally k3.
        body_from_camera: (4, 4) float64. Rigid motion from camera axes to body axes [m].
    """

    width: int
    height: int
    matrix: FloatArray
    distortion: FloatArray
    body_from_camera: FloatArray


class Rectifier:
    """Rectification of raw stereo images, at the same size.

    Args:
        left: Calibration of the left camera.
        right: Calibration of the right camera.

    Attributes:
        pair: Calibration of the rectified images.
        body_from_camera: (4, 4) float64. Rigid motion from axes of the rectified left camera to body axes [m].

    Raises:
        ValueError: If the images differ in size, or the right camera is not to the right of the left one.
    """

    def __init__(self, left: CameraCalibration, right: CameraCalibration) -> None:
        if (left.width, left.height) != (right.width, right.height):
            got = f"a pair of {left.width} x {left.height} and {right.width} x {right.height} px"
            raise argument_error("right", "a camera with images of the left one's size", got, "Check the calibrations.")
        self._size = left.width, left.height
        right_from_left = np.linalg.solve(right.body_from_camera, left.body_from_camera)
        found: Any = cv2.stereoRectify(
            left.matrix,
            left.distortion,
            right.matrix,
            right.distortion,
            self._size,
            right_from_left[:3, :3],
            right_from_left[:3, 3:],
            flags=cv2.CALIB_ZERO_DISPARITY,
            alpha=0.0,
        )
        rectified_from_left, rectified_from_right, left_projection, right_projection = found[:4]
        focal = float(left_projection[0, 0])
        baseline = -float(right_projection[0, 3]) / focal
        if baseline <= 0.0 or abs(float(right_projection[1, 3])) > abs(float(right_projection[0, 3])):
            hint = "Swap the calibrations; vertical pairs are not supported."
            raise argument_error(
                "right", "a camera to the right of the left one", f"a baseline of {baseline:.3f} m", hint
            )
        self.pair = RectifiedPair(focal, left_projection[:2, 2].copy(), baseline)
        back = np.eye(4)
        back[:3, :3] = rectified_from_left.T
        self.body_from_camera = left.body_from_camera @ back
        self._maps = [
            self._map(camera, turn, projection)
            for camera, turn, projection in (
                (left, rectified_from_left, left_projection),
                (right, rectified_from_right, right_projection),
            )
        ]

    @property
    def camera(self) -> StereoCamera:
        """The rectified camera."""
        return self.pair.camera(*self._size)

    def rectify(self, left: Any, right: Any) -> tuple[Image, Image]:
        """Return the rectified images (H, W) uint8 of a raw pair, interpolated linearly.

        Args:
            left: (H, W) uint8, of the size of the calibration.
            right: (H, W) uint8, of the same size.

        Raises:
            ValueError: If an image is not an eight-bit grey image of the calibration's size.
        """
        rectified = []
        for name, image, (columns, rows) in zip(("left", "right"), (left, right), self._maps, strict=True):
            checked = check_image(name, image)
            if checked.shape != (self._size[1], self._size[0]):
                expected = f"an image of {self._size[0]} x {self._size[1]} px"
                raise argument_error(name, expected, f"shape {checked.shape}", "Check the calibration.")
            rectified.append(np.asarray(cv2.remap(checked, columns, rows, cv2.INTER_LINEAR), dtype=np.uint8))
        return rectified[0], rectified[1]

    def _map(
        self, camera: CameraCalibration, turn: FloatArray, projection: FloatArray
    ) -> tuple[Float32Array, Float32Array]:
        """Return the raw columns and rows of each pixel of the rectified image."""
        maps: Any = cv2.initUndistortRectifyMap(
            camera.matrix, camera.distortion, turn, projection[:, :3], self._size, cv2.CV_32FC1
        )
        return maps[0], maps[1]


class Rectified:
    """Stereo rig with rectified images, which stay unchanged.

    Args:
        pair: Calibration of the images.
        width: Width of the images [px].
        height: Height of the images [px].

    Attributes:
        pair: Calibration of the images.
        body_from_camera: (4, 4) float64. Identity: the body frame is that of the left camera.
    """

    def __init__(self, pair: RectifiedPair, width: int, height: int) -> None:
        self.pair, self.body_from_camera = pair, np.eye(4)
        self._size = width, height

    @property
    def camera(self) -> StereoCamera:
        """The rectified camera."""
        return self.pair.camera(*self._size)

    def rectify(self, left: Any, right: Any) -> tuple[Image, Image]:
        """Return a pair (H, W) uint8 unchanged.

        Raises:
            ValueError: If an image is not an eight-bit grey image of the rig's size.
        """
        for name, image in (("left", left), ("right", right)):
            if check_image(name, image).shape != (self._size[1], self._size[0]):
                expected = f"an image of {self._size[0]} x {self._size[1]} px"
                raise argument_error(name, expected, f"shape {np.shape(image)}", "Give images of one size.")
        return left, right


def load_kitti_calibration(path: str | Path) -> RectifiedPair:
    """Read a file `calib.txt` of KITTI's odometry benchmark: projection matrices of the left and the right camera.

    Args:
        path: File whose first two matrices of 12 numbers are used, with or without names such as `P0:`.

    Raises:
        ValueError: If the file is missing, lacks two such matrices, or these are not a rectified pair.
    """
    file = Path(path)
    found = (parse_numbers(line.split(":", 1)[-1].split()) for _, line in data_lines(_text(file)))
    rows = [numbers for numbers in found if numbers is not None and len(numbers) == 12]
    if len(rows) < 2 or not np.isfinite(rows).all():
        expected = f"{file.name} with two matrices of 12 numbers"
        raise argument_error("calibration", expected, f"a file with {len(rows)}", f"Get {str(file)!r} again.")
    left, right = (np.array(row).reshape(3, 4) for row in rows[:2])
    focal, baseline = left[0, 0], (left[0, 3] - right[0, 3]) / left[0, 0]
    if not (np.allclose(left[:, :3], right[:, :3]) and np.isclose(left[1, 1], focal) and focal > 0.0 and baseline > 0):
        expected = f"{file.name} with a rectified pair of square pixels, the left camera first"
        raise argument_error("calibration", expected, "other matrices", f"Correct {str(file)!r}.")
    return RectifiedPair(float(focal), left[:2, 2].copy(), float(baseline))


def load_euroc_calibration(left: str | Path, right: str | Path) -> Rectifier:
    """Read two files `sensor.yaml` of EuRoC's cameras and prepare the rectification of their images.

    Args:
        left: File of the left camera.
        right: File of the right camera.

    Raises:
        ValueError: If a file is missing or lacks an entry, or the two are not a stereo pair.
    """
    return Rectifier(load_euroc_camera(left), load_euroc_camera(right))


def load_euroc_camera(path: str | Path) -> CameraCalibration:
    """Read one file `sensor.yaml` of EuRoC's cameras: pinhole, radial-tangential distortion, pose on the body.

    Raises:
        ValueError: If the file is missing, lacks an entry, or describes another kind of camera.
    """
    file = Path(path)
    text = re.sub(r"#[^\n]*", "", _text(file))
    model = re.search(r"distortion_model:\s*(\S+)", text)
    if model is not None and model.group(1) not in ("radial-tangential", "radtan", "plumb_bob"):
        raise argument_error(
            "calibration", "the distortion model radial-tangential", repr(model.group(1)), "Undistort."
        )
    pose = _numbers(file, text, "data", (16,)).reshape(4, 4)
    turn = pose[:3, :3]
    rigid = np.abs(turn @ turn.T - np.eye(3)).max() < SMOOTH_ROTATION and np.linalg.det(turn) > 0.0
    if not rigid or not np.array_equal(pose[3], [0.0, 0.0, 0.0, 1.0]):
        raise argument_error("calibration", f"{file.name} with a rigid motion T_BS", "another matrix", "Correct it.")
    fu, fv, cu, cv = _numbers(file, text, "intrinsics", (4,))
    for focal in (fu, fv):
        check_float("calibration.intrinsics", float(focal), "Focal lengths are positive.", above=0.0)
    width, height = _numbers(file, text, "resolution", (2,))
    return CameraCalibration(
        int(width),
        int(height),
        np.array([[fu, 0.0, cu], [0.0, fv, cv], [0.0, 0.0, 1.0]]),
        _numbers(file, text, "distortion_coefficients", (4, 5)),
        pose,
    )


def _text(file: Path) -> str:
    """Return the text of a file."""
    return read_text(file, "calibration", "a file of a calibration")


def _numbers(file: Path, text: str, key: str, counts: tuple[int, ...]) -> FloatArray:
    """Return the list of numbers after a key."""
    found = re.search(rf"\b{key}:\s*\[([^\]]*)\]", text)
    words = [] if found is None else [word for word in re.split(r"[,\s]+", found.group(1)) if word]
    if len(words) not in counts:
        expected = f"{file.name} with {counts[0]} numbers {key!r}"
        raise argument_error("calibration", expected, f"a list of {len(words)}", f"Get {str(file)!r} again.")
    hint = f"Correct {key!r} in {str(file)!r}."
    numbers = parse_numbers(words)
    if numbers is None:
        raise argument_error("calibration", f"numbers after {key!r}", words, hint)
    return np.asarray(check_array("calibration", numbers, (len(words),), hint))
