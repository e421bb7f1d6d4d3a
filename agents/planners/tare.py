"""Tours through few viewpoints from which all frontier cells are visible, as TARE plans them.

Cao, Zhu, Choset and Zhang, "TARE: a hierarchical framework for efficiently exploring complex 3D environments", RSS
2021, local level: viewpoints are drawn with probabilities proportional to what they newly cover until little is left,
a travelling-salesman tour visits them, and the shortest tour of several draws is taken. Deviations: viewpoints are the
goals of the frontiers, there is one level, since buildings are small, and robots leave frontiers to which a teammate
has a shorter path.
"""

import numpy as np

from agents.planners.common.targets import Targets
from slam_backend.core.validation import BoolArray, IntArray
from vslam_env.navigation import frontier_cells, open_tour, sees, tour_length

COVER_RANGE = 4.0  # [m] range from which frontier cells count as covered
DRAWS = 5  # sets of viewpoints that are tried
LEFT_OVER = 2  # frontier cells that a viewpoint must newly cover


def tare(targets: Targets, rng: np.random.Generator) -> IntArray:
    """Return the target (K,) of each robot: the first viewpoint of its tour."""
    covers = sees(targets.ways, targets.places, frontier_cells(targets.ways), COVER_RANGE)
    assigned: IntArray = targets.lengths.argmin(axis=1)
    for robot, ways in enumerate(targets.lengths[: targets.num_deciding]):
        share = targets.share(robot)
        if not len(share):
            continue
        share_covers = covers[share]
        share_covers = share_covers[:, share_covers.any(axis=0)]  # few of all cells, which shortens the draws
        shortest = np.inf
        for _ in range(DRAWS if len(share) > 1 else 1):
            drawn = share[draw_cover(share_covers, rng)]
            pairs = targets.between[np.ix_(drawn, drawn)]
            tour = open_tour(ways[drawn], pairs)
            length = tour_length(tour, ways[drawn], pairs)
            if length < shortest:
                shortest, assigned[robot] = length, drawn[tour[0]]
    return assigned


def draw_cover(covers: BoolArray, rng: np.random.Generator) -> IntArray:
    """Draw viewpoints that together cover nearly all cells that any viewpoint covers.

    Args:
        covers: (n, m) bool, n >= 1. Cells that each viewpoint covers.
        rng: Source of the draws.

    Returns:
        (k,) int64, k >= 1. Viewpoints in the order of the draws; each adds at least `LEFT_OVER` cells, but the first.
    """
    drawn: list[int] = []
    weights = covers.astype(np.float64)
    left = np.asarray(covers.any(axis=0), dtype=np.float64)
    while True:
        gains = weights @ left
        total = gains.sum()
        if drawn and gains.max() < LEFT_OVER:
            return np.array(drawn)
        limits = (gains / total if total > 0.0 else np.full(len(gains), 1.0 / len(gains))).cumsum()
        drawn.append(int((limits / limits[-1]).searchsorted(rng.random(), side="right")))
        left[covers[drawn[-1]]] = 0.0
