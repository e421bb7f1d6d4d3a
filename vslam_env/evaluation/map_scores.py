"""Errors of a team's maps and poses, and the ground-truth association of the estimated landmarks."""

import math
from collections.abc import Mapping
from itertools import count
from typing import Any

import numpy as np

from slam_backend.core.jit import in_place
from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray, check_float
from slam_backend.fastslam.relative_poses import OWN, SIGMAS, START, TeamPoses
from slam_backend.maps.landmark_map import TeamMapSummaries
from slam_backend.state import INT64, MAX_LANDMARKS, Array, Dict, Each, Int, Sizes, State
from slam_backend.team.merge import branches_in
from slam_backend.team.reports import LandmarkIdMap, LandmarksCreated, MapForked, MapReleased, TeamReport
from vslam_env.evaluation.team_metrics import RobotMetrics

FALSE, UNCOUNTED = -1, -2  # claims of false landmarks, and of true ones that are not scored
ACCURATE_WITHIN = 0.5  # [m] error below which a landmark counts as accurate


UNUSED = -3  # claim of an unused landmark id


@in_place
def score_team(
    positions: Any,
    counts_and_ids: Any,
    map_rows: Any,
    ground_truth: tuple[Any, ...],
    beliefs: Any,
    true_starts: Any,
    true_poses: Any,
    metrics: RobotMetrics[FloatArray],
) -> None:
    """Write the errors of the robots' maps and poses, in their own start frames and without a fit.

    Args:
        positions, counts_and_ids, map_rows: (n, 4), (n, 2) int64, (K, 2) int64. Landmarks of all maps, and first and
            last row of each robot's map; see `TeamMapSummaries`.
        ground_truth: Claims of the landmarks, and the data to score them:
            (B, n) int64. Claim of each landmark id, map by map: a row of the true positions, `FALSE` or `UNCOUNTED`.
            (K,) int64. Row of each robot's map in these claims.
            (N, 3) float64 [m], world frame. True positions of the observable landmarks, N >= 1.
            Cutoff c of the map error [m].
            (K, N) float64. Output: smallest squared error [m^2] of the landmarks that claim each true one in each
            robot's map; inf without any.
        beliefs: (K, 16 + K). Array of `TeamPoses`.
        true_starts, true_poses: (K, 3) [m, m, rad], world frame. True start and current poses.
        metrics: Rows (K,), see `TeamMetrics` and `slam_backend.metrics.map_error`. Output: those that compare maps and
            poses with the truth.
    """
    claims, claims_row, truths, cutoff, smallest_errors = ground_truth
    for robot in range(len(beliefs)):
        belief, start, true = beliefs[robot], true_starts[robot], true_poses[robot]
        smallest = smallest_errors[robot]
        c, s = math.cos(start[2]), math.sin(start[2])
        dx = start[0] + c * belief[OWN] - s * belief[OWN + 1] - true[0]
        dy = start[1] + s * belief[OWN] + c * belief[OWN + 1] - true[1]
        turned = start[2] + belief[OWN + 2] - true[2]
        metrics.pose_errors[robot] = math.hypot(dx, dy)
        metrics.heading_errors[robot] = abs((turned + math.pi) % (2.0 * math.pi) - math.pi)
        metrics.pose_sigmas[robot] = belief[SIGMAS + robot]

        x0 = start[0] + c * belief[START] - s * belief[START + 1]
        y0 = start[1] + s * belief[START] + c * belief[START + 1]
        c, s = math.cos(start[2] + belief[START + 2]), math.sin(start[2] + belief[START + 2])
        smallest[:] = np.inf
        estimated = surplus = 0
        for i in range(map_rows[robot, 0], map_rows[robot, 1]):
            claim = claims[claims_row[robot], counts_and_ids[i, 1]]
            estimated += claim != UNCOUNTED
            if claim == FALSE:
                surplus += 1
            elif claim >= 0:
                x = x0 + c * positions[i, 0] - s * positions[i, 1] - truths[claim, 0]
                y = y0 + s * positions[i, 0] + c * positions[i, 1] - truths[claim, 1]
                z = positions[i, 2] - truths[claim, 2]
                surplus += smallest[claim] < np.inf
                smallest[claim] = min(smallest[claim], x * x + y * y + z * z)
        matched = accurate = 0
        squares, total = 0.0, 0.5 * cutoff * cutoff * surplus
        for square in smallest:
            if square < np.inf:
                matched += 1
                accurate += square < ACCURATE_WITHIN * ACCURATE_WITHIN
                squares += square
                total += min(square, cutoff * cutoff)
            else:
                total += 0.5 * cutoff * cutoff
        metrics.map_errors[robot] = math.sqrt(total / len(truths))
        metrics.map_rmses[robot] = math.sqrt(squares / matched) if matched else cutoff
        metrics.map_recalls[robot], metrics.map_precisions[robot] = matched / len(truths), matched / max(estimated, 1)
        metrics.accurate_recalls[robot] = accurate / len(truths)


