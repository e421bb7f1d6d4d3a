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
SAME_SURFACE_GAP = 0.4  # [m] no robot fits between two hits this near: they are joined unseen
STRAIGHT_GAP = 0.8  # [m] joined if a third hit lies on their line; doors are 1.1 m and wider
STRAIGHT_TOLERANCE = 0.1  # [m]
NOTHING, JUMP, SPARSE, SOLID = 0, 1, 2, 3  # what two neighbouring rays see

READINGS_FINE, BAD_RANGES, BAD_ANGLES, BAD_POSE = 0, 1, 2, 3

MOST_CHANGES = 4096  # that a grid keeps for whoever counts its free cells; a scan makes a hundred at most


@jit
def _judge(cells: Any, changes: Any, row: int, col: int, verdict: int) -> None:
    """Set a cell's verdict, and note it if it changed.

    Args:
        cells: (300, 300) uint8.
        changes: (1 + n,) int32. How many changed, -1 if that is not known any more; then which, as places in the flat
            grid.
        row: Of the cell.
        col: Of the cell.
        verdict: The new one.
    """
    if cells[row, col] != verdict:
        cells[row, col] = verdict
        if 0 <= changes[0] < len(changes) - 1:
            changes[0] += 1
            changes[changes[0]] = row * GRID_SIZE + col
        else:
            changes[0] = -1


@jit
def _add(evidence: Any, cells: Any, changes: Any, row: int, col: int, change: int) -> None:
    """Change one cell's evidence within its bounds; 0 is kept for cells that were never touched."""
    value = min(max(evidence[row, col] + change, MOST_FREE), MOST_OCCUPIED)
    if value == 0:
        value = -1
    evidence[row, col] = value
    _judge(cells, changes, row, col, OCCUPIED if value > 0 else FREE)


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
    """Find out what neighbouring rays see.

    Returns:
        For each pair of rays, (n - 1,) int8: `SOLID`, one surface without a gap to drive through; `SPARSE`, hits that
        line up with a third one but leave room for a gap; `JUMP`, a jump in range; `NOTHING`, no hit. And of the line
        through the two hits the unit normal towards the robot and the robot's distance, (n - 1, 3) float64.
    """
    count = len(is_hit)
    kinds = np.full(count - 1, NOTHING, np.int8)
    lines = np.zeros((count - 1, 3))
    for i in range(count - 1):
        if not (is_hit[i] and is_hit[i + 1]):
            kinds[i] = JUMP if is_hit[i] or is_hit[i + 1] else NOTHING
            continue
        along_x, along_y = hits[i + 1, 0] - hits[i, 0], hits[i + 1, 1] - hits[i, 1]
        gap = max(math.hypot(along_x, along_y), 1e-9)
        before = i > 0 and is_hit[i - 1] and _on_one_line(hits[i - 1], hits[i], hits[i + 1])
        after = i + 2 < count and is_hit[i + 2] and _on_one_line(hits[i], hits[i + 1], hits[i + 2])
        if gap <= SAME_SURFACE_GAP or (gap <= STRAIGHT_GAP and (before or after)):
            kinds[i] = SOLID
        else:
            kinds[i] = SPARSE if before or after else JUMP
        lines[i, 0], lines[i, 1] = -along_y / gap, along_x / gap
        lines[i, 2] = (along_y * hits[i, 0] - along_x * hits[i, 1]) / gap
    return kinds, lines


@jit
def _on_a_line_beside(kinds: Any, lines: Any, k: int, u: float, v: float) -> bool:
    """Tell whether a cell between the rays k and k + 1 lies where the surface seen by the next pair would go on."""
    for other in (max(k - 1, 0), min(k + 1, len(kinds) - 1)):
        before = lines[other, 0] * u + lines[other, 1] * v + lines[other, 2]
        if kinds[other] in (SOLID, SPARSE) and abs(before) < WALL_HALF_THICKNESS:
            return True
    return False


