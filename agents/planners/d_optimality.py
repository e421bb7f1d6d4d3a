"""`DOptimality`: planner that explores where the pose stays well known.

Carrillo, Reid and Castellanos, "On the comparison of uncertainty criteria for active SLAM", ICRA 2012: of the paths to
the candidates the one with the least D-optimality of the predicted covariances is taken, since only this criterion is
monotonic. Placed et al., "A survey on active simultaneous localization and mapping", T-RO 2023, weigh it against what
the path discovers: here unknown area in view per metre of path, divided by the ratio of the mean D-optimality along
the path to that of now. Robots leave frontiers to which a teammate is nearer.
"""

import numpy as np

from agents.goal_choice import GoalHolder
from agents.planners.common.predicted_pose import best_of_nearest, d_optimality, predict_covariances
from slam_backend.core.validation import FloatArray, IntArray
from vslam_env.belief.team_belief import Belief

LEAST = 1e-3  # D-optimality below which the pose counts as known: .02 m and .001 rad or so
REACH = 3.0  # [m] added to the length of a path


class DOptimality(GoalHolder):
    """Planner that chooses the frontier with the most unknown area for path length and uncertainty of the pose."""

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to; the path to the previous one counts half."""
        self._held = best_of_nearest(belief, self._held, values)
        return self._held


def values(belief: Belief, slots: IntArray, lengths: FloatArray) -> FloatArray:
    """Return the values (n,) of slots with paths of some lengths (n,) [m]."""
    now = LEAST + float(d_optimality(belief.covariance + 1e-12 * np.eye(3)))
    covariances = predict_covariances(belief, slots)
    ahead = np.array([LEAST + d_optimality(along_path).mean() for along_path in covariances])
    found: FloatArray = (0.5 + belief.candidates.gains.unknown_area[slots]) / (REACH + lengths) * now / ahead
    return found
