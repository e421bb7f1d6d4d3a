"""Drives of robots to goals: a path over the robot's own grid, followed tick by tick."""

from collections.abc import Mapping
from typing import Any

from slam_backend.core.validation import FloatArray
from slam_backend.state import FLOAT64, Array, Float, Maybe, Sizes, State
from vslam_env.navigation._grid_kernels import LARGEST_HALF_WIDTH
from vslam_env.navigation.occupancy_grid import OccupancyGrid
from vslam_env.navigation.planning import follow_path, plan_path

__all__ = ["Driver"]


class Driver:
    """Driver of one robot to a goal over its own occupancy grid.

    It plans a path when the goal is set, and again after a bump.
    """

    STATE = State(
        goal=Maybe(Array(FLOAT64, "2", -LARGEST_HALF_WIDTH, LARGEST_HALF_WIDTH, renewed=True)),
        heading=Maybe(Float()),
        path=Maybe(Array(FLOAT64, "n 2", -2.0 * LARGEST_HALF_WIDTH, 2.0 * LARGEST_HALF_WIDTH, renewed=True)),
    )

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

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise for a path without points."""
        if parts["path"] is not None and not len(parts["path"]):
            raise ValueError("a path without points")
