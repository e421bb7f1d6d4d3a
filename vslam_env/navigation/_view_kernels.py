"""The compiled loops over what a camera sees on a grid: looks at walls, gains of viewpoints, and places to look from.

A wall stretch is looked at from one side only, so that looks are counted on the free cells just before walls. A border
cell is a free cell beside an occupied one.
"""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit
from vslam_env.navigation._grid_kernels import (
    CELL,
    FREE,
    HALF_WIDTH,
    LARGEST_HALF_WIDTH,
    LARGEST_SIZE,
    OCCUPIED,
    UNKNOWN,
    cell_index,
    margin_of,
    widen_bounds,
)
from vslam_env.navigation._planning_kernels.candidates import is_settled
from vslam_env.navigation._planning_kernels.costmap import PAD
from vslam_env.navigation._planning_kernels.dijkstra import (
    ESCAPE_CELLS,
    ISLAND,
    UNREACHED,
    nearest_open,
    wavefront,
)

MOST_LOOKS = 255
LOOKED = 45  # looks at a border cell and its eight neighbours after which hardly a landmark there is missed
WEAK = 3  # landmarks with fewer measurements are to be seen again
FACING = 0.5  # cosine of the largest incidence at which landmarks are measured
NEAREST = 1.4  # [m] from which landmarks 0.5 m above or below the camera are in its view
BEFORE = 0.2  # [m] from a hit to the cell that counts the look
JUMP = 0.5  # [m] neighbouring hits farther apart lie on different surfaces
MARCH = 0.75 * CELL  # [m] step along a line of sight
RAY_ANGLE = 0.05  # [rad] between rays of a view
WALL_CELLS = 3  # [cells] from a wall within which a point may be a landmark
AT_WALL = 0.3  # [m] a line of sight to a landmark ends so far before it

UNKNOWN_AREA, UNSEEN_WALL, WEAK_LANDMARKS, UNCERTAIN_LENGTH, NUM_GAINS = 0, 1, 2, 3, 4
X, Y, HEADING, SIZE, LENGTH = range(5)  # columns of candidates, as of `FrontierColumns`


@inline
def to_index(coordinate: float, size: int) -> int:
    """Return the row or column of a coordinate [m] in a grid of some size, whose middle is the start."""
    return cell_index(coordinate, margin_of(size))


@inline
def to_coordinate(index: int, size: int) -> float:
    """Return the coordinate [m] of the centre of a row or column."""
    return (index - margin_of(size) + 0.5) * CELL - HALF_WIDTH


@inline
def is_occupied(cells: Any, x: float, y: float) -> bool:
    """Return whether a point [m] lies in an occupied cell of a grid."""
    size = len(cells)
    row, col = to_index(y, size), to_index(x, size)
    return bool(0 <= row < size and 0 <= col < size and cells[row, col] == OCCUPIED)


@device
@in_place
def count_looks(looks: Any, row: int, col: int) -> int:
    """Return the looks at a cell, not at the edge of the grid, and its eight neighbours."""
    total = 0
    for r in range(row - 1, row + 2):
        for c in range(col - 1, col + 2):
            total += looks[r, c]
    return total


@device
@in_place
def is_border(cells: Any, row: int, col: int) -> bool:
    """Return whether a cell, not at the edge of the grid, is free and beside an occupied one."""
    beside = (
        (cells[row - 1, col] == OCCUPIED)
        | (cells[row + 1, col] == OCCUPIED)
        | (cells[row, col - 1] == OCCUPIED)
        | (cells[row, col + 1] == OCCUPIED)
    )
    return bool(cells[row, col] == FREE and beside)


@device
@in_place
def mark_borders(cells: Any, row: int, first: int, last: int, flags: Any) -> None:
    """Write 1 for the border cells of a part of a row, else 0, without branches: this becomes vector code."""
    here, above, below = cells[row, first:last], cells[row + 1, first:last], cells[row - 1, first:last]
    left, right = cells[row, first - 1 : last - 1], cells[row, first + 1 : last + 1]
    for i in range(len(here)):
        beside = (above[i] == OCCUPIED) | (below[i] == OCCUPIED) | (left[i] == OCCUPIED) | (right[i] == OCCUPIED)
        flags[i] = (here[i] == FREE) & beside


@inline
def nearest_look(reach: float) -> float:
    """Return the range [m] from which a wall is seen at all heights of landmarks, for cameras with a range [m]."""
    return min(NEAREST, 0.5 * reach)


@device
@in_place
def mark_unseen(flags: Any, looks: Any, row: int, first: int, columns: Any, unseen: Any) -> None:
    """Write 1 for the border cells of a part of a row that were looked at too little, else 0; this becomes vector code.

    Args:
        flags: (n,) uint8. Result of `mark_borders` for the part.
        looks: (S, S) uint8. Looks of the grid.
        row: Row of the part, not at the edge of the grid.
        first: First column of the part; neither it nor its last one is at the edge.
        columns: (n + 2,) uint16. Workspace.
        unseen: (n,) uint8. Output.
    """
    end = first + len(flags) + 1
    above, here, below = looks[row - 1, first - 1 : end], looks[row, first - 1 : end], looks[row + 1, first - 1 : end]
    for i in range(len(columns)):
        columns[i] = above[i] + here[i] + below[i]
    for i in range(len(flags)):
        around = np.uint16(columns[i] + columns[i + 1] + columns[i + 2])
        unseen[i] = flags[i] & (around < LOOKED)


