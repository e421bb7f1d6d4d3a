"""Upright SURF (u-SURF) descriptors of 64 numbers, in compiled code.

Bay, Ess, Tuytelaars, Van Gool (2008), "Speeded-Up Robust Features (SURF)", Computer Vision and Image Understanding 110,
Sec. 4.2, without the rotation of Sec. 4.1. Box edges are not rounded to pixels. With the scale s:

- 20 x 20 samples at offsets (i - 9.5) s from the point, i = 0..19;
- at each the Haar responses of side 2 s: dx = right half - left half, dy = lower half - upper half;
- each response is weighted by one Gaussian of 3.3 s about the point;
- 4 x 4 cells of 5 x 5 samples, row by row; each gives [sum dx, sum dy, sum |dx|, sum |dy|]; unit L2 norm.

All box edges lie on one lattice of 22 x 22 points, so that 484 reads of the integral image suffice for 400 samples.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import jit_fma
from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.validation import Float32Array, FloatArray, argument_error, check_array
from slam_backend.frontend.images import Image, check_image

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

SIZE = 64
SAMPLES = 20  # along a side of the window
EDGES = SAMPLES + 2  # lattice points along a side
GAUSSIAN = 3.3  # standard deviation of the weights, in units of the scale
FLAT = 1e-3  # [grey level px^2] length of an unnormalised descriptor below which a patch has no contrast
WEIGHTS = np.exp(-0.5 * ((np.arange(SAMPLES) - 0.5 * (SAMPLES - 1)) / GAUSSIAN) ** 2).astype(np.float32)


def usurf_descriptors(image: Any, points_xy: Any, scales: Any) -> Float32Array:
    """Return upright SURF descriptors of points of an image.

    The image is extended beyond its border by its outermost pixels. A patch without contrast has the zero vector.

    Args:
        image: (H, W) uint8.
        points_xy: (n, 2) float64 [px]. Column and row; pixel centres are at integers.
        scales: (n,) float64 or one number [px]. Scales s; the window is 21 s wide.

    Returns:
        (n, 64) float32, of unit length.

    Raises:
        ValueError: If the image is not an eight-bit grey image, a shape is wrong, or a scale is not positive.
    """
    image = check_image("image", image)
    points: Any = check_array("points_xy", points_xy, (None, 2), "Give one row (column, row) per point.")
    sizes = np.broadcast_to(np.asarray(scales, dtype=np.float64), (len(points),)) if np.ndim(scales) == 0 else scales
    checked: Any = check_array("scales", sizes, (len(points),), "Give one scale per point, or one for all.")
    if len(checked) and checked.min() <= 0.0:
        raise argument_error("scales", "numbers > 0", float(checked.min()), "Give pixels; 2.3 is a good value.")
    return describe(integral_of(image), points, checked)


def integral_of(image: Image) -> NDArray[np.int32]:
    """Return the sums (H + 1, W + 1) int32 of all pixels above and left of each pixel corner."""
    return np.asarray(cv2.integral(image, sdepth=cv2.CV_32S))


def describe(integral: NDArray[np.int32], points: FloatArray, scales: FloatArray) -> Float32Array:
    """Return descriptors of points (n, 2) [px] at scales (n,) [px] of an image given by `integral_of`, unchecked."""
    descriptors = np.empty((len(points), SIZE), dtype=np.float32)
    _describe(integral, points, scales, WEIGHTS, descriptors)
    return descriptors


@jit_fma
def _describe(
    integral: NDArray[np.int32],
    points: FloatArray,
    scales: FloatArray,
    weights: Float32Array,
    descriptors: Float32Array,
) -> None:
    """Write `descriptors` (n, 64).

    Between two pixel corners the integral of a piecewise constant image is bilinear. The polynomial of the outermost
    pixel extends it beyond the border, which replicates the edge.
    """
    rows, columns = integral.shape[0] - 1, integral.shape[1] - 1
    lattice = np.empty((EDGES, EDGES), dtype=np.float64)
    column_of = np.empty(EDGES, dtype=np.int64)
    column_share = np.empty(EDGES, dtype=np.float64)
    boxes = np.empty((EDGES - 1, EDGES - 1), dtype=np.float32)
    sums = np.empty((4, SAMPLES), dtype=np.float32)  # over the five rows of a cell, column by column
    half = 0.5 * (EDGES - 1)
    for n in range(len(points)):
        s = scales[n]
        left, top = points[n, 0] + 0.5 - half * s, points[n, 1] + 0.5 - half * s
        for i in range(EDGES):
            x = left + i * s
            column_of[i] = min(max(int(np.floor(x)), 0), columns - 1)
            column_share[i] = x - column_of[i]
        for j in range(EDGES):
            y = top + j * s
            row = min(max(int(np.floor(y)), 0), rows - 1)
            share = y - row
            for i in range(EDGES):
                c, f = column_of[i], column_share[i]
                a, b = np.float64(integral[row, c]), np.float64(integral[row, c + 1])
                d, e = np.float64(integral[row + 1, c]), np.float64(integral[row + 1, c + 1])
                above = a + f * (b - a)
                lattice[j, i] = above + share * (d + f * (e - d) - above)
        for j in range(EDGES - 1):  # float64 for differences of large sums, float32 for their result
            for i in range(EDGES - 1):
                boxes[j, i] = (lattice[j + 1, i + 1] - lattice[j + 1, i]) - (lattice[j, i + 1] - lattice[j, i])
        square = np.float32(0.0)
        for cell_row in range(4):
            for i in range(SAMPLES):
                sums[0, i], sums[1, i], sums[2, i], sums[3, i] = 0.0, 0.0, 0.0, 0.0
            for j in range(5 * cell_row, 5 * cell_row + 5):
                for i in range(SAMPLES):
                    w = weights[j] * weights[i]
                    falling = boxes[j + 1, i + 1] - boxes[j, i]
                    rising = boxes[j + 1, i] - boxes[j, i + 1]
                    dx, dy = w * (falling - rising), w * (falling + rising)
                    sums[0, i] += dx
                    sums[1, i] += dy
                    sums[2, i] += abs(dx)
                    sums[3, i] += abs(dy)
            for cell in range(4):
                for part in range(4):
                    total = np.float32(0.0)
                    for i in range(5 * cell, 5 * cell + 5):
                        total += sums[part, i]
                    descriptors[n, 16 * cell_row + 4 * cell + part] = total
        for i in range(SIZE):
            square += descriptors[n, i] * descriptors[n, i]
        length = np.sqrt(square)
        inverse = np.float32(1.0) / length if length > FLAT else np.float32(0.0)
        for i in range(SIZE):
            descriptors[n, i] *= inverse
