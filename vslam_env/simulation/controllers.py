"""Robots carry out actions: commands as they stand, or the ways to the `goal` candidates that they chose."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray
from vslam_env.actions import MAX_SPEED, MAX_TURN
from vslam_env.config import EnvConfig
from vslam_env.navigation import follow_path, plan_path
from vslam_env.simulation.episode import Episode


class GoalController:
    """Drives one robot to the candidate that it chose, over the floor of its own grid.

    A path is planned when the goal is set, and again when the robot bumps into something.
    """

    def __init__(self) -> None:
        self._goal: FloatArray | None = None
        self._heading = 0.0
        self._path: FloatArray | None = None

    def set_goal(self, candidate: tuple[FloatArray, float] | None, pose: FloatArray, cells: NDArray[np.uint8]) -> None:
        """Head for a goal (2,) [m], start frame, and look in a direction [rad] there; or stay with None.

        Args:
            candidate: Goal and direction.
            pose, cells: As of `command`.
        """
        if candidate is None:
            self._goal = None
        else:
            self._goal, self._heading = candidate
            self._path = plan_path(cells, pose[:2], self._goal)

    def command(self, pose: FloatArray, cells: NDArray[np.uint8], bumped: bool) -> FloatArray:
        """Return the velocity command (2,) [m/s, rad/s] for the next tick.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. As the robot believes.
            cells: (300, 300) uint8. Of its seen grid.
            bumped: Whether it bumped into something in the last tick.
        """
        if self._goal is None:
            return np.zeros(2)
        if bumped:
            self._path = plan_path(cells, pose[:2], self._goal)
        if self._path is None:
            return np.zeros(2)
        return np.array(follow_path(pose, self._path, MAX_SPEED, MAX_TURN, self._heading))

    def get_state(self) -> dict[str, Any]:
        """Return where it is heading, and by which way. Arrays are read-only."""
        goal, path = (None if array is None else as_read_only(array) for array in (self._goal, self._path))
        return {"goal": goal, "heading": self._heading, "path": path}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on as the driver that gave `state`, with copies of goal and path."""
        goal, self._heading, path = state["goal"], state["heading"], state["path"]
        self._goal, self._path = (None if array is None else array.copy() for array in (goal, path))


class ActionExecutor:
    """Drives all robots of an environment for a step.

    Args:
        config: Of the environment.
    """

    def __init__(self, config: EnvConfig) -> None:
        self._action_type, self._ticks = config.action_type, config.ticks_per_step
        self._drivers = [GoalController() for _ in range(config.num_robots)]

    def execute(self, episode: Episode, chosen: Any) -> list[int]:
        """Let an episode advance by the ticks of a step.

        Args:
            episode: It is changed.
            chosen: What each robot is to do, as `checked_actions` returns it.

        Returns:
            Per robot 1 if its action was masked, else 0.
        """
        if self._action_type != "goal":
            for _ in range(self._ticks):
                episode.advance(chosen)
            return [0] * len(chosen)
        beliefs = episode.belief
        candidates = [beliefs.candidate(robot, action - 1) if action else None for robot, action in enumerate(chosen)]
        poses = beliefs.poses
        for robot, (driver, candidate) in enumerate(zip(self._drivers, candidates, strict=True)):
            driver.set_goal(candidate, poses[robot], beliefs.cells(robot))
        for _ in range(self._ticks):
            poses, bumps = beliefs.poses, episode.readings.bumps.tolist()
            driven = [
                driver.command(poses[robot], beliefs.cells(robot), bumps[robot])
                for robot, driver in enumerate(self._drivers)
            ]
            episode.advance(np.array(driven))
        return [int(action != 0 and found is None) for action, found in zip(chosen, candidates, strict=True)]

    def get_state(self) -> list[dict[str, Any]]:
        """Return where each robot is heading."""
        return [driver.get_state() for driver in self._drivers]

    def set_state(self, state: Sequence[Mapping[str, Any]]) -> None:
        """Go on as the drivers that gave `state`."""
        for driver, kept in zip(self._drivers, state, strict=True):
            driver.set_state(kept)
