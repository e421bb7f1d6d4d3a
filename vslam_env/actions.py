"""Action spaces, validation of actions, and their conversion to velocity commands."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces

from slam_backend.core.validation import FloatArray, argument_error, check_array
from vslam_env.belief.observation_keys import NUM_ACTIONS
from vslam_env.navigation.planning import MAX_SPEED, MAX_TURN

MAX_REVERSE = 0.3  # [m/s]
DISCRETE_COMMANDS = ((0.0, 0.0), (MAX_SPEED, 0.0), (0.0, MAX_TURN), (0.0, -MAX_TURN))  # stay ahead left right
PAIR_HINT = "Give (speed, turn) in [-1, 1]."
CLIP_HINT = f"{PAIR_HINT} Clip what a learner draws: gymnasium.wrappers.ClipAction, or clip_actions_v0 of SuperSuit."


def action_space(action_type: str) -> spaces.Space[Any]:
    """Return the action space of one robot."""
    if action_type == "continuous":
        return spaces.Box(-1.0, 1.0, (2,), np.float32)
    return spaces.Discrete(len(DISCRETE_COMMANDS) if action_type == "discrete" else NUM_ACTIONS)


def checked_actions(actions: Any, agents: Sequence[str], action_type: str) -> FloatArray | list[int]:
    """Validate actions and convert them, in the order of the agents.

    Args:
        actions: Mapping from agent to action.
        agents: Names of the agents, all of which must act.
        action_type: Type of all actions.

    Returns:
        Velocity commands (K, 2) float64 [m/s, rad/s] for continuous and discrete actions; ints for `goal` actions.

    Raises:
        ValueError: If an agent is unknown or missing, or an action is outside its space.
    """
    if type(actions) is not dict and not isinstance(actions, Mapping):  # isinstance alone takes 1 us for a dict
        raise argument_error("actions", "a dict from agent to action", actions, "Pass {agent: action}.")
    if list(actions) != agents and actions.keys() != set(agents):  # the usual order needs no set
        unknown = [agent for agent in actions if agent not in agents]
        if unknown:
            raise argument_error("actions", f"actions for {list(agents)}", unknown[0], "Remove unknown agents.")
        missing = next(agent for agent in agents if agent not in actions)
        raise argument_error("actions", f"an action for {missing!r}", f"no {missing!r}", "All agents act in each step.")
    if action_type == "continuous":
        return _continuous_commands(actions, agents)
    if action_type == "discrete":
        limit = len(DISCRETE_COMMANDS)
        return np.array([DISCRETE_COMMANDS[_checked_index(agent, actions[agent], limit)] for agent in agents])
    return [_checked_index(agent, actions[agent], NUM_ACTIONS) for agent in agents]


def _continuous_commands(actions: Mapping[str, Any], agents: Sequence[str]) -> FloatArray:
    """Return the velocity commands (K, 2) [m/s, rad/s] for pairs in [-1, 1], or raise.

    Each direction is scaled to its own limit; zeros mean standing still.
    """
    commands = np.empty((len(agents), 2))
    for robot, agent in enumerate(agents):
        action = actions[agent]
        try:
            speed, turn = action.tolist()  # fast path for arrays
        except (AttributeError, TypeError, ValueError):
            speed = turn = None
        if type(speed) is not float or type(turn) is not float:
            speed, turn = _pair(agent, action)
        if not (-1.0 <= speed <= 1.0 and -1.0 <= turn <= 1.0):  # false for NaN
            raise argument_error(f"actions[{agent!r}]", "two numbers in [-1, 1]", [speed, turn], CLIP_HINT)
        commands[robot, 0] = speed * (MAX_SPEED if speed > 0.0 else MAX_REVERSE)
        commands[robot, 1] = turn * MAX_TURN
    return commands


def _pair(agent: str, action: Any) -> tuple[float, float]:
    """Return a pair of numbers of any type as floats, or raise."""
    if isinstance(action, (list, tuple)) and len(action) == 2 and all(type(part) is float for part in action):
        return action[0], action[1]
    name = f"actions[{agent!r}]"
    speed, turn = check_array(name, action, (2,), PAIR_HINT, finite=False).tolist()
    parts = np.asarray(action, dtype=object).tolist()
    if any(isinstance(part, (bool, np.bool_)) for part in parts):  # numpy would convert them
        raise argument_error(name, "an array of shape (2,) of real numbers", action, PAIR_HINT)
    return speed, turn


def _checked_index(agent: str, action: Any, limit: int) -> int:
    """Return a discrete or `goal` action as an int in [0, limit), or raise."""
    value = action.item() if isinstance(action, (np.generic, np.ndarray)) and np.size(action) == 1 else action
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < limit:
        hint = "Sample from env.action_space(agent)."
        raise argument_error(f"actions[{agent!r}]", f"an int from 0 to {limit - 1}", action, hint)
    return value
