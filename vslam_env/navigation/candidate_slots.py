"""Candidate slots: frontiers presented to policies under stable indices.

This runs once a second, on at most a few dozen places; only the search before it is compiled.
"""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.state import FLOAT64, INT64, Array, Sizes, State
from vslam_env.navigation._grid_kernels import LARGEST_HALF_WIDTH
from vslam_env.navigation._planning_kernels import PAD, UNREACHED, FrontierColumns, dijkstra, frontiers_reached
from vslam_env.navigation.occupancy_grid import OccupancyGrid, cell_of
from vslam_env.navigation.planning import known_part
from vslam_env.navigation.validation import pose_floats, positions_array

__all__ = ["NUM_SLOTS", "CandidateSlots"]

NUM_SLOTS = 16
Ways = tuple[NDArray[np.uint8], NDArray[np.uint8], NDArray[np.int32], NDArray[np.int32], int, int]
NUM_COLUMNS = len(FrontierColumns._fields)
NO_CANDIDATE = np.full((1, NUM_COLUMNS), np.nan)
ROBOT_RADIUS = 0.2  # [m]
SAME_GOAL = 1.0  # [m] between updates the goal of a living candidate moves less than this
AT_GOAL = 0.5  # [m]
LOOKING = 0.6  # [rad] a robot whose heading is this near to a candidate's looks at the unknown
LOOK_COUNTS = 4  # times as much as a visit without a look, for a teammate's direction is not told
PATIENCE = 16  # visits, after which what is still unseen there never will be seen
CUT_MARGIN = 25  # [cells] from where a search was cut off: what is to be seen from there may lie beyond


class CandidateSlots:
    """Sixteen slots for candidate places to explore; a candidate keeps its slot while its frontier exists.

    An update assigns the old candidates to the current frontiers, nearest pairs first. Pairs less than 1 m apart
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
        self._count_visits(poses, robot)
        x, y, _ = poses[robot].tolist()
        ways = dijkstra(cells, bounds, x, y, ROBOT_RADIUS, math.nan, math.nan, float(reach))
        frontiers = frontiers_reached(ways, len(cells), self._given_up)
        if reach < math.inf:
            told = frontiers[~untold(ways, bounds, len(cells), frontiers)]
            others = self._rows[untold(ways, bounds, len(cells), self._rows)]
            frontiers = np.concatenate([told, others[~(_distances(others, told) < SAME_GOAL).any(axis=1)]])
        found = pair_up(self._rows, frontiers)
        gaps, is_new = np.flatnonzero(found < 0), np.ones(len(frontiers), np.bool_)
        self._visits[gaps], is_new[found[found >= 0]] = 0, False
        new = np.flatnonzero(is_new)[: len(gaps)]
        found[gaps[: len(new)]] = new
        self._rows[:] = np.concatenate([frontiers, NO_CANDIDATE])[found]
        return ways

    def _count_visits(self, poses: FloatArray, robot: int) -> None:
        """Count the visits of the robot and its teammates, see `renew`; where patience runs out, give up."""
        gaps = _distances(self._rows, poses)
        for slot in np.flatnonzero((gaps <= AT_GOAL).any(axis=1)).tolist():
            x, y, heading, _, _ = self._rows[slot].tolist()
            looked = gaps[slot, robot] <= AT_GOAL and math.cos(heading - poses[robot, 2]) > math.cos(LOOKING)
            self._visits[slot] += LOOK_COUNTS if looked else 1
            if self._visits[slot] >= PATIENCE:
                self._visits[slot] = 0
                self._given_up = np.concatenate([self._given_up, [[x, y]]])

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


def _distances(goals: FloatArray, places: FloatArray) -> FloatArray:
    """Return the distances (m, n) [m] between goals (m, 2 or more) and places (n, 2 or more); NaN where either is."""
    return np.asarray(np.hypot(goals[:, 0, None] - places[:, 0], goals[:, 1, None] - places[:, 1]))


def pair_up(goals: FloatArray, places: FloatArray) -> IntArray:
    """Return the place (m,) that each goal (m, 2 or more) is now, of places (n, 2 or more); -1: none.

    Pairs are less than `SAME_GOAL` apart, the nearest ones are chosen first, and each place is chosen once.
    """
    found, distances = np.full(len(goals), -1), _distances(goals, places)
    slots, sources = (distances < SAME_GOAL).nonzero()
    taken: set[int] = set()
    for k in distances[slots, sources].argsort(kind="stable").tolist():
        source = int(sources[k])
        if found[slots[k]] < 0 and source not in taken:
            found[slots[k]] = source
            taken.add(source)
    return found


def untold(ways: Ways, bounds: NDArray[np.int32], size: int, rows: FloatArray) -> BoolArray:
    """Return the mask (m,) of candidates (m, 5) of which a search over a part of the known floor tells nothing.

    It tells what there is at a cell unless that is open and not reached, or within `CUT_MARGIN` of an edge where the
    search was cut off.

    Args:
        ways: Paths of the search, of `dijkstra`.
        bounds: (4,) int32. Bounds of the known part of the grid.
        size: Number of cells along a side of the grid.
        rows: (m, 5). Candidates; NaN in empty slots, which are not in the mask.
    """
    _, weights, cost, _, *corner = ways
    is_untold = ~np.isnan(rows[:, 0])
    cells, first, end = cell_of(rows[is_untold, :2], size), np.array(corner), np.add(corner, cost.shape)
    low = np.where(first + PAD <= bounds[:2], first, first + PAD + CUT_MARGIN)
    high = np.where(end - PAD >= bounds[2:], end, end - PAD - CUT_MARGIN)
    settled = np.asarray(((low <= cells) & (cells < high)).all(axis=1))
    row, col = (cells[settled] - corner).T
    settled[settled] = (weights[row, col] == 0) | (cost[row, col] != UNREACHED)
    is_untold[is_untold] = ~settled
    return is_untold
