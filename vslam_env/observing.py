"""What an environment shows each of its agents, in the form that it was made for."""

from collections.abc import Sequence
from typing import Any

from vslam_env.belief import TeamBelief
from vslam_env.observation import flatten, observed
from vslam_env.readings import Readings, TeamReadings


def observations_of(
    agents: Sequence[str], belief: TeamBelief, readings: TeamReadings | Sequence[Readings], goal: bool, flat: bool
) -> dict[str, Any]:
    """Return each agent's observation after a tick.

    Args:
        agents: Names of the K robots.
        belief: What they believe.
        readings: What they have read in the tick, in one piece or not, with images if these are to be shown.
        goal: Whether actions are masked.
        flat: One vector instead of named arrays.

    Returns:
        By agent fresh arrays by name, as `vslam_env.observation` says; flat ones as one vector, or as
        `{"observation", "action_mask"}` where actions are masked.
    """
    if not isinstance(readings, TeamReadings):
        readings = TeamReadings.gathered(readings)
    shown = observed(belief.view(), readings.scans, goal)
    if readings.images is not None:
        for observation, image in zip(shown, readings.images, strict=True):
            observation["image"] = image[:, :, None].copy()
    if not flat:
        return dict(zip(agents, shown, strict=True))
    return {
        agent: {"observation": flatten(each), "action_mask": each["action_mask"]} if goal else flatten(each)
        for agent, each in zip(agents, shown, strict=True)
    }
