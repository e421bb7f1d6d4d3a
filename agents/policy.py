"""`Policy`: the interface of a policy that controls one robot."""

from typing import Any, Protocol

import numpy as np

from vslam_env.belief.team_belief import Belief


class Policy(Protocol):
    """Policy of one robot. Each robot needs a policy object of its own.

    A policy may have an attribute `observation_keys`, a tuple of the keys of observations that it reads. It takes them
    from the belief where an observation lacks them, see `vslam_env.belief.observation.observe`; environments that are
    made for it then compute no other keys.
    """

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
