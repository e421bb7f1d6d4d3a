"""Relocalisation: a robot that holds a wrong pose builds a part of its map twice; both parts tell where it really is.

Landmarks of one robot that look like older ones that it saw elsewhere are aligned with these, as two maps of unknown
relative frame are. Where the alignment holds, the robot's path since then is moved, both landmarks of a pair become
one, and the smoother continues from there. A motion that the claimed covariance of the robot's pose allows is a late
loop closure: odometry and its noise stay as they are. Otherwise the robot was lost if there is a moment at which its
view stayed the same while the odometry jumped: there the odometry is cut. Without such a moment the robot may have been
carried, or the other place may be another one that looks alike, as a second corridor does: that is reported, and
nothing is done. (A view that changes while a robot hardly moves is no such moment: that happens at corners.)

Landmarks that only other robots saw do not count: where these disagree, the start of the robot may be wrong and not its
odometry, and a merge is to be undone.
"""

from typing import Literal, NamedTuple

import numpy as np

from slam_backend.core.packed_symmetric import UNPACK_INDEX
from slam_backend.core.validation import BoolArray, Float32Array, FloatArray, IntArray
from slam_backend.geometry import compose, rotation, wrap_angle
from slam_backend.maps.alignment import align_maps
from slam_backend.maps.alignment_types import Alignment, AlignmentOptions
from slam_backend.maps.descriptor_matching import similar_pairs
from slam_backend.maps.landmark_map import LandmarkMap, unchecked_map
from slam_backend.smoother.duplicates import without_duplicates
from slam_backend.smoother.graph import UNINFORMATIVE, SlamGraph
from slam_backend.smoother.graph_reduction import without_unused_frames
from slam_backend.smoother.optimizer import MapEstimate
from slam_backend.smoother.reassociation import LandmarkTable

MIN_PAIRS = 5  # landmarks seen again
SAME_VIEW, VIEW = 3, 3  # landmarks in the last and in the next so many keys that tell a jump of the odometry
LOST = 16.27  # squared Mahalanobis distance of the motion beyond which the pose was wrong, 99.9 % of 3 degrees
Outcome = Literal["loop closed", "found", "suspected"]


class Relocated(NamedTuple):
    """A robot that sees its own older landmarks elsewhere.

    Attributes:
        robot: Index of the robot.
        shift: (3,) float64 [m, m, rad], map frame. Difference of its newest pose to the one that was believed.
        distance_sq: Squared Mahalanobis distance [-] of the shift, by the claimed covariance.
        pairs: (n, 2) int64 rows (id of the later landmark, id of the older one).
        graph: Graph with the moved path and without the later landmarks, before the next descent; None if the robot may
            also be at another place that looks alike.
    """

    robot: int
    shift: FloatArray
    distance_sq: float
    pairs: IntArray
    graph: SlamGraph | None

    @property
    def outcome(self) -> Outcome:
        """What it means."""
        if self.distance_sq <= LOST:
            return "loop closed"
        return "suspected" if self.graph is None else "found"


class _Sightings(NamedTuple):
    """First and last key (l,) from which a robot saw each landmark, and the later of both for all other robots."""

    first: IntArray
    last: IntArray
    by_others: IntArray


UNSEEN, NEVER = -1, np.iinfo(np.int64).max


def alignment_options(descriptor_gate: float) -> AlignmentOptions:
    """Return the gates and limits with which robots are found, for landmarks that look alike within a gate."""
    return AlignmentOptions(descriptor_gate=descriptor_gate, min_inliers=MIN_PAIRS)


def are_distinct(looks: Float32Array, options: AlignmentOptions) -> BoolArray:
    """Return which landmarks (l, d) look like few others: those by which a robot can be found."""
    alike = similar_pairs(looks, looks, options.descriptor_gate, options.max_similar + 1)  # each is like itself
    return np.bincount(alike[:, 0], minlength=len(looks)) > 0


def relocalise(
    graph: SlamGraph, mode: MapEstimate, known: LandmarkTable, options: AlignmentOptions
) -> Relocated | None:
    """Return a robot whose later landmarks are older ones of the map, one that can be moved first; None without one.

    Args:
        graph: Graph at its mode.
        mode: MAP estimate of the graph.
        known: Landmarks of the map whose ids come from data association.
        options: Gates, and limits of the alignment.
    """
    rows = np.flatnonzero(np.isin(graph.landmark_ids, known.ids))
    if len(rows) < 2 * MIN_PAIRS:
        return None
    at = np.searchsorted(known.ids, graph.landmark_ids[rows])
    suspected = None
    for robot in range(len(graph.last_keys)):
        seen = _sightings(graph, robot)
        of_known = _Sightings(seen.first[rows], seen.last[rows], seen.by_others[rows])
        split = _split(of_known, known.descriptors[at], options)
        if split is None:
            continue
        first = seen.first[rows]
        parts = (first >= 0) & (first < split), (first >= split) & (seen.by_others[rows] == UNSEEN)
        old, new = (_map_of(graph, known, rows[part], at[part]) for part in parts)
        found = align_maps(old, new, options=options)
        if found.success:
            pairs = np.column_stack([new.ids[found.inliers[:, 1]], old.ids[found.inliers[:, 0]]])
            relocated = _moved(graph, robot, found, pairs, seen, mode)
            if relocated.graph is not None:
                return relocated
            suspected = suspected or relocated
    return suspected


