"""The simulator's books: which true landmark created each landmark of each map, and how wrong the maps are."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray, IntArray, check_float
from slam_backend.geometry import compose
from slam_backend.landmark_map import LandmarkMap
from slam_backend.reports import Renaming, TeamReport

FALSE, UNCOUNTED = -1, -2
UNUSED = -3  # an id that no landmark has had so far
PLACED = 0.5  # [m] a landmark held nearer than this is well placed


@dataclass(frozen=True, slots=True)
class MapScores:
    """How wrong one robot's map is, in its own start frame, without fitting.

    Attributes:
        error: E of the contract [m].
        rmse: Of the matched landmarks [m]; the cutoff where nothing is matched.
        recall: Matched landmarks over the true ones.
        precision: Matched landmarks over the estimated ones.
        placed: Matched landmarks closer than 0.5 m over the true ones.
    """

    error: float
    rmse: float
    recall: float
    precision: float
    placed: float


@jit
def _score(
    means: FloatArray, claims: IntArray, pose: FloatArray, truths: FloatArray, cutoff: float
) -> tuple[float, float, float, float, float]:
    """Compute `MapScores` of means (n, 3) that `pose` (3,) moves to the frame of the truths (N, 3), N >= 1."""
    least = np.full(len(truths), np.inf)
    c, s = math.cos(pose[2]), math.sin(pose[2])
    estimated = surplus = 0
    for i in range(len(means)):
        claim = claims[i]
        estimated += claim != UNCOUNTED
        if claim == FALSE:
            surplus += 1
        elif claim >= 0:
            x = pose[0] + c * means[i, 0] - s * means[i, 1] - truths[claim, 0]
            y = pose[1] + s * means[i, 0] + c * means[i, 1] - truths[claim, 1]
            z = means[i, 2] - truths[claim, 2]
            surplus += least[claim] < np.inf
            least[claim] = min(least[claim], x * x + y * y + z * z)
    matched = placed = 0
    squares = 0.0
    total = 0.5 * cutoff * cutoff * surplus
    for square in least:
        if square < np.inf:
            matched += 1
            placed += square < PLACED * PLACED
            squares += square
            total += min(square, cutoff * cutoff)
        else:
            total += 0.5 * cutoff * cutoff
    rmse = math.sqrt(squares / matched) if matched else cutoff
    count = len(truths)
    return math.sqrt(total / count), rmse, matched / count, matched / max(estimated, 1), placed / count


class ClaimLedger:
    """Which true landmark each landmark of each group claims, kept outside the filters.

    Args:
        num_robots: K; each begins as a group of its own.
        true_positions: (N', 3) float64 [m], world frame. All landmarks of the world.
        countable: (N',) bool. Those that some robot could ever see: only they count, N of them.
        cutoff: c of the map error [m].
    """

    def __init__(self, num_robots: int, true_positions: FloatArray, countable: np.ndarray, cutoff: float) -> None:
        self.cutoff = check_float("map_error_cutoff", cutoff, "Give metres.", above=0.0)
        self.true_positions = np.ascontiguousarray(true_positions[countable])
        self._claim_of = np.where(countable, np.cumsum(countable) - 1, UNCOUNTED)
        self._claims: dict[tuple[int, ...], IntArray] = {(r,): np.empty(0, np.int64) for r in range(num_robots)}

    def record(self, report: TeamReport, true_ids: Sequence[IntArray]) -> None:
        """Enter the landmarks that a step created, then the renamings of its merges.

        Args:
            report: Of the step.
            true_ids: Per robot (n_i,) int64. The landmark behind each measurement; -1 for a false point.
        """
        for robots in self._claims:
            for robot in robots:
                made = report.created[robot]
                new = made >= 0
                if new.any():
                    self._enter(robots, made[new], self._claims_from(true_ids[robot][new]))
        for renaming in report.renamings:
            self.rename(renaming)

    def rename(self, renaming: Renaming) -> None:
        """Join the books of two groups: landmarks of a keep their claims, those of b bring theirs."""
        claims_b = self._claims.pop(renaming.robots_b)
        joint = tuple(sorted(renaming.robots_a + renaming.robots_b))
        self._claims[joint] = self._claims.pop(renaming.robots_a)
        old, new = renaming.ids_b.T
        book = self._claims[joint]
        fused = (new < len(book)) & (book[np.minimum(new, len(book) - 1)] != UNUSED) if len(book) else new < 0
        self._enter(joint, new[~fused], claims_b[old[~fused]])

    def claims(self, robots: tuple[int, ...], ids: IntArray) -> IntArray:
        """Return the claims (n,) int64 of a group's landmarks: index of the true one, -1 false, -2 not countable."""
        return self._claims[robots][ids]

    def score(self, robots: tuple[int, ...], group_map: LandmarkMap, world_from_group: FloatArray) -> MapScores:
        """Score a group's map as one of its robots holds it.

        Args:
            robots: The group.
            group_map: Its map, in its map frame.
            world_from_group: (3,) [m, m, rad]. Through the robot's own start frame and its true start pose.
        """
        claims = self.claims(robots, group_map.ids)
        return MapScores(*_score(group_map.means, claims, world_from_group, self.true_positions, self.cutoff))

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the books, for the same world's landmarks."""
        return {"claims": {robots: book.copy() for robots, book in self._claims.items()}}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with books that `get_state` returned."""
        self._claims = {robots: book.copy() for robots, book in state["claims"].items()}

    def _claims_from(self, true_ids: IntArray) -> IntArray:
        claims = np.full(len(true_ids), FALSE)
        real = true_ids >= 0
        claims[real] = self._claim_of[true_ids[real]]
        return claims

    def _enter(self, robots: tuple[int, ...], ids: IntArray, claims: IntArray) -> None:
        """Note claims under new ids."""
        book = self._claims[robots]
        needed = int(ids.max(initial=-1)) + 1
        if needed > len(book):
            book = np.concatenate([book, np.full(max(needed, 2 * len(book)) - len(book), UNUSED)])
            self._claims[robots] = book
        book[ids] = claims


def world_from_group(true_start: FloatArray, start_from_group: FloatArray) -> FloatArray:
    """Return where a robot's own estimates put the group's map frame in the world, (3,) [m, m, rad]."""
    return compose(true_start, start_from_group)
