"""Update of a grid from a range scan: free up to the first surface, occupied at it, unknown behind."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit, stack_array_of
from slam_backend.core.validation import FloatArray
from vslam_env.navigation._grid_kernels.occupancy import (
    CELL,
    FREE,
    HALF_WIDTH,
    HIT,
    LARGEST_SIZE,
    OCCUPIED,
    Grid,
    cell_range,
    clamp_evidence,
    margin_of,
    set_state,
)

# Rays as they are seen in the frame of a grid: below the rows of a survey that turn, how far to the left a ray gets
# from row to row [cells], left as seen by the robot that looks to these rows; distance of the farthest row that it says
# anything about [m], less than 0 if it leads away; the cell before which it crosses a row.
SLOPE, TOP, CROSSING, NUM_SEEN_ROWS = 4, 5, 6, 7
ASIDE = 1e12  # [cells] per row: how far off a ray crosses rows that it leads away from


@inline
def cross_row(seen: Any, begin: int, end: int, steps: float, beside: float, passed: Any) -> tuple[int, int]:
    """Tell which rays the cells of a row lie to the left of.

    Args:
        seen: (7, n + 1) float64. Rays as `update_from_geometry` sees them; the crossings are written to it.
        begin: First ray that matters.
        end: One past the last ray that matters.
        steps: Distance of the row from the robot [cells].
        beside: Place of the robot, counted from the rightmost cell [cells].
        passed: (width + 1,) uint32, cells from right to left. Written to: one past the last ray that is crossed just
            before a cell; 0 if none is.

    Returns:
        The first cell to the left of the first of these rays, and the first to the left of the last one.
    """
    most = float(len(passed) - 1)
    slopes, crossings = seen[SLOPE, begin:end], seen[CROSSING, begin:end]
    for i in range(len(slopes)):  # a loop of its own becomes vector instructions
        crossings[i] = np.ceil(min(max(beside + steps * slopes[i], 0.0), most))
    passed[:] = 0
    first, crossing = len(passed) - 1, 0
    for i in range(len(crossings)):
        crossing = int(crossings[i])
        passed[np.uint32(crossing)] = begin + i + 1
        first = min(first, crossing)
    return first, crossing


SAME_SURFACE_GAP = 0.4  # [m] no robot fits between two hits this near: they are joined unseen
STRAIGHT_GAP = 0.8  # [m] joined if a third hit lies on their line; doors are 1.1 m and wider
STRAIGHT_TOLERANCE = 0.1  # [m]
WALL_HALF_THICKNESS = 0.12  # [m] half a cell and a little, so that a wall marks at least one cell wherever it lies
LEAST = 1e-9  # of what is divided by

# A survey has a row for each of these, and columns for the n rays of a scan, the last one for none: direction, length
# [m], end [m], whether the ray met something, whether the hit lies on a line through those beside it, and the distance
# up to which the ray may say something about cells beside it [m]. The other rows describe rays k - 1 and k, and their
# first and last columns no rays: the surface that both see lies where NORMAL_X x + NORMAL_Y y + OFFSET is 0, infinitely
# far off if they see none; where this is above WALL_ABOVE, it is a wall, and before it all is free nearer than the root
# of FREE_BELOW; whether there is a jump in range; and TELLING of both where they see no surface [m].
ALONG_X, ALONG_Y, NORMAL_X, NORMAL_Y = range(4)  # these turn with the robot
REACH, END_X, END_Y, IS_HIT, IN_LINE, OBSERVED, OFFSET, WALL_ABOVE, FREE_BELOW, IS_JUMP, OBSERVED_FREE = range(4, 15)
NUM_ROWS = 15
NUM_PAINT_ROWS = NUM_ROWS + NUM_SEEN_ROWS


@device
@in_place
def scan_geometry(ranges: FloatArray, directions: FloatArray, max_range: float, told: Any) -> None:
    """Find out what a scan says: each ray by itself, then neighbouring rays together, then how far all that goes.

    Neighbouring rays see one surface if there is no gap between their hits to drive through, or if the hits line up
    with a third one; where that leaves room for a gap, nothing is a wall between them.

    Args:
        ranges: (n,) float64 [m], at least 0.
        directions: (2, n) float64. Unit vectors along the rays, from right to left, robot frame.
        max_range: A reading as far as this saw nothing [m].
        told: (15, n + 1) float64, robot frame. Written to, as described above.
    """
    count = len(ranges)
    for i in range(count):
        reach = min(ranges[i], max_range)
        told[ALONG_X, i], told[ALONG_Y, i] = directions[0, i], directions[1, i]
        told[REACH, i], told[IS_HIT, i] = reach, ranges[i] < max_range
        told[END_X, i], told[END_Y, i] = reach * directions[0, i], reach * directions[1, i]
        told[IN_LINE, i] = 0.0
    for row in (ALONG_X, ALONG_Y, REACH, IS_HIT, OBSERVED):
        told[row, count] = 0.0
    for i in range(1, count - 1):
        along_x, along_y = told[END_X, i + 1] - told[END_X, i - 1], told[END_Y, i + 1] - told[END_Y, i - 1]
        cross = along_x * (told[END_Y, i] - told[END_Y, i - 1]) - along_y * (told[END_X, i] - told[END_X, i - 1])
        on_line = abs(cross) <= STRAIGHT_TOLERANCE * math.sqrt(along_x * along_x + along_y * along_y)
        told[IN_LINE, i] = told[IS_HIT, i - 1] * told[IS_HIT, i] * told[IS_HIT, i + 1] * on_line

    for k in (0, count):
        told[NORMAL_X, k], told[NORMAL_Y, k], told[OFFSET, k], told[WALL_ABOVE, k] = 0.0, 0.0, np.inf, np.inf
        told[FREE_BELOW, k], told[IS_JUMP, k], told[OBSERVED_FREE, k] = np.inf, 0.0, 0.0
    for k in range(1, count):  # hardly any branches, for none could be foreseen
        x, y, reach = told[END_X, k - 1], told[END_Y, k - 1], min(told[REACH, k - 1], told[REACH, k])
        along_x, along_y = told[END_X, k] - x, told[END_Y, k] - y
        gap = max(math.sqrt(along_x * along_x + along_y * along_y), LEAST)
        hits, in_line = told[IS_HIT, k - 1] + told[IS_HIT, k], told[IN_LINE, k - 1] + told[IN_LINE, k] > 0.0
        is_surface = (hits > 1.0) & ((gap <= SAME_SURFACE_GAP) | in_line)
        is_jump = (hits > 0.0) & (not is_surface)
        told[NORMAL_X, k] = -along_y / gap if is_surface else 0.0
        told[NORMAL_Y, k] = along_x / gap if is_surface else 0.0
        told[OFFSET, k] = (along_y * x - along_x * y) / gap if is_surface else np.inf
        wall_above = -WALL_HALF_THICKNESS if gap <= STRAIGHT_GAP else WALL_HALF_THICKNESS
        told[WALL_ABOVE, k] = wall_above if is_surface else np.inf
        free_below = max(reach - (WALL_HALF_THICKNESS if is_jump else 0.0), 0.0) ** 2
        told[FREE_BELOW, k], told[IS_JUMP, k] = np.inf if is_surface else free_below, is_jump
        cosine = told[ALONG_X, k - 1] * told[ALONG_X, k] + told[ALONG_Y, k - 1] * told[ALONG_Y, k]
        end_of_tangent = reach / max(math.sqrt(0.5 * max(1.0 + cosine, 0.0)), LEAST)  # of the arc up to the reach
        told[OBSERVED_FREE, k] = 0.0 if is_surface else end_of_tangent

    for i in range(len(ranges)):
        telling = told[REACH, i]
        for k in (i, i + 1):
            across = -(told[NORMAL_X, k] * told[ALONG_X, i] + told[NORMAL_Y, k] * told[ALONG_Y, i])
            through_wall = told[REACH, i] + WALL_HALF_THICKNESS / max(across, LEAST)
            telling = max(telling, through_wall if told[WALL_ABOVE, k] < np.inf else told[OBSERVED_FREE, k])
        told[OBSERVED, i] = telling


NONE_PASSED: Any = np.uint32(0)  # unsigned, as are other places of arrays below, so that none counts from the end
MOST_PLACES = LARGEST_SIZE + 1  # before the cells of a row, and after the last one
LEAST_HEIGHT = 1e-9  # [m] that a row is taken to be from the robot, so that no ray crosses it nowhere


@device
@in_place
def _change_at_jump(told: Any, seen: Any, k: Any, u: float, v: float, change: int) -> int:
    """Return the evidence for a cell between two rays at whose ends the range jumps; seen from the robot at (u, v) [m].

    What is free by its distance may be on a surface that goes on from beside; what is not may hold one of the hits.
    """
    right = np.int64(k) - 1
    if change < 0:
        left = right + 2
        before_right = seen[NORMAL_X, right] * u + seen[NORMAL_Y, right] * v + told[OFFSET, right]
        before_left = seen[NORMAL_X, left] * u + seen[NORMAL_Y, left] * v + told[OFFSET, left]
        return 0 if min(abs(before_right), abs(before_left)) < WALL_HALF_THICKNESS else change
    for i in range(right, right + 2):
        off_x = u - told[REACH, i] * seen[ALONG_X, i]
        off_y = v - told[REACH, i] * seen[ALONG_Y, i]
        if told[IS_HIT, i] > 0.0 and max(abs(off_x), abs(off_y)) <= 0.5 * CELL:
            return HIT
    return 0


@device
@in_place
def update_from_geometry(grid: Grid, x: float, y: float, theta: float, buffer: FloatArray) -> None:
    """Write what a scan says into a grid, visiting each cell between rays that reach its row once.

    Two neighbouring rays that see one surface span a triangle: a cell of it is free before the surface, occupied on
    it, and as it was behind. Where hits are sparse, as on a wall seen at a grazing angle, cells between them stay as
    they were. Where the range jumps, the cells nearer than both readings are free, if they are not on a surface that
    may go on there, and each hit marks its own cell.

    Where rays cross the row of a cell decides between which two it lies. Rays that say nothing about a row are passed
    over at both ends of the fan; from row to row away from the robot there are more of them.

    Args:
        grid: Changed.
        x: Place of the robot [m].
        y: See `x`.
        theta: Heading of the robot [rad].
        buffer: (NUM_PAINT_ROWS, n + 1) float64. Survey of the scan; below it workspace, the rays in the grid.
    """
    told, seen, count = buffer[:NUM_ROWS], buffer[NUM_ROWS:], buffer.shape[1] - 1
    all_passed = stack_array_of(MOST_PLACES, np.uint32)
    c, s = math.cos(theta), math.sin(theta)
    for along_x, along_y in ((ALONG_X, ALONG_Y), (NORMAL_X, NORMAL_Y)):
        for i in range(count + 1):
            seen[along_x, i] = c * told[along_x, i] - s * told[along_y, i]
            seen[along_y, i] = s * told[along_x, i] + c * told[along_y, i]
    low_x = high_x = low_y = high_y = 0.0
    for i in range(count):
        end_x, end_y = told[REACH, i] * seen[ALONG_X, i], told[REACH, i] * seen[ALONG_Y, i]
        low_x, high_x = min(low_x, end_x), max(high_x, end_x)
        low_y, high_y = min(low_y, end_y), max(high_y, end_y)
    size = len(grid.cells)
    margin = margin_of(size)
    to_centre = 0.5 - margin  # of a cell, from its index in this grid to its place in a new one
    first_row, last_row = cell_range(y + low_y - CELL, y + high_y + CELL, size)
    first_col, last_col = cell_range(x + low_x - CELL, x + high_x + CELL, size)
    width = last_col - first_col
    nearest_row = (y + HALF_WIDTH) / CELL + 0.5
    own_row = math.floor(min(max(nearest_row, float(first_row - margin)), float(last_row - margin))) + margin
    passed, tops = all_passed[: width + 1], seen[TOP]
    for side in (-1, 1):
        aside = -ASIDE  # all cells are left of what comes before the rays that lead there, none of what comes after
        for i in range(count):
            up = seen[ALONG_Y, i]
            leads_there = side * up > 0.0
            seen[SLOPE, i] = -seen[ALONG_X, i] / (up if leads_there else 1.0) if leads_there else aside
            tops[i] = side * told[OBSERVED, i] * up + 0.5 * CELL if leads_there else -1.0
            aside = ASIDE if leads_there else aside
        right = first_col if side < 0 else last_col - 1  # seen by the robot that looks to these rows
        beside = side * (right + to_centre - (x + HALF_WIDTH) / CELL)
        first, last = 0, count - 1
        for row in range(own_row, last_row) if side > 0 else range(own_row - 1, first_row - 1, -1):
            v = (row + to_centre) * CELL - HALF_WIDTH - y
            while first <= last and tops[first] < side * v:
                first += 1
            while first <= last and tops[last] < side * v:
                last -= 1
            if first > last:
                break
            begin, end = max(first - 1, 0), min(last + 2, count)
            start, stop = cross_row(seen, begin, end, max(side * v, LEAST_HEIGHT) / CELL, beside, passed)
            evidence_row, k = grid.evidence[row], NONE_PASSED
            for j in range(start, stop):
                k = max(k, passed[np.uint32(j)])
                col: Any = np.uint32(right - side * j)
                u = (col + to_centre) * CELL - HALF_WIDTH - x
                before, change = seen[NORMAL_X, k] * u + seen[NORMAL_Y, k] * v + told[OFFSET, k], 0
                if (before > WALL_HALF_THICKNESS) & (u * u + v * v < told[FREE_BELOW, k]):
                    change = -1
                elif before > told[WALL_ABOVE, k]:
                    change = HIT
                if told[IS_JUMP, k] > 0.0:
                    change = _change_at_jump(told, seen, k, u, v, change)
                old = evidence_row[col]
                new = clamp_evidence(old + change) if change != 0 else old
                if new != old:
                    evidence_row[col] = new
                    if old == 0 or (new > 0) != (old > 0):
                        set_state(grid, row, col, OCCUPIED if new > 0 else FREE)


@jit
def update_from_scan(
    grid: Grid, x: float, y: float, theta: float, ranges: FloatArray, directions: FloatArray, max_range: float
) -> None:
    """Write one scan into a grid; arguments as in `survey` and `update_from_geometry`."""
    buffer = np.empty((NUM_PAINT_ROWS, len(ranges) + 1))
    scan_geometry(ranges, directions, max_range, buffer[:NUM_ROWS])
    update_from_geometry(grid, x, y, theta, buffer)
