"""Policies by name, trained ones by their file, and those of the user by their module."""

from pathlib import Path

from agents.nearest_frontier import NearestFrontier, NearestFrontierGoals
from agents.own import ACTION_TYPES, is_plugin, load_plugin, plugin_action_type
from agents.policy import Policy
from agents.random_goals import RandomGoals
from agents.random_walk import RandomWalk
from agents.trained import SUFFIX, TrainedGoalPolicy, load_model
from slam_backend.core.validation import argument_error, check_choice

POLICIES = {  # and the types of action that each knows, that with which policies are compared first
    "frontier": ("goal", "continuous", "discrete"),
    "random_goals": ("goal",),
    "random_walk": ("continuous", "discrete"),
}


def action_types(name: str) -> tuple[str, ...]:
    """Return the types of action that a policy knows, that with which policies are compared first.

    Args:
        name: As in `make_policy`.

    Raises:
        ValueError: If there is no such policy.
    """
    if is_model(name):
        return ("goal",)
    if is_plugin(name):
        return (plugin_action_type(name),)
    cure = "Choose one of these names, the path of a trained model, or MODULE:NAME of your own."
    return POLICIES[check_choice("policy", name, tuple(POLICIES), cure)]


def make_policy(name: str, action_type: str) -> Policy:
    """Make a policy for one robot.

    Args:
        name: `"frontier"`: nearest frontier, for all action types. `"random_goals"`: random candidates, for `goal`.
            `"random_walk"`: for `continuous` and `discrete`. The path of a model that `vslam train` wrote, or of its
            run folder: for `goal` actions and dict observations. `"module:Name"`: what that makes when called without
            arguments, for the actions that its attribute `action_type` names, or else for `goal`.
        action_type: Of the environment.

    Raises:
        ValueError: If there is no such policy, it does not know this type of action, or a model cannot be read.
    """
    known = action_types(name)
    if check_choice("action_type", action_type, ACTION_TYPES) not in known:
        expected = f"{' or '.join(map(repr, known))} for policy {name!r}"
        raise argument_error("action_type", expected, action_type, "Change one of the two.")
    if is_model(name):
        return TrainedGoalPolicy(load_model(name)[0])
    if is_plugin(name):
        return load_plugin(name)
    discrete = action_type == "discrete"
    if name == "frontier":
        return NearestFrontierGoals() if action_type == "goal" else NearestFrontier(discrete)
    return RandomGoals() if name == "random_goals" else RandomWalk(discrete)


def is_model(name: str) -> bool:
    """Tell whether a name is meant as the path of a model or of its run folder."""
    return isinstance(name, str) and name not in POLICIES and (name.endswith(SUFFIX) or Path(name).is_dir())
