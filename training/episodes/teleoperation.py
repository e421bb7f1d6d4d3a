"""Teleoperation: keys control one robot, the others follow a policy."""

import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from agents.policy import Policy
from slam_backend.core.validation import FloatArray
from vslam_env.config import TICK
from vslam_env.environment import ExplorationEnv
from vslam_env.rendering import draw_frame

KEYS = "arrows or WASD: drive, Tab: next robot, Escape or Q: quit"
AHEAD, BACK, LEFT, RIGHT = ({"up", "w"}, {"down", "s"}, {"left", "a"}, {"right", "d"})
NEXT, END = {"tab"}, {"escape", "q"}


class Screen(Protocol):
    """Display of frames and source of key presses: `vslam_env.rendering.window.Window`, or a test double."""

    held: set[str]
    typed: list[str]
    closed: bool

    def show(self, frame: NDArray[np.uint8]) -> None:
        """Show a frame and read the keys."""


def action_of(held: set[str]) -> FloatArray:
    """Return the action (2,), speed and turn in [-1, 1], of the pressed keys."""
    speed = float(bool(held & AHEAD)) - float(bool(held & BACK))
    turn = float(bool(held & LEFT)) - float(bool(held & RIGHT))
    return np.array([speed, turn])


def drive(
    env: ExplorationEnv, screen: Screen, policies: Mapping[str, Policy], seed: int,
    on_frame: Callable[[NDArray[np.uint8]], None] = lambda frame: None, should_stop: Callable[[], bool] = lambda: False,
    pace: float = TICK,
) -> Mapping[str, Mapping[str, Any]]:  # fmt: skip
    """Run an episode in which the keys control one robot at a time.

    Args:
        policies: Policies of the other robots; agents without a policy stand still.
        pace: Minimum duration of a step [s].

    Returns:
        The last infos.
    """
    observations, infos = env.reset(seed=seed)
    rngs = {agent: np.random.default_rng([seed, k]) for k, agent in enumerate(env.agents)}
    driven = 0
    while env.agents:
        due = time.monotonic() + pace
        frame = draw_frame(env.scene())
        screen.show(frame)
        on_frame(frame)
        if screen.closed or END & set(screen.typed) or should_stop():
            break
        driven = (driven + sum(key in NEXT for key in screen.typed)) % len(env.agents)
        actions = _actions(env, observations, policies, rngs, driven, action_of(screen.held))
        observations, _, _, _, infos = env.step(actions)
        time.sleep(max(0.0, due - time.monotonic()))
    return infos


def _actions(
    env: ExplorationEnv, observations: Mapping[str, Any], policies: Mapping[str, Policy],
    rngs: Mapping[str, np.random.Generator], driven: int, action: FloatArray,
) -> dict[str, Any]:  # fmt: skip
    """Return the actions of all robots: from the keys, from a policy, or zero."""
    agents: Sequence[str] = env.agents
    still = np.zeros(2)
    actions: dict[str, Any] = {
        agent: policies[agent].act(observations[agent], env.belief(agent), rngs[agent]) if agent in policies else still
        for index, agent in enumerate(agents)
        if index != driven
    }
    return actions | {agents[driven]: action}
