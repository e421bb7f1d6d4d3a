"""`Policy`: the interface of a policy that controls one robot."""

from typing import Any, Protocol

import numpy as np

from vslam_env.belief.team_belief import Belief


class Policy(Protocol):
    """Policy of one robot. Each robot needs a policy object of its own."""

    def reset(self) -> None:
        """Clear the state of the last episode."""

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> Any:
        """Choose an action.

        Args:
            observation: Observation of this robot, as the environment returned it.
            belief: Belief of this robot.
            rng: Source of all random draws.

        Returns:
            An action of the robot's action space.
        """
