"""Candidate slots: frontiers presented to policies under stable indices."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.state import FLOAT64, INT64, Array, Sizes, State
from vslam_env.navigation._grid_kernels import LARGEST_HALF_WIDTH
from vslam_env.navigation._planning_kernels import (
    SAME_GOAL,
    FrontierColumns,
    fill_slots,
    update_slots,
)
from vslam_env.navigation.occupancy_grid import OccupancyGrid
from vslam_env.navigation.planning import known_part
from vslam_env.navigation.validation import pose_floats, positions_array

__all__ = ["NUM_SLOTS", "CandidateSlots"]

NUM_SLOTS = 16
Ways = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.int32], NDArray[np.int32], int, int]
NUM_COLUMNS = len(FrontierColumns._fields)
ROBOT_RADIUS = 0.2  # [m]


class CandidateSlots:
    """Sixteen slots for candidate places to explore; a candidate keeps its slot while its frontier exists.

    An update assigns the old candidates to the current frontiers at minimal total distance. Pairs less than 1 m apart
    persist; other candidates are dropped. New frontiers fill free slots, nearest first. A frontier that persists
    although the robot looked at it from its goal at 4 updates (or a robot of its group was there at 16) cannot be seen:
    it is noise or lies behind a corner. Unknown cells within 0.8 m of its goal are then ignored, so that exploration
    ends.
    """

    STATE = State(
        rows=Array(FLOAT64, f"{NUM_SLOTS} {NUM_COLUMNS}", nan=True),
        visits=Array(INT64, f"{NUM_SLOTS}"),
        given_up=Array(FLOAT64, "n 2", -LARGEST_HALF_WIDTH, LARGEST_HALF_WIDTH),
    )

    __slots__ = ("_given_up", "_rows", "_visits")

    def __init__(self) -> None:
        self._settle(np.full((NUM_SLOTS, NUM_COLUMNS), np.nan))

    @classmethod
    def over(cls, rows: FloatArray) -> "CandidateSlots":
        """Return empty slots that use given memory for their rows (16, ...)."""
        self = cls.__new__(cls)
        rows.fill(np.nan)
        self._settle(rows)
        return self

    def _settle(self, rows: FloatArray) -> None:
        """Initialise the state with rows of NaN."""
        self._rows = rows
        self._visits = np.zeros(NUM_SLOTS, np.int64)
        self._given_up = np.empty((0, 2))  # goals around which unknown cells are ignored

    @property
    def valid(self) -> BoolArray:
        """(16,) bool. True for slots with a candidate; all False when exploration is complete."""
        return ~np.isnan(self._columns.x)

    @property
    def _columns(self) -> FrontierColumns:
        return FrontierColumns.of(self._rows)

    @property
    def goals(self) -> FloatArray:
        """(16, 2) float64 [m], start frame. Goal positions; NaN in empty slots."""
        return self._columns.goals

    @property
    def headings(self) -> FloatArray:
        """(16,) float64 [rad], start frame. Headings at the goals towards the frontiers; NaN in empty slots."""
        return self._columns.heading.copy()

    @property
    def sizes(self) -> FloatArray:
        """(16,) float64 [m]. Lengths of the frontiers; NaN in empty slots."""
        return self._columns.size.copy()

    @property
    def lengths(self) -> FloatArray:
        """(16,) float64 [m]. Lengths of the paths to the goals at the last update; NaN in empty slots."""
        return self._columns.length.copy()

    def candidate(self, slot: int) -> tuple[FloatArray, float] | None:
        """Return goal (2,) [m] and heading [rad] of a slot, start frame; None if the slot is empty."""
        x, y, heading, _, _ = self._rows[slot].tolist()
        return None if math.isnan(x) else (np.array([x, y]), heading)

    def update(self, cells: OccupancyGrid | NDArray[np.uint8], pose: ArrayLike, teammates: ArrayLike = ()) -> None:
        """Update the candidates; intended once a second.

        Args:
            cells: Grid of the robot, or its cells (S, S) uint8.
            pose: (3,) float64 [m, m, rad], start frame. Pose of the robot.
            teammates: (k, 2) float64 [m], start frame. Positions of its teammates, whose visits also count.

        Raises:
            ValueError: If an array has the wrong shape or is not finite.
        """
        poses = _together(pose, teammates)
        self.renew(*known_part(cells), poses, 0)

    def renew(
        self,
        cells: NDArray[np.uint8],
        bounds: NDArray[np.int32],
        poses: FloatArray,
        robot: int,
        reach: float = math.inf,
    ) -> Ways:
        """Update the candidates of a robot without checks; return the paths from it, of `dijkstra`.

        Args:
            cells: (S, S) uint8. Cells of the robot's grid.
            bounds: (4,) int32. Bounds of the known part of the grid, see `GridStorage`.
            poses: (n, 3) float64 [m, m, rad], start frame. Poses of the robot and its teammates; NaN: unknown.
            robot: Row of the robot in `poses`.
            reach: Distance [m] from the robot along x and y beyond which candidates stay as they are.
        """
        slots = self._rows, self._visits
        frontiers, costs, is_clear, self._given_up, ways = update_slots(
            cells, bounds, ROBOT_RADIUS, poses, robot, *slots, self._given_up, float(reach)
        )
        if not is_clear:
            fill_slots(_assign(costs), frontiers, *slots)
        return ways

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless kernels find all positions in the grid."""
        check_rows(parts["rows"])


def check_rows(rows: FloatArray) -> None:
    """Raise unless rows (..., 5) of candidates are either NaN or have positions in the grid."""
    empty = np.isnan(rows)
    if (empty != empty[..., :1]).any() or (np.abs(rows[..., :2]) > LARGEST_HALF_WIDTH).any():
        raise ValueError("positions that are not in the grid")


def _together(pose: ArrayLike, teammates: ArrayLike) -> FloatArray:
    """Return the pose (3,) of a robot and the positions (k, 2) of its teammates as poses (1 + k, 3), or raise."""
    robot_pose, positions = pose_floats(pose), positions_array(teammates, "teammates")
    poses = np.zeros((1 + len(positions), 3))
    poses[0], poses[1:, :2] = robot_pose, positions
    return poses


def _assign(costs: FloatArray) -> FloatArray:
    """Return the costs (m, n) of the minimal assignment, and `SAME_GOAL` for all other pairs."""
    from scipy.optimize import linear_sum_assignment  # slow import, not always needed

    chosen, pairs = np.full_like(costs, SAME_GOAL), linear_sum_assignment(costs)
    chosen[pairs] = costs[pairs]
    return chosen
