"""Errors of a team's maps and poses: which true landmark each landmark of a map stands for, and how far off it is."""

import math
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place, inline
from slam_backend.core.read_only import with_constants, with_read_only
from slam_backend.core.validation import FloatArray, IntArray, check_float
from slam_backend.fastslam.relative_poses import OWN, SIGMAS, START, TeamPoses
from slam_backend.fastslam.reports import LandmarkIdMap, LandmarksCreated, MapForked, MapReleased, TeamReport
from slam_backend.maps.landmark_map import TeamMapSummaries

FALSE, UNCOUNTED = -1, -2  # claims of landmarks that are no true one, or one that does not matter
PLACED = 0.5  # [m] a landmark held nearer than this is well placed


@inline
def pose_error(start: FloatArray, estimated: FloatArray, true: FloatArray) -> tuple[float, float]:
    """Return how far an estimated pose, laid at the true start, is from the true one.

    Args:
        start: (3,) float64 [m, m, rad], world frame. True start pose.
        estimated: (3,) float64 [m, m, rad], own start frame.
        true: (3,) float64 [m, m, rad], world frame.

    Returns:
        The distance [m], and the difference of the headings [rad] in [0, pi].
    """
    c, s = math.cos(start[2]), math.sin(start[2])
    dx = start[0] + c * estimated[0] - s * estimated[1] - true[0]
    dy = start[1] + s * estimated[0] + c * estimated[1] - true[1]
    turn = start[2] + estimated[2] - true[2]
    return math.hypot(dx, dy), abs((turn + math.pi) % (2.0 * math.pi) - math.pi)


@inline
def _score_map(
    places: FloatArray, names: IntArray, book: IntArray, x0: float, y0: float, turn: float, truths: FloatArray,
    cutoff: float, least: FloatArray,
) -> tuple[float, float, float, float, float]:  # fmt: skip
    """Return the scores of a robot's map, in the order of `score_team`.

    Args:
        places, names: (n, 4), (n, 2) int64. Of its landmarks, as in `MapSummaryRows`.
        book: What the landmark of each name claims.
        x0, y0, turn: The motion [m, m, rad] of the places to the frame of the truths.
        truths: (N, 3) [m], N >= 1.
        cutoff: c of the map error [m].
        least: (N,) overwritten: the squared distance of the nearest landmark that claims each, else infinite.
    """
    least[:] = np.inf
    c, s = math.cos(turn), math.sin(turn)
    estimated = surplus = 0
    for i in range(len(places)):
        claim = book[names[i, 1]]
        estimated += claim != UNCOUNTED
        if claim == FALSE:
            surplus += 1
        elif claim >= 0:
            x = x0 + c * places[i, 0] - s * places[i, 1] - truths[claim, 0]
            y = y0 + s * places[i, 0] + c * places[i, 1] - truths[claim, 1]
            z = places[i, 2] - truths[claim, 2]
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
    rmse = math.sqrt(squares / matched) if matched else cutoff
    return math.sqrt(total / count), rmse, matched / count, matched / max(estimated, 1), placed / count


@in_place
def score_team(
    places: Any, names: Any, parts: Any, books: Any, book_of: Any, truths: Any, cutoff: float, beliefs: Any,
    true_starts: Any, true_poses: Any, scores: Any, least: Any,
) -> None:  # fmt: skip
    """Write how wrong the robots' maps and poses are, in their own start frames and without fitting.

    Args:
        places, names, parts: (N, 4), (N, 2) int64, (K, 2) int64. Of `TeamMapSummaries`.
        books: (B, n) int64. What the landmark of each name claims, map by map: a row of truths, or as above.
        book_of: (K,) int64. Which book is that of each robot's map.
        truths: (N', 3) [m], world frame. The landmarks that count, N' >= 1.
        cutoff: c of the map error [m].
        beliefs: (K, 16 + K). Of `TeamPoses`.
        true_starts, true_poses: (K, 3) [m, m, rad], world frame.
        scores: (8 or more, K) float64. Written to: per robot the map error E of the contract [m]; the RMSE [m] of the
            matched landmarks, the cutoff where nothing is matched; matched landmarks over the true ones, and over
            those of the map; matched ones nearer than 0.5 m over the true ones; errors of position [m] and heading
            [rad]; and what the robot believes of the former, one sigma [m].
        least: (N',) room to work in.
    """
    for robot in range(len(beliefs)):
        held, belief = slice(parts[robot, 0], parts[robot, 1]), beliefs[robot]
        x, y, theta = belief[START], belief[START + 1], belief[START + 2]
        c, s = math.cos(true_starts[robot, 2]), math.sin(true_starts[robot, 2])
        x0 = true_starts[robot, 0] + c * x - s * y
        y0 = true_starts[robot, 1] + s * x + c * y
        turn, book = true_starts[robot, 2] + theta, books[book_of[robot]]
        of_map = _score_map(places[held], names[held], book, x0, y0, turn, truths, cutoff, least)
        scores[0, robot], scores[1, robot], scores[2, robot], scores[3, robot], scores[4, robot] = of_map
        scores[5, robot], scores[6, robot] = pose_error(true_starts[robot], belief[OWN : OWN + 3], true_poses[robot])
        scores[7, robot] = belief[SIGMAS + robot]


UNUSED = -3  # an id that no landmark has had so far


