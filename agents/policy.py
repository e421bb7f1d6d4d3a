"""`Policy`: what decides for one robot, from what that robot can know."""

from typing import Any, Protocol

import numpy as np

from vslam_env.belief.team_belief import Belief


class Policy(Protocol):
    """Decides for one robot. Each robot needs a policy object of its own."""

    def reset(self) -> None:
        """Forget the last episode."""

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> Any:
        """Choose an action.

        Args:
            observation: What the environment gave this robot.
            belief: What this robot believes.
            rng: Source of all draws.

        Returns:
            An action of the robot's space.
        """