@device
@in_place
def wall_length(cells: Any, row: int, col: int, along_x: float, along_y: float) -> float:
    """Return the length of wall beside a border cell that a ray of unit width covers; 0 if the ray grazes it."""
    normal_x, normal_y = 0, 0
    for i in range(-1, 2):
        for j in range(-1, 2):
            if cells[row + i, col + j] == OCCUPIED:
                normal_x, normal_y = normal_x + j, normal_y + i
    length = math.sqrt(normal_x * normal_x + normal_y * normal_y)
    across = normal_x * along_x + normal_y * along_y
    return length / across if across >= max(FACING * length, 1e-9) else 0.0


@device
@in_place
def looks_of(scan: Any, directions: Any, reach: float, points: Any) -> int:
    """Find the looks of one scan at the walls that it meets at a usable range and incidence.

    Args:
        scan: (R,) [m]. Ranges.
        directions: (2, R). Unit vectors of the rays; zeros for rays outside the field of view.
        reach: Range below which landmarks are measured [m].
        points: (R, 2) [m], robot frame. Output: points just before the walls.

    Returns:
        Number of points.
    """
    count, num, nearest = len(scan), 0, nearest_look(reach)
    for k in range(count):
        if not nearest < scan[k] < reach:
            continue
        first = k - 1 if k > 0 and abs(scan[k - 1] - scan[k]) < JUMP else k
        last = k + 1 if k + 1 < count and abs(scan[k + 1] - scan[k]) < JUMP else k
        along_x = scan[last] * directions[0, last] - scan[first] * directions[0, first]
        along_y = scan[last] * directions[1, last] - scan[first] * directions[1, first]
        across = directions[0, k] * along_y - directions[1, k] * along_x
        if across * across > FACING * FACING * (along_x * along_x + along_y * along_y):
            before = max(scan[k] - BEFORE, 0.0)
            points[num, 0], points[num, 1] = before * directions[0, k], before * directions[1, k]
            num += 1
    return num


@device
@in_place
def count_looks_at(looks: Any, bounds: Any, row: int, col: int, more: int) -> None:
    """Add to the looks at a cell, and widen the bounds (4,) of the cells with looks."""
    looks[row, col] = min(looks[row, col] + more, MOST_LOOKS)
    widen_bounds(bounds, row, col)


@in_place
def paint_looks(
    looks: Any, bounds: Any, shared: Any, poses: Any, scans: Any, directions: Any, reach: float,
    points: Any,
) -> None:  # fmt: skip
    """Count the looks of a tick, once a scan and cell.

    Args:
        looks: (K, S, S) uint8. Looks of the grids of K robots; changed.
        bounds: (K, 4) int32. Bounds of those that are not zero, as in `GridStorage`; changed.
        shared: (K, K) int64. See `TeamGrids.update`.
        poses: (K, K, 3) [m, m, rad]. See there.
        scans: (K, R) [m]. See there.
        directions: (2, R). See `looks_of`.
        reach: Range below which landmarks are measured [m].
        points: (R, 2). Workspace.
    """
    size = looks.shape[1]
    for robot in range(len(scans)):
        num = looks_of(scans[robot], directions, reach, points)
        for owner in range(len(shared)):
            if not shared[owner, robot]:
                continue
            x, y, theta = poses[owner, robot]
            c, s = math.cos(theta), math.sin(theta)
            last_row = last_col = -1
            for k in range(num):
                row = to_index(y + s * points[k, 0] + c * points[k, 1], size)
                col = to_index(x + c * points[k, 0] - s * points[k, 1], size)
                if 0 <= row < size and 0 <= col < size and (row != last_row or col != last_col):
                    count_looks_at(looks[owner], bounds[owner], row, col, 1)
                    last_row, last_col = row, col


@in_place
def merge_looks(looks: Any, bounds: Any, other: Any, others_bounds: Any, x: float, y: float, theta: float) -> None:
    """Add the looks (S', S') uint8 of another grid, whose start pose in this one is (x, y, theta), to looks (S, S).

    Bounds (4,) int32 of the part of either that is not zero are given, as in `GridStorage`; those of looks change.
    """
    c, s = math.cos(theta), math.sin(theta)
    size, others = len(looks), len(other)
    for other_row in range(others_bounds[0], others_bounds[2]):
        for other_col in range(others_bounds[1], others_bounds[3]):
            if other[other_row, other_col] > 0:
                u, v = to_coordinate(other_col, others), to_coordinate(other_row, others)
                row, col = to_index(y + s * u + c * v, size), to_index(x + c * u - s * v, size)
                if 0 <= row < size and 0 <= col < size:
                    count_looks_at(looks, bounds, row, col, other[other_row, other_col])


@device
@in_place
def is_clear(cells: Any, x: float, y: float, to_x: float, to_y: float, slack: float) -> bool:
    """Return whether no occupied cell lies on the line from a point to another one [m], up to a slack before it [m]."""
    distance = math.hypot(to_x - x, to_y - y)
    steps = int(max(distance - slack, 0.0) / MARCH)
    for k in range(1, steps + 1):
        share = k * MARCH / distance
        if is_occupied(cells, x + share * (to_x - x), y + share * (to_y - y)):
            return False
    return True


@device
@in_place
def lack_of_looks(looks: Any, row: int, col: int) -> float:
    """Return the share, 0 to 1, of the looks that the wall beside a cell, not at the edge of the grid, still lacks."""
    return max(1.0 - count_looks(looks, row, col) / LOOKED, 0.0)


