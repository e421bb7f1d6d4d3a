"""`NearestFrontier`: planner that goes to the nearest frontier to which no teammate is nearer; the baseline.

Yamauchi, "Frontier-based exploration using multiple robots", Agents 1998, with goals shared by distance as in MinPos
(Bautin, Simonin and Charpillet, "MinPos: a novel frontier allocation algorithm", 2012), in its simplest form.
"""

import numpy as np

from agents.goal_choice import GoalHolder, nearest_slot, own_share
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CandidateKind


def choose_slot(belief: Belief, held: int | None = None) -> int | None:
    """Return the slot of the nearest frontier by path length, or None if there is none.

    Frontiers to which a teammate is nearer, in a straight line, are left to the teammate unless there are no others.

    Args:
        belief: Belief of the robot.
        held: Slot of the previous goal; it is kept unless the candidate is gone or another is much nearer.
    """
    candidates = belief.candidates
    return nearest_slot(candidates, own_share(belief, candidates.of_kind(CandidateKind.FRONTIER)), held)


class NearestFrontier(GoalHolder):
    """Planner that chooses the nearest frontier to which no teammate is nearer, and none where all is explored."""

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to; the previous one is kept unless another frontier is much nearer."""
        self._held = choose_slot(belief, self._held)
        return self._held
