"""Where the known floor of a box borders on what has not been seen."""

import math
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from slam_backend.core.validation import FloatArray
from vslam_env.navigation._grid_kernels import CELL, FREE, HALF_WIDTH, UNKNOWN, margin_of
from vslam_env.navigation._planning_kernels.dijkstra import UNREACHED

MIN_CELLS = 3  # a robot needs 0.4 m; what is smaller is a speck or the corner of a wall
MAX_CELLS = 20  # longer frontiers are cut, as one goal cannot stand for them
GOAL_STEPS = 5  # a goal is at most this far from its frontier [cells]
MOST_NEAR = 1 + 2 * GOAL_STEPS * (GOAL_STEPS + 1)  # cells that so many steps lead to, the first one included
LOOKED_AT = 4  # added to the marks of cells while a goal is looked for
SIGHT_CELLS = 3  # the unknown this near to a goal tells where to look from it

X, Y, HEADING, SIZE, LENGTH, NUM_COLUMNS = range(6)  # columns of the rows of candidates, see `FrontierColumns`


class FrontierColumns(NamedTuple):
    """The columns of rows that describe frontiers, each (n,) float64; start frame.

    Attributes:
        x: Place of the goal [m].
        y: See `x`.
        heading: Direction from the goal to the unknown [rad].
        size: Length of the frontier [m].
        length: Length of the path to the goal [m].
    """

    x: FloatArray
    y: FloatArray
    heading: FloatArray
    size: FloatArray
    length: FloatArray

    @classmethod
    def of(cls, rows: FloatArray) -> "FrontierColumns":
        """Return views of the columns of rows (n, 5)."""
        return cls(*rows.T)

    @property
    def goals(self) -> FloatArray:
        """Places of the goals (n, 2) [m], a copy."""
        return np.column_stack([self.x, self.y])


@device
@in_place
def _flood(mark: Any, level: int, into: int, row: int, col: int, limit: int, queue: Any) -> int:
    """Move up to `limit` connected cells from one level of marks to another, nearest first; return how many.

    Their rows and columns are left in the first rows of `queue`.
    """
    queue[0, 0], queue[0, 1] = row, col
    mark[row, col] = into
    head, tail = 0, 1
    while head < tail:
        r, c = queue[head]
        head += 1
        for nr in range(r - 1, r + 2):
            for nc in range(c - 1, c + 2):
                if mark[nr, nc] == level and tail < limit:
                    mark[nr, nc] = into
                    queue[tail, 0], queue[tail, 1] = nr, nc
                    tail += 1
    return tail


@device
@jit
def _goal_near(members: Any, box: Any, cost: Any, mark: Any) -> tuple[int, int]:
    """Return a reached cell as few steps as possible from a frontier and near its middle; (-1, -1) if none is near.

    Steps go sideways and not through walls. Most often one is enough; where a wall that is drawn too thick closes a
    door, the robot has to come near and look again. Marks are afterwards as they were.
    """
    queue = np.empty((MOST_NEAR * len(members), 2), np.int64)
    first, last, goal_row, goal_col = 0, len(members), -1, -1
    for k in range(last):
        queue[k, 0], queue[k, 1] = members[k]
        mark[members[k, 0], members[k, 1]] |= LOOKED_AT
    for _ in range(GOAL_STEPS):
        following, total, sum_row, sum_col = last, 0, 0.0, 0.0
        for k in range(first, last):
            for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0)):
                r, c = queue[k, 0] + i, queue[k, 1] + j
                if not (0 <= r < box.shape[0] and 0 <= c < box.shape[1]) or mark[r, c] & LOOKED_AT:
                    continue
                if box[r, c] in (FREE, UNKNOWN):
                    mark[r, c] |= LOOKED_AT
                    queue[following, 0], queue[following, 1] = r, c
                    following += 1
                    if cost[r, c] != UNREACHED:
                        total, sum_row, sum_col = total + 1, sum_row + r, sum_col + c
        first, last = last, following
        if total > 0:
            best = np.inf
            for k in range(first, last):
                r, c = queue[k]
                distance = (r - sum_row / total) ** 2 + (c - sum_col / total) ** 2
                if cost[r, c] != UNREACHED and distance < best:
                    best, goal_row, goal_col = distance, r, c
            break
    for k in range(last):
        mark[queue[k, 0], queue[k, 1]] ^= LOOKED_AT
    return goal_row, goal_col


