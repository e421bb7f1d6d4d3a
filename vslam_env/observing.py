"""What an environment shows each of its agents, in the form that it was made for."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from vslam_env.belief import TeamBelief
from vslam_env.observation import flatten, observed
from vslam_env.readings import Readings


def observations_of(
    agents: Sequence[str], belief: TeamBelief, readings: Sequence[Readings], goal: bool, flat: bool
) -> dict[str, Any]:
    """Return each agent's observation after a tick.

    Args:
        agents: Names of the K robots.
        belief: What they believe.
        readings: What each has read in the tick, with an image if that is to be shown.
        goal: Whether actions are masked.
        flat: One vector instead of named arrays.

    Returns:
        By agent fresh arrays by name, as `vslam_env.observation` says; flat ones as one vector, or as
        `{"observation", "action_mask"}` where actions are masked.
    """
    observations: dict[str, Any] = {}
    scans = np.array([reading.scan for reading in readings])
    shown = observed(belief.view(), scans, goal)
    for agent, reading, observation in zip(agents, readings, shown, strict=True):
        if reading.image is not None:
            observation["image"] = reading.image[:, :, None].copy()
        if not flat:
            observations[agent] = observation
        elif goal:
            observations[agent] = {"observation": flatten(observation), "action_mask": observation["action_mask"]}
        else:
            observations[agent] = flatten(observation)
    return observations
