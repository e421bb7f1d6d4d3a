"""`IndependentFrontier`: planner that goes to the nearest frontier, whatever its teammates do.

Yamauchi, "Frontier-based exploration using multiple robots", Agents 1998: robots share maps, but not goals. Compared
with `NearestFrontier` it shows what coordination is worth.
"""

import numpy as np

from agents.goal_choice import GoalHolder, nearest_slot
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CandidateKind


class IndependentFrontier(GoalHolder):
    """Planner that chooses the nearest frontier, and none where all is explored."""

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to; the previous one is kept unless another frontier is much nearer."""
        self._held = nearest_slot(belief.candidates, belief.candidates.of_kind(CandidateKind.FRONTIER), self._held)
        return self._held
