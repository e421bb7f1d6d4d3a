"""Features of candidates in observations, and the goals of teammates that these tell of."""

import math
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place
from vslam_env.navigation._planning_kernels.frontiers import HEADING, LENGTH, SIZE, X, Y
from vslam_env.navigation._view_kernels.view_gains import NUM_GAINS

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
