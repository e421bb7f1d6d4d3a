"""Policies by name."""

from agents.nearest_frontier import NearestFrontier, NearestFrontierGoals
from agents.policy import Policy
from agents.random_goals import RandomGoals
from agents.random_walk import RandomWalk
from slam_backend.errors import bad_argument, check_choice

POLICIES = ("frontier", "random_goals", "random_walk")
ACTION_TYPES = ("continuous", "discrete", "goal")


def make_policy(name: str, action_type: str) -> Policy:
    """Make a policy for one robot.

    Args:
        name: `"frontier"`: nearest frontier, for all action types. `"random_goals"`: random candidates, for `goal`.
            `"random_walk"`: for `continuous` and `discrete`.
        action_type: Of the environment.

    Raises:
        ValueError: If there is no such policy, or it does not know this type of action.
    """
    check_choice("policy", name, POLICIES)
    check_choice("action_type", action_type, ACTION_TYPES)
    discrete = action_type == "discrete"
    if name == "frontier":
        return NearestFrontierGoals() if action_type == "goal" else NearestFrontier(discrete)
    if (name == "random_goals") != (action_type == "goal"):
        knows = "'goal'" if name == "random_goals" else "'continuous' or 'discrete'"
        raise bad_argument("action_type", f"{knows} for policy {name!r}", action_type, "Change one of the two.")
    return RandomGoals() if name == "random_goals" else RandomWalk(discrete)
