"""What an environment shows each of its agents, in the form that it was made for."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vslam_env.config import EnvConfig
from vslam_env.episode import Episode
from vslam_env.observation import flatten, observed


def observations_of(agents: Sequence[str], episode: Episode, config: EnvConfig) -> dict[str, Any]:
    """Return each agent's observation after the last tick.

    Args:
        agents: Names of the K robots.
        episode: The running one.
        config: Of the environment: named arrays or flat, with a mask, with images.

    Returns:
        By agent fresh arrays by name, as `vslam_env.observation` says; flat ones as one vector, or as
        `{"observation", "action_mask"}` where actions are masked.
    """
    goal, flat = config.action_type == "goal", config.observation_type == "flat"
    observations: dict[str, Any] = {}
    scans = np.array([reading.scan for reading in episode.readings])
    shown = observed(episode.belief.view(), scans, goal)
    for agent, reading, observation in zip(agents, episode.readings, shown, strict=True):
        if reading.image is not None:
            observation["image"] = reading.image[:, :, None].copy()
        if not flat:
            observations[agent] = observation
        elif goal:
            observations[agent] = {"observation": flatten(observation), "action_mask": observation["action_mask"]}
        else:
            observations[agent] = flatten(observation)
    return observations
