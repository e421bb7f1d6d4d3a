"""The 16 slots that hand frontiers to a policy under stable numbers."""

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import BoolArray, FloatArray
from vslam_env.navigation._grid_kernels import GRID_SIZE
from vslam_env.navigation._planning_kernels import (
    FRONTIER_SIZE,
    SAME_GOAL,
    FrontierColumns,
    describe,
    fill_slots,
    update_slots,
)
from vslam_env.navigation.occupancy_grid import known_bounds
from vslam_env.navigation.team_grids import TeamGrids
from vslam_env.navigation.validation import check_cells, pose_floats, positions_array

__all__ = ["FRONTIER_SIZE", "NUM_FEATURES", "NUM_SLOTS", "CandidateSlots", "TeamSlots"]

NUM_SLOTS, NUM_FEATURES = 16, 5
NUM_COLUMNS = len(FrontierColumns._fields)
ROBOT_RADIUS = 0.2  # [m]


class CandidateSlots:
    """Sixteen places to explore, each in a slot that it keeps while it lives.

    At an update, old candidates are paired with the frontiers found now, at least total distance, and live on where a
    pair is less than 1 m apart; others die. New frontiers fill free slots, nearest first. A frontier that stays though
    the robot looked at it from its goal at 4 updates (or a robot of its group was there at 16) cannot be seen, as it is
    a speck of noise or a nook behind a corner: what is unknown within 0.8 m of the goal is given up, so that
    exploration ends.
    """

    __slots__ = ("_given_up", "_rows", "_visits")

    def __init__(self) -> None:
        self._settle(np.full((NUM_SLOTS, NUM_COLUMNS), np.nan))

    @classmethod
    def over(cls, rows: FloatArray) -> "CandidateSlots":
        """Return empty slots whose rows (16, ...) are these."""
        self = cls.__new__(cls)
        rows.fill(np.nan)
        self._settle(rows)
        return self

    def _settle(self, rows: FloatArray) -> None:
        """Begin with these rows, which are NaN."""
        self._rows = rows
        self._visits = np.zeros(NUM_SLOTS, np.int64)
        self._given_up = np.zeros((GRID_SIZE, GRID_SIZE), np.bool_)

    @property
    def valid(self) -> BoolArray:
        """Which slots hold a candidate, (16,) bool; none when nothing is left to explore."""
        return ~np.isnan(self._columns.x)

    @property
    def _columns(self) -> FrontierColumns:
        return FrontierColumns.of(self._rows)

    @property
    def goals(self) -> FloatArray:
        """Where to go, (16, 2) float64 [m], start frame; NaN in empty slots."""
        return self._columns.goals

    @property
    def headings(self) -> FloatArray:
        """Where to look from the goals, (16,) float64 [rad], start frame; NaN in empty slots."""
        return self._columns.heading.copy()

    @property
    def sizes(self) -> FloatArray:
        """How long the frontiers are, (16,) float64 [m]; NaN in empty slots."""
        return self._columns.size.copy()

    @property
    def lengths(self) -> FloatArray:
        """How long the robot's paths to the goals were at the last update, (16,) float64 [m]; NaN in empty slots."""
        return self._columns.length.copy()

    def candidate(self, slot: int) -> tuple[FloatArray, float] | None:
        """Return the goal (2,) [m] of a slot and where to look from there [rad], start frame; None if it is empty."""
        x, y, heading, _, _ = self._rows[slot].tolist()
        return None if math.isnan(x) else (np.array([x, y]), heading)

    def update(self, cells: NDArray[np.uint8], pose: ArrayLike, teammates: ArrayLike = ()) -> None:
        """Bring the candidates up to date; meant to be called once a second.

        Args:
            cells: (300, 300) uint8. `SeenGrid.cells`.
            pose: (3,) float64 [m, m, rad], start frame. Pose of the robot.
            teammates: (k, 2) float64 [m], start frame. Places of the others in its group: their visits count as well.

        Raises:
            ValueError: If an array has the wrong shape or is not finite.
        """
        poses = _together(pose, teammates)
        check_cells(cells)
        self.renew(cells, known_bounds(cells), poses, 0)

    def renew(self, cells: NDArray[np.uint8], bounds: NDArray[np.int32], poses: FloatArray, robot: int) -> None:
        """Bring the candidates of a robot up to date.

        Args:
            cells: (300, 300) uint8. Cells of its grid.
            bounds: (4,) int32. Bounds of its grid, see `TeamGrids`.
            poses: (n, 3) float64 [m, m, rad], start frame. Its own and those of teammates; NaN: it does not know.
            robot: Its row in the poses.
        """
        slots = self._rows, self._visits
        found, costs, is_clear = update_slots(cells, bounds, ROBOT_RADIUS, poses, robot, *slots, self._given_up)
        if not is_clear:
            fill_slots(_assign(costs), found, *slots)

    def features(self, pose: ArrayLike, teammates: ArrayLike = ()) -> NDArray[np.float32]:
        """Describe the candidates to a policy.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Pose of the robot.
            teammates: (k, 2) float64 [m], start frame. Places of the others in its group.

        Returns:
            (16, 5) float32, all metres: x and y of the goal in the robot frame, length of the path at the last update,
            size of the frontier, and distance from the goal to the nearest teammate, 60 if there is none. Zeros in
            empty slots.
        """
        features = np.empty((1, NUM_SLOTS, NUM_FEATURES), np.float32)
        describe(self._rows[None], _together(pose, teammates)[None], features)
        return np.asarray(features[0])

    def get_state(self) -> dict[str, Any]:
        """Return a copy of all that `set_state` needs to continue bit by bit."""
        return {"rows": self._rows.copy(), "visits": self._visits.copy(), "given_up": self._given_up.copy()}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_state` returned."""
        self._rows[:] = state["rows"]
        self._visits = state["visits"].copy()
        self._given_up = state["given_up"].copy()


class TeamSlots:
    """The slots of all robots of a team, whose rows lie in an array of one piece.

    Args:
        num_robots: K.

    Attributes:
        slots: Slots of each robot.
    """

    def __init__(self, num_robots: int) -> None:
        self._rows = np.empty((num_robots, NUM_SLOTS, NUM_COLUMNS))
        self.slots = list(map(CandidateSlots.over, self._rows))

    def update(self, robot: int, grids: TeamGrids, poses: FloatArray) -> None:
        """Bring a robot's candidates up to date, as `CandidateSlots.update` does; nothing is checked.

        Args:
            robot: Index of the robot.
            grids: Grids of the team.
            poses: (K, K, 3) float64 [m, m, rad]. See `features`.
        """
        self.slots[robot].renew(grids.grids[robot].cells, grids.bounds[robot], poses[robot], robot)

    def features(self, poses: FloatArray) -> NDArray[np.float32]:
        """Describe all robots' candidates to policies; nothing is checked.

        Args:
            poses: (K, K, 3) float64 [m, m, rad]. Where robot i believes robot j to be, in i's start frame; NaN: it
                does not know.

        Returns:
            `CandidateSlots.features` (K, 16, 5). A fresh array.
        """
        features = np.empty((len(self._rows), NUM_SLOTS, NUM_FEATURES), np.float32)
        describe(self._rows, poses, features)
        return features


def _together(pose: ArrayLike, teammates: ArrayLike) -> FloatArray:
    """Return a robot's pose (3,) and the positions (k, 2) of its teammates as poses (1 + k, 3), or raise."""
    own, places = pose_floats(pose), positions_array(teammates, "teammates")
    poses = np.zeros((1 + len(places), 3))
    poses[0], poses[1:, :2] = own, places
    return poses


def _assign(costs: FloatArray) -> FloatArray:
    """Return costs (m, n) that are `SAME_GOAL` but for the pairs, each of other rows and columns, of least total."""
    from scipy.optimize import linear_sum_assignment  # slow to import, and not always needed

    chosen, pairs = np.full_like(costs, SAME_GOAL), linear_sum_assignment(costs)
    chosen[pairs] = costs[pairs]
    return chosen
