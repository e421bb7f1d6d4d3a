"""Camera images with corners and landmarks, and image pairs with their matches."""

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from slam_backend.core.files import write_file
from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.frontend import StereoFrame
from slam_backend.frontend.images import Image
from slam_backend.frontend.odometry import CameraMotion
from slam_backend.geometry import inverse, transform_points
from training.experiments.output.plotting import picture

KNOWN, NEW, REFUSED, EXPECTED = (90, 200, 90), (60, 170, 250), (70, 70, 230), (230, 190, 90)  # blue, green, red


@picture
def draw_frame(
    file: Path, image: Image, pixels: FloatArray, ids: IntArray, counts: dict[int, int], expected: FloatArray
) -> None:
    """Draw a stereo frame and its data associations into a PNG file.

    Args:
        pixels: (n, 3) float64 [px]. Column, row and disparity of the measured points.
        ids: (n,) int64. Landmark ids of the points, -1 for rejected ones.
        expected: (m, 2) float64 [px]. Predicted positions of the landmarks in view.
    """
    canvas = cv2.cvtColor(image, cv2.COLOR_GRAY2BGR)
    for column, row in expected:
        cv2.circle(canvas, _fine(column, row), 5 * 16, EXPECTED, 1, cv2.LINE_AA, 4)
    for (column, row, disparity), name in zip(pixels, ids.tolist(), strict=True):
        colour = REFUSED if name < 0 else KNOWN if counts.get(name, 0) > 1 else NEW
        cv2.line(canvas, _fine(column, row), _fine(column - disparity, row), colour, 1, cv2.LINE_AA, 4)
        cv2.circle(canvas, _fine(column, row), 2 * 16, colour, -1, cv2.LINE_AA, 4)
    _write(file, canvas)


@picture
def draw_matches(file: Path, images: tuple[Image, Image], frames: Sequence[StereoFrame], motion: CameraMotion) -> None:
    """Draw two images, one above the other, with lines between matched points; wrong matches are red."""
    (left, right), good = images, set(np.flatnonzero(motion.inliers).tolist())
    a, b = (frame.pixels[rows, :2] for frame, rows in zip(frames, motion.pairs.T, strict=True))
    width = max(left.shape[1], right.shape[1])
    canvas = np.zeros((left.shape[0] + right.shape[0], width), np.uint8)
    canvas[: left.shape[0], : left.shape[1]] = left
    canvas[left.shape[0] :, : right.shape[1]] = right
    picture = cv2.cvtColor(canvas, cv2.COLOR_GRAY2BGR)
    for row in sorted(range(len(a)), key=lambda n: n in good):
        colour = KNOWN if row in good else REFUSED
        ends = _fine(*a[row]), _fine(b[row, 0], b[row, 1] + left.shape[0])
        cv2.line(picture, *ends, colour, 1, cv2.LINE_AA, 4)
    _write(file, picture)


def expected_pixels(
    landmarks: FloatArray, pose: FloatArray, focal_px: float, centre_px: FloatArray, reach: float
) -> FloatArray:
    """Return the image positions (m, 2) [px] of landmarks in front of a level camera within `reach` [m].

    Args:
        landmarks: (N, 3) [m], start frame: x ahead, y left, z above the camera.
        pose: (3,) [m, m, rad], start frame. Pose of the camera.
    """
    local = transform_points(inverse(pose), landmarks)
    local = local[(local[:, 0] > 1.0) & (local[:, 0] < reach)]
    return np.asarray(centre_px - focal_px * local[:, 1:] / local[:, :1])


def _fine(column: float, row: float) -> tuple[int, int]:
    """Return a point in sixteenths of a pixel, the unit of OpenCV's drawing functions."""
    return round(16.0 * float(column)), round(16.0 * float(row))


def _write(file: Path, picture: np.ndarray) -> None:
    write_file(file, cv2.imencode(file.suffix, picture)[1].tobytes(), "out")
