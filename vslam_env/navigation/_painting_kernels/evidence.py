"""What a cell has been seen as: its evidence within bounds, the verdict that follows, and which verdicts changed."""

from typing import Any

from slam_backend.core.jit import device, in_place, inlined
from vslam_env.navigation._painting_kernels.bounds import widen

GRID_SIZE = 300
CELL = 0.2
UNKNOWN, FREE, OCCUPIED = 0, 1, 2

HALF_WIDTH = 0.5 * GRID_SIZE * CELL  # [m]; the start pose is the middle of the grid

# Evidence per cell: 0 never touched, negative free, positive occupied. A hit outweighs three passes, so that a wall of
# no thickness survives rays that graze its cell; the bounds let a few seconds of new readings overrule any old ones.
HIT = 3
MOST_FREE, MOST_OCCUPIED = -8, 12

MOST_CHANGES = 4096  # that a grid keeps for whoever counts its free cells; a scan makes a hundred at most


@inlined
def bounded(evidence: int) -> int:
    """Keep the evidence of a cell within its bounds; 0 is kept for cells that were never touched."""
    evidence = min(max(evidence, MOST_FREE), MOST_OCCUPIED)
    return evidence if evidence != 0 else -1


@device
@in_place
def judge(cells: Any, changes: Any, bounds: Any, row: int, col: int, verdict: int) -> None:
    """Set a cell's verdict, and note it if it changed or was not known before.

    Args:
        cells: (300, 300) uint8.
        changes: (1 + n,) int32. How many changed, -1 if that is not known any more; then which, as places in the flat
            grid.
        bounds: (4,) int32. Of what is known.
        row: Of the cell.
        col: Of the cell.
        verdict: The new one.
    """
    if cells[row, col] != verdict:
        if cells[row, col] == UNKNOWN:
            widen(bounds, row, col)
        cells[row, col] = verdict
        if 0 <= changes[0] < len(changes) - 1:
            changes[0] += 1
            changes[changes[0]] = row * GRID_SIZE + col
        else:
            changes[0] = -1


@inlined
def cell_range(low: float, high: float) -> tuple[int, int]:
    """Return the first and the one-past-last index of the cells between two coordinates [m], inside the grid."""
    first = min(max((low + HALF_WIDTH) / CELL, 0.0), float(GRID_SIZE))
    last = min(max((high + HALF_WIDTH) / CELL + 1.0, 0.0), float(GRID_SIZE))
    return int(first), int(last)