class GroundTruthAssociation:
    """Claims: the true landmark of each landmark in each map, recorded outside the filters.

    Args:
        num_robots: Number of robots K; initially each has its own map, with its index as the number.
        true_positions: (N', 3) float64 [m], world frame. Positions of all landmarks of the world.
        observable: (N',) bool. True for the N observable landmarks, the only ones scored.
        cutoff: Cutoff c of the map error [m].
    """

    STATE = State(
        claims=Array(INT64, "maps ids", UNUSED, "LANDMARKS"),
        row_of=Dict(Int(0, MAX_LANDMARKS), Int(high="maps")),
        map_of=Each(Int(), "K"),
        seen=Dict(Int(), Array(INT64, "K *", -1, "WORLD", constant=True)),
    )

    def __init__(self, num_robots: int, true_positions: FloatArray, observable: np.ndarray, cutoff: float) -> None:
        self.cutoff = check_float("map_error_cutoff", cutoff, "Give metres.", above=0.0)
        self.true_positions = np.ascontiguousarray(true_positions[observable])
        self._smallest = np.full((num_robots, len(self.true_positions)), np.inf)  # squared errors of the last score
        self._claim_of = np.where(observable, np.cumsum(observable) - 1, UNCOUNTED)
        self._claims = np.empty((num_robots, 0), np.int64)  # row: claims of the ids of one map
        self._row_of = {number: number for number in range(num_robots)}
        self._use_maps(tuple(range(num_robots)))
        self._seen: dict[int, IntArray] = {}  # true ids of the measurements by step, a row for each robot

    def record(self, report: TeamReport, true_ids: IntArray) -> None:
        """Record all changes of maps in a step.

        Args:
            report: Report of the filters on the step.
            true_ids: (K, B) int64. True landmark of each measurement, -1 for a false point; a row for each robot, with
                anything beyond its measurements. It is kept; the caller does not write to it afterwards.
        """
        self._seen[report.step] = as_read_only(true_ids)
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
        while self._seen and (oldest := next(iter(self._seen))) < report.oldest_step:  # in ascending order
            del self._seen[oldest]

    def merge(self, id_map: LandmarkIdMap) -> None:
        """Combine the claims of two groups' maps in the joint map.

        A merge that is already recorded is ignored.
        """
        map_a, map_b, joint = id_map.maps
        if joint in self._row_of:
            return
        self._copy(map_a, joint)
        self._use_maps(tuple([joint if number in (map_a, map_b) else number for number in self._map_of]))
        old, new = id_map.ids_b.T
        self._reserve(int(new.max(initial=-1)) + 1)
        added = self._claims[self._row_of[joint], new] == UNUSED  # the others were fused with landmarks of a
        self._claims[self._row_of[joint], new[added]] = self._claims[self._row_of[map_b], old[added]]

    def true_ids(self, robot: int, ids: IntArray) -> IntArray:
        """Return the claims (n,) int64 of landmarks in a robot's map: true index, -1 false, -2 not scored."""
        return np.asarray(self._claims[self._claims_row[robot], ids])

    def claims_of(self, number: int, ids: IntArray) -> IntArray:
        """Return the claims (n,) int64 of landmarks in the map of that number, see `true_ids`."""
        return np.asarray(self._claims[self._row_of[number], ids])

    def rows_of(self, true_ids: IntArray) -> IntArray:
        """Return the rows (n,) int64 of `true_positions` for true ids (n,), -1: false point; negative if not scored."""
        return np.where(true_ids >= 0, self._claim_of[true_ids], FALSE)

    @property
    def accurate(self) -> BoolArray:
        """(K, N) bool. Which true landmarks the map of each robot held within 0.5 m at the last score."""
        return self._smallest < ACCURATE_WITHIN * ACCURATE_WITHIN

    def score(
        self,
        map_summaries: TeamMapSummaries,
        team_poses: TeamPoses,
        true_starts: FloatArray,
        true_poses: FloatArray,
        metrics: RobotMetrics[FloatArray],
    ) -> None:
        """Score the robots' maps and poses in their own start frames.

        Args:
            map_summaries: Summaries of the maps of the K robots, in their map frames.
            team_poses: Pose estimates of the robots.
            true_starts: (K, 3) [m, m, rad], world frame. True start poses.
            true_poses: (K, 3) [m, m, rad], world frame. True current poses.
            metrics: Output, see `score_team`.
        """
        (positions, counts_and_ids), map_rows = map_summaries
        ground_truth = self._claims, self._claims_row, self.true_positions, self.cutoff, self._smallest
        score_team(
            positions, counts_and_ids, map_rows, ground_truth, team_poses.beliefs, true_starts, true_poses, metrics
        )

    def rebuild(self) -> None:
        """Look up the rows of the robots' maps."""
        self._use_maps(self._map_of)

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless each map has a row of its own."""
        row_of, map_of = parts["row_of"], parts["map_of"]
        if len(set(row_of.values())) < len(row_of) or not set(map_of) <= set(row_of):
            raise ValueError(f"not a row for each map: {dict(row_of)}, {map_of}")

    def _use_maps(self, map_of: tuple[int, ...]) -> None:
        """Set the map number of each robot."""
        self._map_of = map_of
        self._claims_row = np.array([self._row_of[number] for number in map_of])

    def _copy(self, source: int, copy: int) -> None:
        """Copy the claims of a map to a new map."""
        taken = set(self._row_of.values())
        row = next(row for row in count() if row not in taken)
        if row == len(self._claims):
            self._claims = np.vstack([self._claims, self._claims])
        self._claims[row] = self._claims[self._row_of[source]]
        self._row_of[copy] = row

    def _reserve(self, needed: int) -> None:
        """Extend claims that are too short to the needed length, at least doubling them."""
        length = self._claims.shape[1]
        if needed > length:
            more = max(needed - length, length)
            self._claims = np.pad(self._claims, ((0, 0), (0, more)), constant_values=UNUSED)

    def _enter(self, number: int, ids: IntArray, true_ids: IntArray) -> None:
        """Record the claims of the landmarks with `ids` (m,), -1: none, created by measurements of `true_ids` (m,)."""
        numbers = ids.tolist()  # few: a Python loop is faster than numpy calls
        self._reserve(max(numbers, default=-1) + 1)
        claims = self._claims[self._row_of[number]]
        for landmark, true_id in zip(numbers, true_ids.tolist(), strict=False):
            if landmark >= 0:
                claims[landmark] = self._claim_of[true_id] if true_id >= 0 else FALSE


MOST_MEASURED = 1000  # most landmarks that all robots together create in a tick


def check_claims(association: Mapping[str, Any], team: Mapping[str, Any], tick: int) -> None:
    """Raise unless the state of an association holds what kernels and later reports look up without checks.

    Args:
        association: State of a `GroundTruthAssociation`.
        team: State of the `TeamSlam` with the maps.
        tick: Present tick.
    """
    claims, seen = association["claims"], association["seen"]
    numbers: set[int] = set(team["numbers"])
    for branch in branches_in(team["merges"]):
        numbers.add(branch["number"])
        maps = branch["filter"]["maps"]
        needed = max(1 + maps.ids.max(initial=-1), maps.next_id - MOST_MEASURED * tick)
        if needed > claims.shape[1]:
            raise ValueError(f"claims of {claims.shape[1]} landmarks, not {needed}")
    if lacking := numbers - set(association["row_of"]):
        raise ValueError(f"no claims of map {min(lacking)}")
    for step, inputs in team["records"]["log"]["steps"].items():
        if step not in seen or max(given.num_given for given in inputs.inputs) > seen[step].shape[1]:
            raise ValueError(f"not all true ids of step {step}")
    for entry in team["records"]["entries"]:
        if isinstance(entry, LandmarksCreated) and (
            entry.step not in seen or len(entry.ids) > seen[entry.step].shape[1]
        ):
            raise ValueError(f"not all true ids of step {entry.step}")
        if isinstance(entry, LandmarkIdMap) and len(entry.ids_b) and entry.ids_b.max() >= claims.shape[1]:
            raise ValueError(f"claims of {claims.shape[1]} landmarks, not {entry.ids_b.max() + 1}")
