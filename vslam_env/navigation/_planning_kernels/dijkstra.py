"""Cheapest paths from one cell to all others, and the shortcuts that straighten them."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from vslam_env.navigation._grid_kernels import CELL, LARGEST_HALF_WIDTH, OCCUPIED, cell_index, margin_of
from vslam_env.navigation._planning_kernels.costmap import OUTSIDE, PAD, inflate_costs


@jit
def shorten_path(weights: Any, cost: Any, parent: Any, row: int, col: int) -> Any:
    """Follow the parents from a goal back to the start, and pull the way straight where that costs no more.

    Args:
        weights: (h, w) uint8.
        cost: (h, w) int32, of `wavefront`.
        parent: (h, w) int32, of `wavefront`.
        row: The goal, a reached cell.
        col: Column of the first cell.

    Returns:
        (n, 2) int64 rows (row, column) of the corners, from the start to the goal.
    """
    width = weights.shape[1]
    costs, before = cost.ravel(), parent.ravel()
    goal = row * width + col
    count = 1
    cell = goal
    while before[cell] >= 0:
        cell = before[cell]
        count += 1
    way = np.empty(count, np.int64)
    cell = goal
    for i in range(count - 1, -1, -1):
        way[i] = cell
        cell = before[cell]

    corners = np.empty((count, 2), np.int64)
    corners[0, 0], corners[0, 1] = way[0] // width, way[0] % width
    num = 1
    anchor = 0
    while anchor < count - 1:
        reached = anchor + 1
        while reached + 1 < count:
            ahead = way[reached + 1]
            first_row, first_col = way[anchor] // width, way[anchor] % width
            rows, cols = ahead // width - first_row, ahead % width - first_col
            distance = math.hypot(rows, cols)
            samples = int(4.0 * distance) + 1
            total, is_open = 0.0, True
            for i in range(samples + 1):
                share = i / samples
                weight = weights[int(first_row + share * rows + 0.5), int(first_col + share * cols + 0.5)]
                total += weight
                is_open &= weight > 0
            straight = 2.0 * STRAIGHT * distance * total / (samples + 1)
            # 2 % for the short diagonal and the sampling
            if not is_open or straight > 1.02 * (costs[ahead] - costs[way[anchor]]):
                break
            reached += 1
        corners[num, 0], corners[num, 1] = way[reached] // width, way[reached] % width
        num += 1
        anchor = reached
    return corners[:num]


STRAIGHT, DIAGONAL = 5, 7  # length of a step in fifths of a cell; 7/5 is 1 % short of the diagonal
NUM_STRAIGHT = 4  # of the eight directions, the first ones
# numba compiles a kernel once more for each number of Python that is passed to it, and once for all of numpy's.
ESCAPE_CELLS: Any = np.int64(
    25
)  # a robot that a bump put into a wall's margin, or drift among walls, looks this far for open floor
GOAL_CELLS: Any = np.int64(2)  # search radius for an open cell if the goal lies in an inflated wall
ISLAND: Any = np.int64(25)  # fewer open cells that lead nowhere else (1 m^2) are no floor to begin at
ANY_CELL: Any = np.int64(1)  # an island will do
NO_GOAL: Any = np.int64(-1)  # ways to all cells are wanted
NUM_BUCKETS = 64  # a power of two above the dearest step, DIAGONAL * (CLOSE + CLOSE)
UNREACHED = np.iinfo(np.int32).max


@device
@jit
def is_island(weights: Any, row: int, col: int, least: int) -> bool:
    """Return whether fewer than `least` > 1 open cells (at most 256) can be reached from an open cell (row, col)."""
    queue, num = np.empty((least, 2), np.int64), 1
    queue[0, 0], queue[0, 1] = row, col
    head = 0
    while head < num < least:
        r, c = queue[head]
        head += 1
        for i in range(r - 1, r + 2):
            for j in range(c - 1, c + 2):
                is_new = weights[i, j] > 0 and num < least  # the outermost cells are closed
                for k in range(num):
                    is_new &= queue[k, 0] != i or queue[k, 1] != j
                if is_new:
                    queue[num, 0], queue[num, 1] = i, j
                    num += 1
    return num < least


@jit
def nearest_open(box: Any, weights: Any, row: int, col: int, reach: int, least: int) -> tuple[int, int]:
    """Find the open cell that is the fewest steps away, without stepping through a wall.

    Args:
        box: (h, w) uint8. Cells.
        weights: (h, w) uint8. 0 where a robot may not be. The outermost cells must be closed.
        row: Row of the first cell, which may be a wall.
        col: Column of the first cell.
        reach: Search radius in cells.
        least: Number of open cells that must be reachable from it, if another one is within reach: walls drawn twice
            leave islands, from which a robot would see no way out.

    Returns:
        Row and column of the cell, or (-1, -1).
    """
    height, width = box.shape
    if not (0 <= row < height and 0 <= col < width):
        return -1, -1
    side = 2 * reach + 1
    visited = np.zeros((side, side), np.bool_)
    queue = np.empty((side * side, 2), np.int64)
    queue[0, 0], queue[0, 1] = row, col
    visited[reach, reach] = True
    head, tail, first_row, first_col = 0, 1, -1, -1
    while head < tail:
        r, c = queue[head]
        head += 1
        if weights[r, c] > 0:
            if least <= 1 or not is_island(weights, r, c, least):
                return r, c
            if first_row < 0:
                first_row, first_col = r, c
        for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            nr, nc = r + i, c + j
            if not (0 <= nr < height and 0 <= nc < width) or abs(nr - row) > reach or abs(nc - col) > reach:
                continue
            if visited[nr - row + reach, nc - col + reach] or box[nr, nc] == OCCUPIED:
                continue
            visited[nr - row + reach, nc - col + reach] = True
            queue[tail, 0], queue[tail, 1] = nr, nc
            tail += 1
    return first_row, first_col


@device
@jit
def wavefront(weights: Any, row: int, col: int, goal: int) -> tuple[Any, Any]:
    """Find the cheapest ways from one cell to all others, or to one of them (Dijkstra's algorithm with Dial's buckets).

    A step to one of the eight neighbours costs its length times the sum of the weights of its two cells. Diagonal
    steps need no look at the cells beside them, since walls have been widened by more than a cell. Costs are small
    integers, so that the queue is a ring of buckets, each a linked list. A cell whose cost falls is listed again; its
    older entries are passed over.

    Args:
        weights: (h, w) uint8, 0 = closed. The outermost cells must be closed.
        row: The first cell, open; -1 if there is none, and nothing is reached.
        col: Column of the first cell.
        goal: Flat index of the only cell whose way is wanted; `NO_GOAL`: the ways to all cells are.

    Returns:
        Cost (h, w) int32 of each cell, `UNREACHED` if there is no path; and the flat index (h, w) int32 of its parent,
        -1 at the first cell and where there is no path. With a goal they hold along the way to it.
    """
    width = weights.shape[1]
    weight = weights.ravel()
    cost = np.empty(weight.size, np.int32)
    num_open = 0
    for i in range(weight.size):
        # Closed cells are below all costs, so that one comparison passes over closed and settled cells alike.
        cost[i] = UNREACHED if weight[i] > 0 else -1
        num_open += weight[i] > 0
    parents = np.full(weight.size, -1, np.int32)
    # Cells, and which entry follows each; a cost falls at most once per neighbour.
    entries = np.empty((8 * num_open + 1, 2), np.int32)
    heads = np.full(NUM_BUCKETS, -1, np.int32)
    steps = np.array((1, width, -1, -width, 1 + width, width - 1, -1 - width, 1 - width))

    used, taken, current = 0, 0, 0
    if row >= 0:
        cost[row * width + col] = 0
        entries[0, 0], entries[0, 1], heads[0] = row * width + col, -1, 0
        used = 1
    # Unsigned places need no look at whether they count from the end, which takes a quarter more time.
    while taken < used:
        bucket = np.uint32(current & (NUM_BUCKETS - 1))
        while heads[bucket] >= 0:
            entry = np.uint32(heads[bucket])
            cell, heads[bucket] = np.uint32(entries[entry, 0]), entries[entry, 1]
            taken += 1
            if cost[cell] != current:
                continue
            if np.int64(cell) == goal:
                taken = used  # ways to dearer cells are not wanted
                break
            here = np.int32(weight[cell])
            for k in range(8):
                neighbour = np.uint32(np.int64(cell) + steps[k])
                length = STRAIGHT if k < NUM_STRAIGHT else DIAGONAL
                through = np.int32(current + length * (here + np.int32(weight[neighbour])))
                if through < cost[neighbour]:
                    cost[neighbour], parents[neighbour] = through, cell
                    target, place = np.uint32(through & (NUM_BUCKETS - 1)), np.uint32(used)
                    entries[place, 0], entries[place, 1], heads[target] = neighbour, heads[target], used
                    used += 1
        current += 1
    for i in range(weight.size):
        cost[i] &= UNREACHED  # turns -1 into it, and leaves all costs as they are
    return cost.reshape(weights.shape), parents.reshape(weights.shape)


@in_place
def part_within(
    bounds: Any, size: int, x: float, y: float, goal_x: float, goal_y: float, reach: float
) -> tuple[int, int, int, int]:
    """Return the rows and columns, first and end, of the known part within reach of a place and a goal, or of all.

    See `dijkstra` for the arguments. It is all where nothing is known within reach.
    """
    low_row, low_col, high_row, high_col = bounds[0], bounds[1], bounds[2], bounds[3]
    far = 2.0 * LARGEST_HALF_WIDTH
    if reach < far:
        low_x, high_x = (x, x) if np.isnan(goal_x) else (min(x, goal_x), max(x, goal_x))
        low_y, high_y = (y, y) if np.isnan(goal_y) else (min(y, goal_y), max(y, goal_y))
        margin = margin_of(size)
        row, col = cell_index(max(low_y - reach, -far), margin), cell_index(max(low_x - reach, -far), margin)
        end_row, end_col = cell_index(min(high_y + reach, far), margin), cell_index(min(high_x + reach, far), margin)
        row, col = max(row, low_row), max(col, low_col)
        end_row, end_col = min(end_row + 1, high_row), min(end_col + 1, high_col)
        if row < end_row and col < end_col:
            return row, col, end_row, end_col
    return low_row, low_col, high_row, high_col


@jit
def dijkstra(
    cells: Any, bounds: Any, x: float, y: float, radius: float, goal_x: float, goal_y: float, reach: float
) -> tuple[Any, Any, Any, Any, int, int]:
    """Find the cheapest ways over the known floor of a grid.

    Args:
        cells: (S, S) uint8. The grid.
        bounds: (4,) int32, of `known_bounds`.
        x: Place where the ways begin [m]. If a robot may not be there, they begin at the nearest open cell.
        y: See `x`.
        radius: Radius of the robot [m].
        goal_x: Place of the only goal [m], so that the search ends there; NaN: all places are.
        goal_y: See `goal_x`.
        reach: Distance [m] from both along x and y beyond which the floor is left out, so that a search near the robot
            takes the same time however much is known; infinity: all known floor counts.

    Returns:
        The known box (h, w) uint8, with `PAD` cells before its bounds and after them; its weights, of `inflate_costs`;
        costs and parents, of `wavefront`; and the grid's row and column of the box's first cell.
    """
    size = len(cells)
    low_row, low_col, high_row, high_col = part_within(bounds, size, x, y, goal_x, goal_y, reach)
    first_row, first_col = low_row - PAD, low_col - PAD
    box = np.full((high_row + PAD - first_row, high_col + PAD - first_col), OUTSIDE, np.uint8)
    first, last = max(first_col, 0), min(high_col + PAD, size)
    for grid_row in range(max(first_row, 0), min(high_row + PAD, size)):
        here, there = box[grid_row - first_row, first - first_col :], cells[grid_row, first:last]
        for i in range(len(there)):  # an assignment of slices would take ten times as long
            here[i] = there[i]

    weights = inflate_costs(box, radius / CELL + 0.5)
    far = 2.0 * LARGEST_HALF_WIDTH  # as good as anywhere outside
    row = cell_index(min(max(y, -far), far), margin_of(size)) - first_row
    col = cell_index(min(max(x, -far), far), margin_of(size)) - first_col
    start_row, start_col = nearest_open(box, weights, row, col, ESCAPE_CELLS, ISLAND)
    goal = NO_GOAL
    if not np.isnan(goal_x):
        row = cell_index(min(max(goal_y, -far), far), margin_of(size)) - first_row
        col = cell_index(min(max(goal_x, -far), far), margin_of(size)) - first_col
        goal_row, goal_col = nearest_open(box, weights, row, col, GOAL_CELLS, ANY_CELL)
        goal = goal_row * box.shape[1] + goal_col if goal_row >= 0 else NO_GOAL
        start_row = start_row if goal >= 0 else -1  # nowhere to go
    cost, parents = wavefront(weights, start_row, start_col, goal)
    return box, weights, cost, parents, first_row, first_col