@device
@in_place
def view_gains(cells: Any, looks: Any, weak: Any, view: Any, camera: Any, gains: Any) -> None:
    """Find out what there is to gain from a pose; areas and lengths are sums over a fan of rays.

    Args:
        cells: (S, S) uint8. Cells of a grid.
        looks: (S, S) uint8. Looks of the grid.
        weak: (n, 2) [m]. Landmarks measured too rarely.
        view: (3 or more,) [m, m, rad]. Pose of the camera.
        camera: (3,). Half the field of view [rad], range [m], radius of the robot [m].
        gains: (3 or more,). Output: unknown area [m^2] in view, through what is unknown; length [m] of walls in view
            that were looked at too little, by the share of looks that they lack; number of weak landmarks in view.
    """
    size, half_fov, reach = len(cells), camera[0], camera[1]
    x, y = view[0], view[1]
    gains[UNKNOWN_AREA] = gains[UNSEEN_WALL] = gains[WEAK_LANDMARKS] = 0.0
    rays, steps = int(2.0 * half_fov / RAY_ANGLE) + 1, int(reach / CELL)
    width = 2.0 * half_fov / rays
    inset = (LARGEST_SIZE - size) // 2  # in the largest grid coordinates are positive, so that `int` rounds them down
    start_col, start_row = (x + LARGEST_HALF_WIDTH) / CELL, (y + LARGEST_HALF_WIDTH) / CELL
    area, wall, nearest = 0.0, 0.0, nearest_look(reach)
    for k in range(rays):
        angle = view[2] - half_fov + (k + 0.5) * width
        c, s = math.cos(angle), math.sin(angle)
        last_row = last_col = -1
        for i in range(steps + 1):
            row, col = int(start_row + i * s) - inset, int(start_col + i * c) - inset
            inside = 1 <= row < size - 1 and 1 <= col < size - 1
            state = cells[row, col] if inside else UNKNOWN
            if state == OCCUPIED:
                if i * CELL >= nearest and is_border(cells, last_row, last_col):
                    lack = lack_of_looks(looks, last_row, last_col)
                    if lack > 0.0:
                        wall += wall_length(cells, last_row, last_col, c, s) * i * lack
                break
            area += i if state == UNKNOWN else 0
            last_row, last_col = row, col
    gains[UNKNOWN_AREA], gains[UNSEEN_WALL] = area * width * CELL * CELL, wall * width * CELL
    least = math.cos(half_fov)
    view_x, view_y = math.cos(view[2]), math.sin(view[2])
    for k in range(len(weak)):
        u, v = weak[k, 0] - x, weak[k, 1] - y
        distance = math.sqrt(u * u + v * v)
        if distance < reach and u * view_x + v * view_y > least * distance:
            gains[WEAK_LANDMARKS] += is_clear(cells, x, y, weak[k, 0], weak[k, 1], AT_WALL)


BLOCK = 5  # [cells] side of the blocks into which unseen walls are cut
SPACING = 6  # [cells] between the places that are tried
BINS = 24  # headings that are tried; a view holds targets of three neighbouring ones
FARTHEST = 4.5  # [m] from which targets are looked at
LEAST_BLOCK = 2  # border cells of a block that is a target
LANDMARK_VALUE = 0.6  # [m] of unseen wall that a weak landmark is worth
MOST_TARGETS = 192
LEAST_GAIN, LEAST_KEPT = 1.0, 0.6  # [m] of a new candidate and of one that is kept
APART = 1.0  # [m] between new candidates
AT_GOAL, LOOKING, PATIENCE = 0.5, 0.4, 4  # [m], [rad], and updates after which what is still unseen is given up
GIVEN_UP = 2  # [cells] around a target that is given up
SURE_BLOCK = 10  # [cells] side of blocks of floor; near landmarks in or beside a block a robot can find its pose
RECHECKED = 4  # updates between computations of the gains of a candidate that stays
MOVED, TURNED = 0.4, 0.3  # [m], [rad] from which a candidate does not stay
NEAR_PLACE = 10  # [cells] from a place for a rendezvous to a reachable cell


