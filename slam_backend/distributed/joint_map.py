"""Joint map of a group: the graphs of its robots, joined at their common landmarks, at their optimum."""

from collections.abc import Mapping
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np

from slam_backend.core.validation import FloatArray, IntArray
from slam_backend.distributed.messages import Link, SharedMap
from slam_backend.geometry import compose, inverse
from slam_backend.maps.alignment import AlignmentOptions
from slam_backend.maps.correspondences import candidates, too_many
from slam_backend.maps.fusion import fuse_descriptors
from slam_backend.maps.landmark_map import LandmarkMap, unchecked_map
from slam_backend.maps.match_table import match_table
from slam_backend.maps.verification import inlier_mask
from slam_backend.smoother.graph import SlamGraph
from slam_backend.smoother.graph_building import merge_graphs
from slam_backend.smoother.optimizer import MapEstimate, optimize
from slam_backend.smoother.options import SmoothingOptions

Links = Mapping[tuple[str, str], Link]
Pairs = Mapping[tuple[str, str], IntArray]  # ids of common landmarks, by names in alphabetical order
NO_PAIRS = np.empty((0, 2), np.int64)


class JointMap(NamedTuple):
    """What the robots of a group know together, start frame of one of them.

    Attributes:
        starts: Start pose (3,) [m, m, rad] of each robot.
        corrections: Motion (3,) from each robot's own start frame to the joint one, where it was last.
        landmarks: Landmarks of all maps; those of the robot itself keep their ids.
        own_ids: (n,) int64. Ids in the map of the robot itself that `landmarks` holds.
    """

    starts: dict[str, FloatArray]
    corrections: dict[str, FloatArray]
    landmarks: LandmarkMap
    own_ids: IntArray


def joint_map(
    name: str, known: Mapping[str, SharedMap], links: Links, camera: FloatArray, smoothing: SmoothingOptions,
    alignment: AlignmentOptions,
) -> JointMap:  # fmt: skip
    """Return the joint map of a robot's group, in its start frame.

    The graphs of the robots are joined at the landmarks that alignments paired. At the optimum further landmarks of two
    maps turn out to be the same, and the graphs are joined at these, too. All robots of a group that know the same maps
    and links join the same graphs.

    Args:
        name: Name of the robot.
        known: Latest map of each robot, by name.
        links: Link of each pair of robots that has one, by names in alphabetical order.
        camera: (7,) as kernels take it.
        smoothing: Options of the smoother.
        alignment: Gates of common landmarks.
    """
    placed = _placed(name, links)
    pairs = {pair: link.pairs for pair, link in links.items()}
    joint = _joined(placed, known, pairs, camera, smoothing)
    if len(placed) > 1:
        moved = {other: _placed_map(known[other], joint, other) for other in placed}
        for one, other in combinations(sorted(placed), 2):
            more = _same(moved[one], moved[other], alignment)
            pairs[one, other] = np.concatenate([pairs.get((one, other), NO_PAIRS), more])
        joint = _joined(placed, known, pairs, camera, smoothing)
    return JointMap(joint.starts, joint.corrections, *_landmarks(known, joint))


class _Joined(NamedTuple):
    """Joint graph at its optimum, or as it was joined if there is none."""

    ids: dict[str, dict[int, int]]  # Joint id of each landmark of each graph, by name; the robot itself first
    graph: SlamGraph
    places: FloatArray  # (l, 3) [m] positions of the landmarks
    mode: MapEstimate | None  # The optimum
    starts: dict[str, FloatArray]
    corrections: dict[str, FloatArray]

    def rows(self, name: str, ids: IntArray) -> IntArray:
        """Return the rows (n,) of landmarks (n,) of a robot's map in the joint graph; -1: it has no such landmark."""
        row_of = {joint: row for row, joint in enumerate(self.graph.landmark_ids.tolist())}
        return np.array([row_of.get(self.ids[name].get(own, -1), -1) for own in ids.tolist()], np.int64)


def _joined(
    placed: Mapping[str, FloatArray], known: Mapping[str, SharedMap], pairs: Pairs, camera: FloatArray,
    options: SmoothingOptions,
) -> _Joined:  # fmt: skip
    """Return the joint graph of some robots, placed by their links, at its optimum."""
    names = list(placed)
    graph = known[names[0]].graph
    ids = {names[0]: {own: own for own in graph.landmark_ids.tolist()}}
    free = 1 + int(max(known[names[0]].ids.max(initial=-1), graph.landmark_ids.max(initial=-1)))
    for other in names[1:]:
        theirs = known[other].graph
        ids[other] = _common(other, ids, known, pairs)
        for own in theirs.landmark_ids.tolist():
            if own not in ids[other]:
                ids[other][own], free = free, free + 1
        renamed = np.array(list(ids[other].items()), dtype=np.int64).reshape(-1, 2)
        graph = merge_graphs(graph, theirs, placed[other], renamed)
    mode = None
    poses, places = graph.poses, graph.landmarks
    if len(names) > 1:
        found = optimize(graph, camera, options)
        if not found.reason:
            poses, places, mode = found.poses, found.landmarks, found
    starts: dict[str, FloatArray] = {}
    corrections: dict[str, FloatArray] = {}
    for row, other in enumerate(names):
        own = known[other].graph
        for keys, mine, into in (
            (graph.first_keys, own.first_keys, starts), (graph.last_keys, own.last_keys, corrections)
        ):  # fmt: skip
            into[other] = compose(poses[keys[row]], inverse(own.poses[mine[0]]))
    return _Joined(ids, graph, places, mode, starts, corrections)


