"""Registry of policies: built-in ones by name, trained ones by file, custom ones by module."""

from pathlib import Path

from agents.nearest_frontier import NearestFrontier, NearestFrontierGoals
from agents.plugins import ACTION_TYPES, is_plugin, load_plugin, plugin_action_type
from agents.policy import Policy
from agents.random_goals import RandomGoals
from agents.random_walk import RandomWalk
from agents.trained import SUFFIX, TrainedGoalPolicy, load_model
from slam_backend.core.validation import argument_error, check_choice

POLICIES = {  # with the action types that each supports; comparisons of policies use the first one
    "frontier": ("goal", "continuous", "discrete"),
    "random_goals": ("goal",),
    "random_walk": ("continuous", "discrete"),
}


def action_types(name: str) -> tuple[str, ...]:
    """Return the action types that a policy supports; comparisons of policies use the first one.

    Args:
        name: Name of the policy, see `make_policy`.

    Raises:
        ValueError: If there is no such policy.
    """
    if is_model(name):
        return ("goal",)
    if is_plugin(name):
        return (plugin_action_type(name),)
    hint = "Choose one of these names, the path of a trained model, or MODULE:NAME of a custom policy."
    return POLICIES[check_choice("policy", name, tuple(POLICIES), hint)]


def make_policy(name: str, action_type: str) -> Policy:
    """Make a policy for one robot.

    Args:
        name: Name of the policy. `"frontier"`: nearest frontier, for all action types. `"random_goals"`: random
            candidates, for `goal`. `"random_walk"`: random walk, for `continuous` and `discrete`. Path of a model of
            `vslam train`, or of its run folder: trained policy, for `goal` actions and dict observations.
            `"module:Name"`: custom policy, made by calling `Name` without arguments, for its attribute `action_type`,
            or else for `goal`.
        action_type: Action type of the environment.

    Raises:
        ValueError: If there is no such policy, it does not support the action type, or a model cannot be read.
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
    """Return whether a name is the path of a model or of its run folder."""
    return isinstance(name, str) and name not in POLICIES and (name.endswith(SUFFIX) or Path(name).is_dir())