@device
@jit
def collect_targets(cells: Any, bounds: Any, looks: Any, weak: Any) -> Any:
    """Return what should be looked at again: blocks of walls looked at too little, and weak landmarks.

    Returns:
        (n, 6) float64 rows: x, y [m]; unit normal of the wall, zeros if none; value [m]; length [m] of the end of a
        line of sight that may lead through the wall.
    """
    size = len(cells)
    top, left = max(bounds[0], 1) // BLOCK, max(bounds[1], 1) // BLOCK
    blocks = np.zeros((max(bounds[2], 1) // BLOCK - top + 1, max(bounds[3], 1) // BLOCK - left + 1, 5))
    first, last = max(bounds[1], 1), min(bounds[3], size - 1)
    flags = np.zeros(max(last - first, 0), np.uint8)
    for row in range(max(bounds[0], 1), min(bounds[2], size - 1)):
        mark_borders(cells, row, first, last, flags)
        for i in range(len(flags)):
            col = first + i
            lack = lack_of_looks(looks, row, col) if flags[i] else 0.0
            if lack == 0.0:
                continue
            block = blocks[row // BLOCK - top, col // BLOCK - left]
            block[0] += lack * to_coordinate(col, size)
            block[1] += lack * to_coordinate(row, size)
            for v, u in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                if cells[row + v, col + u] == OCCUPIED:
                    block[2], block[3] = block[2] - lack * u, block[3] - lack * v
            block[4] += lack
    targets = np.empty((MOST_TARGETS, 6))
    num = 0
    for r in range(blocks.shape[0]):
        for c in range(blocks.shape[1]):
            block = blocks[r, c]
            if block[4] >= LEAST_BLOCK and num < MOST_TARGETS:
                length = math.hypot(block[2], block[3])
                is_flat = length >= 0.5 * block[4]  # otherwise walls that face each other, or a corner
                targets[num, 0], targets[num, 1] = block[0] / block[4], block[1] / block[4]
                targets[num, 2] = block[2] / length if is_flat else 0.0
                targets[num, 3] = block[3] / length if is_flat else 0.0
                targets[num, 4], targets[num, 5] = CELL * block[4], 0.0
                num += 1
    for k in range(len(weak)):
        if num < MOST_TARGETS:
            targets[num, 0], targets[num, 1] = weak[k, 0], weak[k, 1]
            targets[num, 2] = targets[num, 3] = 0.0
            targets[num, 4], targets[num, 5] = LANDMARK_VALUE, AT_WALL
            num += 1
    return targets[:num]


@device
@in_place
def is_measurable(cells: Any, target: Any, x: float, y: float, reach: float) -> bool:
    """Return whether a target can be measured from a place [m] by a camera that looks at it."""
    u, v = target[0] - x, target[1] - y
    square, nearest, most = u * u + v * v, nearest_look(reach), min(FARTHEST, reach)
    if not nearest * nearest <= square <= most * most:
        return False
    if target[2] != 0.0 or target[3] != 0.0:
        before = -(u * target[2] + v * target[3])
        if before < 0.0 or before * before < FACING * FACING * square:
            return False
    return is_clear(cells, x, y, target[0], target[1], target[5])


@inline
def bin_of(angle: float) -> int:
    """Return the bin, from 0 to `BINS` - 1, of an angle [rad]."""
    return math.floor(angle / (2.0 * math.pi) * BINS + 0.5) % BINS


@device
@in_place
def best_view(bins: Any, values: Any, gains: Any) -> tuple[float, int]:
    """Return the gain and the bin of the best heading from a place.

    Args:
        bins: (n,) int8. Bins of the bearings of targets; -1: not measurable.
        values: (n,). Values of the targets.
        gains: (BINS,). Workspace.
    """
    gains[:] = 0.0
    for t in range(len(values)):
        if bins[t] >= 0:
            for turn in range(-1, 2):
                gains[(bins[t] + turn) % BINS] += values[t]
    best = 0
    for b in range(1, BINS):
        best = b if gains[b] > gains[best] else best
    return gains[best], best


@inline
def is_in_view(bin_: int, heading: int) -> bool:
    """Return whether a camera with a heading in one bin sees a measurable target with a bearing in another one."""
    return (bin_ - heading + 1) % BINS <= 2


@device
@in_place
def path_lengths_to(parents: Any, row: int, col: int, corner: Any, sure: Any) -> tuple[float, float]:
    """Follow the parents (h, w) of a box back from one of its cells.

    Args:
        parents: (h, w) int32. Result of `wavefront`.
        row: Row of the cell in the box.
        col: Column of the cell in the box.
        corner: Row and column of the box in the grid.
        sure: (m, m) bool. Blocks of floor near which landmarks were measured often enough.

    Returns:
        Length of the path [m], and how much of it leads over other blocks [m].
    """
    width, length, uncertain = parents.shape[1], 0.0, 0.0
    flat = parents.reshape(parents.size)
    cell = row * width + col
    while flat[cell] >= 0:
        step = abs(cell - flat[cell])
        part = CELL if step == 1 or step == width else math.sqrt(2.0) * CELL
        length += part
        r, c = (cell // width + corner[0]) // SURE_BLOCK + 1, (cell % width + corner[1]) // SURE_BLOCK + 1
        uncertain += 0.0 if sure[r, c] else part
        cell = flat[cell]
    return length, uncertain


@device
@in_place
def give_up(looks: Any, bounds: Any, target: Any) -> None:
    """Count the cells around a target that cannot be seen as looked at as often as possible."""
    size = len(looks)
    row, col = to_index(target[1], size), to_index(target[0], size)
    for r in range(max(row - GIVEN_UP, 0), min(row + GIVEN_UP + 1, size)):
        for c in range(max(col - GIVEN_UP, 0), min(col + GIVEN_UP + 1, size)):
            count_looks_at(looks, bounds, r, c, MOST_LOOKS)


@device
@in_place
def is_at_unseen_wall(cells: Any, looks: Any, row: int, col: int) -> bool:
    """Return whether a border cell whose wall lacks looks lies within `WALL_CELLS` of a cell."""
    last = len(cells) - 1
    for r in range(max(row - WALL_CELLS, 1), min(row + WALL_CELLS + 1, last)):
        for c in range(max(col - WALL_CELLS, 1), min(col + WALL_CELLS + 1, last)):
            if is_border(cells, r, c) and lack_of_looks(looks, r, c) > 0.0:
                return True
    return False


@device
@jit
def worth_seeing(cells: Any, looks: Any, bounds: Any, places: Any, counts: Any, start: Any) -> tuple[Any, Any]:
    """Return the places (n, 2) of landmarks measured too rarely, and the blocks (m, m) bool near the other ones.

    Landmarks that stay rare however often the robot looks at them are taken for false points. The landmarks (n, 2 or
    more), their counts (n, 1 or more) and the motion (3,) from their frame to the start frame are given. Those outside
    the known part of the grid, whose bounds (4,) are given, do not count.
    """
    size = len(looks)
    weak, num = np.empty((len(places), 2)), 0
    sure = np.zeros((size // SURE_BLOCK + 3, size // SURE_BLOCK + 3), np.bool_)
    c, s = math.cos(start[2]), math.sin(start[2])
    for k in range(len(places)):
        x = start[0] + c * places[k, 0] - s * places[k, 1]
        y = start[1] + s * places[k, 0] + c * places[k, 1]
        row, col = to_index(y, size), to_index(x, size)
        if not (bounds[0] <= row < bounds[2] and bounds[1] <= col < bounds[3]):
            continue
        if counts[k, 0] < WEAK:
            if looks[row, col] < MOST_LOOKS and is_at_unseen_wall(cells, looks, row, col):
                weak[num, 0], weak[num, 1] = x, y
                num += 1
        else:
            r, c_ = row // SURE_BLOCK + 1, col // SURE_BLOCK + 1
            for i in range(r - 1, r + 2):
                for j in range(c_ - 1, c_ + 2):
                    sure[i, j] = True
    return weak[:num], sure


@device
@jit
def keep_revisits(
    cells: Any, seen: tuple[Any, Any], pose: Any, camera: Any, targets: Any, values: Any, rows: Any, visits: Any,
    distant: Any,
) -> None:  # fmt: skip
    """Keep the revisit candidates (m, 5) with something left to gain, and empty the other slots.

    Looks (S, S) and their bounds (4,) are given together. Values (n,) of targets (n, 6)
    that candidates cover become 0. Distant candidates, a mask (m,), stay as they are.
    """
    looks, looks_bounds = seen
    for i in range(len(rows)):
        if np.isnan(rows[i, X]) or distant[i]:
            continue
        at_goal = math.hypot(rows[i, X] - pose[0], rows[i, Y] - pose[1]) <= AT_GOAL
        if at_goal and math.cos(rows[i, HEADING] - pose[2]) > math.cos(LOOKING):
            visits[i] += 1
        gain, heading = 0.0, bin_of(rows[i, HEADING])
        for t in range(len(values)):
            if values[t] == 0.0 or not is_measurable(cells, targets[t], rows[i, X], rows[i, Y], camera[1]):
                continue
            if is_in_view(bin_of(math.atan2(targets[t, 1] - rows[i, Y], targets[t, 0] - rows[i, X])), heading):
                if visits[i] >= PATIENCE:
                    give_up(looks, looks_bounds, targets[t])
                else:
                    gain += values[t]
                values[t] = 0.0
        if gain < LEAST_KEPT:
            rows[i], visits[i] = np.nan, 0
        else:
            rows[i, SIZE] = gain


@device
@jit
def add_revisits(cells: Any, cost: Any, corner: Any, camera: Any, targets: Any, values: Any, rows: Any) -> None:
    """Fill empty slots (m, 5) by a greedy cover.

    Each new candidate is the place and heading, among reachable cells on a lattice, with most of what no other one
    covers. Values (n,) of targets (n, 6) that are covered become 0.
    """
    left, empty = 0, 0
    for t in range(len(values)):  # only what is not covered yet
        if values[t] > 0.0:
            targets[left], values[left] = targets[t], values[t]
            left += 1
    for i in range(len(rows)):
        empty += np.isnan(rows[i, X])
    targets, values = targets[:left], values[:left]
    if empty == 0 or values.sum() < LEAST_GAIN:
        return
    size, (height, width) = len(cells), cost.shape
    num_places = 0
    places = np.empty(((height // SPACING + 1) * (width // SPACING + 1), 2), np.int64)
    bins, best = np.empty((len(places), left), np.int8), np.zeros((len(places), 2))
    gains, beside = np.empty(BINS), np.empty(left, np.int64)
    most = min(FARTHEST, camera[1]) + CELL  # rounding must not decide
    margin = margin_of(size)  # the lattice is that of a new grid
    for row in range((margin - corner[0]) % SPACING, height, SPACING):
        y, num_beside = to_coordinate(row + corner[0], size), 0
        for t in range(left):
            if abs(targets[t, 1] - y) <= most:
                beside[num_beside] = t
                num_beside += 1
        if num_beside == 0:
            continue
        for col in range((margin - corner[1]) % SPACING, width, SPACING):
            if cost[row, col] == UNREACHED:
                continue
            x, total = to_coordinate(col + corner[1], size), 0.0
            bins[num_places] = -1
            for t in beside[:num_beside]:
                if is_measurable(cells, targets[t], x, y, camera[1]):
                    bins[num_places, t] = bin_of(math.atan2(targets[t, 1] - y, targets[t, 0] - x))
                    total += values[t]
            if total >= LEAST_GAIN:
                places[num_places, 0], places[num_places, 1] = row, col
                best[num_places, 0], best[num_places, 1] = best_view(bins[num_places], values, gains)
                num_places += 1
    if num_places == 0:
        return
    best = best[:num_places]
    for i in range(len(rows)):
        if not np.isnan(rows[i, X]):
            continue
        p: Any = 0
        for _ in range(num_places):  # gains only fall: once the highest is up to date, none is better
            p = np.argmax(best[:, 0])
            known = best[p, 0]
            if known >= LEAST_GAIN:
                best[p, 0], best[p, 1] = best_view(bins[p], values, gains)
            if known < LEAST_GAIN or best[p, 0] == known:
                break
        if best[p, 0] < LEAST_GAIN:
            break
        heading = int(best[p, 1])
        rows[i, X] = to_coordinate(places[p, 1] + corner[1], size)
        rows[i, Y] = to_coordinate(places[p, 0] + corner[0], size)
        rows[i, HEADING] = 2.0 * math.pi * (heading if 2 * heading <= BINS else heading - BINS) / BINS
        rows[i, SIZE] = best[p, 0]
        for t in range(left):
            if bins[p, t] >= 0 and is_in_view(bins[p, t], heading):
                values[t] = 0.0
        for q in range(num_places):
            u, v = places[q, 0] - places[p, 0], places[q, 1] - places[p, 1]
            if (u * u + v * v) * CELL * CELL < APART * APART:
                best[q, 0] = 0.0


@device
@in_place
def set_rendezvous(cost: Any, corner: Any, size: int, pose: Any, places: Any, rows: Any, distant: Any) -> None:
    """Move places (m, 3), NaN: none, to the nearest reachable cells and write them as candidates (m, 5).

    Places that the robot has reached, or that no reachable cell is near, leave their slots empty. Distant candidates, a
    mask (m,), stay while their places do; those that do not are no longer marked.
    """
    height, width = cost.shape
    for i in range(len(rows)):
        if distant[i] and math.hypot(rows[i, X] - places[i, 0], rows[i, Y] - places[i, 1]) <= NEAR_PLACE * CELL:
            continue
        rows[i], distant[i] = np.nan, False
        if np.isnan(places[i, 0]):
            continue
        row, col = to_index(places[i, 1], size) - corner[0], to_index(places[i, 0], size) - corner[1]
        least, goal_row, goal_col = (NEAR_PLACE + 1) ** 2, -1, -1
        for r in range(max(row - NEAR_PLACE, 0), min(row + NEAR_PLACE + 1, height)):
            for c in range(max(col - NEAR_PLACE, 0), min(col + NEAR_PLACE + 1, width)):
                square = (r - row) * (r - row) + (c - col) * (c - col)
                if cost[r, c] != UNREACHED and square < least:
                    least, goal_row, goal_col = square, r, c
        if goal_row < 0:
            continue
        x, y = to_coordinate(goal_col + corner[1], size), to_coordinate(goal_row + corner[0], size)
        if math.hypot(x - pose[0], y - pose[1]) > AT_GOAL:
            rows[i, X], rows[i, Y], rows[i, HEADING], rows[i, SIZE] = x, y, places[i, 2], 0.0


@device
@jit
def measure_teammates(
    box: Any, weights: Any, corner: Any, size: int, poses: Any, robot: int, rows: Any, lengths: Any
) -> None:
    """Write the lengths (C, K) of the paths of a robot's teammates to its candidates (C, 5), over cells twice as wide.

    These make the search four times as fast; passages stay open, since a wide cell is passable if one of its parts is.
    """
    height, width = (box.shape[0] + 1) // 2, (box.shape[1] + 1) // 2
    wide = np.zeros((0, 0), np.uint8)
    for k in range(len(poses)):
        if k == robot or np.isnan(poses[k, 0]):
            continue
        if len(wide) == 0:
            wide = np.zeros((height, width), np.uint8)
            for row in range(box.shape[0]):
                here, there = weights[row], wide[row // 2]
                for i in range(box.shape[1] // 2):  # the last column of an odd number is closed
                    for j in range(2):
                        weight, old = here[2 * i + j], there[i]
                        there[i] = weight if weight > 0 and (old == 0 or weight < old) else old
            wide[0], wide[height - 1], wide[:, 0], wide[:, width - 1] = 0, 0, 0, 0  # open where the floor was cut off
        row, col = to_index(poses[k, 1], size) - corner[0], to_index(poses[k, 0], size) - corner[1]
        start_row, start_col = nearest_open(box, weights, row, col, ESCAPE_CELLS, ISLAND)
        if not (0 < start_row // 2 < height - 1 and 0 < start_col // 2 < width - 1):
            continue
        cost, parents = wavefront(wide, start_row // 2, start_col // 2, -1)
        flat = parents.ravel()
        for i in range(len(rows)):
            if np.isnan(rows[i, X]):
                continue
            row, col = to_index(rows[i, Y], size) - corner[0], to_index(rows[i, X], size) - corner[1]
            inside = 0 <= row < box.shape[0] and 0 <= col < box.shape[1]
            if not inside or cost[row // 2, col // 2] == UNREACHED:
                continue
            cell, length = row // 2 * width + col // 2, 0.0
            while flat[cell] >= 0:
                step = abs(cell - flat[cell])
                length += 2.0 * CELL if step == 1 or step == width else math.sqrt(8.0) * CELL
                cell = flat[cell]
            lengths[i, k] = length


@jit
def renew_candidates(
    cells: Any, bounds: Any, seen: tuple[Any, Any], ways: tuple[Any, Any, Any, Any, int, int],
    landmarks: tuple[Any, Any, Any], poses: Any, camera: Any, places: Any,
    slots: tuple[Any, Any, Any, Any, Any, int, int],
) -> None:  # fmt: skip
    """Bring a robot's candidates up to date, given its frontiers.

    Args:
        cells: (S, S) uint8. Cells of the robot's grid.
        bounds: (4,) int32. Bounds of its known part.
        seen: Looks of the grid (S, S) uint8, of which those at walls that cannot be seen are set to the largest number;
            and their bounds (4,) int32, see `TeamLooks`.
        ways: Paths from the robot, of `dijkstra`. Where they cover a part of the known floor, candidates of which they
            tell nothing (`is_settled`) stay as they are.
        landmarks: All landmarks of the robot's map (n, 4), their counts (n, 2), and the motion (3,) from the map frame
            to the start frame; see `MapSummaryRows`.
        poses: (K, 3) [m, m, rad]. Poses of all robots in the robot's frame; NaN: unknown.
        camera: (3,). Half the field of view [rad], range [m], radius of the robot [m].
        places: (R, 3) [m, m, rad]. Places for rendezvous; NaN: none.
        slots: Candidates (C, 5): first frontiers, which are given, then V revisit ones, then R rendezvous, NaN in empty
            slots; visits (V,) int64 of the revisit ones; gains (C, 4), see `view_gains` and `path_lengths_to`; the
            poses (C, 3) for which they were computed; lengths (C, K) [m] of all robots' paths, inf: unknown or
            unreachable; all changed; the row of the robot in `poses`; the number of the update: the gains of a
            candidate that stays are computed in every fourth one, new places to look from are sought in every second.
    """
    looks, _ = seen
    rows, visits, gains, views, lengths, robot, update = slots
    size, num_places = len(cells), len(places)
    first_revisit, first_rendezvous = len(rows) - num_places - len(visits), len(rows) - num_places
    box, weights, cost, parents, first_row, first_col = ways
    corner = (first_row, first_col)
    part = np.empty(4, np.int32)  # the part of the known floor that was searched
    part[0], part[1] = first_row + PAD, first_col + PAD
    part[2], part[3] = first_row + box.shape[0] - PAD, first_col + box.shape[1] - PAD
    is_part = False
    for i in range(4):
        is_part |= part[i] != bounds[i]
    distant = np.zeros(len(rows), np.bool_)
    if is_part:
        for i in range(len(rows)):
            if not np.isnan(rows[i, X]):
                row, col = to_index(rows[i, Y], size), to_index(rows[i, X], size)
                distant[i] = not is_settled(weights, cost, corner, bounds, row, col)
    weak, sure = worth_seeing(cells, looks, part, *landmarks)

    revisits = rows[first_revisit:first_rendezvous]
    targets = collect_targets(cells, part, looks, weak)
    values = targets[:, 4].copy()
    for i in range(len(revisits)):
        if not np.isnan(revisits[i, X]) and not distant[first_revisit + i]:
            row, col = to_index(revisits[i, Y], size) - first_row, to_index(revisits[i, X], size) - first_col
            inside = 0 <= row < cost.shape[0] and 0 <= col < cost.shape[1]
            if not inside or cost[row, col] == UNREACHED:
                revisits[i], visits[i] = np.nan, 0
    kept = distant[first_revisit:first_rendezvous]
    keep_revisits(cells, seen, poses[robot], camera, targets, values, revisits, visits, kept)
    if update % 2 == 0:
        add_revisits(cells, cost, corner, camera, targets, values, revisits)
    set_rendezvous(cost, corner, size, poses[robot], places, rows[first_rendezvous:], distant[first_rendezvous:])

    for i in range(len(rows)):
        off = math.hypot(rows[i, X] - views[i, X], rows[i, Y] - views[i, Y])  # NaN: another candidate, or none
        if not (is_part and off < APART):
            lengths[i] = np.inf
        if not np.isnan(rows[i, X]) and not distant[i]:
            row, col = to_index(rows[i, Y], size) - first_row, to_index(rows[i, X], size) - first_col
            if cost[row, col] != UNREACHED:
                lengths[i, robot], gains[i, UNCERTAIN_LENGTH] = path_lengths_to(parents, row, col, corner, sure)
                rows[i, LENGTH] = lengths[i, robot]
    measure_teammates(box, weights, corner, size, poses, robot, rows, lengths)
    for i in range(len(rows)):
        if np.isnan(rows[i, X]):
            gains[i], views[i] = 0.0, np.nan
            continue
        moved = math.hypot(rows[i, X] - views[i, X], rows[i, Y] - views[i, Y])  # NaN: not looked at yet
        is_near = moved < MOVED and math.cos(rows[i, HEADING] - views[i, HEADING]) > math.cos(TURNED)
        if not is_near or (i % RECHECKED == update % RECHECKED and not distant[i]):
            view_gains(cells, looks, weak, rows[i], camera, gains[i])
            views[i] = rows[i, :3]


NOWHERE = 60.0  # [m] stands for the distance of a teammate or another candidate when there is none
OWN_GOAL, SAME_GOAL = 0.3, 1.0  # [m] within which a candidate is a robot's own goal, or a teammate's
NUM_DESCRIBED = 14  # features before the kinds


@in_place
def write_goals(starts: Any, own_goals: Any, shared: Any, goals: Any) -> None:
    """Write the goals that robots know.

    Args:
        starts: (K, 3) [m, m, rad]. Motions from the map frames to the start frames, see `TeamPoses`.
        own_goals: (K, 2) [m]. Goal of each robot in its own start frame; NaN: none.
        shared: (K, K) int64. 1 where two robots are on the same filter.
        goals: (K, K, 2) [m]. Output: goal of robot j in the start frame of robot i; NaN: none, or not known.
    """
    goals[:] = np.nan
    for j in range(len(starts)):
        if np.isnan(own_goals[j, 0]):
            continue
        u, v = own_goals[j, 0] - starts[j, 0], own_goals[j, 1] - starts[j, 1]
        c, s = math.cos(starts[j, 2]), math.sin(starts[j, 2])
        x, y = c * u + s * v, c * v - s * u  # in the map frame
        for i in range(len(starts)):
            if i == j:
                goals[i, j, 0], goals[i, j, 1] = own_goals[j, 0], own_goals[j, 1]
            elif shared[i, j]:
                c, s = math.cos(starts[i, 2]), math.sin(starts[i, 2])
                goals[i, j, 0], goals[i, j, 1] = starts[i, 0] + c * x - s * y, starts[i, 1] + s * x + c * y


@in_place
def describe_candidates(rows: Any, gains: Any, lengths: Any, poses: Any, goals: Any, kinds: Any, features: Any) -> None:
    """Write the features of all robots' candidates, in the order of `CANDIDATE_FEATURES`.

    Args:
        rows: (K, C, 5). Candidates, NaN in empty slots.
        gains: (K, C, 4). See `renew_candidates`.
        lengths: (K, C, K). See `renew_candidates`.
        poses: (K, n, 3) [m, m, rad], n >= K. Pose of robot j in the frame of robot i.
        goals: (K, n, 2) [m]. Current goal of robot j in the frame of robot i; NaN: unknown.
        kinds: (C,) int64. Kind of each slot.
        features: (K, C, 17) float32. Output; zeros in empty slots.
    """
    for robot in range(len(rows)):
        x, y, theta = poses[robot, robot]
        c, s = math.cos(theta), math.sin(theta)
        for i in range(rows.shape[1]):
            row, here = rows[robot, i], features[robot, i]
            here[:] = 0.0
            if np.isnan(row[X]):
                continue
            u, v, turn = row[X] - x, row[Y] - y, row[HEADING] - theta
            here[0], here[1] = c * u + s * v, c * v - s * u
            here[2], here[3] = math.cos(turn), math.sin(turn)
            here[4], here[5] = row[LENGTH], row[SIZE]
            nearest, another = NOWHERE, NOWHERE * NOWHERE
            for mate in range(lengths.shape[2]):
                if mate != robot:
                    nearest = min(nearest, lengths[robot, i, mate])
            for mate in range(goals.shape[1]):
                gap = math.hypot(row[X] - goals[robot, mate, 0], row[Y] - goals[robot, mate, 1])  # NaN: unknown
                if mate == robot:
                    here[7] = gap < OWN_GOAL
                elif gap < SAME_GOAL:
                    here[8] = 1.0
            for j in range(rows.shape[1]):
                gap_x, gap_y = row[X] - rows[robot, j, X], row[Y] - rows[robot, j, Y]  # NaN: empty
                square = gap_x * gap_x + gap_y * gap_y
                if j != i and square < another:
                    another = square
            here[6], here[13] = nearest, math.sqrt(another)
            for k in range(NUM_GAINS):
                here[9 + k] = gains[robot, i, k]
            here[NUM_DESCRIBED + kinds[i]] = 1.0


COARSE = 48  # cells along a side of the global grid, as of the local one, so that one network can look at both
NUM_COARSE = 3  # channels: free, occupied, walls looked at


@jit
def write_global_grid(cells: Any, looks: Any, bounds: Any, picture: Any, frame: Any) -> None:
    """Write the known part of a grid at the finest resolution at which it fits, by whole multiples of a cell.

    Args:
        cells: (S, S) uint8. Cells of a grid.
        looks: (S, S) uint8. Looks of the grid.
        bounds: (4,) int32. Bounds of its known part.
        picture: (3, 48, 48) uint8. Output, rows with y and columns with x: shares of free and of occupied cells, and
            the share of border cells that were looked at, times 255.
        frame: (3,) float32. Output: x and y of the picture's middle in the start frame, and size of its cells [m].
    """
    size = len(cells)
    height, width = bounds[2] - bounds[0], bounds[3] - bounds[1]
    scale = max((max(height, width) + COARSE - 1) // COARSE, 1)
    top, left = bounds[0] - (COARSE * scale - height) // 2, bounds[1] - (COARSE * scale - width) // 2
    first, last = max(bounds[1], 1), min(bounds[3], size - 1)
    first_row, last_row = max(bounds[0], 1), min(bounds[2], size - 1)
    num = max(last - first, 0)
    places, shades = np.empty(num, np.int32), np.empty(scale * scale + 1, np.uint8)
    for i in range(num):
        places[i] = (first + i - left) // scale
    for k in range(len(shades)):  # instead of a division per cell
        shades[k] = k * 255 // (scale * scale)
    borders, unseen, columns = np.empty(num, np.uint8), np.empty(num, np.uint8), np.empty(num + 2, np.uint16)
    counts, sums = np.empty((4, num), np.uint16), np.empty((4, COARSE), np.int32)
    free, occupied, at_wall, looked = counts[0], counts[1], counts[2], counts[3]
    picture[:] = 0
    for r in range(COARSE):
        begin, end = max(top + r * scale, first_row), min(top + (r + 1) * scale, last_row)
        if begin >= end or num == 0:
            continue
        for i in range(num):
            free[i] = occupied[i] = at_wall[i] = looked[i] = 0
        for row in range(begin, end):
            mark_borders(cells, row, first, last, borders)
            mark_unseen(borders, looks, row, first, columns, unseen)
            here = cells[row, first:last]
            for i in range(num):  # without branches: this becomes vector code
                free[i] += here[i] == FREE
                occupied[i] += here[i] == OCCUPIED
                at_wall[i] += borders[i]
                looked[i] += borders[i] - unseen[i]
        sums[:] = 0
        for k in range(4):
            for i in range(num):
                sums[k, places[i]] += counts[k, i]
        for block in range(COARSE):
            picture[0, r, block], picture[1, r, block] = shades[sums[0, block]], shades[sums[1, block]]
            if sums[2, block] > 0:
                picture[2, r, block] = sums[3, block] * 255 // sums[2, block]
    frame[0] = to_coordinate(left, size) + 0.5 * (COARSE * scale - 1) * CELL
    frame[1] = to_coordinate(top, size) + 0.5 * (COARSE * scale - 1) * CELL
    frame[2] = scale * CELL


@jit
def write_global_grids(cells: Any, looks: Any, bounds: Any, pictures: Any, frames: Any) -> None:
    """Write the pictures of K grids; arguments as those of `write_global_grid`, with an axis of K before."""
    for robot in range(len(cells)):
        write_global_grid(cells[robot], looks[robot], bounds[robot], pictures[robot], frames[robot])
