"""Environments of one robot whose observations have drawn candidates, for learners; nothing is simulated."""

from abc import abstractmethod
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from vslam_env import NUM_CANDIDATES
from vslam_env.belief.observation import observation_space

SPACE = observation_space()


class GoalChoices(ParallelEnv):  # type: ignore[misc]
    """Environment with new candidates at each step, and no end."""

    possible_agents = ("robot_0",)
    render_mode = None

    @abstractmethod
    def draw(self, seen: Any) -> NDArray[np.int64]:
        """Write the observation of the next step into zeros; return the slots that hold candidates."""

    @abstractmethod
    def reward(self, action: int) -> float:
        """Return the reward of an action in the last observation."""

    def observation_space(self, agent: str) -> Any:
        """Return the space of dict observations."""
        return SPACE

    def action_space(self, agent: str) -> Any:
        """Return the space of goals."""
        return spaces.Discrete(1 + NUM_CANDIDATES)

    def reset(self, seed: int | None = None, options: Any = None) -> tuple[Any, Any]:
        """Begin with a seed."""
        self.rng = np.random.default_rng(seed)
        self.agents = ["robot_0"]
        return self._seen(), {"robot_0": {}}

    def step(self, actions: Any) -> tuple[Any, ...]:
        """Reward the action, and draw the next observation."""
        gained = self.reward(int(actions["robot_0"]))
        return self._seen(), {"robot_0": gained}, {"robot_0": False}, {"robot_0": False}, {"robot_0": {}}

    def _seen(self) -> Any:
        seen = {name: np.zeros(box.shape, box.dtype) for name, box in SPACE.spaces.items()}
        seen["action_mask"][[0, *(1 + self.draw(seen))]] = 1
        return {"robot_0": seen}