def _sightings(graph: SlamGraph, robot: int) -> _Sightings:
    """Return which landmarks a robot saw, and when."""
    keys = np.concatenate([graph.condensed_keys, graph.frame_keys[graph.point_frames]])
    landmarks = np.concatenate([graph.condensed_landmarks, graph.point_landmarks])
    own = graph.robots[keys] == robot
    count = len(graph.landmark_ids)
    first, last, by_others = np.full(count, graph.num_keys), np.full(count, UNSEEN), np.full(count, UNSEEN)
    np.minimum.at(first, landmarks[own], keys[own])
    np.maximum.at(last, landmarks[own], keys[own])
    np.maximum.at(by_others, landmarks[~own], keys[~own])
    first[last == UNSEEN] = UNSEEN
    return _Sightings(first, last, by_others)


def _split(seen: _Sightings, looks: Float32Array, options: AlignmentOptions) -> int | None:
    """Return the key from which a robot sees most landmarks for the first time that look like those seen before alone.

    Args:
        seen: Sightings of l landmarks.
        looks: (l, d) float32. Descriptors of these.
        options: Gates and limits of the alignment.
    """
    first, last, by_others = seen
    own = last != UNSEEN
    new = np.flatnonzero(own & (by_others == UNSEEN) & (first > last[own].min(initial=NEVER)))
    old = np.flatnonzero(own & (last < first[new].max(initial=UNSEEN)))
    if min(len(new), len(old)) < MIN_PAIRS:
        return None
    pairs = similar_pairs(looks[new], looks[old], options.descriptor_gate, options.max_similar + 1)
    ended = np.full(len(first), NEVER)
    np.minimum.at(ended, new[pairs[:, 0]], last[old[pairs[:, 1]]])
    later = np.flatnonzero(ended < first)
    begins = first[later]
    counts = ((ended[later] < begins[:, None]) & (begins >= begins[:, None])).sum(axis=1)
    return int(begins[counts == counts.max()].min()) if counts.max(initial=0) >= MIN_PAIRS else None


def _map_of(graph: SlamGraph, known: LandmarkTable, rows: IntArray, at: IntArray) -> LandmarkMap:
    """Return landmarks of a graph as a map."""
    return unchecked_map(
        graph.landmarks[rows], known.covariances[at][:, UNPACK_INDEX], known.descriptors[at],
        np.ones(len(rows), np.int64), graph.landmark_ids[rows],
    )  # fmt: skip


def _moved(
    graph: SlamGraph, robot: int, found: Alignment, pairs: IntArray, seen: _Sightings, mode: MapEstimate
) -> Relocated:
    """Return the graph with the robot's later path at its older landmarks; none if nothing explains the motion."""
    row = {int(name): i for i, name in enumerate(graph.landmark_ids)}
    new, old = (np.array([row[int(name)] for name in names]) for names in pairs.T)
    keys = np.flatnonzero((graph.robots == robot) & (mode.columns >= 0))
    newest = graph.last_keys[robot]
    shift, distance_sq = _shift(found, graph.poses[newest], mode.covariance(np.array([newest])))
    noises, variances = graph.odometry_covariances, graph.transition_variances
    shares = np.zeros(graph.num_keys)
    if distance_sq > LOST:
        cut = _cut(keys, seen.last[old], seen.first[new])
        if cut is None:
            return Relocated(robot, shift, distance_sq, pairs, None)
        shares[keys[keys >= cut]] = 1.0
        noises, variances = noises.copy(), variances.copy()
        noises[cut], variances[cut] = np.diag(UNINFORMATIVE), UNINFORMATIVE[0]
    else:
        begin = int(seen.first[new].min())
        end = int(seen.last[old][seen.last[old] < begin].max(initial=UNSEEN))
        shares[keys[keys > begin]] = 1.0
        way = keys[(keys > end) & (keys <= begin)]
        shares[way] = np.arange(1, len(way) + 1) / max(len(way), 1)
    poses, landmarks = graph.poses.copy(), graph.landmarks.copy()
    for key in np.flatnonzero(shares):
        poses[key] = compose(shares[key] * found.transform, poses[key])
    own = np.flatnonzero((seen.by_others == UNSEEN) & (seen.first >= 0))
    for landmark in own[shares[seen.first[own]] > 0.0]:
        share = shares[seen.first[landmark]] * found.transform
        landmarks[landmark, :2] = rotation(share[2]) @ landmarks[landmark, :2] + share[:2]
    joined = without_duplicates(
        graph.with_columns(
            poses=poses, landmarks=landmarks, odometry_covariances=noises, transition_variances=variances
        ),
        pairs,
    )
    return Relocated(robot, shift, distance_sq, pairs, without_unused_frames(joined))


def _cut(keys: IntArray, last: IntArray, first: IntArray) -> int | None:
    """Return the key at which the view stayed the same while the odometry jumped; None if none is clear.

    Args:
        keys: (k,) keys of the robot.
        last, first: (n,) last key from which each older landmark was seen, and first from which the later one was.
    """
    before, after = np.searchsorted(keys, last), np.searchsorted(keys, first)
    places = np.arange(len(keys))[:, None]
    same = (before < places) & (before >= places - VIEW) & (after >= places) & (after < places + VIEW)
    counts = same.sum(axis=1)
    return int(keys[counts.argmax()]) if counts.max(initial=0) >= SAME_VIEW else None


def _shift(found: Alignment, pose: FloatArray, covariance: FloatArray) -> tuple[FloatArray, float]:
    """Return the moved pose minus the pose (3,), and its squared Mahalanobis distance."""
    moved = compose(found.transform, pose)
    off = moved - pose
    off[2] = wrap_angle(off[2])
    lever = np.eye(3)
    lever[:2, 2] = -(moved[1] - found.ty), moved[0] - found.tx
    return off, float(off @ np.linalg.solve(covariance + lever @ found.covariance @ lever.T, off))
