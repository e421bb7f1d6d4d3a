"""Policies by name, and trained ones by their file."""

from pathlib import Path

from agents.nearest_frontier import NearestFrontier, NearestFrontierGoals
from agents.policy import Policy
from agents.random_goals import RandomGoals
from agents.random_walk import RandomWalk
from agents.trained import SUFFIX, TrainedGoals, load_model
from slam_backend.errors import bad_argument, check_choice

POLICIES = ("frontier", "random_goals", "random_walk")
ACTION_TYPES = ("continuous", "discrete", "goal")


def make_policy(name: str, action_type: str) -> Policy:
    """Make a policy for one robot.

    Args:
        name: `"frontier"`: nearest frontier, for all action types. `"random_goals"`: random candidates, for `goal`.
            `"random_walk"`: for `continuous` and `discrete`. The path of a model that `vslam train` wrote, or of its
            run folder: for `goal` actions and dict observations.
        action_type: Of the environment.

    Raises:
        ValueError: If there is no such policy, it does not know this type of action, or a model cannot be read.
    """
    if is_model(name):
        check_choice("action_type", action_type, ACTION_TYPES)
        if action_type != "goal":
            raise bad_argument("action_type", "'goal' for a trained policy", action_type, "Use goal actions.")
        return TrainedGoals(load_model(name)[0])
    check_choice("policy", name, POLICIES)
    check_choice("action_type", action_type, ACTION_TYPES)
    discrete = action_type == "discrete"
    if name == "frontier":
        return NearestFrontierGoals() if action_type == "goal" else NearestFrontier(discrete)
    if (name == "random_goals") != (action_type == "goal"):
        knows = "'goal'" if name == "random_goals" else "'continuous' or 'discrete'"
        raise bad_argument("action_type", f"{knows} for policy {name!r}", action_type, "Change one of the two.")
    return RandomGoals() if name == "random_goals" else RandomWalk(discrete)


def is_model(name: str) -> bool:
    """Tell whether a name is meant as the path of a model or of its run folder."""
    return isinstance(name, str) and name not in POLICIES and (name.endswith(SUFFIX) or Path(name).is_dir())