@device
@jit
def _unseen_edges(box: Any, row: int, col: int, size: int) -> Any:
    """Return (h, w) int8, 1 for unknown cells beside free ones in a box that begins at a cell of a grid of a size."""
    height, width = box.shape
    edges = np.zeros((height, width), np.int8)
    for r in range(max(1, -row), min(height - 1, size - row)):
        first, last = max(1, -col), min(width - 1, size - col)
        here, edge = box[r, first:last], edges[r, first:last]
        below, above = box[r - 1, first:last], box[r + 1, first:last]
        right, left = box[r, first - 1 : last - 1], box[r, first + 1 : last + 1]
        for i in range(len(here)):  # without branches, it becomes vector code
            beside = (below[i] == FREE) | (above[i] == FREE) | (right[i] == FREE) | (left[i] == FREE)
            edge[i] = beside & (here[i] == UNKNOWN)
    return edges


GIVEN_UP = 0.8  # [m] radius of what is left out around a goal that shows nothing new


@device
@in_place
def _leave_out(mark: Any, x: float, y: float, row_centre: float, col_centre: float) -> None:
    """Clear the marks (h, w) within `GIVEN_UP` of a point [m]; the centre of a cell is its index plus the offset."""
    row, col = math.floor((y + HALF_WIDTH) / CELL - row_centre), math.floor((x + HALF_WIDTH) / CELL - col_centre)
    span = math.ceil(GIVEN_UP / CELL) + 1
    for r in range(max(row - span, 0), min(row + span + 1, mark.shape[0])):
        for c in range(max(col - span, 0), min(col + span + 1, mark.shape[1])):
            cell_x, cell_y = (c + col_centre) * CELL - HALF_WIDTH, (r + row_centre) * CELL - HALF_WIDTH
            if (cell_x - x) ** 2 + (cell_y - y) ** 2 <= GIVEN_UP**2:
                mark[r, c] = 0


@jit
def frontiers_reached(ways: tuple[Any, Any, Any, Any, int, int], grid_size: int, ignored: Any) -> Any:
    """Collect the frontiers to which a way is known.

    Args:
        ways: Paths of `dijkstra`.
        grid_size: Number of cells along a side of the grid.
        ignored: (n, 2) float64 [m]. Points around which, within `GIVEN_UP`, unknown cells do not count.

    Returns:
        (n, 5) float64 rows (x, y, heading, size, length), see `FrontierColumns`, by increasing length.
    """
    box, _, cost, parents, first_row, first_col = ways
    height, width = box.shape
    before, to_centre = parents.ravel(), 0.5 - margin_of(grid_size)
    # 1: such an edge; 2: its component known; 3: in a piece
    mark = _unseen_edges(box, first_row, first_col, grid_size)
    for i in range(len(ignored)):
        _leave_out(mark, ignored[i, 0], ignored[i, 1], first_row + to_centre, first_col + to_centre)

    frontiers = np.empty((height * width // MIN_CELLS + 1, NUM_COLUMNS))
    count = 0
    whole = np.empty((height * width, 2), np.int64)
    piece = np.empty((MAX_CELLS, 2), np.int64)
    for r in range(1, height - 1):
        line, marks = mark[r], np.uint8(0)
        for c in range(width):  # a loop of its own becomes vector instructions
            marks = np.uint8(marks | line[c])
        for c in range(1, width - 1 if marks > 0 else 1):
            if mark[r, c] != 1:
                continue
            size = _flood(mark, 1, 2, r, c, height * width, whole)
            num_pieces = (size + MAX_CELLS - 1) // MAX_CELLS
            share = (size + num_pieces - 1) // num_pieces
            for k in range(size - 1, -1, -1):  # from the far end, so that a line is cut piece by piece
                if mark[whole[k, 0], whole[k, 1]] != 2:
                    continue
                num = _flood(mark, 2, 3, whole[k, 0], whole[k, 1], share, piece)
                if num < MIN_CELLS:
                    continue
                row, col = _goal_near(piece[:num], box, cost, mark)
                if row < 0:
                    continue
                cell, length = row * width + col, 0.0
                while before[cell] >= 0:
                    step = abs(cell - before[cell])
                    length += CELL if step == 1 or step == width else math.sqrt(2.0) * CELL
                    cell = before[cell]
                up = right = 0  # to the unknown cells around the goal
                for i in range(max(row - SIGHT_CELLS, 0), min(row + SIGHT_CELLS + 1, height)):
                    for j in range(max(col - SIGHT_CELLS, 0), min(col + SIGHT_CELLS + 1, width)):
                        if box[i, j] == UNKNOWN:
                            up, right = up + i - row, right + j - col
                at = count
                while at > 0 and frontiers[at - 1, LENGTH] > length:
                    for i in range(NUM_COLUMNS):
                        frontiers[at, i] = frontiers[at - 1, i]
                    at -= 1
                frontiers[at, 0] = (first_col + col + to_centre) * CELL - HALF_WIDTH
                frontiers[at, 1] = (first_row + row + to_centre) * CELL - HALF_WIDTH
                frontiers[at, HEADING] = math.atan2(up, right)
                frontiers[at, SIZE] = num * CELL
                frontiers[at, LENGTH] = length
                count += 1
    return frontiers[:count]
