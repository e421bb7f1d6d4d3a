"""`WithTrueState`: environment with the true state in its observations, for the critic of a learner."""

from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo.utils.wrappers import BaseParallelWrapper

from slam_backend.core.validation import argument_error

STATE = "state"
TEAM_VALUES = 2  # coverage and merges, the last values of `ExplorationEnv.state`
# Factors that scale the values of a robot to the order of one: true and estimated pose (x, y, cos, sin), map error,
# recall, heading error and the first robot of the group.
ROBOT_SCALE = np.array([0.05, 0.05, 1.0, 1.0, 0.05, 0.05, 1.0, 1.0, 1.0, 1.0, 1.0, 0.25], np.float32)


class WithTrueState(BaseParallelWrapper):  # type: ignore[misc]   # its types are not checked
    """Environment whose observations also have `state`.

    `state` has the values of `ExplorationEnv.state`, scaled, with those of the observing robot first. It is the truth:
    a critic may use it in training, a policy may not.

    Args:
        env: `ExplorationEnv` with dict observations.

    Raises:
        ValueError: If observations are flat.
    """

    def __init__(self, env: Any) -> None:
        super().__init__(env)
        kind = env.unwrapped.config.observation_type
        if kind != "dict":
            raise argument_error("observation_type", "'dict', to which the state is added", kind, "Choose dicts.")
        size = len(env.possible_agents) * len(ROBOT_SCALE) + TEAM_VALUES
        box = spaces.Box(-np.inf, np.inf, (size,), np.float32)
        self._spaces = {
            agent: spaces.Dict({**env.observation_space(agent).spaces, STATE: box}) for agent in env.possible_agents
        }

    def observation_space(self, agent: str) -> spaces.Dict:
        """Return the observation space of an agent."""
        return self._spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Reset; see `ExplorationEnv.reset`."""
        observations, infos = self.env.reset(seed=seed, options=options)
        return self._with_state(observations), infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, Any]:
        """Step; see `ExplorationEnv.step`."""
        observations, *others = self.env.step(actions)
        return self._with_state(observations), *others

    def _with_state(self, observations: dict[str, Any]) -> dict[str, Any]:
        state: NDArray[np.float32] = self.env.state()
        robots, team = state[:-TEAM_VALUES].reshape(-1, len(ROBOT_SCALE)) * ROBOT_SCALE, state[-TEAM_VALUES:]
        places = {agent: place for place, agent in enumerate(self.env.possible_agents)}
        return {
            agent: {**seen, STATE: np.concatenate([np.roll(robots, -places[agent], axis=0).ravel(), team])}
            for agent, seen in observations.items()
        }
