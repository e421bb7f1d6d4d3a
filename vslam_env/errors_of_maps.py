"""The simulator's books: which true landmark created each landmark of each map, and how wrong the maps are."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.errors import FloatArray, IntArray, check_float
from slam_backend.geometry import compose, transform_points
from slam_backend.landmark_map import LandmarkMap
from slam_backend.metrics import map_error, map_rmse
from slam_backend.reports import Renaming, TeamReport

FALSE, UNCOUNTED = -1, -2
UNUSED = -3  # an id that no landmark has had so far


@dataclass(frozen=True, slots=True)
class MapScores:
    """How wrong one robot's map is, in its own start frame, without fitting.

    Attributes:
        error: E of the contract [m].
        rmse: Of the matched landmarks [m]; the cutoff where nothing is matched.
        recall: Matched landmarks over the true ones.
        precision: Matched landmarks over the estimated ones.
    """

    error: float
    rmse: float
    recall: float
    precision: float


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
        means = transform_points(world_from_group, group_map.means)
        claims = self.claims(robots, group_map.ids)
        matched = map_rmse(means, self.true_positions, claims=claims)
        return MapScores(
            error=map_error(means, claims, self.true_positions, self.cutoff),
            rmse=matched.rmse if len(matched.matched) else self.cutoff,
            recall=matched.recall,
            precision=matched.precision,
        )

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
