"""`RandomWalk`: policy that drives straight and turns for random times; the weakest baseline."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from vslam_env.belief.team_belief import Belief

MEAN_STRAIGHT, MEAN_TURN = 20, 8  # ticks
AHEAD, LEFT, RIGHT = 1, 2, 3  # discrete actions


class RandomWalk:
    """Policy that alternates between driving straight and turning, in phases of random length.

    Args:
        discrete: Whether actions are `discrete`; otherwise they are `continuous`.
    """

    observation_keys = ()

    def __init__(self, discrete: bool = False) -> None:
        self._discrete = discrete
        self.reset()

    def reset(self) -> None:
        """Clear the state of the last episode."""
        self._left = 0
        self._action = LEFT

    def act(self, observation: Any, belief: Belief, rng: np.random.Generator) -> int | NDArray[np.float32]:
        """Continue the current phase, or start the next one; left and right turns alternate with straight phases."""
        if self._left == 0:
            turning = self._action != AHEAD
            self._left = 1 + int(rng.geometric(1.0 / (MEAN_STRAIGHT if turning else MEAN_TURN)))
            self._action = AHEAD if turning else int(rng.choice([LEFT, RIGHT]))
        self._left -= 1
        if self._discrete:
            return self._action
        turn = {AHEAD: 0.0, LEFT: 1.0, RIGHT: -1.0}[self._action]
        return np.array([1.0 if self._action == AHEAD else 0.0, turn], dtype=np.float32)
