"""Hungarian assignment of robots to rooms, and within rooms to frontiers.

Wurm, Stachniss and Burgard, "Coordinated multi-robot exploration using a segmentation of the environment", IROS 2008:
the free floor is divided into rooms, robots are assigned to rooms with frontiers by the Hungarian method, at the cost
of the shortest path to a frontier of the room, and a room's robots to its frontiers. The room in which a robot is costs
less, so that it finishes it. Deviation: rooms come from distances to walls (`rooms_of`), not from a Voronoi graph.
"""

import numpy as np

from agents.planners.common.targets import Targets
from slam_backend.core.validation import FloatArray, IntArray

SAME_ROOM = 0.5  # factor of the cost of the room in which a robot is


def hungarian(targets: Targets, rng: np.random.Generator) -> IntArray:
    """Return the target (K,) of each robot."""
    robot_rooms, target_rooms = targets.rooms
    rooms = np.unique(target_rooms)
    costs = np.stack([targets.lengths[:, target_rooms == room].min(axis=1) for room in rooms], axis=1)
    costs = np.where(robot_rooms[:, None] == rooms, SAME_ROOM * costs, costs)
    in_room, assigned = rooms[assign_all(costs)], np.full(len(costs), -1)
    for room in np.unique(in_room):
        robots, targets_there = np.flatnonzero(in_room == room), np.flatnonzero(target_rooms == room)
        assigned[robots] = targets_there[assign_all(targets.lengths[np.ix_(robots, targets_there)])]
    return assigned


def assign_all(costs: FloatArray) -> IntArray:
    """Return a column (K,) for each row at the least total cost; with more rows than columns, in several rounds.

    Args:
        costs: (K, n) float64, n >= 1.

    >>> assign_all(np.array([[1.0, 2.0], [1.5, 9.0], [0.0, 0.0]])).tolist()
    [0, 0, 1]
    """
    from scipy.optimize import linear_sum_assignment  # slow import, not always needed

    assigned = np.full(len(costs), -1)
    while (left := np.flatnonzero(assigned < 0)).size:
        rows, columns = linear_sum_assignment(costs[left])
        assigned[left[rows]] = columns
    return assigned
