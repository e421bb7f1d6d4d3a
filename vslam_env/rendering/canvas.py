"""Drawing primitives with sub-pixel positions, and the mapping from metres to pixels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.lazy_import import LazyModule
from slam_backend.core.validation import FloatArray
from vslam_env.rendering.palette import Colour

if TYPE_CHECKING:
    import cv2
else:
    cv2 = LazyModule("cv2")  # takes as long to import as numpy

Image = NDArray[np.uint8]

SHIFT = 4  # fractional bits of the coordinates that OpenCV gets
FARTHEST = 20_000.0  # [px] limit against overflow of OpenCV's fixed-point coordinates
MARGIN_M = 0.4  # [m] margin around the world
UNSEEN_PX = 0.3  # tolerance of simplified paths
CHI_SQUARE_95 = 5.991  # 95 % of a planar Gaussian lie inside this squared Mahalanobis distance
FONT = 0  # cv2.FONT_HERSHEY_SIMPLEX
_TURN = 2.0 * np.pi * np.arange(16) / 16
_CIRCLE = np.stack([np.cos(_TURN), np.sin(_TURN)], axis=-1)


@dataclass(frozen=True, slots=True)
class Viewport:
    """Mapping from world points to an image: y points up in the world and down in the image.

    Attributes:
        scale: Scale in both directions [px/m].
        left: World x of the image's left edge [m].
        top: World y of the image's top edge [m].
    """

    scale: float
    left: float
    top: float

    @classmethod
    def around(cls, points: FloatArray, width: int, height: int) -> Self:
        """Return the viewport that fits points with a margin into an image, centred and undistorted.

        Args:
            points: (n, 2) float64 [m], world frame, n >= 1. Points to show.
            width, height: Size of the image [px].
        """
        low, high = points.min(axis=0) - MARGIN_M, points.max(axis=0) + MARGIN_M
        scale = float(min(width / (high[0] - low[0]), height / (high[1] - low[1])))
        centre = 0.5 * (low + high)
        return cls(scale, float(centre[0] - 0.5 * width / scale), float(centre[1] + 0.5 * height / scale))

    def pixels(self, points: FloatArray) -> FloatArray:
        """Return the image positions (..., 2) [px] of world points (..., 2 or more) [m]."""
        x, y = (points[..., 0] - self.left) * self.scale, (self.top - points[..., 1]) * self.scale
        return np.clip(np.stack([x, y], axis=-1), -FARTHEST, FARTHEST)


def fixed(points: FloatArray) -> NDArray[np.int32]:
    """Return positions (..., 2) [px] as OpenCV's fixed-point numbers, with (0, 0) at the centre of the first pixel."""
    return np.rint((points - 0.5) * (1 << SHIFT)).astype(np.int32)


def fill(image: Image, colour: Colour) -> None:
    """Fill an image with one colour."""
    image[:] = np.full((image.shape[1], 3), colour, np.uint8)  # row by row: eight times as fast as pixel by pixel


def lines(image: Image, points: Sequence[FloatArray] | FloatArray, colour: Colour, width: int, closed: bool) -> None:
    """Draw polylines, anti-aliased.

    Args:
        image: (H, W, 3) uint8; changed in place.
        points: Points of each line (n, 2) float64 [px]; an array (lines, n, 2) if all have the same length.
        colour: Colour (RGB).
        width: Width of the lines [px].
        closed: Whether the last point is joined to the first.
    """
    if len(points):
        paths: Any = list(fixed(points)) if isinstance(points, np.ndarray) else [fixed(line) for line in points]
        cv2.polylines(image, paths, closed, colour, width, cv2.LINE_AA, SHIFT)


def path(image: Image, points: FloatArray, colour: Colour, width: int) -> None:
    """Draw a long polyline, simplified below the visible resolution.

    Args:
        image: (H, W, 3) uint8; changed in place.
        points: (n, 2) float64 [px]. Points of the line.
        colour: Colour (RGB).
        width: Width of the line [px].
    """
    if len(points) > 1:
        corners = cv2.approxPolyDP(points.astype(np.float32)[:, None], UNSEEN_PX, closed=False)
        lines(image, corners[:, 0].astype(np.float64)[None], colour, width, False)


def disc(image: Image, centre: FloatArray, radius: float, colour: Colour, width: int = -1) -> None:
    """Draw a circle.

    Args:
        image: (H, W, 3) uint8; changed in place.
        centre: (2,) float64 [px]. Centre.
        radius: Radius [px].
        colour: Colour (RGB).
        width: Width of the line [px]; -1 for a filled circle.
    """
    x, y = fixed(centre).tolist()
    cv2.circle(image, (x, y), max(1, round(radius * (1 << SHIFT))), colour, width, cv2.LINE_AA, SHIFT)


