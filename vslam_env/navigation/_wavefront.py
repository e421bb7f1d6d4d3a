"""The compiled search over the known part of a grid: where a disc fits, and the cheapest ways from one cell."""

import math
from typing import Any

import numpy as np

from slam_backend._jit import jit
from vslam_env.navigation._painting_kernels import FREE, GRID_SIZE, OCCUPIED, UNKNOWN

PAD = 2  # cells around the known box, so that loops over frontiers and neighbours need no bounds
OUTSIDE = 3  # beyond the 60 x 60 m: neither known nor worth exploring

STRAIGHT, DIAGONAL = 5, 7  # length of a step in fifths of a cell; 7/5 is 1 % short of the diagonal
CLOSE, NEAR, OPEN = 4, 2, 1  # weights of cells by their distance from walls
NUM_BUCKETS = 64  # a power of two above the dearest step, DIAGONAL * (CLOSE + CLOSE)
UNREACHED = np.iinfo(np.int32).max
_WALL = 255


@jit
def known_bounds(cells: Any) -> tuple[int, int, int, int]:
    """Return first row, first column, height and width of the cells (300, 300) that are known; zeros if none is."""
    columns = np.zeros(GRID_SIZE, np.uint8)
    first_row, last_row = GRID_SIZE, -1
    for row in range(GRID_SIZE):
        known = np.uint8(0)
        for col in range(GRID_SIZE):
            known |= cells[row, col]
            columns[col] |= cells[row, col]
        if known != UNKNOWN:
            first_row, last_row = min(first_row, row), row
    if last_row < 0:
        return 0, 0, 0, 0
    first_col, last_col = 0, GRID_SIZE - 1
    while columns[first_col] == UNKNOWN:
        first_col += 1
    while columns[last_col] == UNKNOWN:
        last_col -= 1
    return first_row, first_col, last_row - first_row + 1, last_col - first_col + 1


@jit
def known_box(cells: Any, row: int, col: int, height: int, width: int) -> Any:
    """Cut the known box out of a grid, and pad it with the cells around.

    Args:
        cells: (300, 300) uint8. The grid.
        row: First row of the box.
        col: First column of the box.
        height: Of the box in cells.
        width: Of the box in cells.

    Returns:
        (height + 2 PAD, width + 2 PAD) uint8, its first cell being (row - PAD, col - PAD) of the grid.
    """
    box = np.full((height + 2 * PAD, width + 2 * PAD), OUTSIDE, np.uint8)
    first, last = max(col - PAD, 0), min(col + width + PAD, GRID_SIZE)
    for grid_row in range(max(row - PAD, 0), min(row + height + PAD, GRID_SIZE)):
        box[grid_row - row + PAD, first - col + PAD : last - col + PAD] = cells[grid_row, first:last]
    return box


@jit
def _squared_clearance(box: Any, span: int) -> Any:
    """Return each cell's squared distance to the nearest occupied one, (h, w) int16, if at most `span`; else more."""
    height, width = box.shape
    along_row = np.empty((height, width), np.int16)
    for r in range(height):
        gap = span + 1
        for c in range(width):
            gap = 0 if box[r, c] == OCCUPIED else min(gap + 1, span + 1)
            along_row[r, c] = gap * gap
        gap = span + 1
        for c in range(width - 1, -1, -1):
            gap = 0 if box[r, c] == OCCUPIED else min(gap + 1, span + 1)
            along_row[r, c] = min(along_row[r, c], gap * gap)
    squared = along_row.copy()
    for r in range(height):
        for other in range(max(r - span, 0), min(r + span + 1, height)):
            rise = (other - r) * (other - r)
            for c in range(width):
                through = np.int16(along_row[other, c] + rise)
                if through < squared[r, c]:  # unlike min(), this becomes vector code
                    squared[r, c] = through
    return squared


@jit
def weigh(box: Any, reach: float) -> Any:
    """Weigh the cells of a box by how near they are to walls.

    Args:
        box: (h, w) uint8.
        reach: Distance from an occupied cell below which a robot may not be, in cells.

    Returns:
        (h, w) uint8: 0 where a robot may not be (occupied, unknown, too near to a wall, or at the edge of the box),
        `CLOSE` within one more cell of that, `NEAR` within two or beside the unknown, else `OPEN`.
    """
    clearance = _squared_clearance(box, math.ceil(reach + 1.0))
    weights = np.zeros(box.shape, np.uint8)
    for r in range(1, box.shape[0] - 1):
        for c in range(1, box.shape[1] - 1):
            if box[r, c] != FREE or clearance[r, c] < reach**2:
                continue
            at_edge = UNKNOWN in (box[r - 1, c], box[r + 1, c], box[r, c - 1], box[r, c + 1])
            if clearance[r, c] < (reach + 1.0) ** 2:
                weights[r, c] = CLOSE
            elif at_edge or clearance[r, c] < (reach + 2.0) ** 2:
                weights[r, c] = NEAR
            else:
                weights[r, c] = OPEN
    return weights


