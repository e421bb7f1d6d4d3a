"""Utility minus cost: robots choose one after another, and near a chosen frontier others lose their value.

Burgard, Moors, Stachniss and Schneider, "Coordinated multi-robot exploration", IEEE T-RO 21(3), 2005, Algorithm 1:
all frontiers start with utility 1. The pair of robot and frontier with the largest utility minus weighted path length
is assigned, and the utility of frontiers visible from there falls by the probability that they are seen from it, which
decreases linearly with the distance.
"""

import numpy as np

from agents.planners.common.targets import SIGHT, Targets
from slam_backend.core.validation import IntArray

COST = 0.1  # [1/m] utility that a metre of path costs


def utility_cost(targets: Targets, rng: np.random.Generator) -> IntArray:
    """Return the target (K,) of each robot."""
    distances = np.linalg.norm(targets.places[:, None] - targets.places[None], axis=-1)
    seen = np.where(targets.seen_together, np.maximum(0.0, 1.0 - distances / SIGHT), 0.0)
    utility, values = np.ones(len(targets.places)), -COST * targets.lengths
    assigned = np.full(len(values), -1)
    for _ in range(len(values)):
        gains = np.where(assigned[:, None] < 0, utility + values, -np.inf)
        robot, target = np.unravel_index(int(gains.argmax()), gains.shape)
        assigned[robot] = target
        utility = utility - seen[target]
    return assigned
