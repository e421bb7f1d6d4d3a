"""`Rendezvous`: planner that explores, and from time to time goes where maps can meet.

Roy and Dudek, "Collaborative robot exploration and rendezvous", Autonomous Robots 11, 2001: robots that explore apart
interrupt it at intervals to meet at places that both find distinctive. Deviations: places come from the environment's
rendezvous candidates (own start, where most landmarks are well known, last places of teammates), a visit is enough,
since maps are compared without contact of robots, and between visits the robot explores as `NearestFrontier` does.
"""

import numpy as np

from agents.goal_choice import GoalHolder, nearest_slot, own_share
from vslam_env.belief.team_belief import Belief
from vslam_env.navigation import CandidateKind

INTERVAL = 400  # [ticks] of exploration between two visits
DETOUR = 15.0  # [m] longest path to a rendezvous while there are frontiers
VISITED = 1.0  # [m]


class Rendezvous(GoalHolder):
    """Planner that alternates between the nearest frontier and visits of the nearest rendezvous."""

    def reset(self) -> None:
        """Clear the state of the last episode."""
        super().reset()
        self._last = 0

    def choose(self, belief: Belief, rng: np.random.Generator) -> int | None:
        """Return the slot to go to, or None if no frontier and no rendezvous is left."""
        candidates = belief.candidates
        meetings, frontiers = map(candidates.of_kind, (CandidateKind.RENDEZVOUS, CandidateKind.FRONTIER))
        place = nearest_slot(candidates, meetings, self._held)
        is_due = belief.tick - self._last >= INTERVAL and place is not None and candidates.lengths[place] < DETOUR
        if place is not None and (is_due or not len(frontiers)):
            if candidates.lengths[place] < VISITED:
                self._last = belief.tick
            self._held = place
        else:
            self._held = nearest_slot(candidates, own_share(belief, frontiers), self._held)
        return self._held