@jit
def nearest_open(box: Any, weights: Any, row: int, col: int, reach: int) -> tuple[int, int]:
    """Find the open cell that is the fewest steps away, without stepping through a wall.

    Args:
        box: (h, w) uint8. Cells.
        weights: (h, w) uint8. 0 where a robot may not be.
        row: Where to begin; this cell itself may be a wall's.
        col: See `row`.
        reach: How far to look, in cells.

    Returns:
        Its row and column, or (-1, -1).
    """
    height, width = box.shape
    if not (0 <= row < height and 0 <= col < width):
        return -1, -1
    side = 2 * reach + 1
    visited = np.zeros((side, side), np.bool_)
    queue = np.empty((side * side, 2), np.int64)
    queue[0, 0], queue[0, 1] = row, col
    visited[reach, reach] = True
    head, tail = 0, 1
    while head < tail:
        r, c = queue[head]
        head += 1
        if weights[r, c] > 0:
            return r, c
        for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0)):
            nr, nc = r + i, c + j
            if not (0 <= nr < height and 0 <= nc < width) or abs(nr - row) > reach or abs(nc - col) > reach:
                continue
            if visited[nr - row + reach, nc - col + reach] or box[nr, nc] == OCCUPIED:
                continue
            visited[nr - row + reach, nc - col + reach] = True
            queue[tail, 0], queue[tail, 1] = nr, nc
            tail += 1
    return -1, -1


@jit
def wavefront(weights: Any, row: int, col: int) -> tuple[Any, Any]:
    """Find the cheapest ways from one cell to all others (Dijkstra's algorithm with Dial's buckets).

    A step to one of the eight neighbours costs its length times the sum of the weights of its two cells. Diagonal
    steps need no look at the cells beside them, since walls have been widened by more than a cell. Costs are small
    integers, so that the queue is a ring of buckets, each a linked list. A cell whose cost falls is listed again; its
    older entries are passed over.

    Args:
        weights: (h, w) uint8, 0 = closed. The outermost cells must be closed.
        row: The first cell, open; -1 if there is none, and nothing is reached.
        col: See `row`.

    Returns:
        Of each cell, (h, w) int32: the cost, `UNREACHED` if there is no way; and the flat index of the cell before
        it, -1 at the first cell and where there is no way.
    """
    width = weights.shape[1]
    weight = weights.ravel()
    cost = np.full(weight.size, UNREACHED, np.int32)
    for cell in range(weight.size):
        if weight[cell] == 0:
            cost[cell] = -1  # below all costs, so that one comparison passes over closed and settled cells alike
    parent = np.full(weight.size, -1, np.int32)
    entries = np.empty(8 * weight.size + 1, np.int32)  # a cost falls at most once per neighbour
    following = np.empty(8 * weight.size + 1, np.int32)
    heads = np.full(NUM_BUCKETS, -1, np.int32)

    offsets = np.array([1, width, -1, -width, 1 + width, width - 1, -1 - width, 1 - width])  # four straight ones first

    used, waiting, current = 0, 0, 0
    if row >= 0:
        cost[row * width + col] = 0
        entries[0], following[0], heads[0] = row * width + col, -1, 0
        used = waiting = 1
    while waiting > 0:
        bucket = current & (NUM_BUCKETS - 1)
        while heads[bucket] >= 0:
            cell = entries[heads[bucket]]
            heads[bucket] = following[heads[bucket]]
            waiting -= 1
            if cost[cell] != current:
                continue
            for k in range(8):
                neighbour = cell + offsets[k]
                step = STRAIGHT if k < 4 else DIAGONAL
                through = current + step * (np.int64(weight[cell]) + weight[neighbour])
                if through >= cost[neighbour]:
                    continue
                cost[neighbour], parent[neighbour] = through, cell
                target = through & (NUM_BUCKETS - 1)
                entries[used], following[used], heads[target] = neighbour, heads[target], used
                used += 1
                waiting += 1
        current += 1
    for cell in range(weight.size):
        if weight[cell] == 0:
            cost[cell] = UNREACHED
    return cost.reshape(weights.shape), parent.reshape(weights.shape)


@jit
def _line_cost(weights: Any, row: float, col: float, to_row: float, to_col: float) -> float:
    """Return the cost of a straight line between two cells, infinite if it leaves the open ones."""
    distance = math.hypot(to_row - row, to_col - col)
    samples = int(4.0 * distance) + 1
    total = 0.0
    for i in range(samples + 1):
        share = i / samples
        weight = weights[int(row + share * (to_row - row) + 0.5), int(col + share * (to_col - col) + 0.5)]
        if weight == 0:
            return np.inf
        total += weight
    return 2.0 * STRAIGHT * distance * total / (samples + 1)


@jit
def straight_path(weights: Any, cost: Any, parent: Any, row: int, col: int) -> Any:
    """Follow the parents from a goal back to the start, and pull the way straight where that costs no more.

    Args:
        weights: (h, w) uint8.
        cost: (h, w) int32, of `wavefront`.
        parent: (h, w) int32, of `wavefront`.
        row: The goal, a reached cell.
        col: See `row`.

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
            line = _line_cost(weights, way[anchor] // width, way[anchor] % width, ahead // width, ahead % width)
            if line > 1.02 * (costs[ahead] - costs[way[anchor]]):  # 2 % for the short diagonal and the sampling
                break
            reached += 1
        corners[num, 0], corners[num, 1] = way[reached] // width, way[reached] % width
        num += 1
        anchor = reached
    return corners[:num]
