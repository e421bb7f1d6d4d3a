"""The simulator's books: which true landmark created each landmark of each map, and how wrong the maps are."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from slam_backend._jit import jit
from slam_backend.errors import FloatArray, IntArray, check_float
from slam_backend.landmark_map import LandmarkMap, MapOutline
from slam_backend.reports import LandmarksCreated, MapCopied, MapDropped, Renaming, TeamReport

FALSE, UNCOUNTED = -1, -2
UNUSED = -3  # an id that no landmark has had so far
PLACED = 0.5  # [m] a landmark held nearer than this is well placed


class MapScores(NamedTuple):
    """How wrong each robot's map is, in its own start frame, without fitting.

    Attributes:
        errors: (K,) float64 [m]. E of the contract.
        rmses: (K,) float64 [m]. Of the matched landmarks; the cutoff where nothing is matched.
        recalls: (K,) float64. Matched landmarks over the true ones.
        precisions: (K,) float64. Matched landmarks over the estimated ones.
        placed: (K,) float64. Matched landmarks closer than 0.5 m over the true ones.
    """

    errors: FloatArray
    rmses: FloatArray
    recalls: FloatArray
    precisions: FloatArray
    placed: FloatArray


@jit
def _score(
    robot: int,
    means: FloatArray,
    ids: IntArray,
    book: IntArray,
    poses: FloatArray,
    truths: FloatArray,
    cutoff: float,
    scores: FloatArray,
) -> None:
    """Write a robot's column of scores (5, K), the rows of which are `MapScores`.

    Args:
        robot: Its index.
        means: (n, 3) [m]. Of the landmarks of its map.
        ids: (n,) int64. Theirs.
        book: What landmark i claims stands at `book[ids[i]]`.
        poses: (K, 3) [m, m, rad]. Robot by robot, what moves its means to the frame of the truths.
        truths: (N, 3) [m], N >= 1.
        cutoff: c of the map error [m].
        scores: Written to.
    """
    least = np.full(len(truths), np.inf)
    pose = poses[robot]
    c, s = math.cos(pose[2]), math.sin(pose[2])
    estimated = surplus = 0
    for i in range(len(means)):
        claim = book[ids[i]]
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
    count = len(truths)
    scores[0, robot] = math.sqrt(total / count)
    scores[1, robot] = math.sqrt(squares / matched) if matched else cutoff
    scores[2, robot] = matched / count
    scores[3, robot] = matched / max(estimated, 1)
    scores[4, robot] = placed / count


class ClaimLedger:
    """Which true landmark each landmark of each map claims, kept outside the filters.

    Args:
        num_robots: K; each begins with a map of its own, numbered as it is.
        true_positions: (N', 3) float64 [m], world frame. All landmarks of the world.
        countable: (N',) bool. Those that some robot could ever see: only they count, N of them.
        cutoff: c of the map error [m].
    """

    def __init__(self, num_robots: int, true_positions: FloatArray, countable: np.ndarray, cutoff: float) -> None:
        self.cutoff = check_float("map_error_cutoff", cutoff, "Give metres.", above=0.0)
        self.true_positions = np.ascontiguousarray(true_positions[countable])
        self._claim_of = np.where(countable, np.cumsum(countable) - 1, UNCOUNTED)
        self._claims: dict[int, IntArray] = {number: np.empty(0, np.int64) for number in range(num_robots)}
        self._map_of = list(range(num_robots))
        self._seen: dict[tuple[int, int], IntArray] = {}  # (step, robot): true ids of what it measured then

    def record(self, report: TeamReport, true_ids: Sequence[IntArray]) -> None:
        """Enter all that a step did to maps.

        Args:
            report: Of the step.
            true_ids: Per robot (n_i,) int64. The landmark behind each measurement; -1 for a false point.
        """
        for robot, ids in enumerate(true_ids):
            self._seen[report.step, robot] = ids
        for entry in report.entries:
            if isinstance(entry, LandmarksCreated):
                new = entry.ids >= 0
                self._enter(entry.number, entry.ids[new], self._claims_from(self._seen[entry.step, entry.robot][new]))
            elif isinstance(entry, MapCopied):
                self._claims[entry.copy] = self._claims[entry.source].copy()
            elif isinstance(entry, MapDropped):
                self._claims.pop(entry.number)
            elif isinstance(entry, Renaming):
                self.rename(entry)
        self._map_of = list(report.maps)
        while self._seen and (oldest := next(iter(self._seen)))[0] < report.oldest_step:  # they stand in order of time
            del self._seen[oldest]

    def rename(self, renaming: Renaming) -> None:
        """Join the books of two groups: landmarks of a keep their claims, those of b bring theirs.

        A merge that is in the books already is not entered again.
        """
        map_a, map_b, joint = renaming.maps
        if joint in self._claims:
            return
        claims_b, book = self._claims[map_b], self._claims[map_a].copy()
        self._claims[joint] = book
        self._map_of = [joint if number in (map_a, map_b) else number for number in self._map_of]
        old, new = renaming.ids_b.T
        fused = (new < len(book)) & (book[np.minimum(new, len(book) - 1)] != UNUSED) if len(book) else new < 0
        self._enter(joint, new[~fused], claims_b[old[~fused]])

    def claims(self, robot: int, ids: IntArray) -> IntArray:
        """Return the claims (n,) int64 of landmarks of a robot's map: index of the true one, -1 false, -2 no matter."""
        return self._claims[self._map_of[robot]][ids]

    def scores(self, maps: Sequence[LandmarkMap | MapOutline], world_from_group: FloatArray) -> MapScores:
        """Score the robots' maps.

        Args:
            maps: Of each of the K robots, or the outline of it, in its map frame.
            world_from_group: (K, 3) [m, m, rad]. Through the robot's own start frame and its true start pose.
        """
        scores = np.empty((len(MapScores._fields), len(maps)))
        for robot, (held, number) in enumerate(zip(maps, self._map_of, strict=True)):
            book = self._claims[number]
            _score(robot, held.means, held.ids, book, world_from_group, self.true_positions, self.cutoff, scores)
        return MapScores(*scores)

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the books, for the same world's landmarks."""
        books = {number: book.copy() for number, book in self._claims.items()}
        return {"claims": books, "map_of": tuple(self._map_of), "seen": dict(self._seen)}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with books that `get_state` returned."""
        self._claims = {number: book.copy() for number, book in state["claims"].items()}
        self._map_of, self._seen = list(state["map_of"]), dict(state["seen"])

    def _claims_from(self, true_ids: IntArray) -> IntArray:
        claims = np.full(len(true_ids), FALSE)
        real = true_ids >= 0
        claims[real] = self._claim_of[true_ids[real]]
        return claims

    def _enter(self, number: int, ids: IntArray, claims: IntArray) -> None:
        """Note claims under new ids of a map."""
        book = self._claims[number]
        needed = int(ids.max(initial=-1)) + 1
        if needed > len(book):
            book = np.concatenate([book, np.full(max(needed, 2 * len(book)) - len(book), UNUSED)])
            self._claims[number] = book
        book[ids] = claims