@jit
def paint_scan(
    evidence: Any,
    cells: Any,
    changes: Any,
    x: float,
    y: float,
    theta: float,
    ranges: FloatArray,
    angles: FloatArray,
    max_range: float,
) -> int:
    """Write one scan, visiting each cell between its rays once.

    Two neighbouring rays that see one surface span a triangle: a cell of it is free before the surface, occupied on
    it, untold behind. Where hits are sparse, as on a wall seen at a grazing angle, what lies between them stays
    untold. Where the range jumps, the cells nearer than both readings are free, if they are not on a surface that may
    go on there, and each hit marks its own cell.

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
        reach[i], is_hit[i] = min(ranges[i], max_range), ranges[i] < max_range
        hits[i, 0], hits[i, 1] = reach[i] * direction[i, 0], reach[i] * direction[i, 1]
        low_x, high_x = min(low_x, hits[i, 0]), max(high_x, hits[i, 0])
        low_y, high_y = min(low_y, hits[i, 1]), max(high_y, hits[i, 1])
    kinds, lines = _surfaces(hits, is_hit)
    free_below = np.empty(count - 1)
    for i in range(count - 1):
        margin = WALL_HALF_THICKNESS if kinds[i] == JUMP else 0.0
        free_below[i] = max(min(reach[i], reach[i + 1]) - margin, 0.0)

    first_row, last_row = _cell_range(y + low_y - CELL, y + high_y + CELL)
    first_col, last_col = _cell_range(x + low_x - CELL, x + high_x + CELL)
    k = 0  # the cell lies between the rays k and k + 1
    for row in range(first_row, last_row):
        v = (row + 0.5) * CELL - HALF_WIDTH - y
        for col in range(first_col, last_col):
            u = (col + 0.5) * CELL - HALF_WIDTH - x
            if direction[0, 0] * v < direction[0, 1] * u or direction[count - 1, 0] * v >= direction[count - 1, 1] * u:
                continue
            while k > 0 and direction[k, 0] * v < direction[k, 1] * u:
                k -= 1
            while k < count - 2 and direction[k + 1, 0] * v >= direction[k + 1, 1] * u:
                k += 1
            if kinds[k] in (SOLID, SPARSE):
                before = lines[k, 0] * u + lines[k, 1] * v + lines[k, 2]
                if before > WALL_HALF_THICKNESS:
                    _add(evidence, cells, changes, row, col, -1)
                elif before > -WALL_HALF_THICKNESS and kinds[k] == SOLID:
                    _add(evidence, cells, changes, row, col, HIT)
            elif u * u + v * v < free_below[k] ** 2:
                if kinds[k] == NOTHING or not _on_a_line_beside(kinds, lines, k, u, v):
                    _add(evidence, cells, changes, row, col, -1)
            else:
                for ray in range(k, k + 2):
                    off_x, off_y = abs(u - hits[ray, 0]), abs(v - hits[ray, 1])
                    if is_hit[ray] and max(off_x, off_y) <= 0.5 * CELL:
                        _add(evidence, cells, changes, row, col, HIT)
                        break
    return READINGS_FINE


@jit
def paint_disc(evidence: Any, cells: Any, changes: Any, x: float, y: float, radius: float) -> None:
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
                _judge(cells, changes, row, col, FREE)


@jit
def paint_bump(evidence: Any, cells: Any, changes: Any, x: float, y: float, theta: float, radius: float) -> None:
    """Mark the cell just ahead of a robot's rim as occupied, no firmer than two hits."""
    ahead = radius + 0.5 * CELL
    row = math.floor((y + ahead * math.sin(theta) + HALF_WIDTH) / CELL)
    col = math.floor((x + ahead * math.cos(theta) + HALF_WIDTH) / CELL)
    if 0 <= row < GRID_SIZE and 0 <= col < GRID_SIZE:
        evidence[row, col] = max(evidence[row, col], 2 * HIT)
        _judge(cells, changes, row, col, OCCUPIED)


@jit
def paint_reading(
    evidence: Any,
    cells: Any,
    changes: Any,
    pose: FloatArray,
    ranges: FloatArray,
    angles: FloatArray,
    max_range: float,
    radius: float,
    bump: bool,
) -> int:
    """Write what a robot at `pose` (3,) reads in a tick: its scan, the floor that it covers, and a bump."""
    x, y, theta = pose[0], pose[1], pose[2]
    if not math.isfinite(x + y + theta):
        return BAD_POSE
    fault = paint_scan(evidence, cells, changes, x, y, theta, ranges, angles, max_range)
    if fault == READINGS_FINE:
        paint_disc(evidence, cells, changes, x, y, radius)
        if bump:
            paint_bump(evidence, cells, changes, x, y, theta, radius)
    return fault


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
def paint_grid(evidence: Any, cells: Any, changes: Any, other: Any, x: float, y: float, theta: float) -> None:
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
                _add(evidence, cells, changes, row, col, found)