def dots(image: Image, centres: FloatArray, radius: float, colour: Colour) -> None:
    """Draw small equal filled discs as polygons, because OpenCV's small circles are diamonds.

    Args:
        image: (H, W, 3) uint8; changed in place.
        centres: (n, 2) float64 [px]. Centres.
        radius: Radius [px].
        colour: Colour (RGB).
    """
    draw, smooth = cv2.fillConvexPoly, cv2.LINE_AA
    # Anti-aliasing adds half a pixel all around.
    for outline in fixed(centres[:, None] + (radius - 0.5) * _CIRCLE[::2]):
        draw(image, outline, colour, smooth, SHIFT)


def translucent_fill(image: Image, centres: FloatArray, radius: float, colour: Colour, opacity: float) -> None:
    """Draw equal translucent discs whose opacity accumulates where they overlap.

    Args:
        image: (H, W, 3) uint8; changed in place.
        centres: (n, 2) float64 [px]. Centres; discs are clipped to the image.
        radius: Radius [px].
        colour: Colour (RGB).
        opacity: Opacity of one disc, in (0, 1).
    """
    reach = int(np.ceil(radius + 0.5))
    inside = (centres > -reach).all(axis=1) & (centres < np.array(image.shape[1::-1]) + reach).all(axis=1)
    if not inside.any():
        return
    corner = np.maximum(np.floor(centres[inside].min(axis=0)).astype(np.int64) - reach, 0)
    end = np.floor(centres[inside].max(axis=0)).astype(np.int64) + reach + 1
    part = image[corner[1] : end[1], corner[0] : end[0]]
    height, width = part.shape[:2]
    centres = centres[inside] - corner
    offsets = np.arange(-reach, reach + 1)
    columns = np.floor(centres[:, 0]).astype(np.int64)[:, None, None] + offsets[None, None, :]
    rows = np.floor(centres[:, 1]).astype(np.int64)[:, None, None] + offsets[None, :, None]
    distance = np.hypot(columns + 0.5 - centres[:, 0, None, None], rows + 0.5 - centres[:, 1, None, None])
    cover = opacity * np.clip(radius + 0.5 - distance, 0.0, 1.0)
    seen = (cover > 0.0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    at = (rows * width + columns)[seen]
    through = np.ones(height * width, np.float32)
    np.multiply.at(through, at, (1.0 - cover[seen]).astype(np.float32))
    covered = np.flatnonzero(through != 1.0)
    share, pixels = through[covered, None], np.divmod(covered, width)
    part[pixels] = np.rint(part[pixels] * share + np.array(colour, np.float32) * (1.0 - share)).astype(np.uint8)


def ellipse_outlines(means: FloatArray, covariances: FloatArray, view: Viewport, smallest: float) -> FloatArray:
    """Return the 95 % regions of planar Gaussians as polygons.

    Args:
        means: (n, 2) float64 [m]. Means.
        covariances: (n, 2, 2) float64 [m^2]. Covariances; indefinite ones give degenerate ellipses.
        view: Mapping from metres to pixels.
        smallest: Least long half axis of a drawn ellipse [px]; smaller ones would be hidden by a dot.

    Returns:
        (m, 16, 2) [px]. Outlines, m <= n.
    """
    xx, xy, yy = covariances[:, 0, 0], 0.5 * (covariances[:, 0, 1] + covariances[:, 1, 0]), covariances[:, 1, 1]
    largest = 0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)
    visible = (xx > 0.0) & (CHI_SQUARE_95 * largest * view.scale**2 >= smallest**2)
    xx, xy, yy = xx[visible], xy[visible], yy[visible]
    # Any square root of the covariance maps the circle onto the ellipse; Cholesky's is the cheapest.
    roots = np.zeros((len(xx), 2, 2))
    roots[:, 0, 0] = np.sqrt(xx)
    roots[:, 1, 0] = xy / roots[:, 0, 0]
    roots[:, 1, 1] = np.sqrt(np.maximum(yy - roots[:, 1, 0] ** 2, 0.0))
    circle = np.sqrt(CHI_SQUARE_95) * _CIRCLE
    return view.pixels(means[visible, None, :] + circle @ roots.swapaxes(-1, -2))


def text_width(text: str, size: float) -> float:
    """Return the width of a line of text [px]; `size` is the height of a capital [px]."""
    (width, _), _ = cv2.getTextSize(text, FONT, size / 21.0, 1)
    return float(width)


def write(image: Image, text: str, left: float, middle: float, size: float, colour: Colour) -> None:
    """Write one line of text.

    Args:
        image: (H, W, 3) uint8; changed in place.
        text: ASCII text, the character set of OpenCV's font.
        left: Left edge x [px].
        middle: Vertical centre y [px].
        size: Height of a capital [px].
        colour: Colour (RGB).
    """
    where = (round(left), round(middle + 0.5 * size))
    cv2.putText(image, text, where, FONT, size / 21.0, colour, 1, cv2.LINE_AA)
