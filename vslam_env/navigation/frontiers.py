"""Where the seen floor ends: frontiers, and the 16 slots that hand them to a policy under stable numbers."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment

from slam_backend._jit import jit
from slam_backend.errors import BoolArray, FloatArray, bad_argument, check_array
from vslam_env.navigation._painting import CELL, FREE, GRID_SIZE, UNKNOWN
from vslam_env.navigation._wavefront import UNREACHED, path_lengths
from vslam_env.navigation.planning import distance_map
from vslam_env.navigation.seen_grid import centre_of

NUM_SLOTS = 16
MIN_CELLS = 3  # a robot needs 0.4 m; what is smaller is a speck or the corner of a wall
MAX_CELLS = 20  # longer frontiers are cut, as one goal cannot stand for them
SIGHT_CELLS = 3  # the unknown this near to a goal tells where to look from it

SAME_GOAL = 1.0  # [m] between updates the goal of a living candidate moves less than this
AT_GOAL = 0.5  # [m]
PATIENCE = 5  # updates with somebody at the goal, after which what is still unseen there never will be seen
GIVEN_UP = 0.8  # [m] radius of what is then left out
NO_TEAMMATE = 60.0  # [m] stands for the distance of a teammate when there is none


@dataclass(frozen=True, slots=True, kw_only=True)
class Frontiers:
    """Places to explore, by increasing path length.

    Attributes:
        goals: (n, 2) float64 [m], start frame. Open floor beside the middle of each frontier.
        headings: (n,) float64 [rad], start frame. Where the unknown lies, seen from the goal.
        sizes: (n,) float64 [m]. Length of each frontier.
        lengths: (n,) float64 [m]. Of the path from the robot to the goal.
    """

    goals: FloatArray
    headings: FloatArray
    sizes: FloatArray
    lengths: FloatArray


@jit
def _flood(mark: Any, level: int, into: int, row: int, col: int, limit: int, queue: Any) -> int:
    """Move up to `limit` connected cells from one level of marks to another, nearest first; return how many.

    Their rows and columns are left in the first rows of `queue`.
    """
    queue[0, 0], queue[0, 1] = row, col
    mark[row, col] = into
    head, tail = 0, 1
    while head < tail:
        r, c = queue[head]
        head += 1
        for nr in range(r - 1, r + 2):
            for nc in range(c - 1, c + 2):
                if mark[nr, nc] == level and tail < limit:
                    mark[nr, nc] = into
                    queue[tail, 0], queue[tail, 1] = nr, nc
                    tail += 1
    return tail


@jit
def _goal_beside(members: Any, cost: Any) -> tuple[int, int]:
    """Return the reached cell beside a frontier that is nearest to the middle of all such cells; (-1, -1) if none."""
    total, sum_row, sum_col = 0, 0.0, 0.0
    for k in range(len(members)):
        for nr in range(members[k, 0] - 1, members[k, 0] + 2):
            for nc in range(members[k, 1] - 1, members[k, 1] + 2):
                if cost[nr, nc] != UNREACHED:
                    total, sum_row, sum_col = total + 1, sum_row + nr, sum_col + nc
    best, goal_row, goal_col = np.inf, -1, -1
    for k in range(len(members)):
        for nr in range(members[k, 0] - 1, members[k, 0] + 2):
            for nc in range(members[k, 1] - 1, members[k, 1] + 2):
                if cost[nr, nc] != UNREACHED:
                    distance = (nr - sum_row / total) ** 2 + (nc - sum_col / total) ** 2
                    if distance < best:
                        best, goal_row, goal_col = distance, nr, nc
    return goal_row, goal_col


@jit
def _find(box: Any, cost: Any, ignored: Any, row: int, col: int) -> Any:
    """Collect the frontiers of a padded box whose first cell is the grid's (row, col).

    Returns:
        (n, 4) float64 rows (row and column of the goal in the box, heading, number of cells).
    """
    height, width = box.shape
    mark = np.zeros((height, width), np.int8)  # 1: unseen beside free floor; 2: its component known; 3: in a piece
    for r in range(1, height - 1):
        for c in range(1, width - 1):
            at_edge = FREE in (box[r - 1, c], box[r + 1, c], box[r, c - 1], box[r, c + 1])
            if at_edge and box[r, c] == UNKNOWN and not ignored[row + r, col + c]:
                mark[r, c] = 1

    found = np.empty((height * width // MIN_CELLS + 1, 4))
    count = 0
    whole = np.empty((height * width, 2), np.int64)
    piece = np.empty((MAX_CELLS, 2), np.int64)
    for r in range(1, height - 1):
        for c in range(1, width - 1):
            if mark[r, c] != 1:
                continue
            size = _flood(mark, 1, 2, r, c, height * width, whole)
            if size < MIN_CELLS:
                continue
            num_pieces = (size + MAX_CELLS - 1) // MAX_CELLS
            share = (size + num_pieces - 1) // num_pieces
            for k in range(size - 1, -1, -1):  # from the far end, so that a line is cut piece by piece
                if mark[whole[k, 0], whole[k, 1]] != 2:
                    continue
                num = _flood(mark, 2, 3, whole[k, 0], whole[k, 1], share, piece)
                if num < MIN_CELLS:
                    continue
                goal_row, goal_col = _goal_beside(piece[:num], cost)
                if goal_row < 0:
                    continue
                look_row = look_col = 0
                for i in range(max(goal_row - SIGHT_CELLS, 0), min(goal_row + SIGHT_CELLS + 1, height)):
                    for j in range(max(goal_col - SIGHT_CELLS, 0), min(goal_col + SIGHT_CELLS + 1, width)):
                        if box[i, j] == UNKNOWN:
                            look_row, look_col = look_row + i - goal_row, look_col + j - goal_col
                found[count, 0], found[count, 1] = goal_row, goal_col
                found[count, 2] = np.arctan2(look_row, look_col)
                found[count, 3] = num
                count += 1
    return found[:count]


def find_frontiers(
    cells: NDArray[np.uint8], start_xy: ArrayLike, radius: float = 0.2, ignored: BoolArray | None = None
) -> Frontiers:
    """Find where floor that a robot can reach borders on what has not been seen.

    A frontier is a connected set of unknown cells beside free ones, of at least 0.6 m, and with an open cell beside
    it to which a way is known. Those above 4 m are cut into pieces of equal size.

    Args:
        cells: (300, 300) uint8. `SeenGrid.cells`.
        start_xy: (2,) float64 [m], start frame. Where the robot is.
        radius: Of the robot [m].
        ignored: (300, 300) bool. Unknown cells that do not count; None to count all.

    Returns:
        The frontiers, nearest first; none if nothing is left to explore.

    Raises:
        ValueError: If the cells are not a grid's, or a number is not finite.
    """
    if ignored is None:
        ignored = np.zeros((GRID_SIZE, GRID_SIZE), np.bool_)
    ways = distance_map(cells, start_xy, radius)
    found = _find(ways.box, ways.cost, ignored, *ways.corner)
    goals = found[:, :2].astype(np.int64)
    lengths = path_lengths(ways.parent, goals) * CELL
    order = np.argsort(lengths, kind="stable")
    return Frontiers(
        goals=centre_of(goals[order] + np.array(ways.corner)),
        headings=found[order, 2],
        sizes=found[order, 3] * CELL,
        lengths=lengths[order],
    )


@jit
def _features(
    valid: Any, goals: Any, lengths: Any, sizes: Any, x: float, y: float, theta: float, teammates: FloatArray
) -> Any:
    """Compute `CandidateSlots.features`."""
    features = np.zeros((NUM_SLOTS, 5), np.float32)
    c, s = np.cos(theta), np.sin(theta)
    for i in range(NUM_SLOTS):
        if not valid[i]:
            continue
        u, v = goals[i, 0] - x, goals[i, 1] - y
        nearest = NO_TEAMMATE
        for k in range(len(teammates)):
            nearest = min(nearest, np.hypot(goals[i, 0] - teammates[k, 0], goals[i, 1] - teammates[k, 1]))
        features[i, 0], features[i, 1] = c * u + s * v, c * v - s * u
        features[i, 2], features[i, 3], features[i, 4] = lengths[i], sizes[i], nearest
    return features


class CandidateSlots:
    """Sixteen places to explore, each in a slot that it keeps while it lives.

    At an update, old candidates are paired with the frontiers found now, at least total distance, and live on where a
    pair is less than 1 m apart; others die. New frontiers fill free slots, nearest first. A frontier that stays though
    somebody has been at its goal for 5 updates cannot be seen (a speck of noise, a nook behind a corner): what is
    unknown within 0.8 m of the goal is given up for good, so exploration ends. The arrays are replaced, never changed.

    Attributes:
        goals: (16, 2) float64 [m], start frame. Where to go; NaN in empty slots.
        headings: (16,) float64 [rad], start frame. Where to look from there; NaN in empty slots.
        sizes: (16,) float64 [m]. Length of the frontier; 0 in empty slots.
        lengths: (16,) float64 [m]. Of the path from the robot to the goal at the last update; 0 in empty slots.
        valid: (16,) bool. Which slots hold a candidate; none when nothing is left to explore.
    """

    __slots__ = ("_given_up", "_visits", "goals", "headings", "lengths", "sizes", "valid")

    def __init__(self) -> None:
        self.goals: FloatArray = np.full((NUM_SLOTS, 2), np.nan)
        self.headings: FloatArray = np.full(NUM_SLOTS, np.nan)
        self.sizes: FloatArray = np.zeros(NUM_SLOTS)
        self.lengths: FloatArray = np.zeros(NUM_SLOTS)
        self.valid: BoolArray = np.zeros(NUM_SLOTS, np.bool_)
        self._visits = np.zeros(NUM_SLOTS, np.int64)
        self._given_up = np.zeros((GRID_SIZE, GRID_SIZE), np.bool_)

    def update(self, cells: NDArray[np.uint8], pose: ArrayLike, teammates: ArrayLike = ()) -> None:
        """Bring the candidates up to date; meant to be called once a second.

        Args:
            cells: (300, 300) uint8. `SeenGrid.cells`.
            pose: (3,) float64 [m, m, rad], start frame. Of the robot.
            teammates: (k, 2) float64 [m], start frame. Where the others of its group are: their visits count as well.

        Raises:
            ValueError: If an array has the wrong shape or is not finite.
        """
        robot = check_array("pose", pose, (3,), "Give (x, y, theta).")[:2]
        self._count_visits(np.vstack([robot, _positions(teammates)]))
        found = find_frontiers(cells, robot, ignored=self._given_up)

        slots = np.flatnonzero(self.valid)
        distances = np.linalg.norm(self.goals[slots, None] - found.goals[None], axis=-1)
        rows, columns = linear_sum_assignment(np.minimum(distances, SAME_GOAL))
        alive = distances[rows, columns] < SAME_GOAL
        kept, source = slots[rows[alive]], columns[alive]
        free = np.setdiff1d(np.arange(NUM_SLOTS), kept)
        new = np.setdiff1d(np.arange(len(found.goals)), source)[: len(free)]
        taken = np.concatenate([kept, free[: len(new)]])
        source = np.concatenate([source, new])

        visits = np.zeros(NUM_SLOTS, np.int64)
        visits[kept] = self._visits[kept]
        self._visits = visits
        self.goals = np.full((NUM_SLOTS, 2), np.nan)
        self.headings = np.full(NUM_SLOTS, np.nan)
        self.sizes, self.lengths = np.zeros(NUM_SLOTS), np.zeros(NUM_SLOTS)
        self.valid = np.zeros(NUM_SLOTS, np.bool_)
        self.goals[taken], self.headings[taken] = found.goals[source], found.headings[source]
        self.sizes[taken], self.lengths[taken] = found.sizes[source], found.lengths[source]
        self.valid[taken] = True

    def _count_visits(self, visitors: FloatArray) -> None:
        """Count who is at a goal, and give up what is unknown around goals that were visited too often."""
        distances = np.linalg.norm(self.goals[:, None] - visitors[None], axis=-1).min(axis=1)
        self._visits = self._visits + (distances <= AT_GOAL)  # NaN, of empty slots, compares false
        for slot in np.flatnonzero(self._visits >= PATIENCE):
            along = (np.arange(GRID_SIZE) + 0.5) * CELL - 0.5 * GRID_SIZE * CELL
            x, y = self.goals[slot]
            self._given_up |= (along[None] - x) ** 2 + (along[:, None] - y) ** 2 <= GIVEN_UP**2

    def features(self, pose: ArrayLike, teammates: ArrayLike = ()) -> NDArray[np.float32]:
        """Describe the candidates to a policy.

        Args:
            pose: (3,) float64 [m, m, rad], start frame. Of the robot.
            teammates: (k, 2) float64 [m], start frame. Of the others in its group.

        Returns:
            (16, 5) float32, all metres: x and y of the goal in the robot frame, length of the path at the last update,
            size of the frontier, and distance from the goal to the nearest teammate, 60 if there is none. Zeros in
            empty slots.
        """
        x, y, theta = np.asarray(pose, dtype=np.float64).tolist()
        features: NDArray[np.float32] = _features(
            self.valid, self.goals, self.lengths, self.sizes, x, y, theta, _positions(teammates)
        )
        return features

    def get_state(self) -> dict[str, Any]:
        """Return a copy of all that `set_state` needs to continue bit by bit."""
        return {name: getattr(self, name).copy() for name in self.__slots__}

    def set_state(self, state: dict[str, Any]) -> None:
        """Restore what `get_state` returned."""
        for name in self.__slots__:
            setattr(self, name, state[name].copy())


def _positions(teammates: ArrayLike) -> FloatArray:
    """Return positions as an array (k, 2), or raise."""
    positions = np.asarray(teammates, dtype=np.float64)
    if positions.size == 0:
        return np.empty((0, 2))
    if positions.ndim != 2 or positions.shape[1] != 2:
        raise bad_argument(
            "teammates", "an array of shape (k, 2)", f"shape {positions.shape}", "Give one (x, y) per teammate."
        )
    return positions
