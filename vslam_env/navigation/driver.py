"""Drives of robots to goals: a path over the robot's own grid, followed tick by tick."""

from collections.abc import Mapping
from typing import Any

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import FloatArray
from vslam_env.navigation.occupancy_grid import OccupancyGrid
from vslam_env.navigation.planning import follow_path, plan_path

__all__ = ["Driver"]


class Driver:
    """Driver of one robot to a goal over its own occupancy grid.

    It plans a path when the goal is set, and again after a bump.
    """

    def __init__(self) -> None:
        self._goal: FloatArray | None = None
        self._heading: float | None = 0.0
        self._path: FloatArray | None = None

    @property
    def path(self) -> FloatArray | None:
        """(n, 2) float64 [m], start frame. Path to the goal; None without a goal, or if no path is known."""
        return None if self._goal is None else self._path

    def set_goal(self, goal: tuple[FloatArray, float | None] | None, pose: FloatArray, grid: OccupancyGrid) -> None:
        """Set the goal and plan a path to it.

        Args:
            goal: Place (2,) [m] and heading there [rad], None: any, start frame; None: stay.
            pose, grid: Pose and grid, see `command`.
        """
        if goal is None:
            self._goal = None
        else:
            self._goal, self._heading = goal
            self._path = plan_path(grid, pose[:2], self._goal)

    def command(
        self, pose: FloatArray, grid: OccupancyGrid, bumped: bool = False, aside: float = 0.0
    ) -> tuple[float, float]:
        """Return the velocity command (v, omega) [m/s, rad/s] for the next tick; zeros without a path.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Pose estimate of the robot.
            grid: Occupancy grid of the robot.
            bumped: Whether the robot bumped into an obstacle in the last tick.
            aside: Angle between heading and path [rad], see `follow_path`.
        """
        if bumped and self._goal is not None:
            self._path = plan_path(grid, pose[:2], self._goal)
        path = self.path
        return (0.0, 0.0) if path is None else follow_path(pose, path, final_heading=self._heading, aside=aside)

    def get_state(self) -> dict[str, Any]:
        """Return goal, heading and path; arrays are read-only."""
        goal, path = (None if array is None else as_read_only(array) for array in (self._goal, self._path))
        return {"goal": goal, "heading": self._heading, "path": path}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Restore a state of `get_state`, with copies of goal and path."""
        goal, self._heading, path = state["goal"], state["heading"], state["path"]
        self._goal, self._path = (None if array is None else array.copy() for array in (goal, path))
