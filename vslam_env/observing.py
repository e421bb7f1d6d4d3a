"""What an environment shows each of its agents, in the form that it was made for."""

from collections.abc import Sequence
from typing import Any

from vslam_env.config import EnvConfig
from vslam_env.episode import Episode
from vslam_env.observation import flatten, observe_glimpse


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
    for robot, (agent, reading) in enumerate(zip(agents, episode.readings, strict=True)):
        observation = observe_glimpse(episode.belief.glimpse(robot), reading.scan, goal)
        if reading.image is not None:
            observation["image"] = reading.image[:, :, None].copy()
        if not flat:
            observations[agent] = observation
        elif goal:
            observations[agent] = {"observation": flatten(observation), "action_mask": observation["action_mask"]}
        else:
            observations[agent] = flatten(observation)
    return observations
