"""`DOptimality`: planner that explores where the pose stays well known.

Carrillo, Reid and Castellanos, "On the comparison of uncertainty criteria for active SLAM", ICRA 2012: of the paths to
the candidates the one with the least D-optimality of the predicted covariances is taken, since only this criterion is
monotonic. Placed et al., "A survey on active simultaneous localization and mapping", T-RO 2023, weigh it against what
the path discovers: here unknown area in view per metre of path, divided by the ratio of the mean D-optimality along
the path to that of now. Robots leave frontiers to which a teammate is nearer.
"""

import numpy as np

from agents.goal_choice import SWITCH_RATIO, nearest_own_frontiers
from agents.planners.common.predicted_pose import d_optimality, predict_covariances
from vslam_env.belief.team_belief import Belief

LEAST = 1e-3  # D-optimality below which the pose counts as known: .02 m and .001 rad or so
REACH = 3.0  # [m] added to the length of a path
MOST_PREDICTED = 6  # nearest candidates whose poses are predicted


class DOptimality:
    """Planner that chooses the frontier with the most unknown area for path length and uncertainty of the pose."""

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
        now = LEAST + float(d_optimality(belief.covariance + 1e-12 * np.eye(3)))
        covariances = predict_covariances(belief, slots)
        ahead = np.array([LEAST + d_optimality(along_path).mean() for along_path in covariances])
        lengths = np.where(slots == self._held, SWITCH_RATIO, 1.0) * candidates.lengths[slots]
        values = (0.5 + candidates.gains.unknown_area[slots]) / (REACH + lengths) * now / ahead
        self._held = int(slots[np.argmax(values)])
        return self._held
