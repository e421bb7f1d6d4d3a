"""Places for rendezvous: where maps are likely to overlap before a merge, and where loops can be closed after it."""

import math
from functools import lru_cache
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place, jit, stack_array
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam.relative_poses import OWN, SIGMAS, START, TeamPoses
from slam_backend.state import BOOL, Array, State
from vslam_env.navigation.candidates import NUM_RENDEZVOUS, LandmarkRows

OWN_START, RICHEST, NUM_FIXED = 0, 1, 2  # slots; the others belong to teammates
LOST = 0.2  # [m] one sigma of the position from which the own start is a place to close a loop
BLOCK = 4.0  # [m] side of the blocks in which landmarks are counted
FARTHEST = 400.0  # [m] from the own start along x and y, the reach of grids
MOST_PLACES = 16
FAR = 3.0  # [m] from the own start to the block with most landmarks
VISITED = 1.5  # [m]
SURE = 3  # measurements of a landmark that others can match


class Rendezvous:
    """Places at which a robot expects to meet others' maps.

    As long as robots are missing in its group: its own start, where its map is most accurate, and the middle of the
    block of floor with most well-known landmarks, where others' maps are most likely to match. For each teammate, two
    at most: its last known place while it is out of contact, else its start, until the robot has been there: common
    landmarks there close a loop between their paths. Its own start counts again when its pose is uncertain.

    Args:
        num_robots: Number of robots K.
    """

    STATE = State(visited=Array(BOOL, "K K"))

    def __init__(self, num_robots: int) -> None:
        self._visited = np.zeros((num_robots, num_robots), np.bool_)

    def update(
        self, robot: int, team_poses: TeamPoses, group: tuple[int, ...], shared: IntArray, landmarks: LandmarkRows
    ) -> FloatArray:
        """Return the places of a robot.

        Args:
            robot: Index of the robot.
            team_poses: Pose estimates.
            group: Known group members of the robot.
            shared: (K,) int64. 1 for robots on the same filter.
            landmarks: All landmarks of the robot's map, see `TeamCandidates.update`.

        Returns:
            (4, 3) float64 [m, m, rad], start frame. NaN: none.
        """
        visited, places = self._visited[robot], np.full((NUM_RENDEZVOUS, 3), np.nan)
        member = member_mask(group, len(visited))
        place_rendezvous(robot, team_poses.beliefs, team_poses.poses[robot], member, shared, visited, places)
        if len(group) < len(visited):
            richest_place(*landmarks, places[RICHEST])
        return places


@lru_cache(maxsize=256)
def member_mask(group: tuple[int, ...], num_robots: int) -> BoolArray:
    """Return which of K robots belong to a group (K,) bool; shared, for kernels."""
    return np.array([robot in group for robot in range(num_robots)])


@in_place
def place_rendezvous(robot: int, beliefs: Any, poses: Any, member: Any, shared: Any, visited: Any, places: Any) -> None:
    """Write the places of a robot that depend on poses; see `Rendezvous`.

    Args:
        robot: Index of the robot.
        beliefs: (K, 16 + K). See `TeamPoses`.
        poses: (K, 3) [m, m, rad]. Poses of all robots in the robot's frame.
        member: (K,) bool. True for the robot's group.
        shared: (K,) int64. 1 for robots on the same filter.
        visited: (K,) bool. True for teammates whose starts the robot has visited; changed.
        places: (R, 3) [m, m, rad]. Output, NaN before.
    """
    belief, is_split = beliefs[robot], False
    for mate in range(len(member)):
        is_split |= not member[mate]
    if is_split or belief[SIGMAS + robot] > LOST:
        places[OWN_START] = 0.0
    gaps = stack_array(MOST_PLACES)
    gaps[:] = np.inf
    for mate in range(len(member)):
        if mate == robot or not member[mate]:
            visited[mate] = False
            continue
        # The teammate's start pose: its inverse motion to the map frame, then the robot's motion from there.
        other = beliefs[mate]
        turn = belief[START + 2] - other[START + 2]
        c, s = math.cos(turn), math.sin(turn)
        x = belief[START] - c * other[START] + s * other[START + 1]
        y = belief[START + 1] - s * other[START] - c * other[START + 1]
        theta = turn
        visited[mate] |= math.hypot(x - belief[OWN], y - belief[OWN + 1]) < VISITED
        if shared[mate] == 0:
            x, y, theta = poses[mate]
        elif visited[mate]:
            continue
        gap = math.hypot(x - belief[OWN], y - belief[OWN + 1])
        for slot in range(NUM_FIXED, len(places)):  # the nearest ones, in order
            if gap < gaps[slot]:
                for later in range(len(places) - 1, slot, -1):
                    gaps[later] = gaps[later - 1]
                    for i in range(3):
                        places[later, i] = places[later - 1, i]
                gaps[slot] = gap
                places[slot, 0], places[slot, 1], places[slot, 2] = x, y, theta
                break


@jit
def richest_place(positions: Any, counts: Any, start: Any, place: Any) -> None:
    """Write the middle of the well-known landmarks of the block with most of them, far from the start.

    Args:
        positions: (n, 2 or more) [m]. Landmarks in the map frame.
        counts: (n, 1 or more) int64. Numbers of measurements.
        start: (3,) [m, m, rad]. Motion from the map frame to the start frame.
        place: (3,) [m, m, rad]. Output in the start frame, heading away from the start; unchanged without such a block.
    """
    points = np.empty((len(positions), 2))
    c, s = math.cos(start[2]), math.sin(start[2])
    num, low_x, low_y, high_x, high_y = 0, np.inf, np.inf, -np.inf, -np.inf
    for k in range(len(positions)):
        x = start[0] + c * positions[k, 0] - s * positions[k, 1]
        y = start[1] + s * positions[k, 0] + c * positions[k, 1]
        if counts[k, 0] >= SURE and x * x + y * y > FAR * FAR and max(abs(x), abs(y)) < FARTHEST:
            points[num, 0], points[num, 1] = x, y
            low_x, low_y, high_x, high_y = min(low_x, x), min(low_y, y), max(high_x, x), max(high_y, y)
            num += 1
    if num == 0:
        return
    left, top = math.floor(low_x / BLOCK), math.floor(low_y / BLOCK)
    sums = np.zeros((math.floor(high_y / BLOCK) - top + 1, math.floor(high_x / BLOCK) - left + 1, 3))
    most, best_row, best_col = 0.0, 0, 0
    for k in range(num):
        x, y = points[k]
        row, col = math.floor(y / BLOCK) - top, math.floor(x / BLOCK) - left
        block = sums[row, col]
        block[0], block[1], block[2] = block[0] + x, block[1] + y, block[2] + 1.0
        if block[2] > most:
            most, best_row, best_col = block[2], row, col
    x, y = sums[best_row, best_col, 0] / most, sums[best_row, best_col, 1] / most
    place[0], place[1], place[2] = x, y, math.atan2(y, x)
