"""`Policy`: the interface of a policy that controls one robot."""

from typing import Any, Protocol

import numpy as np

from vslam_env.belief.observation_keys import MASK
from vslam_env.belief.team_belief import Belief


class Policy(Protocol):
    """Policy of one robot. Each robot needs a policy object of its own.

    A policy may have an attribute `observation_keys`: a tuple of the keys of observations that it reads, or the name of
    a set. Commands then make environments that observe exactly these. `vslam_env.belief.observation.observe` takes from
    the belief what an observation lacks.
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


def keys_of(policy: Policy) -> str | tuple[str, ...] | None:
    """Return the keys of observations that a policy reads; None: it does not say, and may read any."""
    keys: str | tuple[str, ...] | None = getattr(policy, "observation_keys", None)
    return keys


def keys_for(policy: Policy, action_type: str) -> str | tuple[str, ...]:
    """Return the keys that the environment of a policy observes, see `EnvConfig`; the pose if it reads none."""
    keys = keys_of(policy)
    if keys is None or isinstance(keys, str):
        return "all" if keys is None else keys
    others = tuple(key for key in keys if key != MASK) or ("pose",)
    return (*others, MASK) if action_type == "goal" else others
