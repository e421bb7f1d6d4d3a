"""`RandomGoals`: drives to candidates drawn at random."""

from typing import Any

import numpy as np

from vslam_env.belief.team_belief import Belief


class RandomGoals:
    """Draws one of the valid candidates at every decision; stays when there is none. For `goal` actions."""

    def reset(self) -> None:
        """Nothing is remembered."""

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int:
        """Return 1 + the slot of a candidate, uniformly among the valid ones, or 0 if there is none."""
        slots = np.flatnonzero(belief.candidates.valid)
        return 1 + int(rng.choice(slots)) if len(slots) else 0
