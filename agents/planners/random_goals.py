"""`RandomGoals`: policy that drives to random candidates."""

from typing import Any

import numpy as np

from vslam_env.belief.team_belief import Belief


class RandomGoals:
    """Policy for `goal` actions that draws a valid candidate at every decision and stays if there is none."""

    observation_keys = ()

    def reset(self) -> None:
        """Do nothing; the policy has no state."""

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int:
        """Return 1 + the slot of a candidate, uniformly among the valid ones, or 0 if there is none."""
        slots = np.flatnonzero(belief.candidates.valid)
        return 1 + int(rng.choice(slots)) if len(slots) else 0
