"""`RbpfGain`: planner that maximises the expected fall of the entropy of map and pose, minus the path's cost.

Stachniss, Grisetti and Burgard, "Information gain-based exploration using Rao-Blackwellized particle filters", RSS
2005: the entropy of the posterior over paths and maps is that of the paths plus the expected one of the map; an action
is simulated and its expected gain weighed against its cost. Deviations: the entropy of paths is that of the Gaussian
with the particles' covariance, predicted by `predict_covariances` instead of sampled readings, and unknown area stands
for the simulated scans. Robots leave frontiers to which a teammate is nearer.
"""

import math

import numpy as np

from agents.goal_choice import GoalHolder
from agents.planners.common.predicted_pose import best_of_nearest, predict_covariances
from slam_backend.core.validation import FloatArray, IntArray
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CELL

AREA_NATS = math.log(2.0) / CELL**2  # [1/m^2] entropy of the unknown cells of a square metre
MAP_WEIGHT = 0.02  # cells of a grid are not independent: weight of their entropy beside that of the pose
COST = 0.5  # [nats/m] of path


class RbpfGain(GoalHolder):
    """Planner that chooses the frontier with the largest expected information gain minus cost."""

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to; the path to the previous one counts half."""
        self._held = best_of_nearest(belief, self._held, values)
        return self._held


def values(belief: Belief, slots: IntArray, lengths: FloatArray) -> FloatArray:
    """Return the expected gains minus costs (n,) [nats] of slots with paths of some lengths (n,) [m]."""
    before = np.linalg.slogdet(belief.covariance + 1e-12 * np.eye(3))[1]
    after = np.linalg.slogdet([covariances[-1] for covariances in predict_covariances(belief, slots)])[1]
    gains: FloatArray = MAP_WEIGHT * AREA_NATS * belief.candidates.gains.unknown_area[slots] + 0.5 * (before - after)
    return gains - COST * lengths
