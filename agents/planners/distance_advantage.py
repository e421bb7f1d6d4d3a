"""Distance advantage: frontiers near the robot and far from all others come first, since a later visit is a detour.

Ericson, Pedro and Jensfelt, "Information gain is not all you need", arXiv 2504.01980. Deviations: robots leave
frontiers to which a teammate has a shorter path (the paper has one robot), and remoteness is the mean path length to
the other frontiers with the weight `REMOTENESS`.
"""

import numpy as np

from agents.planners.common.targets import Targets
from slam_backend.core.validation import FloatArray, IntArray

REMOTENESS = 0.5  # weight of the mean path length to the other frontiers


def distance_advantage(targets: Targets, rng: np.random.Generator) -> IntArray:
    """Return the target (K,) of each robot."""
    assigned = np.zeros(len(targets.lengths), np.int64)
    for robot in range(targets.num_deciding):
        share, costs = advantage_costs(targets, robot)
        if len(share):
            assigned[robot] = share[np.argmin(costs)]
    return assigned


def advantage_costs(targets: Targets, robot: int) -> tuple[IntArray, FloatArray]:
    """Return the targets (m,) int64 left to a robot, and the cost of each (m,) float64 [m]."""
    share = targets.share(robot)
    remoteness = targets.between.sum(axis=1) / max(1, len(targets.places) - 1)
    return share, targets.lengths[robot, share] - REMOTENESS * remoteness[share]
