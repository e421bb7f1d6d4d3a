"""The compiled inner loops of observations: what robots believe and scan, as the arrays that agents are handed."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import device, in_place, stack_array_of
from slam_backend.fastslam.relative_poses import COVARIANCE, ESS, OWN, SIGMAS, START
from vslam_env.navigation import CELL, FREE, GRID_SIZE, OCCUPIED, UNKNOWN
from vslam_env.navigation._grid_kernels import LARGEST_HALF_WIDTH, margin_of

MAX_TEAMMATES = 7
POSE_LIMIT = np.array([LARGEST_HALF_WIDTH, LARGEST_HALF_WIDTH, np.pi])
MAX_POSITION = LARGEST_HALF_WIDTH  # [m]
MAP_STATS_LIMIT = np.array([10_000.0, 10.0, 10.0, 10_000.0, 1.0, 1.0 + MAX_TEAMMATES])


@device
@in_place
def _clip(value: float, low: float, high: float) -> np.float32:
    """Clip to bounds that are rounded as those of the space are."""
    return min(max(np.float32(value), np.float32(low)), np.float32(high))


SIZE = 48
CHANNELS = ("free", "occupied", "landmarks")
GRID_ON = 255
REACH = 0.75 * SIZE  # [cells] more than from the robot to a corner of its picture


@device
@in_place
def paint(cells: Any, belief: Any, places: Any, local: Any) -> None:
    """Sample the occupancy grid at the centres of the local cells, and mark the cells that hold landmarks.

    Rows go from 4.8 m ahead to 4.8 m behind, columns from 4.8 m to the left to 4.8 m to the right. Each row is written
    in short loops without branches, which become vector instructions but for the look-up itself.

    Args:
        cells: (S, S) uint8. Occupancy grid.
        belief: (16 or more,). Pose of the robot, and the motion of landmarks to its frame; see `TeamPoses`.
        places: (n, 4). Landmarks, see `MapSummaryRows`.
        local: (3, 48, 48) uint8. Channels free, occupied, landmarks, of cells of 0.2 m, 0 or 255. Written to.
    """
    x, y = belief[OWN], belief[OWN + 1]
    c, s = math.cos(belief[OWN + 2]), math.sin(belief[OWN + 2])
    middle = 0.5 * SIZE
    flat, size = cells.reshape(cells.size), len(cells)
    margin = np.int32(margin_of(size))
    low, high = REACH - 0.5 * size, 0.5 * size - REACH
    surely_inside = low < x / CELL < high and low < y / CELL < high
    place, seen = stack_array_of(SIZE, np.int32), stack_array_of(SIZE, np.uint8)
    for row in range(SIZE):
        ahead = middle - 0.5 - row  # in cells, as are all coordinates of this loop
        first_i, first_j = y / CELL + s * ahead + 0.5 * GRID_SIZE, x / CELL + c * ahead + 0.5 * GRID_SIZE
        if surely_inside:
            for col in range(SIZE):
                left = middle - 0.5 - col
                i, j = np.int32(np.floor(first_i + c * left)), np.int32(np.floor(first_j - s * left))
                place[col] = (i + margin) * np.int32(size) + j + margin
            for col in range(SIZE):
                seen[col] = flat[np.uint32(place[col])]
        else:
            for col in range(SIZE):
                left = middle - 0.5 - col
                i, j = first_i + c * left, first_j - s * left
                row_in, col_in = math.floor(i) + margin, math.floor(j) + margin
                inside = 0 <= row_in < size and 0 <= col_in < size
                seen[col] = cells[row_in, col_in] if inside else UNKNOWN
        free, occupied, landmarks = local[0, row], local[1, row], local[2, row]
        for col in range(SIZE):
            free[col] = GRID_ON if seen[col] == FREE else 0
            occupied[col] = GRID_ON if seen[col] == OCCUPIED else 0
            landmarks[col] = 0
    start_x, start_y = belief[START], belief[START + 1]
    start_c, start_s = math.cos(belief[START + 2]), math.sin(belief[START + 2])
    for k in range(len(places)):
        dx = start_x + start_c * places[k, 0] - start_s * places[k, 1] - x
        dy = start_y + start_s * places[k, 0] + start_c * places[k, 1] - y
        row = math.floor(middle - (c * dx + s * dy) / CELL)
        col = math.floor(middle - (c * dy - s * dx) / CELL)
        if 0 <= row < SIZE and 0 <= col < SIZE:
            local[2, row, col] = GRID_ON


COUNT_BINS = np.array([1, 3, 5, 9, 17])  # least numbers of measurements of the bins of `landmark_counts`
MAX_SECONDS_LEFT = 1e6


@in_place
def write_observations(
    robots: Any, poses: Any, beliefs: Any, positions: Any, counts_and_ids: Any, parts: Any, cells: Any, scans: Any,
    observed: tuple[Any, Any, Any, Any, Any, Any, Any, Any, Any],
) -> None:  # fmt: skip
    """Write what robots observe.

    Args:
        robots: (n,) int64. Indices of the robots.
        poses, beliefs: (n, K, 3), (n, 16 + K). See `TeamPoses`.
        positions, counts_and_ids, parts: (N, 4), (N, 2) int64, (n, 2) int64. Landmarks of all maps, and the part of
            each robot; see `TeamMapSummaries`.
        cells: (n, S, S) uint8. Occupancy grids.
        scans: (n, R) float64 [m].
        observed: Written to, in the order of the table of `observation`: (n, 3), (n, 3) and (n, 6) float32;
            (n, 3, 48, 48) uint8, or (n, 0, 48, 48) for no pictures; (n, R), (n, C, F) and (n, 7, 5) float32; (n, 7)
            int8; (n, 5) float32. The candidates hold their features without bounds before.
    """
    pose, pose_std, map_stats, local_grid, scan, features, teammates, present, landmark_counts = observed
    for k in range(len(robots)):
        for r in range(scans.shape[1]):
            scan[k, r] = scans[k, r]

        belief = beliefs[k]
        for i in range(3):
            pose[k, i] = _clip(belief[OWN + i], -POSE_LIMIT[i], POSE_LIMIT[i])
            pose_std[k, i] = _clip(math.sqrt(belief[COVARIANCE + 4 * i]), 0.0, POSE_LIMIT[i])

        for i in range(features.shape[1]):
            for j in range(features.shape[2]):
                features[k, i, j] = _clip(features[k, i, j], -MAX_POSITION, MAX_POSITION)

        teammates[k], present[k] = 0.0, 0
        x, y, theta = belief[OWN], belief[OWN + 1], belief[OWN + 2]
        c, s = math.cos(theta), math.sin(theta)
        group_size = 1
        for mate in range(poses.shape[1]):
            if mate != robots[k] and not np.isnan(poses[k, mate, 0]):
                group_size += 1
                to, place = teammates[k, mate - (mate > robots[k])], poses[k, mate]
                dx, dy, turn = place[0] - x, place[1] - y, place[2] - theta
                to[0], to[1] = (
                    _clip(c * dx + s * dy, -MAX_POSITION, MAX_POSITION),
                    _clip(c * dy - s * dx, -MAX_POSITION, MAX_POSITION),
                )
                to[2], to[3] = np.float32(math.cos(turn)), np.float32(math.sin(turn))
                to[4] = _clip(belief[SIGMAS + mate], -MAX_POSITION, MAX_POSITION)
                present[k, mate - (mate > robots[k])] = 1

        total = largest = 0.0
        times = 0
        landmark_counts[k] = 0.0
        for landmark in range(parts[k, 0], parts[k, 1]):
            sigma = math.sqrt(positions[landmark, 3] / 3.0)
            total += sigma
            largest = max(largest, sigma)
            times += counts_and_ids[landmark, 0]
            count_bin = 0
            while count_bin + 1 < len(COUNT_BINS) and counts_and_ids[landmark, 0] >= COUNT_BINS[count_bin + 1]:
                count_bin += 1
            landmark_counts[k, count_bin] += 1.0
        held, stats = parts[k, 1] - parts[k, 0], map_stats[k]
        stats[0] = _clip(held, 0.0, MAP_STATS_LIMIT[0])
        stats[1] = _clip(total / max(held, 1), 0.0, MAP_STATS_LIMIT[1])
        stats[2] = _clip(largest, 0.0, MAP_STATS_LIMIT[2])
        stats[3] = _clip(times / max(held, 1), 0.0, MAP_STATS_LIMIT[3])
        stats[4] = _clip(belief[ESS], 0.0, MAP_STATS_LIMIT[4])
        stats[5] = _clip(group_size, 0.0, MAP_STATS_LIMIT[5])

        for i in range(landmark_counts.shape[1]):
            landmark_counts[k, i] = _clip(landmark_counts[k, i], 0.0, MAP_STATS_LIMIT[0])
        if local_grid.shape[1] > 0:
            paint(cells[k], belief, positions[parts[k, 0] : parts[k, 1]], local_grid[k])
