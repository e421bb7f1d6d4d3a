"""Compiled: what a level pinhole camera sees of textured vertical walls, and which wall each ray meets.

With vertical walls and a level camera, depth is the same along an image column, and what a pixel covers of a wall is a
box along the texture's axes. One table of sums gives its mean exactly, at any distance. A column is rendered as several
sub-columns, each of which meets one wall.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.jit import device, jit, jit_fma, simd
from slam_backend.core.validation import Float32Array, FloatArray, IntArray

NOTHING, ROBOT = -1, -2  # instead of a wall
NEAREST = 0.02  # [m] nothing nearer than this is seen
FLOOR, CEILING = np.float32(60.0), np.float32(205.0)  # grey levels
BODY_TOP = 0.3  # robots end at this height above the reference height [m]
BODY = np.float32(45.0)  # grey level of a robot's edge; its middle is twice as bright
ULP = 1e-9
BYTES_MEAN, BYTES_SIGMA = 510.0, 147.8005  # of the sum of four uniform bytes


@device
@simd
def _nearest(slope: float, local: FloatArray, robots: FloatArray, radius: float) -> tuple[int, float, float]:
    """Follow the ray (1, slope) from the origin of the camera's frame.

    Args:
        slope: Metres to the left per metre ahead.
        local: (n, 4) float64 [m]. Walls, camera frame (ahead, left).
        robots: (m, 2) float64 [m]. Discs, camera frame.
        radius: Radius of these [m].

    Returns:
        Row of the wall (`NOTHING`: none, `ROBOT`: a disc first); metres ahead; and how far along the wall, in [0, 1],
        or how much the disc faces the ray.
    """
    surface, depth, along = NOTHING, np.inf, 0.0
    for i in range(len(local)):
        x1, y1 = local[i, 0], local[i, 1]
        ex, ey = local[i, 2] - x1, local[i, 3] - y1
        cross = ey - slope * ex
        if cross == 0.0:
            continue
        u = (slope * x1 - y1) / cross
        if u < -ULP or u > 1.0 + ULP:
            continue
        t = x1 + u * ex
        if NEAREST < t < depth:
            surface, depth, along = i, t, min(max(u, 0.0), 1.0)
    length = np.sqrt(1.0 + slope * slope)
    for j in range(len(robots)):
        middle = (robots[j, 0] + slope * robots[j, 1]) / length
        aside = robots[j, 0] ** 2 + robots[j, 1] ** 2 - middle * middle
        inside = radius * radius - aside
        if inside > 0.0:
            t = (middle - np.sqrt(inside)) / length
            if NEAREST < t < depth:
                surface, depth, along = ROBOT, t, np.sqrt(inside) / radius
    return surface, depth, along


@jit
def trace(
    columns: FloatArray, local: FloatArray, robots: FloatArray, radius: float, focal: float, centre: float
) -> tuple[IntArray, FloatArray, FloatArray]:
    """Follow the rays through image columns (n,) [px]; see `_nearest` for what comes back, one entry a column."""
    walls, depths, along = (
        np.empty(len(columns), dtype=np.int64),
        np.empty(len(columns)),
        np.empty(len(columns)),
    )
    for n in range(len(columns)):
        slope = -(columns[n] - centre) / focal
        walls[n], depths[n], along[n] = _nearest(slope, local, robots, radius)
    return walls, depths, along


@device
@simd
def _fill_column(
    sums: NDArray[np.int32],
    begin: int,
    first: float,
    last: float,
    top: float,
    step: float,
    share: float,
    cumulative: Float32Array,
    out: Float32Array,
) -> None:
    """Add `share` times the mean of each pixel of a sub-column to `out` (H,).

    Args:
        sums: (C, T + 1) int32. See `Faces`.
        begin: First row of the face.
        first: Left end of what the sub-column covers [texels].
        last: Right end, greater [texels].
        top: Upper end of the first pixel [texels], from the ceiling down.
        step: Height of a pixel [texels].
        share: Share of this sub-column in its column.
        cumulative: (T + 1,) float32. Room.
        out: (H,) float32.
    """
    rows, height = sums.shape[1] - 1, len(out)
    i, j = int(first), int(last)
    f, g = np.float32(first - i), np.float32(last - j)
    i, j = begin + i, begin + j
    low = max(0, int(np.floor(top)))
    high = min(rows, int(np.floor(top + step * height)) + 1)
    for k in range(low, high + 1):  # differences of whole numbers are exact, and small enough for float32
        between = np.float32(sums[j, k] - sums[i, k])
        right = np.float32(sums[j + 1, k] - sums[j, k])
        left = np.float32(sums[i + 1, k] - sums[i, k])
        cumulative[k] = between + g * right - f * left
    width = np.float32(last - first)
    scale = np.float32(share / ((last - first) * step))
    before = np.float32(0.0)
    for v in range(height + 1):  # sums from the ceiling down to the upper end of each pixel
        y = top + step * v
        if y <= 0.0:
            after = np.float32(y * width * CEILING)
        elif y >= rows:
            after = np.float32(cumulative[rows] + np.float32(y - rows) * width * FLOOR)
        else:
            k = int(y)
            after = np.float32(cumulative[k] + np.float32(y - k) * (cumulative[k + 1] - cumulative[k]))
        if v > 0:
            out[v - 1] += scale * (after - before)
        before = after


class Faces(NamedTuple):
    """The pictures of the faces of S walls, see `WallTextures`.

    Attributes:
        sums: (C, T + 1) int32.
        starts: (2 S,) int64.
        columns: (2 S,) int64.
    """

    sums: NDArray[np.int32]
    starts: IntArray
    columns: IntArray


@jit_fma
def render(
    local: FloatArray,
    indices: IntArray,
    robots: FloatArray,
    radius: float,
    optics: FloatArray,
    faces: Faces,
    parts: int,
    out: Float32Array,
) -> None:
    """Render one eye.

    Args:
        local: (n, 4) float64 [m]. Walls near the eye, camera frame (ahead, left).
        indices: (n,) int64. Indices of these walls.
        robots: (m, 2) float64 [m]. Other robots, camera frame.
        radius: Radius of these [m].
        optics: (6,) float64. Focal length, column and row of the axis [px]; heights of the camera and of the ceiling
            above the reference height, and height of a texel [m].
        faces: Pictures of the walls.
        parts: Number of sub-columns of a column.
        out: (W, H) float32, column after column. Grey levels without noise.
    """
    focal, centre_x, centre_y, height, ceiling, texel = optics
    rows = faces.sums.shape[1] - 1
    cumulative = np.empty(rows + 1, dtype=np.float32)
    share = 1.0 / parts
    for column in range(out.shape[0]):
        out[column, :] = 0.0
        for part in range(parts):
            left_edge = column - 0.5 + part * share
            slope = -(left_edge + 0.5 * share - centre_x) / focal
            surface, depth, along = _nearest(slope, local, robots, radius)
            if surface == NOTHING:
                for v in range(out.shape[1]):
                    out[column, v] += np.float32(share) * (CEILING if v < centre_y else FLOOR)
                continue
            per_pixel = depth / focal / texel
            top = (ceiling - height) / texel - (centre_y + 0.5) * per_pixel
            if surface == ROBOT:
                shade = BODY * np.float32(1.0 + along)
                crown = (ceiling - BODY_TOP) / texel
                for v in range(out.shape[1]):
                    y = top + (v + 0.5) * per_pixel
                    level = shade
                    if y < crown:
                        level = CEILING
                    elif y > rows:
                        level = FLOOR
                    out[column, v] += np.float32(share) * level
                continue
            x1, y1 = local[surface, 0], local[surface, 1]
            ex, ey = local[surface, 2] - x1, local[surface, 3] - y1
            face = 2 * indices[surface] + (0 if ex * y1 - ey * x1 < 0.0 else 1)
            texels = float(faces.columns[face])
            ends = (0.0, 0.0)
            for side in range(2):
                ray = -(left_edge + side * share - centre_x) / focal
                cross = ey - ray * ex
                u = (ray * x1 - y1) / cross if cross != 0.0 else along
                u = min(max(u, 0.0), 1.0) * texels
                ends = (u, ends[1]) if side == 0 else (ends[0], u)
            first, last = min(ends), max(ends)
            if last - first < 1e-3:
                first = min(max(along * texels - 5e-4, 0.0), texels - 1e-3)
                last = first + 1e-3
            last = min(last, texels - 1e-6)
            first = min(first, last - 1e-3) if last - 1e-3 >= 0.0 else 0.0
            _fill_column(faces.sums, faces.starts[face], first, last, top, per_pixel, share, cumulative, out[column])


@simd
def expose(
    radiance: Float32Array, noise: NDArray[np.uint8], gain: float, offset: float, sigma: float, image: NDArray[np.uint8]
) -> None:
    """Turn grey levels (W, H), column after column, into an image (H, W) uint8 with noise.

    The noise of a pixel is the sum of four of the uniform bytes (4, H, W), centred and scaled: nearly normal, and
    never more than 3.45 standard deviations.
    """
    scale = np.float32(sigma / BYTES_SIGMA)
    for v in range(image.shape[0]):
        for u in range(image.shape[1]):
            total = np.float32(noise[0, v, u]) + np.float32(noise[1, v, u])
            total += np.float32(noise[2, v, u]) + np.float32(noise[3, v, u])
            value = np.float32(gain) * radiance[u, v] + np.float32(offset) + scale * (total - np.float32(BYTES_MEAN))
            value = min(max(value + np.float32(0.5), np.float32(0.0)), np.float32(255.0))
            image[v, u] = np.uint8(value)
