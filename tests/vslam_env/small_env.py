"""A room of 11 x 13 m with an inner wall, small enough to run hundreds of steps in a second or two."""

from typing import Any

import numpy as np

from slam_backend.core.validation import FloatArray
from vslam_env import ExplorationEnv, World, vslam_v0

WALLS = np.array(
    [
        [0.0, 0.0, 11.0, 0.0],
        [11.0, 0.0, 11.0, 13.0],
        [11.0, 13.0, 0.0, 13.0],
        [0.0, 13.0, 0.0, 0.0],
        [0.0, 7.0, 6.0, 7.0],
    ]
)
# Side by side, both looking at the lower right corner: their maps soon have landmarks in common.
MEETING = np.array([[4.0, 3.0, -0.3], [4.5, 4.5, -0.6]])


def room() -> World:
    """Return the room."""
    return World("room", WALLS)


def small_env(**kwargs: Any) -> ExplorationEnv:
    """Return an environment in the room: two robots, 20 particles, 40 steps, unless said otherwise."""
    options: dict[str, Any] = {"world": room(), "num_robots": 2, "num_particles": 20, "max_cycles": 40}
    return vslam_v0.parallel_env(**options | kwargs)


def wander(env: ExplorationEnv, rng: np.random.Generator) -> dict[str, Any]:
    """Return valid random actions: mostly ahead, gently turning, or candidates."""
    if env.config.action_type == "continuous":
        return {agent: np.array([0.6, np.clip(0.8 * rng.standard_normal(), -1, 1)], np.float32) for agent in env.agents}
    if env.config.action_type == "discrete":
        return {agent: int(rng.integers(4)) for agent in env.agents}
    valid = {agent: 1 + np.flatnonzero(env.belief(agent).candidates.valid) for agent in env.agents}
    return {agent: int(rng.choice([0, *valid[agent]])) for agent in env.agents}


def turning(agents: list[str], speed: float = 0.25, turn: float = 0.4) -> dict[str, FloatArray]:
    """Return continuous actions that drive every robot in a circle."""
    return {agent: np.array([speed, turn]) for agent in agents}
