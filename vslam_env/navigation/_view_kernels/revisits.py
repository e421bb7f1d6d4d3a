"""Places to look from again: a greedy cover of walls looked at too little and of landmarks measured too rarely."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, inline, jit
from vslam_env.navigation._grid_kernels import CELL, OCCUPIED, margin_of, to_coordinate, to_index
from vslam_env.navigation._planning_kernels.dijkstra import UNREACHED
from vslam_env.navigation._planning_kernels.frontiers import HEADING, SIZE, X, Y
from vslam_env.navigation._view_kernels.looks import (
    FACING,
    MOST_LOOKS,
    count_looks_at,
    lack_of_looks,
    mark_borders,
    nearest_look,
)
from vslam_env.navigation._view_kernels.view_gains import is_clear

BLOCK = 5  # [cells] side of the blocks into which unseen walls are cut
SPACING = 6  # [cells] between the places that are tried
BINS = 24  # headings that are tried; a view holds targets of three neighbouring ones
FARTHEST = 4.5  # [m] from which targets are looked at
LEAST_BLOCK = 2  # border cells of a block that is a target
MOST_TARGETS = 192
LEAST_GAIN, LEAST_KEPT = 1.0, 0.6  # [m] of a new candidate and of one that is kept
APART = 1.0  # [m] between new candidates
AT_GOAL, LOOKING, PATIENCE = 0.5, 0.4, 4  # [m], [rad], and updates after which what is still unseen is given up
GIVEN_UP = 2  # [cells] around a target that is given up


@device
@jit
def collect_targets(cells: Any, bounds: Any, looks: Any) -> Any:
    """Return what should be looked at again: blocks of walls looked at too little.

    Returns:
        (n, 5) float64 rows: x, y [m]; unit normal of the wall, zeros if none; value [m].
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
    targets = np.empty((MOST_TARGETS, 5))
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
                targets[num, 4] = CELL * block[4]
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
    return is_clear(cells, x, y, target[0], target[1], 0.0)


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
def give_up(looks: Any, bounds: Any, target: Any) -> None:
    """Count the cells around a target that cannot be seen as looked at as often as possible."""
    size = len(looks)
    row, col = to_index(target[1], size), to_index(target[0], size)
    for r in range(max(row - GIVEN_UP, 0), min(row + GIVEN_UP + 1, size)):
        for c in range(max(col - GIVEN_UP, 0), min(col + GIVEN_UP + 1, size)):
            count_looks_at(looks, bounds, r, c, MOST_LOOKS)


@device
@jit
def keep_revisits(
    cells: Any, seen: tuple[Any, Any], pose: Any, camera: Any, targets: Any, values: Any, rows: Any, visits: Any,
    distant: Any,
) -> None:  # fmt: skip
    """Keep the revisit candidates (m, 5) with something left to gain, and empty the other slots.

    Looks (S, S) and their bounds (4,) are given together. Values (n,) of targets (n, 5)
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
            values[left] = values[t]
            for i in range(targets.shape[1]):
                targets[left, i] = targets[t, i]
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
