"""The compiled inner loops of stereo matching: nearest descriptors along rows, and patches laid over each other."""

import numpy as np

from slam_backend.core.jit import device, jit, jit_fma, simd
from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray
from slam_backend.frontend.images import Image

LARGEST_PATCH = 31  # px; side of a patch
STILL = 0.01  # [px] a patch that moves less has arrived
FARTHEST = 3.0  # [px] a patch that wanders off farther is lost


@jit
def match_rows(
    left: FloatArray,
    right: FloatArray,
    left_descriptors: Float32Array,
    right_descriptors: Float32Array,
    row_tolerance: float,
    least_disparity: float,
    largest_disparity: float,
    ceiling: float,
) -> tuple[IntArray, BoolArray, Float32Array]:
    """Find for each left corner the right one that looks most like it, near its row and within the disparities.

    Args:
        left: (n, 2) float64 [px].
        right: (m, 2) float64 [px].
        left_descriptors: (n, d) float32.
        right_descriptors: (m, d) float32.
        row_tolerance: Largest difference of rows [px].
        least_disparity, largest_disparity: Bounds on left minus right columns [px].
        ceiling: Largest squared L2 distance of descriptors [-].

    Returns:
        (n,) int64, the right corner or -1; (n,) bool, whether the left corner is also the best for that right one;
        (n,) float32, the squared distance of descriptors.
    """
    partner = np.full(len(left), -1, dtype=np.int64)
    nearest = np.full(len(left), np.float32(ceiling), dtype=np.float32)
    back = np.full(len(right), -1, dtype=np.int64)
    back_nearest = np.full(len(right), np.float32(np.inf), dtype=np.float32)
    size = left_descriptors.shape[1]
    for i in range(len(left)):
        for j in range(len(right)):
            if abs(left[i, 1] - right[j, 1]) > row_tolerance:
                continue
            disparity = left[i, 0] - right[j, 0]
            if disparity < least_disparity or disparity > largest_disparity:
                continue
            square = np.float32(0.0)
            for k in range(size):
                difference = left_descriptors[i, k] - right_descriptors[j, k]
                square += difference * difference
            if square < nearest[i]:
                nearest[i], partner[i] = square, j
            if square < back_nearest[j]:
                back_nearest[j], back[j] = square, i
    mutual = np.zeros(len(left), dtype=np.bool_)
    for i in range(len(left)):
        mutual[i] = partner[i] >= 0 and back[partner[i]] == i
    return partner, mutual, nearest


