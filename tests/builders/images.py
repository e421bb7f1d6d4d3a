"""Exact stereo images of planes covered with boxes: each pixel is the mean of what it covers."""

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import FloatArray


def draw_boxes(
    width: int, height: int, shift: float, seed: int = 0, slant: float = 0.0, count: int = 160
) -> NDArray[np.uint8]:
    """Return an image of boxes whose pixel x shows the texture at x + shift + slant (x - middle)."""
    rng = np.random.default_rng(seed)
    corners = rng.uniform([-60.0, -10.0], [width + 60.0, height], (count, 2))
    sizes, levels = rng.uniform(9.0, 40.0, (count, 2)), rng.uniform(10.0, 245.0, count)
    boxes = np.column_stack([corners, corners + sizes])
    middle = 0.5 * (width - 1)
    for column in (0, 2):
        boxes[:, column] = (boxes[:, column] - shift + slant * middle) / (1.0 + slant)
    return paint(width, height, boxes, levels)


def paint(width: int, height: int, boxes: FloatArray, levels: FloatArray) -> NDArray[np.uint8]:
    """Return an image of boxes (n, 4), left, top, right, bottom [px], each over those before it."""
    image = np.full((height, width), 128.0)
    for (left, top, right, bottom), level in zip(boxes, levels, strict=True):
        share = np.outer(_covered(top, bottom, height), _covered(left, right, width))
        image += share * (level - image)
    return np.rint(image).astype(np.uint8)


def _covered(begin: float, end: float, size: int) -> FloatArray:
    pixels = np.arange(size)
    return np.asarray(np.clip(np.minimum(end, pixels + 0.5) - np.maximum(begin, pixels - 0.5), 0.0, 1.0))
