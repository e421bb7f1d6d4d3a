"""The compiled loops that write range readings, discs and other grids into the evidence of a `SeenGrid`."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray

GRID_SIZE = 300
CELL = 0.2
UNKNOWN, FREE, OCCUPIED = 0, 1, 2

HALF_WIDTH = 0.5 * GRID_SIZE * CELL  # [m]; the start pose is the middle of the grid

# Evidence per cell: 0 never touched, negative free, positive occupied. A hit outweighs three passes, so that a wall of
# no thickness survives rays that graze its cell; the bounds let a few seconds of new readings overrule any old ones.
HIT = 3
MOST_FREE, MOST_OCCUPIED = -8, 12

WALL_HALF_THICKNESS = 0.12  # [m] half a cell and a little, so that a wall marks at least one cell wherever it lies
SAME_SURFACE_GAP = 0.4  # [m] no robot fits between two hits this close: they are joined unseen
STRAIGHT_GAP = 0.8  # [m] joined if a third hit lies on their line; doors are 1.1 m and wider
STRAIGHT_TOLERANCE = 0.1  # [m]
RAY_HALF_WIDTH = 0.1  # [m] what one ray beside a jump in range tells about the cells along it

READINGS_FINE, BAD_RANGES, BAD_ANGLES = 0, 1, 2


@jit
def _add(evidence: Any, cells: Any, row: int, col: int, change: int) -> None:
    """Change one cell's evidence within its bounds; 0 is kept for cells that were never touched."""
    value = min(max(evidence[row, col] + change, MOST_FREE), MOST_OCCUPIED)
    if value == 0:
        value = -1
    evidence[row, col] = value
    cells[row, col] = OCCUPIED if value > 0 else FREE


@jit
def _cell_range(low: float, high: float) -> tuple[int, int]:
    """Return the first and the one-past-last index of the cells between two coordinates [m], inside the grid."""
    first = min(max((low + HALF_WIDTH) / CELL, 0.0), float(GRID_SIZE))
    last = min(max((high + HALF_WIDTH) / CELL + 1.0, 0.0), float(GRID_SIZE))
    return int(first), int(last)


@jit
def _on_one_line(a: Any, b: Any, c: Any) -> bool:
    """Tell whether the middle one of three points (2,) lies on the line through the others."""
    along_x, along_y = c[0] - a[0], c[1] - a[1]
    cross = along_x * (b[1] - a[1]) - along_y * (b[0] - a[0])
    return bool(abs(cross) <= STRAIGHT_TOLERANCE * math.hypot(along_x, along_y))


@jit
def _surfaces(hits: Any, is_hit: Any) -> tuple[Any, Any]:
    """Find which neighbouring rays see one surface without a gap to drive through.

    Returns:
        For each pair of rays, whether it does, (n - 1,) bool; and of the line through its two hits the unit normal
        towards the robot and the robot's distance, (n - 1, 3) float64.
    """
    count = len(is_hit)
    joined = np.zeros(count - 1, np.bool_)
    lines = np.zeros((count - 1, 3))
    for i in range(count - 1):
        if not (is_hit[i] and is_hit[i + 1]):
            continue
        along_x, along_y = hits[i + 1, 0] - hits[i, 0], hits[i + 1, 1] - hits[i, 1]
        gap = math.hypot(along_x, along_y)
        if gap < 1e-6 or gap > STRAIGHT_GAP:
            continue
        before = i > 0 and is_hit[i - 1] and _on_one_line(hits[i - 1], hits[i], hits[i + 1])
        after = i + 2 < count and is_hit[i + 2] and _on_one_line(hits[i], hits[i + 1], hits[i + 2])
        joined[i] = gap <= SAME_SURFACE_GAP or before or after
        lines[i, 0], lines[i, 1] = -along_y / gap, along_x / gap
        lines[i, 2] = (along_y * hits[i, 0] - along_x * hits[i, 1]) / gap
    return joined, lines


