"""Execution of actions: velocity commands, and drives to the candidates chosen by `goal` actions."""

from typing import Any

import numpy as np

from slam_backend.state import Child, Each, State
from vslam_env.config import EnvConfig
from vslam_env.navigation.driver import Driver
from vslam_env.simulation.episode import Episode

NOWHERE = np.full(2, np.nan)


class ActionExecutor:
    """Executor of the actions of all robots for a step.

    Args:
        config: Configuration of the environment.
    """

    STATE = State(drivers=Each(Child(Driver), "K", list))

    def __init__(self, config: EnvConfig) -> None:
        self._action_type, self._ticks = config.action_type, config.ticks_per_step
        self._drivers = [Driver() for _ in range(config.num_robots)]

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
        for robot, (driver, candidate) in enumerate(zip(self._drivers, candidates, strict=True)):
            driver.set_goal(candidate, poses[robot], beliefs.grid(robot))
        for _ in range(self._ticks):
            poses, bumps = beliefs.poses, episode.readings.bumps.tolist()
            commands = [
                driver.command(poses[robot], beliefs.grid(robot), bumps[robot])
                for robot, driver in enumerate(self._drivers)
            ]
            episode.advance(np.array(commands), goals)
        return [int(action != 0 and candidate is None) for action, candidate in zip(chosen, candidates, strict=True)]
