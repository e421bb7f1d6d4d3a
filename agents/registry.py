"""Registry of policies: built-in ones by name, trained ones by file, custom ones by module."""

from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

from agents.goal_choice import DrivingPolicy, GoalPolicy, Planner
from agents.goal_network import Weights
from agents.planners.d_optimality import DOptimality
from agents.planners.distance_advantage import distance_advantage
from agents.planners.hungarian import hungarian
from agents.planners.independent_frontier import IndependentFrontier
from agents.planners.mtsp import mtsp
from agents.planners.nearest_frontier import NearestFrontier
from agents.planners.next_best_view import NextBestView
from agents.planners.random_goals import RandomGoals
from agents.planners.random_walk import RandomWalk
from agents.planners.rbpf_gain import RbpfGain
from agents.planners.rendezvous import Rendezvous
from agents.planners.tare import tare
from agents.planners.utility_cost import utility_cost
from agents.plugins import ACTION_TYPES, is_plugin, load_plugin, plugin_action_type
from agents.policy import Policy
from agents.team import Assign, Assigned, CentralPolicy, SeparatePolicies, TeamPolicy
from agents.trained import MODEL_FILE, SUFFIX, TrainedDriver, TrainedGoalPolicy, drives, load_model, trained_policy
from slam_backend.core.validation import argument_error, check_choice

# Planners that divide the frontiers of a group among its robots, and planners of a single robot
ASSIGNMENTS: dict[str, Assign] = {
    "utility_cost": utility_cost,
    "hungarian": hungarian,
    "mtsp": mtsp,
    "distance_advantage": distance_advantage,
    "tare": tare,
}
PLANNERS: dict[str, Callable[[], Planner]] = {
    "frontier": NearestFrontier,
    "independent_frontier": IndependentFrontier,
    "next_best_view": NextBestView,
    "rendezvous": Rendezvous,
    "rbpf_gain": RbpfGain,
    "d_optimality": DOptimality,
    **{name: partial(Assigned, assign) for name, assign in ASSIGNMENTS.items()},
}
LEARNED = Path(__file__).parent / "pretrained" / f"goal{SUFFIX}"
ANY = ("goal", "continuous", "discrete")
SWEEPING = ("next_best_view",)  # planners whose robots sweep their cameras on the way, as those of models do
POLICIES: dict[str, tuple[str, ...]] = {  # with supported action types; comparisons of policies use the first one
    "frontier": ANY,
    "random_goals": ("goal",),
    "random_walk": ("continuous", "discrete"),
    "learned": ANY,
    **dict.fromkeys(PLANNERS, ANY),
}


def action_types(name: str) -> tuple[str, ...]:
    """Return the action types that a policy supports; comparisons of policies use the first one.

    Args:
        name: Name of the policy, see `make_policy`.

    Raises:
        ValueError: If there is no such policy.
    """
    if is_model(name):
        return ("continuous",) if drives(name) else ANY
    if is_plugin(name):
        return (plugin_action_type(name),)
    hint = "Choose one of these names, the path of a trained model, or MODULE:NAME of a custom policy."
    return POLICIES[check_choice("policy", name, tuple(POLICIES), hint)]


def make_policy(name: str, action_type: str) -> Policy:
    """Make a policy for one robot.

    Args:
        name: Name of the policy: one of `POLICIES`, with the action types given there; the planners among them are
            described in docs/how-to/exploration.md, and `learned` in agents/pretrained/goal.md. Path of a model of
            `vslam train`, or of its run folder: trained policy, for dict observations; it chooses goals, to which the
            robot drives itself with other than `goal` actions. A model of `vslam train-batched` drives by itself.
            `"module:Name"`: custom policy, made by calling `Name` without arguments, for its attribute `action_type`,
            or else for `goal`.
        action_type: Action type of the environment.

    Raises:
        ValueError: If there is no such policy, it does not support the action type, or a model cannot be read.
    """
    _check_action_type(name, action_type)
    if is_plugin(name):
        return load_plugin(name)
    if name == "random_goals":
        return RandomGoals()
    if name == "random_walk":
        return RandomWalk(action_type == "discrete")
    if name in PLANNERS:
        chooser: Policy = GoalPolicy(PLANNERS[name]())
    elif name == "learned":
        chooser = TrainedGoalPolicy(_shipped_weights(), greedy=True)
    else:
        chooser = trained_policy(name)
    if isinstance(chooser, TrainedDriver):
        return chooser
    if action_type == "goal":
        return chooser
    return DrivingPolicy(chooser, action_type == "discrete", name not in PLANNERS or name in SWEEPING)


@cache
def _shipped_weights() -> Weights:
    return load_model(LEARNED)[0]


def make_team_policy(name: str, action_type: str) -> TeamPolicy:
    """Make a policy for all robots, which sees all observations and beliefs, as a team with perfect radio would.

    Planners that divide frontiers (`utility_cost`, `hungarian`, `mtsp`, `distance_advantage`, `tare`) do so centrally
    with `goal` actions, for each group of robots that share a map. All others ask one policy for each robot.

    Args:
        name: Name of the policy, see `make_policy`.
        action_type: Action type of the environment.

    Raises:
        ValueError: As in `make_policy`.
    """
    _check_action_type(name, action_type)
    if name in ASSIGNMENTS and action_type == "goal":
        return CentralPolicy(ASSIGNMENTS[name])
    return SeparatePolicies(partial(make_policy, name, action_type))


def is_model(name: str) -> bool:
    """Return whether a name is the path of a model or of its run folder."""
    return isinstance(name, str) and name not in POLICIES and (name.endswith(SUFFIX) or Path(name).is_dir())


def model_file(name: str) -> Path | None:
    """Return the file of a trained policy's model; None for other policies."""
    if name == "learned":
        return LEARNED
    if is_model(name):
        return Path(name) / MODEL_FILE if Path(name).is_dir() else Path(name)
    return None


def _check_action_type(name: str, action_type: str) -> None:
    known = action_types(name)
    if check_choice("action_type", action_type, ACTION_TYPES) not in known:
        expected = f"{' or '.join(map(repr, known))} for policy {name!r}"
        raise argument_error("action_type", expected, action_type, "Change one of the two.")