@jit
def paint_scan(
    evidence: Any,
    cells: Any,
    x: float,
    y: float,
    theta: float,
    ranges: FloatArray,
    angles: FloatArray,
    max_range: float,
) -> int:
    """Write one scan, visiting each cell between its rays once.

    Two neighbouring rays that see one surface span a triangle: a cell of it is free before the surface, occupied on
    it, untold behind. Where the range jumps, the cells nearer than both readings are free, and beyond that each ray
    speaks only for the cells it crosses, and may not free one that is held to be occupied.

    Returns:
        `READINGS_FINE`, or what is wrong with the readings, in which case nothing was written.
    """
    count = len(ranges)
    for i in range(count):
        if not ranges[i] >= 0.0:  # also catches NaN
            return BAD_RANGES
        if not abs(angles[i]) <= 2.0 * math.pi or (i > 0 and not angles[i] > angles[i - 1]):
            return BAD_ANGLES
    if angles[count - 1] - angles[0] >= math.pi:
        return BAD_ANGLES

    direction = np.empty((count, 2))
    hits = np.empty((count, 2))
    reach = np.empty(count)
    is_hit = np.empty(count, np.bool_)
    low_x = high_x = low_y = high_y = 0.0
    for i in range(count):
        direction[i, 0], direction[i, 1] = math.cos(theta + angles[i]), math.sin(theta + angles[i])
        is_hit[i] = ranges[i] < max_range
        reach[i] = min(ranges[i], max_range)
        hits[i, 0], hits[i, 1] = reach[i] * direction[i, 0], reach[i] * direction[i, 1]
        low_x, high_x = min(low_x, hits[i, 0]), max(high_x, hits[i, 0])
        low_y, high_y = min(low_y, hits[i, 1]), max(high_y, hits[i, 1])
    joined, lines = _surfaces(hits, is_hit)
    jump = is_hit[:-1] | is_hit[1:]
    free_below = np.maximum(np.minimum(reach[:-1], reach[1:]) - WALL_HALF_THICKNESS * jump, 0.0)

    first_row, last_row = _cell_range(y + low_y - CELL, y + high_y + CELL)
    first_col, last_col = _cell_range(x + low_x - CELL, x + high_x + CELL)
    k = 0  # the cell lies between the rays k and k + 1
    for row in range(first_row, last_row):
        v = (row + 0.5) * CELL - HALF_WIDTH - y
        for col in range(first_col, last_col):
            u = (col + 0.5) * CELL - HALF_WIDTH - x
            if (
                direction[0, 0] * v < direction[0, 1] * u
                or direction[count - 1, 0] * v >= direction[count - 1, 1] * u
            ):
                continue
            while k > 0 and direction[k, 0] * v < direction[k, 1] * u:
                k -= 1
            while k < count - 2 and direction[k + 1, 0] * v >= direction[k + 1, 1] * u:
                k += 1
            if joined[k]:
                before = lines[k, 0] * u + lines[k, 1] * v + lines[k, 2]
                if before > WALL_HALF_THICKNESS:
                    _add(evidence, cells, row, col, -1)
                elif before > -WALL_HALF_THICKNESS:
                    _add(evidence, cells, row, col, HIT)
            elif u * u + v * v < free_below[k] ** 2:
                _add(evidence, cells, row, col, -1)
            elif jump[k]:
                aside = abs(direction[k, 0] * v - direction[k, 1] * u)
                aside_next = abs(direction[k + 1, 0] * v - direction[k + 1, 1] * u)
                ray = k if aside <= aside_next else k + 1
                past = math.sqrt(u * u + v * v) - reach[ray]
                if min(aside, aside_next) > RAY_HALF_WIDTH:
                    continue
                if past < -WALL_HALF_THICKNESS and evidence[row, col] <= 0:
                    _add(evidence, cells, row, col, -1)
                elif is_hit[ray] and abs(past) < WALL_HALF_THICKNESS:
                    _add(evidence, cells, row, col, HIT)
    return READINGS_FINE


@jit
def paint_disc(evidence: Any, cells: Any, x: float, y: float, radius: float) -> None:
    """Free what a robot covers: unknown cells centred in its disc, and occupied ones that lie wholly inside."""
    first_row, last_row = _cell_range(y - radius, y + radius)
    first_col, last_col = _cell_range(x - radius, x + radius)
    for row in range(first_row, last_row):
        for col in range(first_col, last_col):
            v = (row + 0.5) * CELL - HALF_WIDTH - y
            u = (col + 0.5) * CELL - HALF_WIDTH - x
            distance = math.hypot(u, v)
            inside = distance <= max(radius - 0.5 * CELL, 0.0)
            if inside or (evidence[row, col] == 0 and distance <= radius):
                evidence[row, col] = min(evidence[row, col], -1)
                cells[row, col] = FREE


@jit
def _bounds_in_frame(other: Any, x: float, y: float, c: float, s: float) -> tuple[float, float, float, float]:
    """Return low x, high x, low y and high y [m] of what a grid knows, seen from pose (x, y) turned by (c, s)."""
    low_row, high_row, low_col, high_col = GRID_SIZE, -1, GRID_SIZE, -1
    for row in range(GRID_SIZE):
        for col in range(GRID_SIZE):
            if other[row, col] != 0:
                low_row, high_row = min(low_row, row), row
                low_col, high_col = min(low_col, col), max(high_col, col)
    low_x, high_x, low_y, high_y = math.inf, -math.inf, math.inf, -math.inf
    if high_row >= 0:
        for row in (low_row, high_row + 1):
            for col in (low_col, high_col + 1):
                u, v = col * CELL - HALF_WIDTH, row * CELL - HALF_WIDTH
                low_x, high_x = min(low_x, x + c * u - s * v), max(high_x, x + c * u - s * v)
                low_y, high_y = min(low_y, y + s * u + c * v), max(high_y, y + s * u + c * v)
    return low_x, high_x, low_y, high_y


@jit
def paint_grid(evidence: Any, cells: Any, other: Any, x: float, y: float, theta: float) -> None:
    """Add another grid's evidence, seen from pose (x, y, theta) of its frame in this one.

    Each cell takes the other's value at its centre, or the firmest wall among four points around it: without these,
    a wall one cell thick would come out of a rotation with holes.
    """
    c, s = math.cos(theta), math.sin(theta)
    low_x, high_x, low_y, high_y = _bounds_in_frame(other, x, y, c, s)
    first_row, last_row = _cell_range(low_y, high_y)
    first_col, last_col = _cell_range(low_x, high_x)
    for row in range(first_row, last_row):
        for col in range(first_col, last_col):
            u = (col + 0.5) * CELL - HALF_WIDTH - x
            v = (row + 0.5) * CELL - HALF_WIDTH - y
            other_x, other_y = (c * u + s * v + HALF_WIDTH) / CELL, (-s * u + c * v + HALF_WIDTH) / CELL
            found = 0
            for point in range(5):
                shift = 0.0 if point == 0 else 0.25
                px = other_x + (shift if point % 2 else -shift)
                py = other_y + (shift if point > 2 else -shift)
                if 0.0 <= px < GRID_SIZE and 0.0 <= py < GRID_SIZE:
                    value = other[int(py), int(px)]
                    if point == 0 or value > max(found, 0):
                        found = value
            if found != 0:
                _add(evidence, cells, row, col, found)
