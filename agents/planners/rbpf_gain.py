"""`RbpfGain`: planner that maximises the expected fall of the entropy of map and pose, minus the path's cost.

Stachniss, Grisetti and Burgard, "Information gain-based exploration using Rao-Blackwellized particle filters", RSS
2005: the entropy of the posterior over paths and maps is that of the paths plus the expected one of the map; an action
is simulated and its expected gain weighed against its cost. Deviations: the entropy of paths is that of the Gaussian
with the particles' covariance, predicted by `predict_covariances` instead of sampled readings, and unknown area stands
for the simulated scans. Robots leave frontiers to which a teammate is nearer.
"""

import math

import numpy as np

from agents.goal_choice import SWITCH_RATIO, nearest_own_frontiers
from agents.planners.common.predicted_pose import predict_covariances
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CELL

AREA_NATS = math.log(2.0) / CELL**2  # [1/m^2] entropy of the unknown cells of a square metre
MAP_WEIGHT = 0.02  # cells of a grid are not independent: weight of their entropy beside that of the pose
COST = 0.5  # [nats/m] of path
MOST_PREDICTED = 6  # nearest candidates whose poses are predicted


class RbpfGain:
    """Planner that chooses the frontier with the largest expected information gain minus cost."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._held: int | None = None

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to; the path to the previous one counts half."""
        candidates = belief.candidates
        slots = nearest_own_frontiers(belief, MOST_PREDICTED)
        if not len(slots):
            self._held = None
            return None
        before = np.linalg.slogdet(belief.covariance + 1e-12 * np.eye(3))[1]
        after = np.linalg.slogdet([covariances[-1] for covariances in predict_covariances(belief, slots)])[1]
        lengths = np.where(slots == self._held, SWITCH_RATIO, 1.0) * candidates.lengths[slots]
        gains = MAP_WEIGHT * AREA_NATS * candidates.gains.unknown_area[slots] + 0.5 * (before - after)
        self._held = int(slots[np.argmax(gains - COST * lengths)])
        return self._held
