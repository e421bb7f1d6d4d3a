"""Costs of a grid's cells: walls inflated by the robot's radius, and costs near them."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from vslam_env.navigation._grid_kernels import FREE, OCCUPIED, UNKNOWN

PAD = 2  # cells around the known box, so that loops over frontiers and neighbours need no bounds
OUTSIDE = 3  # beyond the grid: neither known nor worth exploring


CLOSE, NEAR, OPEN = 4, 2, 1  # weights of cells by their distance from walls


@device
@in_place
def _spread(squares: Any, span: int, stride: int, least: Any) -> None:
    """Write the least of each entry and those up to `span` strides before and after it plus the number squared.

    Args:
        squares: (n,) uint8, whose sums with span^2 fit.
        span: >= 0.
        stride: >= 1.
        least: (n,) uint8, result.
    """
    for i in range(len(squares)):
        least[i] = squares[i]
    for gap in range(1, span + 1):
        square = np.uint8(gap * gap)
        after, later = squares[gap * stride :], least[gap * stride :]
        for i in range(len(after)):
            through = np.uint8(after[i] + square)
            least[i] = through if through < least[i] else least[i]  # unlike min(), this becomes vector code
        for i in range(len(later)):
            through = np.uint8(squares[i] + square)
            later[i] = through if through < later[i] else later[i]


@device
@jit
def inflate_costs(box: Any, reach: float) -> Any:
    """Weigh the cells of a box by how near they are to walls.

    Args:
        box: (h, w) uint8.
        reach: Distance from an occupied cell below which a robot may not be, in cells, at most 9.

    Returns:
        (h, w) uint8: 0 where a robot may not be (occupied, unknown, too near to a wall, or at the edge of the box),
        `CLOSE` within one more cell of that, `NEAR` within two or beside the unknown, else `OPEN`.
    """
    height, width = box.shape
    span = math.ceil(reach + 1.0)
    wide = width + span  # rows end in what keeps the next one out of reach
    squares, along_rows = np.empty(height * wide, np.uint8), np.empty(height * wide, np.uint8)
    far = np.uint8((span + 1) ** 2)
    for r in range(height):
        here = squares[r * wide : (r + 1) * wide]
        for c in range(width):
            here[c] = 0 if box[r, c] == OCCUPIED else far
        here[width:] = far
    _spread(squares, span, 1, along_rows)
    _spread(along_rows, span, wide, squares)
    clearance = squares.reshape((height, wide))  # squared distance to the nearest occupied cell, if within the span

    # Squared distances are whole numbers, so that those below a bound are those below the next whole number.
    closed, close = np.uint8(math.ceil(reach**2)), np.uint8(math.ceil((reach + 1.0) ** 2))
    near = np.uint8(math.ceil((reach + 2.0) ** 2))
    weights = np.zeros(box.shape, np.uint8)
    for r in range(1, height - 1):
        for c in range(1, width - 1):
            gap = clearance[r, c]
            at_edge = (
                (box[r - 1, c] == UNKNOWN)
                | (box[r + 1, c] == UNKNOWN)
                | (box[r, c - 1] == UNKNOWN)
                | (box[r, c + 1] == UNKNOWN)
            )
            weight = NEAR if at_edge | (gap < near) else OPEN
            weight = CLOSE if gap < close else weight
            weights[r, c] = 0 if (box[r, c] != FREE) | (gap < closed) else weight
    return weights
