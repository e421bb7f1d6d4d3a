"""Harris corners with sub-pixel peaks, spread over the image.

Harris and Stephens (1988), "A Combined Corner and Edge Detector", Alvey Vision Conference. The response comes from
OpenCV; its peaks are found here, because their sub-pixel positions need the response itself.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from slam_backend.core.jit import jit
from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import MOST, Float32Array, FloatArray, IntArray, check_float, check_int, known_names
from slam_backend.frontend.images import Image, check_image

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

LARGEST_WINDOW = 1000  # [px]
SENSITIVITY = 0.04  # k of det - k trace^2


@short_repr
@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class CornerOptions:
    """Options of corner detection.

    Attributes:
        most: Maximum number of corners in an image.
        block: Side of the window over which gradients are summed [px].
        spacing: Distance along rows and columns within which only the strongest corner is kept [px].
        relative: Minimum response, as a share of the strongest in the image.
        absolute: Minimum response, in OpenCV's units for grey levels of 0..1. The response grows with the fourth power
            of contrast: corners of steps by 10 of 255 grey levels have about 3e-6, noise of 2 grey levels less than
            1e-7.
        border: Minimum distance from the border [px].
        cell: Side of the squares over which the corners are spread [px].
    """

    most: int = 160
    block: int = 3
    spacing: int = 4
    relative: float = 1e-4
    absolute: float = 1e-6
    border: int = 8
    cell: int = 32

    def __post_init__(self) -> None:
        for name in ("block", "spacing"):
            check_int(f"corners.{name}", getattr(self, name), 1, "Use at least 1.", LARGEST_WINDOW)
        for name in ("most", "cell"):
            check_int(f"corners.{name}", getattr(self, name), 1, "Use at least 1.", MOST)
        check_int("corners.border", self.border, self.spacing, "The search around a corner needs this margin.", MOST)
        for name in ("relative", "absolute"):
            value = getattr(self, name)
            check_float(f"corners.{name}", value, "Give a minimum response.", at_least=1e-30, at_most=1e30)


@short_repr
class Corners(NamedTuple):
    """Corners of an image, best first.

    Attributes:
        points: (n, 2) float64 [px]. Column and row; pixel centres are at integers.
        responses: (n,) float64 [-].
    """

    points: FloatArray
    responses: FloatArray


def harris_corners(image: Image, options: CornerOptions | None = None) -> Corners:
    """Find the corners of an image, in the order of `grid_order`.

    The strongest corners of all squares come first, then the second strongest, and so on, so that any number of first
    corners is spread over the image.

    Args:
        image: (H, W) uint8.
        options: Options of corner detection; None: the defaults.

    Returns:
        Corners in that order; none for an image without contrast.

    Raises:
        ValueError: If the image is not an eight-bit grey image.
    """
    options = CornerOptions() if options is None else options
    return find_corners(check_image("image", image), options)


def find_corners(image: Image, options: CornerOptions) -> Corners:
    """Find the corners of a checked image."""
    response: Any = cv2.cornerHarris(image, options.block, 3, SENSITIVITY)
    limit = max(options.absolute, options.relative * float(response.max()))
    side = 2 * options.spacing + 1
    highest = cv2.dilate(response, np.ones((side, side), np.uint8))
    rows, columns = np.divmod(np.flatnonzero(response >= np.maximum(highest, limit)), response.shape[1])
    inside = (np.minimum(rows, columns) >= options.border) & (rows < response.shape[0] - options.border)
    inside &= columns < response.shape[1] - options.border
    found = np.column_stack([rows, columns])[inside]
    points, strengths = np.empty((len(found), 2)), np.empty(len(found))
    count = _peaks(response, found, options.spacing, points, strengths)
    points, strengths = points[:count], strengths[:count]
    order = grid_order(points, strengths, options.cell)[: options.most]
    return Corners(points[order], strengths[order])


def grid_order(points: FloatArray, quality: FloatArray, cell: float) -> IntArray:
    """Return the order (n,) int64 with the best points of all square cells first, then the second best, and so on.

    Args:
        points: (n, 2) float64 [px].
        quality: (n,) float64. Quality, larger is better; orders points within a cell, and those of equal rank.
        cell: Side of a cell [px].

    >>> grid_order(np.array([[1.0, 1.0], [2.0, 2.0], [40.0, 2.0]]), np.array([5.0, 9.0, 1.0]), 32.0).tolist()
    [1, 2, 0]
    """
    best_first = np.argsort(-quality, kind="stable")
    squares = np.floor(points[best_first] / cell).astype(np.int64)
    _, cells, sizes = np.unique(squares, axis=0, return_inverse=True, return_counts=True)
    by_cell = np.argsort(cells, kind="stable")
    ranks = np.empty(len(squares), dtype=np.int64)
    ranks[by_cell] = np.arange(len(squares)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
    return np.asarray(best_first[np.argsort(ranks, kind="stable")])


@jit
def _peaks(response: Float32Array, found: IntArray, spacing: int, points: FloatArray, strengths: FloatArray) -> int:
    """Write the sub-pixel positions of maxima of (H, W) at pixels `found` (n, 2) (row, column); return their number.

    The first of equal maxima within the spacing is used. A position is the peak of the paraboloid through the 3 x 3
    neighbourhood, or the centre of the pixel if that peak does not exist or lies outside the neighbourhood.
    """
    count = 0
    for n in range(len(found)):
        row, column = found[n]
        value = response[row, column]
        first = True
        for j in range(row - spacing, row + 1):
            for i in range(column - spacing, column + spacing + 1):
                if response[j, i] == value and (j < row or i < column):
                    first = False
        if not first:
            continue
        centre = np.float64(value)
        west, east = np.float64(response[row, column - 1]), np.float64(response[row, column + 1])
        north, south = np.float64(response[row - 1, column]), np.float64(response[row + 1, column])
        gx, gy = 0.5 * (east - west), 0.5 * (south - north)
        hxx, hyy = east - 2.0 * centre + west, south - 2.0 * centre + north
        hxy = 0.25 * (
            np.float64(response[row + 1, column + 1])
            - np.float64(response[row + 1, column - 1])
            - np.float64(response[row - 1, column + 1])
            + np.float64(response[row - 1, column - 1])
        )
        determinant = hxx * hyy - hxy * hxy
        dx, dy = 0.0, 0.0
        if determinant > 0.0 and hxx < 0.0:
            dx = -(hyy * gx - hxy * gy) / determinant
            dy = -(hxx * gy - hxy * gx) / determinant
            if abs(dx) > 1.0 or abs(dy) > 1.0:
                dx, dy = 0.0, 0.0
        points[count, 0], points[count, 1] = column + dx, row + dy
        strengths[count] = centre
        count += 1
    return count