def _placed_map(shared: SharedMap, joint: _Joined, name: str) -> LandmarkMap:
    """Return those landmarks of a robot's map that the joint graph has, where it places them."""
    rows = joint.rows(name, shared.ids)
    chosen, places = shared.landmarks().subset(rows >= 0), joint.places[rows[rows >= 0]]
    return unchecked_map(places, chosen.covariances, chosen.descriptors, chosen.counts, chosen.ids)


def _same(one: LandmarkMap, other: LandmarkMap, options: AlignmentOptions) -> IntArray:
    """Return the pairs (n, 2) of ids of landmarks of two maps in one frame that look alike and are at one place."""
    if not len(one) or not len(other) or too_many(one, other, options):
        return NO_PAIRS
    matches, _ = candidates(one, other, options)
    table, floor = match_table(one, other, matches), options.position_floor**2
    inside = inlier_mask(table, matches, np.zeros(3), floor, options.position_gate)
    return np.column_stack([one.ids[matches[inside, 0]], other.ids[matches[inside, 1]]])


def _placed(name: str, links: Links) -> dict[str, FloatArray]:
    """Return the motion (3,) from each robot's start frame to that of one, along the links with most common landmarks.

    These links are a spanning tree: the same for all robots of a group.
    """
    part = {each: {each} for pair in links for each in pair}
    near: dict[str, list[tuple[str, FloatArray]]] = {each: [] for each in part}
    for (one, other), link in sorted(links.items(), key=lambda item: (-len(item[1].pairs), item[0])):
        if other not in part[one]:
            both = part[one] | part[other]
            part |= dict.fromkeys(both, both)
            near[one].append((other, link.motion))
            near[other].append((one, inverse(link.motion)))
    placed = {name: np.zeros(3)}
    waiting = [name]
    for each in waiting:
        for other, motion in near.get(each, ()):
            if other not in placed:
                placed[other] = compose(placed[each], motion)
                waiting.append(other)
    return placed


def _common(
    other: str, ids: Mapping[str, Mapping[int, int]], known: Mapping[str, SharedMap], pairs: Pairs
) -> dict[int, int]:
    """Return the joint ids of a robot's landmarks that robots placed before it have, too, by their ids in its map."""
    found: dict[int, int] = {}
    for one, joint in ids.items():
        pair = (one, other) if one < other else (other, one)
        if pair not in pairs:
            continue
        rows = pairs[pair] if one < other else pairs[pair][:, ::-1]
        graphs = known[one].graph, known[other].graph
        resolved = [graph.resolve_ids(column).tolist() for graph, column in zip(graphs, rows.T, strict=True)]
        held = set(graphs[1].landmark_ids.tolist())
        for mine, theirs in zip(*resolved, strict=True):
            if mine in joint and theirs in held and theirs not in found and joint[mine] not in found.values():
                found[theirs] = joint[mine]
    return found


def _landmarks(known: Mapping[str, SharedMap], joint: _Joined) -> tuple[LandmarkMap, IntArray]:
    """Return the landmarks of all maps where the joint graph places them, and the ids of those of the robot itself."""
    found: dict[int, tuple[FloatArray, Any, int]] = {}  # covariance, descriptor and count, by row of the joint graph
    for robot in joint.ids:
        landmarks = known[robot].landmarks().moved(joint.corrections[robot])
        for k, row in enumerate(joint.rows(robot, landmarks.ids).tolist()):
            if row < 0:
                continue
            look, count = landmarks.descriptors[k], int(landmarks.counts[k])
            if row in found:
                covariance, before, counted = found[row]
                look, count = fuse_descriptors(before, counted, look, count), count + counted
            else:
                covariance = landmarks.covariances[k] if joint.mode is None else _marginal(joint.mode, row)
            found[row] = covariance, look, count
    covariances, looks, counts = zip(*found.values(), strict=True) if found else ((),) * 3
    rows, own = np.array(list(found), np.int64), known[next(iter(joint.ids))]
    joined = unchecked_map(
        joint.places[rows], np.array(covariances, np.float64).reshape(-1, 3, 3),
        np.array(looks, np.float32).reshape(-1, own.descriptors.shape[1]), np.array(counts, np.int64),
        joint.graph.landmark_ids[rows],
    )  # fmt: skip
    return joined, own.ids[joint.rows(own.robot, own.ids) >= 0]


def _marginal(mode: MapEstimate, row: int) -> FloatArray:
    """Return the covariance (3, 3) [m^2] of a landmark of a graph at its optimum."""
    assert mode.system is not None
    covariance = mode.system.covariance(np.array([3 * (mode.system.num_poses + row)]))
    return 0.5 * (covariance + covariance.T)
