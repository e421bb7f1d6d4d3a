"""Multiple travelling salesmen: each robot starts a tour through its share of all frontiers.

Faigl, Kulich and Preucil, "Goal assignment using distance cost in multi-robot exploration", IROS 2012: the cost
of a frontier is the length of a tour that starts with it and visits all other frontiers of the robot. Deviation:
instead of K-means clusters, frontiers move between the tours until the longest is short (`share_places`).
"""

import numpy as np

from agents.planners.common.targets import Targets
from slam_backend.core.validation import IntArray
from vslam_env.navigation import open_tour, share_places


def mtsp(targets: Targets, rng: np.random.Generator) -> IntArray:
    """Return the target (K,) of each robot: the first of its tour, or the nearest if it has no share."""
    owners = share_places(targets.lengths, targets.between)
    assigned: IntArray = targets.lengths.argmin(axis=1)
    for robot, ways in enumerate(targets.lengths[: targets.num_deciding]):
        share = np.flatnonzero(owners == robot)
        if len(share):
            assigned[robot] = share[open_tour(ways[share], targets.between[np.ix_(share, share)])[0]]
    return assigned
