"""Reader of image files of users: limits before memory is taken, transparency, and depths of 1 to 16 bits."""

import io
import warnings
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.text_files import read_bytes
from slam_backend.core.validation import argument_error

MOST_PIXELS = 50_000_000  # 350 x 350 m of a ROS map with cells of 5 cm
MOST_MEGABYTES = 512
FORMATS = ("PNG", "JPEG", "PPM", "BMP", "WEBP", "GIF")  # libtiff prints lines of its own

Pixels = NDArray[np.uint8]


def read_image(path: str | PathLike[str], name: str = "path", hint: str = "Save it as PNG.") -> tuple[Pixels, Pixels]:
    """Read an image file: PNG, JPEG, PGM, PPM, BMP, WebP or GIF.

    Values of PGM files are scaled by their largest value. Of 16 bits the upper 8 are kept, or the lower 8 where no
    value uses the upper ones. The orientation that a camera noted is applied.

    Args:
        path: Path of the file.
        name: The argument that gave the path, for the error.
        hint: Advice where the file is not an image, a full sentence.

    Returns:
        Colours (H, W, 3) uint8 in the order of OpenCV (blue, green, red), and opacity (H, W) uint8, 255 where the
        image is not transparent.

    Raises:
        ValueError: If the file is missing, is not an intact image, or has more than `MOST_PIXELS` pixels.
    """
    from PIL import Image, ImageOps, UnidentifiedImageError

    content, size = read_bytes(path, name, "an image file", MOST_MEGABYTES), "a larger image"
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # Pillow's own limit of pixels, and remarks on metadata
            with Image.open(io.BytesIO(content), formats=FORMATS) as image:
                size = f"a size of {image.width} x {image.height} px"
                if image.width * image.height > MOST_PIXELS:
                    raise Image.DecompressionBombError
                image.load()
                return _colours(ImageOps.exif_transpose(image))
    except Image.DecompressionBombError as error:  # of Pillow, too, before the size is known
        expected = f"an image of at most {MOST_PIXELS / 1e6:.0f} million pixels"
        raise argument_error(name, expected, size, f"Scale down or crop {str(path)!r}.") from error
    except UnidentifiedImageError as error:
        raise argument_error(name, "an image file", Path(path), hint) from error
    except Exception as error:  # decoders raise errors of many kinds for damaged files
        reason = str(error).partition("\n")[0] or type(error).__name__
        raise argument_error(name, "an intact image file", Path(path), f"The reader says: {reason}. {hint}") from error


def read_grey_image(path: str | PathLike[str], name: str = "path", hint: str = "Save it as PNG.") -> Pixels:
    """Read an image file as grey levels (H, W) uint8; transparent parts are blended over white.

    Raises:
        ValueError: As `read_image` does.
    """
    colours, opacity = read_image(path, name, hint)
    return blend_over_white(grey_levels(colours), opacity)


def grey_levels(colours: Pixels) -> Pixels:
    """Return the brightness (H, W) uint8 of colours (H, W, 3) uint8, blue, green, red."""
    import cv2  # a slow import

    return np.asarray(cv2.cvtColor(colours, cv2.COLOR_BGR2GRAY), dtype=np.uint8)


def blend_over_white(pixels: Pixels, opacity: Pixels) -> Pixels:
    """Return grey levels (H, W) or colours (H, W, 3) uint8 on a white page, given their opacity (H, W) uint8."""
    if opacity.min(initial=255) == 255:
        return pixels
    share = opacity.astype(np.uint16).reshape(opacity.shape + (1,) * (pixels.ndim - 2))
    return ((pixels * share + 255 * (255 - share) + 127) // 255).astype(np.uint8)


def _colours(image: Any) -> tuple[Pixels, Pixels]:
    """Return colours and opacity of a loaded image of Pillow."""
    opaque = np.full((image.height, image.width), 255, dtype=np.uint8)
    if image.mode.startswith(("I", "F")):  # more than 8 bits
        grey = _eight_bits(np.asarray(image))
        return np.repeat(grey[:, :, None], 3, axis=2), opaque
    if image.has_transparency_data:
        whole = np.asarray(image.convert("RGBA"))
        return np.ascontiguousarray(whole[:, :, 2::-1]), np.ascontiguousarray(whole[:, :, 3])
    return np.ascontiguousarray(np.asarray(image.convert("RGB"))[:, :, ::-1]), opaque


def _eight_bits(values: NDArray[Any]) -> Pixels:
    """Return values of more than 8 bits as 8 bits: the upper ones, unless the lower ones hold all."""
    if not np.isfinite(values).all() or values.min(initial=0) < 0 or values.max(initial=0) > 65535:
        raise ValueError("its values are not whole numbers of 16 bits")
    return (values if values.max(initial=0) <= 255 else values / 257.0 + 0.5).astype(np.uint8)
