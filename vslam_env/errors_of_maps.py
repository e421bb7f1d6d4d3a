"""The simulator's books: which true landmark created each landmark of each map, and how wrong the maps are."""

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from slam_backend._jit import inlined, jit
from slam_backend.errors import FloatArray, IntArray, check_float
from slam_backend.landmark_map import TeamOutlines
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


@inlined
def _score(
    means: FloatArray, claims: IntArray, x0: float, y0: float, turn: float, truths: FloatArray, least: FloatArray,
    cutoff: float, scores: FloatArray,
) -> None:  # fmt: skip
    """Write a robot's scores (5,), in the order of `MapScores`.

    Args:
        means: (n, 3) [m]. Of the landmarks of its map.
        claims: (n,) int64. What these claim.
        x0, y0, turn: The motion [m, m, rad] of its means to the frame of the truths.
        truths: (N, 3) [m], N >= 1.
        least: (N,) overwritten: the squared distance of the nearest landmark that claims each, else infinite.
        cutoff: c of the map error [m].
        scores: Written to.
    """
    least[:] = np.inf
    c, s = math.cos(turn), math.sin(turn)
    estimated = surplus = 0
    for i in range(len(means)):
        claim = claims[i]
        estimated += claim != UNCOUNTED
        if claim == FALSE:
            surplus += 1
        elif claim >= 0:
            x = x0 + c * means[i, 0] - s * means[i, 1] - truths[claim, 0]
            y = y0 + s * means[i, 0] + c * means[i, 1] - truths[claim, 1]
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
    scores[0] = math.sqrt(total / count)
    scores[1] = math.sqrt(squares / matched) if matched else cutoff
    scores[2] = matched / count
    scores[3] = matched / max(estimated, 1)
    scores[4] = placed / count


@jit
def _score_all(
    means: FloatArray, claims: IntArray, parts: IntArray, starts: FloatArray, true_starts: FloatArray,
    truths: FloatArray, cutoff: float, scores: FloatArray,
) -> None:  # fmt: skip
    """Write the scores (5, K) of all robots.

    Args:
        means, claims, parts: (N, 3), (N,), (K, 2). Of `TeamOutlines`, with what each landmark claims.
        starts, true_starts: As `ClaimLedger.scores` takes them.
        truths, cutoff: As in `_score`.
        scores: Written to.
    """
    least, own_scores = np.empty(len(truths)), np.empty(len(scores))
    for robot in range(len(starts)):
        own = slice(parts[robot, 0], parts[robot, 1])
        x, y, theta = starts[robot]
        c, s = math.cos(true_starts[robot, 2]), math.sin(true_starts[robot, 2])
        x0 = true_starts[robot, 0] + c * x - s * y
        y0 = true_starts[robot, 1] + s * x + c * y
        _score(means[own], claims[own], x0, y0, true_starts[robot, 2] + theta, truths, least, cutoff, own_scores)
        scores[:, robot] = own_scores


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

    def scores(self, outlines: TeamOutlines, starts: FloatArray, true_starts: FloatArray) -> MapScores:
        """Score the robots' maps where their own estimates put them.

        Args:
            outlines: Of the maps of the K robots, in their map frames.
            starts: (K, 3) [m, m, rad]. The motion from its map frame to each robot's own start frame, as it believes.
            true_starts: (K, 3) [m, m, rad]. The true start poses, in the frame of the true positions.
        """
        (means, _, _, ids), parts = outlines
        claims = np.empty(len(ids), np.int64)
        for number, first, last in set(zip(self._map_of, *parts.T.tolist(), strict=True)):
            claims[first:last] = self._claims[number][ids[first:last]]
        scores = np.empty((len(MapScores._fields), len(starts)))
        _score_all(means, claims, parts, starts, true_starts, self.true_positions, self.cutoff, scores)
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
