"""Execution of actions: velocity commands, and drives to the candidates chosen by `goal` actions."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray
from vslam_env.actions import MAX_SPEED, MAX_TURN
from vslam_env.config import EnvConfig
from vslam_env.navigation import OccupancyGrid, follow_path, plan_path
from vslam_env.simulation.episode import Episode

NOWHERE = np.full(2, np.nan)


class GoalController:
    """Controller that drives one robot to a chosen candidate over its own occupancy grid.

    It plans a path when the goal is set, and again after a bump.
    """

    def __init__(self) -> None:
        self._goal: FloatArray | None = None
        self._heading = 0.0
        self._path: FloatArray | None = None

    def set_goal(self, candidate: tuple[FloatArray, float] | None, pose: FloatArray, grid: OccupancyGrid) -> None:
        """Set the goal and plan a path to it.

        Args:
            candidate: Goal (2,) [m] and heading at the goal [rad], start frame; None: stay.
            pose, grid: Pose and grid, see `command`.
        """
        if candidate is None:
            self._goal = None
        else:
            self._goal, self._heading = candidate
            self._path = plan_path(grid, pose[:2], self._goal)

    def command(self, pose: FloatArray, grid: OccupancyGrid, bumped: bool) -> FloatArray:
        """Return the velocity command (2,) [m/s, rad/s] for the next tick.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Pose estimate of the robot.
            grid: Occupancy grid of the robot.
            bumped: Whether the robot bumped into an obstacle in the last tick.
        """
        if self._goal is None:
            return np.zeros(2)
        if bumped:
            self._path = plan_path(grid, pose[:2], self._goal)
        if self._path is None:
            return np.zeros(2)
        return np.array(follow_path(pose, self._path, MAX_SPEED, MAX_TURN, self._heading))

    def get_state(self) -> dict[str, Any]:
        """Return goal, heading and path; arrays are read-only."""
        goal, path = (None if array is None else as_read_only(array) for array in (self._goal, self._path))
        return {"goal": goal, "heading": self._heading, "path": path}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`, with copies of goal and path."""
        goal, self._heading, path = state["goal"], state["heading"], state["path"]
        self._goal, self._path = (None if array is None else array.copy() for array in (goal, path))


class ActionExecutor:
    """Executor of the actions of all robots for a step.

    Args:
        config: Configuration of the environment.
    """

    def __init__(self, config: EnvConfig) -> None:
        self._action_type, self._ticks = config.action_type, config.ticks_per_step
        self._controllers = [GoalController() for _ in range(config.num_robots)]

    def execute(self, episode: Episode, chosen: Any) -> list[int]:
        """Advance an episode by the ticks of a step.

        Args:
            episode: Episode to change.
            chosen: Commands or actions, as returned by `checked_actions`.

        Returns:
            1 for each robot whose action was masked, else 0.
        """
        if self._action_type != "goal":
            for _ in range(self._ticks):
                episode.advance(chosen)
            return [0] * len(chosen)
        beliefs = episode.belief
        candidates = [beliefs.candidate(robot, action - 1) if action else None for robot, action in enumerate(chosen)]
        poses = beliefs.poses
        goals = np.array([NOWHERE if candidate is None else candidate[0] for candidate in candidates])
        for robot, (controller, candidate) in enumerate(zip(self._controllers, candidates, strict=True)):
            controller.set_goal(candidate, poses[robot], beliefs.grid(robot))
        for _ in range(self._ticks):
            poses, bumps = beliefs.poses, episode.readings.bumps.tolist()
            commands = [
                controller.command(poses[robot], beliefs.grid(robot), bumps[robot])
                for robot, controller in enumerate(self._controllers)
            ]
            episode.advance(np.array(commands), goals)
        return [int(action != 0 and candidate is None) for action, candidate in zip(chosen, candidates, strict=True)]

    def get_state(self) -> list[dict[str, Any]]:
        """Return the states of all controllers."""
        return [controller.get_state() for controller in self._controllers]

    def set_state(self, state: Sequence[Mapping[str, Any]]) -> None:
        """Restore a state of `get_state`."""
        for controller, controller_state in zip(self._controllers, state, strict=True):
            controller.set_state(controller_state)
