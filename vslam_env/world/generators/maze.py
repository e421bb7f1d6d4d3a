"""Procedural mazes: narrow corridors with few dead ends and many loops."""

from collections.abc import Iterator

import numpy as np

from slam_backend.core.validation import BoolArray
from vslam_env.world.generators._blueprint import Segment
from vslam_env.world.spec import World

CORRIDOR = (1.7, 2.1)  # [m] least and greatest width of a cell
COLUMNS, ROWS = (8, 10), (5, 7)  # least and greatest number of cells
OPENED = 0.6  # share of the dead ends that are opened

Cell = tuple[int, int]


def maze(rng: np.random.Generator) -> World:
    """Build a maze of about 17 x 11 m.

    A random depth-first spanning tree connects all cells by long corridors; then most dead ends are opened, which
    creates loops.

    Args:
        rng: Source of the layout.

    Returns:
        Closed world with about 20 to 35 maximal straight walls, without landmarks.
    """
    columns, rows = int(rng.integers(COLUMNS[0], COLUMNS[1] + 1)), int(rng.integers(ROWS[0], ROWS[1] + 1))
    size = rng.uniform(*CORRIDOR)
    # Walls between each cell and its right and upper neighbours.
    right, above = np.ones((rows, columns), np.bool_), np.ones((rows, columns), np.bool_)
    for cell, other in _tree(rows, columns, rng):
        _open(right, above, cell, other)
    for index in rng.permutation(rows * columns).tolist():
        cell = divmod(index, columns)
        around = _neighbours(cell, rows, columns)
        closed = [other for other in around if _is_wall(right, above, cell, other)]
        if len(around) - len(closed) == 1 and rng.random() < OPENED:
            _open(right, above, cell, closed[int(rng.integers(len(closed)))])
    return World("maze", size * np.array(_walls(right, above)))


def _tree(rows: int, columns: int, rng: np.random.Generator) -> Iterator[tuple[Cell, Cell]]:
    """Yield the passages of a random spanning tree, depth first."""
    stack = [(int(rng.integers(rows)), int(rng.integers(columns)))]
    seen = {stack[0]}
    while stack:
        unseen = [cell for cell in _neighbours(stack[-1], rows, columns) if cell not in seen]
        if not unseen:
            stack.pop()
            continue
        chosen = unseen[int(rng.integers(len(unseen)))]
        yield stack[-1], chosen
        seen.add(chosen)
        stack.append(chosen)


def _neighbours(cell: Cell, rows: int, columns: int) -> list[Cell]:
    """Return the neighbours of a cell."""
    row, column = cell
    around = [(row - 1, column), (row + 1, column), (row, column - 1), (row, column + 1)]
    return [(r, c) for r, c in around if 0 <= r < rows and 0 <= c < columns]


def _side(right: BoolArray, above: BoolArray, a: Cell, b: Cell) -> tuple[BoolArray, Cell]:
    """Return the array and index of the wall between two neighbours."""
    first = (min(a[0], b[0]), min(a[1], b[1]))
    return (right if a[0] == b[0] else above), first


def _is_wall(right: BoolArray, above: BoolArray, a: Cell, b: Cell) -> bool:
    """Return whether there is a wall between two neighbours."""
    walls, where = _side(right, above, a, b)
    return bool(walls[where])


def _open(right: BoolArray, above: BoolArray, a: Cell, b: Cell) -> None:
    """Remove the wall between two neighbours."""
    walls, where = _side(right, above, a, b)
    walls[where] = False


def _walls(right: BoolArray, above: BoolArray) -> list[Segment]:
    """Return the walls in units of cells: the frame, and maximal straight inner walls."""
    rows, columns = right.shape
    walls: list[Segment] = [(0, 0, columns, 0), (columns, 0, columns, rows), (columns, rows, 0, rows), (0, rows, 0, 0)]
    for column in range(columns - 1):
        walls += [(column + 1, a, column + 1, b) for a, b in _runs(right[:, column])]
    for row in range(rows - 1):
        walls += [(a, row + 1, b, row + 1) for a, b in _runs(above[row])]
    return walls


def _runs(flags: BoolArray) -> list[tuple[int, int]]:
    """Return the runs of True flags as half-open ranges."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(np.int8)))
    return [(int(a), int(b)) for a, b in zip(edges[0::2], edges[1::2], strict=True)]
