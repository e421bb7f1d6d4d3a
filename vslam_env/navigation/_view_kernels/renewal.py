"""Renewal of a robot's candidates: revisits, rendezvous, paths of all robots to them, and their gains."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, jit
from vslam_env.navigation._grid_kernels import CELL, to_coordinate, to_index
from vslam_env.navigation._planning_kernels.costmap import PAD
from vslam_env.navigation._planning_kernels.dijkstra import (
    ESCAPE_CELLS,
    ISLAND,
    NO_GOAL,
    UNREACHED,
    nearest_open,
    wavefront,
)
from vslam_env.navigation._planning_kernels.frontiers import HEADING, LENGTH, SIZE, X, Y
from vslam_env.navigation._view_kernels.looks import MOST_LOOKS, is_border, lack_of_looks
from vslam_env.navigation._view_kernels.revisits import APART, AT_GOAL, add_revisits, collect_targets, keep_revisits
from vslam_env.navigation._view_kernels.view_gains import UNCERTAIN_LENGTH, view_gains

WEAK = 3  # landmarks with fewer measurements are weak
WALL_CELLS = 3  # [cells] from a wall within which a point may be a landmark
SURE_BLOCK = 10  # [cells] side of blocks of floor; near landmarks in or beside a block a robot can find its pose
RECHECKED = 4  # updates between computations of the gains of a candidate that stays
MOVED, TURNED = 0.4, 0.3  # [m], [rad] from which a candidate does not stay
NEAR_PLACE = 10  # [cells] from a place for a rendezvous to a reachable cell


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
        cost, parents = wavefront(wide, start_row // 2, start_col // 2, NO_GOAL)
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
    slots: tuple[Any, Any, Any, Any, Any, Any, int, int],
) -> None:  # fmt: skip
    """Bring a robot's candidates up to date, given its frontiers.

    Args:
        cells: (S, S) uint8. Cells of the robot's grid.
        bounds: (4,) int32. Bounds of its known part.
        seen: Looks of the grid (S, S) uint8, of which those at walls that cannot be seen are set to the largest number;
            and their bounds (4,) int32, see `TeamLooks`.
        ways: Paths from the robot, of `dijkstra`. Where they cover a part of the known floor, candidates of which they
            tell nothing (`untold`) stay as they are.
        landmarks: All landmarks of the robot's map (n, 4), their counts (n, 2), and the motion (3,) from the map frame
            to the start frame; see `MapSummaryRows`.
        poses: (K, 3) [m, m, rad]. Poses of all robots in the robot's frame; NaN: unknown.
        camera: (3,). Half the field of view [rad], range [m], radius of the robot [m].
        places: (R, 3) [m, m, rad]. Places for rendezvous; NaN: none.
        slots: Candidates (C, 5): first frontiers, which are given, then V revisit ones, then R rendezvous, NaN in empty
            slots; the mask (C,) of those that stay as they are; visits (V,) int64 of the revisit ones; gains (C, 4),
            see `view_gains` and `path_lengths_to`; the poses (C, 3) for which they were computed; lengths (C, K) [m] of
            all robots' paths, inf: unknown or unreachable; all changed; the row of the robot in `poses`; the number of
            the update: the gains of a candidate that stays are computed in every fourth one, new places to look from
            are sought in every second.
    """
    looks, _ = seen
    rows, distant, visits, gains, views, lengths, robot, update = slots
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
    weak, sure = worth_seeing(cells, looks, part, *landmarks)

    revisits = rows[first_revisit:first_rendezvous]
    targets = collect_targets(cells, part, looks)
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
            views[i, 0], views[i, 1], views[i, 2] = rows[i, X], rows[i, Y], rows[i, HEADING]
