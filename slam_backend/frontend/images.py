"""What counts as an image: grey, eight bits, two axes; everything else is refused with the cure."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import argument_error

Image = NDArray[np.uint8]

SMALLEST = 16  # px; a smaller image holds no patch
LARGEST = 1 << 23  # pixels; sums of grey levels then fit 32 bits


def check_image(name: str, image: Any) -> Image:
    """Return `image` as a C-ordered (H, W) uint8 array, without a copy if it is one already.

    Args:
        name: The argument as the caller wrote it.
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
        cure = "Convert it first."
        raise argument_error(name, "a grey image (H, W)", f"a colour image {array.shape}", cure)
    if array.ndim != 2:
        raise argument_error(name, "a grey image (H, W)", f"shape {array.shape}", "Give rows and columns.")
    if array.dtype != np.uint8:
        cure = "Scale it to 0..255 and round."
        raise argument_error(name, "an image of dtype uint8", f"an array of dtype {array.dtype}", cure)
    if min(array.shape) < SMALLEST or array.size > LARGEST:
        expected = f"at least {SMALLEST} rows and columns and at most {LARGEST} pixels"
        raise argument_error(name, expected, f"shape {array.shape}", "Crop or scale it.")
    # Kernels are compiled for arrays that can be written; others would be compiled for anew.
    return np.ascontiguousarray(array) if array.flags.writeable else array.copy()
