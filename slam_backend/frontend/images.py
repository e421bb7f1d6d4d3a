"""Validation of grey eight-bit images."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import argument_error

Image = NDArray[np.uint8]

SMALLEST = 16  # px; smaller images have no room for a patch
LARGEST = 1 << 23  # pixels; sums of grey levels fit 32 bits


def check_image(name: str, image: Any) -> Image:
    """Return `image` as a C-ordered (H, W) uint8 array, without a copy if it is one already.

    Args:
        name: Name of the argument in error messages.
        image: (H, W) uint8, at least 16 x 16.

    Raises:
        ValueError: If it is in colour, not of eight bits, or too small or too large.

    >>> check_image("left", np.zeros((240, 320, 3), np.uint8))
    Traceback (most recent call last):
        ...
    ValueError: left: expected a grey image (H, W), got a colour image (240, 320, 3). Convert it first.
    """
    array = np.asarray(image)
    if array.ndim == 3 and array.shape[2] in (1, 3, 4):
        hint = "Convert it first."
        raise argument_error(name, "a grey image (H, W)", f"a colour image {array.shape}", hint)
    if array.ndim != 2:
        raise argument_error(name, "a grey image (H, W)", f"shape {array.shape}", "Give rows and columns.")
    if array.dtype != np.uint8:
        hint = "Scale it to 0..255 and round."
        raise argument_error(name, "an image of dtype uint8", f"an array of dtype {array.dtype}", hint)
    if min(array.shape) < SMALLEST or array.size > LARGEST:
        expected = f"at least {SMALLEST} rows and columns and at most {LARGEST} pixels"
        raise argument_error(name, expected, f"shape {array.shape}", "Crop or scale it.")
    # Kernels are compiled for writable arrays; read-only ones would need another compilation.
    return np.ascontiguousarray(array) if array.flags.writeable else array.copy()
