"""Harris corners with sub-pixel peaks, spread over the image.

Harris and Stephens (1988), "A Combined Corner and Edge Detector", Alvey Vision Conference. The response comes from
OpenCV; its peaks are found here, because the place of a peak between pixels needs the response itself.
"""

from dataclasses import dataclass
from typing import Any, NamedTuple

import cv2
import numpy as np

from slam_backend.core.jit import jit
from slam_backend.core.validation import MOST, Float32Array, FloatArray, IntArray, check_float, check_int, known_names
from slam_backend.frontend.images import Image, check_image

LARGEST_WINDOW = 1000  # [px]
SENSITIVITY = 0.04  # k of det - k trace^2


@known_names
@dataclass(frozen=True, slots=True, kw_only=True)
class CornerOptions:
    """What is a corner, and how many are kept.

    Attributes:
        most: At most so many in an image.
        block: Side of the window over which gradients are summed [px].
        spacing: No other corner within this distance along rows and columns is stronger [px].
        relative: Least response, as a share of the strongest in the image.
        absolute: Least response, in OpenCV's units for grey levels of 0..1. The response grows with the fourth power
            of contrast: corners of steps by 10 of 255 grey levels have about 3e-6, noise of 2 grey levels stays below
            1e-7.
        border: Corners keep this far from the border [px].
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
        check_int("corners.border", self.border, self.spacing, "Leave room for the search around a corner.", MOST)
        for name in ("relative", "absolute"):
            value = getattr(self, name)
            check_float(f"corners.{name}", value, "Give a least response.", at_least=1e-30, at_most=1e30)


class Corners(NamedTuple):
    """Corners of an image, best first.

    Attributes:
        points: (n, 2) float64 [px]. Column and row; pixel centres are at integers.
        responses: (n,) float64 [-].
    """

    points: FloatArray
    responses: FloatArray


def harris_corners(image: Image, options: CornerOptions | None = None) -> Corners:
    """Find corners.

    The strongest corner of each square of the image comes first, strongest square first, then the second of each, and
    so on: any number from the front is spread over the image.

    Args:
        image: (H, W) uint8.
        options: What to look for.

    Returns:
        Corners in that order; none where an image has no contrast.

    Raises:
        ValueError: If the image is not grey and of eight bits.
    """
    options = CornerOptions() if options is None else options
    return find_corners(check_image("image", image), options)


def find_corners(image: Image, options: CornerOptions) -> Corners:
    """Find corners in an image that was checked already."""
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
    """Return the order (n,) int64 that takes the best of each square cell first, then the second best, and so on.

    Args:
        points: (n, 2) float64 [px].
        quality: (n,) float64. Larger is better; decides within a cell, and among the cells' equals.
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
    """Fill in the places of the local maxima of (H, W) at the pixels `found` (n, 2) (row, column); return how many.

    Of equal maxima within the spacing the first one counts. The place of a peak is that of the paraboloid through its
    3 x 3 neighbourhood; where that lies outside the pixels around it, or is no peak, the centre of the pixel.
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
