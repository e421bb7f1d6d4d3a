"""Errors of a team's maps and poses: which true landmark each landmark of a map stands for, and how far off it is."""

import math
from collections.abc import Mapping, Sequence
from itertools import count
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place
from slam_backend.core.read_only import with_constants, with_read_only
from slam_backend.core.validation import FloatArray, IntArray, check_float
from slam_backend.fastslam.relative_poses import OWN, SIGMAS, START, TeamPoses
from slam_backend.fastslam.reports import LandmarkIdMap, LandmarksCreated, MapForked, MapReleased, TeamReport
from slam_backend.maps.landmark_map import TeamMapSummaries

FALSE, UNCOUNTED = -1, -2  # claims of landmarks that are no true one, or one that does not matter
PLACED = 0.5  # [m] a landmark held nearer than this is well placed


UNUSED = -3  # an id that no landmark has had so far


@in_place
def score_team(
    places: Any,
    names: Any,
    parts: Any,
    claims: tuple[Any, ...],
    beliefs: Any,
    true_starts: Any,
    true_poses: Any,
    scores: Any,
) -> None:
    """Write how wrong the robots' maps and poses are, in their own start frames and without fitting.

    Args:
        places, names, parts: (n, 4), (n, 2) int64, (K, 2) int64. Landmarks of all maps, and the part of each robot; see
            `TeamMapSummaries`.
        claims: What the landmarks claim to be, and how that is scored:
            (B, n) int64. Claim of the landmark of each name, map by map: a row of the truths, or as above.
            (K,) int64. Book of each robot's map, one of the B.
            (N, 3) float64 [m], world frame. The landmarks that count, N >= 1.
            c of the map error [m].
            (N,) float64. Room to work in.
        beliefs: (K, 16 + K). See `TeamPoses`.
        true_starts, true_poses: (K, 3) [m, m, rad], world frame.
        scores: (8 or more, K) float64. Written to: per robot the map error E of the contract [m]; the RMSE [m] of the
            matched landmarks, the cutoff where nothing is matched; matched landmarks over the true ones, and over
            those of the map; matched ones nearer than 0.5 m over the true ones; errors of position [m] and heading
            [rad] in [0, pi]; and what the robot believes of the former, one sigma [m].
    """
    books, book_of, truths, cutoff, least = claims
    for robot in range(len(beliefs)):
        belief, start, true, score = beliefs[robot], true_starts[robot], true_poses[robot], scores[:, robot]
        c, s = math.cos(start[2]), math.sin(start[2])
        dx = start[0] + c * belief[OWN] - s * belief[OWN + 1] - true[0]
        dy = start[1] + s * belief[OWN] + c * belief[OWN + 1] - true[1]
        turned = start[2] + belief[OWN + 2] - true[2]
        score[5], score[6] = math.hypot(dx, dy), abs((turned + math.pi) % (2.0 * math.pi) - math.pi)
        score[7] = belief[SIGMAS + robot]

        x0 = start[0] + c * belief[START] - s * belief[START + 1]
        y0 = start[1] + s * belief[START] + c * belief[START + 1]
        c, s = math.cos(start[2] + belief[START + 2]), math.sin(start[2] + belief[START + 2])
        least[:] = np.inf  # squared distance of the nearest landmark that claims each
        estimated = surplus = 0
        for i in range(parts[robot, 0], parts[robot, 1]):
            claim = books[book_of[robot], names[i, 1]]
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
        squares, total = 0.0, 0.5 * cutoff * cutoff * surplus
        for square in least:
            if square < np.inf:
                matched += 1
                placed += square < PLACED * PLACED
                squares += square
                total += min(square, cutoff * cutoff)
            else:
                total += 0.5 * cutoff * cutoff
        score[0] = math.sqrt(total / len(truths))
        score[1] = math.sqrt(squares / matched) if matched else cutoff
        score[2], score[3] = matched / len(truths), matched / max(estimated, 1)
        score[4] = placed / len(truths)


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
            report: Report of the step.
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
            outlines: Outlines of the maps of the K robots, in their map frames.
            points: Poses that the robots believe.
            true_starts: (K, 3) [m, m, rad]. True start poses, in the frame of the true positions.
            true_poses: (K, 3) [m, m, rad]. True poses, in the same frame.
            scores: (8 or more, K) float64. Written to: the first figures of `TeamMetrics`.
        """
        (places, names), parts = outlines
        claims = self._books, self._book_of, self.true_positions, self.cutoff, self._least
        score_team(places, names, parts, claims, points.beliefs, true_starts, true_poses, scores)

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
        """Note what landmarks (m,) claim that measurements (m,) created in a map; -1 stands for none."""
        names = ids.tolist()  # few: a loop in Python takes less than calls of numpy
        self._reserve(max(names, default=-1) + 1)
        book = self._books[self._row_of[number]]
        for name, true_id in zip(names, true_ids.tolist(), strict=False):
            if name >= 0:
                book[name] = self._claim_of[true_id] if true_id >= 0 else FALSE