@in_place
def _record_true_ids(book: IntArray, ids: IntArray, true_ids: IntArray, claim_of: IntArray) -> int:
    """Note what new landmarks claim, if there is room for all of them.

    Args:
        book: (n,) int64. What the landmark of each id claims; changed.
        ids: (m,) int64. Of the landmarks that measurements created, -1 = none.
        true_ids: (m,) int64, read-only. The landmark behind each measurement; -1 for a false point.
        claim_of: (N',) int64. What is noted of each of these.

    Returns:
        How long the book has to be; where it is shorter nothing is noted.
    """
    needed = 0
    for i in range(len(ids)):
        needed = max(needed, ids[i] + 1)
    if needed <= len(book):
        for i in range(len(ids)):
            if ids[i] >= 0:
                book[ids[i]] = claim_of[true_ids[i]] if true_ids[i] >= 0 else FALSE
    return needed


class GroundTruthAssociation:
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
        self._least = np.empty(len(self.true_positions))  # room to score in
        self._claim_of = np.where(countable, np.cumsum(countable) - 1, UNCOUNTED)
        self._books = np.empty((num_robots, 0), np.int64)  # in each row what the ids of one map claim
        self._row_of = {number: number for number in range(num_robots)}
        self._use_maps(tuple(range(num_robots)))
        self._seen: dict[int, Sequence[IntArray] | IntArray] = {}  # by step: true ids of what each robot measured then

    def record(self, report: TeamReport, true_ids: Sequence[IntArray] | IntArray) -> None:
        """Enter all that a step did to maps.

        Args:
            report: Of the step.
            true_ids: Per robot (n_i or more,) int64. The landmark behind each measurement; -1 for a false point.
        """
        self._seen[report.step] = with_read_only(true_ids)
        for entry in report.map_changes:
            if isinstance(entry, LandmarksCreated):
                self._enter(entry.number, entry.ids, self._seen[entry.step][entry.robot])
            elif isinstance(entry, MapForked):
                self._copy(entry.source, entry.copy)
            elif isinstance(entry, MapReleased):
                del self._row_of[entry.number]
            elif isinstance(entry, LandmarkIdMap):
                self.merge(entry)
        if report.maps != self._map_of:
            self._use_maps(report.maps)
        while self._seen and (oldest := next(iter(self._seen))) < report.oldest_step:  # they stand in order of time
            del self._seen[oldest]

    def merge(self, renaming: LandmarkIdMap) -> None:
        """Join the books of two groups: landmarks of a keep their claims, those of b bring theirs.

        A merge that is in the books already is not entered again.
        """
        map_a, map_b, joint = renaming.maps
        if joint in self._row_of:
            return
        self._copy(map_a, joint)
        self._use_maps(tuple([joint if number in (map_a, map_b) else number for number in self._map_of]))
        old, new = renaming.ids_b.T
        self._reserve(int(new.max(initial=-1)) + 1)
        own = self._books[self._row_of[joint], new] == UNUSED  # the others were fused into landmarks of a
        self._books[self._row_of[joint], new[own]] = self._books[self._row_of[map_b], old[own]]

    def true_ids(self, robot: int, ids: IntArray) -> IntArray:
        """Return the claims (n,) int64 of landmarks of a robot's map: index of the true one, -1 false, -2 no matter."""
        return np.asarray(self._books[self._book_of[robot], ids])

    def score(
        self,
        outlines: TeamMapSummaries,
        points: TeamPoses,
        true_starts: FloatArray,
        true_poses: FloatArray,
        scores: FloatArray,
    ) -> None:
        """Score the robots' maps and poses where their own estimates put them.

        Args:
            outlines: Of the maps of the K robots, in their map frames.
            points: Where they believe to be.
            true_starts: (K, 3) [m, m, rad]. The true start poses, in the frame of the true positions.
            true_poses: (K, 3) [m, m, rad]. Likewise.
            scores: (8 or more, K) float64. Written to: the first figures of `TeamMetrics`.
        """
        (places, names), parts = outlines
        score_team(
            places, names, parts, self._books, self._book_of, self.true_positions, self.cutoff, points.beliefs,
            true_starts, true_poses, scores, self._least,
        )  # fmt: skip

    def get_state(self) -> dict[str, Any]:
        """Return a copy of the books, for the same world's landmarks; what was seen is read-only and shared."""
        return {
            "books": self._books.copy(),
            "row_of": dict(self._row_of),
            "map_of": self._map_of,
            "seen": dict(self._seen),
        }

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Go on with books that `get_state` returned."""
        self._books, self._row_of = state["books"].copy(), dict(state["row_of"])
        self._seen = dict(with_constants(state["seen"]))
        self._use_maps(state["map_of"])

    def _use_maps(self, map_of: tuple[int, ...]) -> None:
        """Take note of the map that each robot goes by."""
        self._map_of = map_of
        self._book_of = np.array([self._row_of[number] for number in map_of])

    def _copy(self, source: int, copy: int) -> None:
        """Begin the book of a new map with that of another."""
        taken = set(self._row_of.values())
        row = next(row for row in count() if row not in taken)
        if row == len(self._books):
            self._books = np.vstack([self._books, self._books])
        self._books[row] = self._books[self._row_of[source]]
        self._row_of[copy] = row

    def _reserve(self, needed: int) -> None:
        """Make the books so long, or twice as long as they are, if they are shorter."""
        room = self._books.shape[1]
        if needed > room:
            more = max(needed - room, room)
            self._books = np.pad(self._books, ((0, 0), (0, more)), constant_values=UNUSED)

    def _enter(self, number: int, ids: IntArray, true_ids: IntArray) -> None:
        """Note what measurements (m,) of landmarks (m,) created in a map."""
        row = self._row_of[number]
        needed = _record_true_ids(self._books[row], ids, true_ids, self._claim_of)
        if needed > self._books.shape[1]:
            self._reserve(needed)
            _record_true_ids(self._books[row], ids, true_ids, self._claim_of)
