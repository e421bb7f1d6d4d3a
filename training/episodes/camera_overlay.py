"""What one robot's eyes see, beside the map: its left image with the measured corners, and below it the right one."""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vslam_env.sensors import EyeFrame

NEAR, FAR = (213, 94, 0), (0, 114, 178)  # RGB, of points 1 m and 8 m away
DEPTHS = (1.0, 8.0)  # [m]


def beside_the_map(picture: NDArray[np.uint8], frame: Any, width: int) -> NDArray[np.uint8]:
    """Return a picture (H, W + width, 3) with a robot's two images at its right.

    Args:
        picture: (H, W, 3) uint8, RGB.
        frame: An `EyeFrame`; where it is none, the room stays empty.
        width: Of the images [px].
    """
    height = picture.shape[0]
    panel = np.full((height, width, 3), 24, dtype=np.uint8)
    if isinstance(frame, EyeFrame):
        tall = min(height // 2, round(width * frame.left.shape[0] / frame.left.shape[1]))
        wide = round(tall * frame.left.shape[1] / frame.left.shape[0])
        for row, image in enumerate((draw_eye(frame, (wide, tall)), _large(frame.right, (wide, tall)))):
            panel[row * tall : (row + 1) * tall, :wide] = image
    return np.concatenate([picture, panel], axis=1)


def draw_eye(frame: EyeFrame, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return the left image (h, w, 3) with circles at the measured corners, coloured by depth, and their disparities.

    Args:
        frame: What was seen.
        size: Width and height of the picture [px].
    """
    picture = _large(frame.left, size)
    scale = size[0] / frame.left.shape[1]
    depths = frame.measurements.points[:, 2]
    shares = np.clip((np.log(depths) - np.log(DEPTHS[0])) / np.log(DEPTHS[1] / DEPTHS[0]), 0.0, 1.0)
    for (column, row, disparity), share in zip(frame.seen.pixels.tolist(), shares.tolist(), strict=True):
        colour = tuple(round(near + share * (far - near)) for near, far in zip(NEAR, FAR, strict=True))
        x, y = (round(16.0 * (scale * (value + 0.5) - 0.5)) for value in (column, row))
        cv2.line(picture, (x, y), (x - round(16.0 * scale * disparity), y), colour, 1, cv2.LINE_AA, 4)
        cv2.circle(picture, (x, y), 4 * 16, colour, 2, cv2.LINE_AA, 4)
    return picture


def _large(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    """Return a grey image in RGB at another size."""
    larger = cv2.resize(image, size, interpolation=cv2.INTER_LINEAR)
    return np.asarray(cv2.cvtColor(larger, cv2.COLOR_GRAY2RGB), dtype=np.uint8)