@device
@simd
def _align_patch(
    source: Image,
    target: Image,
    column: int,
    row: int,
    start_x: float,
    start_y: float,
    iterations: int,
    patches: Float32Array,
    sums: Float32Array,
) -> tuple[float, float, float]:
    """Find where the patch around pixel (`column`, `row`) of `source` lies in `target`.

    Inverse compositional Lucas-Kanade (Baker and Matthews 2004, "Lucas-Kanade 20 Years On", IJCV 56) for a translation,
    on patches without their mean and scaled to one contrast, so that the exposure does not matter. Sums are taken
    column by column, which the compiler turns into vector instructions.

    Args:
        source: (H, W) uint8.
        target: (H, W) uint8.
        column, row: Centre of the patch [px].
        start_x, start_y: Initial position in `target` [px].
        iterations: Limit of their number.
        patches: (3, side, side) float32. Room for the template and its two slopes; the side is odd.
        sums: (6, side) float32. Room.

    Returns:
        Column and row in `target` and the correlation of the patches; correlation -1 where the patch leaves an image
        or has no contrast.
    """
    side = patches.shape[1]
    half, count = side // 2, side * side
    left, top = column - half, row - half
    if left < 1 or top < 1 or left + side >= source.shape[1] or top + side >= source.shape[0]:
        return start_x, start_y, -1.0
    sums[:] = 0.0
    for j in range(side):
        for i in range(side):
            x, y = left + i, top + j
            value = np.float32(source[y, x])
            slope_x = np.float32(0.5) * (np.float32(source[y, x + 1]) - np.float32(source[y, x - 1]))
            slope_y = np.float32(0.5) * (np.float32(source[y + 1, x]) - np.float32(source[y - 1, x]))
            patches[0, j, i], patches[1, j, i], patches[2, j, i] = value, slope_x, slope_y
            sums[0, i] += value
            sums[1, i] += slope_x
            sums[2, i] += slope_y
    total, total_x, total_y = 0.0, 0.0, 0.0
    for i in range(side):
        total, total_x, total_y = total + sums[0, i], total_x + sums[1, i], total_y + sums[2, i]
    mean, mean_x, mean_y = np.float32(total / count), np.float32(total_x / count), np.float32(total_y / count)
    sums[:] = 0.0
    for j in range(side):
        for i in range(side):
            value, slope_x, slope_y = patches[0, j, i] - mean, patches[1, j, i] - mean_x, patches[2, j, i] - mean_y
            patches[0, j, i], patches[1, j, i], patches[2, j, i] = value, slope_x, slope_y
            sums[0, i] += value * value
            sums[1, i] += slope_x * slope_x
            sums[2, i] += slope_x * slope_y
            sums[3, i] += slope_y * slope_y
            sums[4, i] += slope_x * value
            sums[5, i] += slope_y * value
    energy, xx, xy, yy, own_x, own_y = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for i in range(side):
        energy, xx, xy = energy + sums[0, i], xx + sums[1, i], xy + sums[2, i]
        yy, own_x, own_y = yy + sums[3, i], own_x + sums[4, i], own_y + sums[5, i]
    determinant = xx * yy - xy * xy
    if energy < count or determinant <= 1e-6 * xx * yy:
        return start_x, start_y, -1.0
    px, py, correlation = start_x, start_y, -1.0
    for _ in range(iterations):
        left, top = int(np.floor(px)) - half, int(np.floor(py)) - half
        if left < 0 or top < 0 or left + side >= target.shape[1] or top + side >= target.shape[0]:
            return px, py, -1.0
        fx, fy = np.float32(px - np.floor(px)), np.float32(py - np.floor(py))
        a, b = (np.float32(1.0) - fx) * (np.float32(1.0) - fy), fx * (np.float32(1.0) - fy)
        c, d = (np.float32(1.0) - fx) * fy, fx * fy
        sums[:] = 0.0
        for j in range(side):
            for i in range(side):
                value = (
                    a * np.float32(target[top + j, left + i])
                    + b * np.float32(target[top + j, left + i + 1])
                    + c * np.float32(target[top + j + 1, left + i])
                    + d * np.float32(target[top + j + 1, left + i + 1])
                    - mean
                )
                sums[0, i] += value
                sums[1, i] += value * value
                sums[2, i] += value * patches[0, j, i]
                sums[3, i] += value * patches[1, j, i]
                sums[4, i] += value * patches[2, j, i]
        total, square, product, along_x, along_y = 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(side):
            total, square, product = total + sums[0, i], square + sums[1, i], product + sums[2, i]
            along_x, along_y = along_x + sums[3, i], along_y + sums[4, i]
        square -= total * total / count  # template and slopes have no mean, so that it matters here only
        if square < count:
            return px, py, -1.0
        correlation = product / np.sqrt(square * energy)
        scale = np.sqrt(energy / square)
        along_x, along_y = scale * along_x - own_x, scale * along_y - own_y
        dx, dy = (yy * along_x - xy * along_y) / determinant, (xx * along_y - xy * along_x) / determinant
        px, py = px - dx, py - dy
        if not (abs(px - start_x) <= FARTHEST and abs(py - start_y) <= FARTHEST):
            return start_x, start_y, -1.0
        if dx * dx + dy * dy < STILL * STILL:
            break
    return px, py, correlation


@jit_fma
def refine(
    left_image: Image, right_image: Image, left: FloatArray, right: FloatArray, half: int, iterations: int
) -> FloatArray:
    """Lay patches of matched corners over each other, left onto right and back.

    A patch is taken around the whole pixel that is nearest to its corner, without interpolation.

    Args:
        left_image: (H, W) uint8.
        right_image: (H, W) uint8.
        left: (n, 2) float64 [px]. Corners.
        right: (n, 2) float64 [px]. Matched corners of the right image.
        half: Patches are 2 `half` + 1 pixels wide.
        iterations: Limit of their number for each way.

    Returns:
        (n, 6) float64: disparity and row difference (right minus left) by the way forward [px]; the same by the way
        back; correlations forward and back, -1 where a patch was lost.
    """
    found = np.empty((len(left), 6))
    side = 2 * half + 1
    patches = np.empty((3, side, side), dtype=np.float32)
    sums = np.empty((6, side), dtype=np.float32)
    for n in range(len(left)):
        column, row = int(np.rint(left[n, 0])), int(np.rint(left[n, 1]))
        x, y, forward = _align_patch(
            left_image,
            right_image,
            column,
            row,
            column + right[n, 0] - left[n, 0],
            row + right[n, 1] - left[n, 1],
            iterations,
            patches,
            sums,
        )
        found[n, 0], found[n, 1] = column - x, y - row
        found[n, 2], found[n, 3], found[n, 4], found[n, 5] = found[n, 0], found[n, 1], forward, -1.0
        if forward < 0.0:
            continue
        column, row = int(np.rint(x)), int(np.rint(y))
        x, y, backward = _align_patch(
            right_image,
            left_image,
            column,
            row,
            column + found[n, 0],
            row - found[n, 1],
            iterations,
            patches,
            sums,
        )
        found[n, 2], found[n, 3], found[n, 5] = x - column, row - y, backward
    return found
