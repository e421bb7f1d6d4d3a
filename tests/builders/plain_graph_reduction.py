"""Graph reduction in plain numpy, the reference of the compiled kernels."""

import heapq
from dataclasses import replace

import numpy as np

from slam_backend.core.packed_symmetric import UNPACK_INDEX, UPPER
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import between, compose, rotation
from slam_backend.smoother._kernels import LandmarkFactors, Points
from slam_backend.smoother.graph import NONE, SlamGraph
from slam_backend.smoother.graph_reduction import CONTRADICTION
from slam_backend.smoother.optimizer import gathered, linearise
from slam_backend.smoother.options import SmoothingOptions, keyframe_limit


def chained(
    chain: FloatArray, noise: FloatArray, move: FloatArray, move_noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a motion (3,) followed by another, and its covariance (3, 3), to first order; each in its first frame."""
    by_first, by_second = np.eye(3), np.eye(3)
    by_second[:2, :2] = rotation(chain[2])
    by_first[:2, 2] = by_second[:2, :2] @ [-move[1], move[0]]
    return compose(chain, move), by_first @ noise @ by_first.T + by_second @ move_noise @ by_second.T


def plain_reduced(graph: SlamGraph, camera: FloatArray, options: SmoothingOptions) -> SlamGraph:
    """Return what `reduce_keyframes` does."""
    share = max(1, options.recent_keys // len(graph.last_keys))
    fresh = np.zeros(graph.num_keys, dtype=np.bool_)
    for robot in range(len(graph.last_keys)):
        fresh[np.flatnonzero(graph.robots == robot)[-share:]] = True
    condensed = _without_blind(_condensed(graph, fresh, camera, options), fresh)
    representatives, slack = _representatives(
        condensed, graph.transition_variances, fresh, keyframe_limit(options, len(graph.landmark_ids), graph.latest)
    )
    return plain_compacted(_joined(replace(condensed, rigid_variances=slack), representatives))


def plain_compacted(graph: SlamGraph) -> SlamGraph:
    """Return what `without_unused_frames` does."""
    frames, of_frames = _used(len(graph.frame_keys), graph.point_frames)
    landmarks, of_landmarks = _used(len(graph.landmark_ids), graph.point_landmarks, graph.condensed_landmarks)
    return replace(
        graph,
        frame_keys=graph.frame_keys[frames],
        frame_offsets=graph.frame_offsets[frames],
        point_frames=of_frames[graph.point_frames],
        point_landmarks=of_landmarks[graph.point_landmarks],
        condensed_landmarks=of_landmarks[graph.condensed_landmarks],
        landmark_ids=graph.landmark_ids[landmarks],
        landmarks=graph.landmarks[landmarks],
    )


def _used(num: int, *rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return which of `num` rows any of these name, and what each of those is called among them."""
    used = np.zeros(num, dtype=np.bool_)
    for column in rows:
        used[column] = True
    return np.flatnonzero(used), np.cumsum(used) - 1


def _linked(graph: SlamGraph) -> BoolArray:
    """Return (k,) whether a key comes after another of the same robot."""
    return np.asarray((graph.parents >= 0) & (graph.robots[graph.parents] == graph.robots))


def _condensed(graph: SlamGraph, fresh: BoolArray, camera: FloatArray, options: SmoothingOptions) -> SlamGraph:
    """Freeze what was measured from keys that are no longer fresh, but for what the smoothed path contradicts."""
    old = ~fresh[graph.frame_keys[graph.point_frames]]
    seen = _linearised(graph, camera, options)
    if options.kernel and (lost := old & (seen.squares > CONTRADICTION * options.kernel)).any():
        graph = replace(graph, **{name: getattr(graph, name)[~lost] for name in Points._fields})
        seen = _linearised(graph, camera, options)
    frozen = seen.condensed | ~fresh[seen.keys]
    keep = fresh[graph.frame_keys[graph.point_frames]]
    return replace(
        graph,
        **{name: getattr(graph, name)[keep] for name in Points._fields},
        condensed_keys=seen.keys[frozen],
        condensed_landmarks=seen.landmarks[frozen],
        linearisation_points=seen.linearisation_points[frozen],
        information=seen.information[frozen],
        gradients=seen.gradients[frozen],
        counts=seen.counts[frozen],
    )


def _linearised(graph: SlamGraph, camera: FloatArray, options: SmoothingOptions) -> LandmarkFactors:
    """Return all that was measured as forms, linearised where the graph's poses and landmarks are."""
    seen = gathered(graph)
    linearise(seen, graph, graph.poses, graph.landmarks, camera, options)
    return seen


def _without_blind(graph: SlamGraph, fresh: BoolArray) -> SlamGraph:
    """Chain the odometry over keys from which nothing was measured; they lose their successors."""
    sighted = np.zeros(graph.num_keys, dtype=np.bool_)
    sighted[graph.condensed_keys] = True
    sighted[graph.frame_keys[graph.point_frames]] = True
    blind = ~sighted & ~fresh & _linked(graph)
    if not blind.any():
        return graph
    previous, motions, noises = graph.parents.copy(), graph.odometry.copy(), graph.odometry_covariances.copy()
    for key in np.flatnonzero(_linked(graph)):  # in the order of time
        before = previous[key]
        while blind[before]:
            motions[key], noises[key] = chained(motions[before], noises[before], motions[key], noises[key])
            before = previous[before]
        previous[key] = before
    return replace(graph, parents=previous, odometry=motions, odometry_covariances=noises)


def _representatives(
    graph: SlamGraph, cost: FloatArray, fresh: BoolArray, most_keys: int
) -> tuple[IntArray, FloatArray]:
    """Return (k,) the key that each stands rigidly to, itself or an earlier one, or `NONE`; and new slacks (k,)."""
    k = graph.num_keys
    representative = np.arange(k)
    following = np.full(k, NONE)
    linked = np.flatnonzero(_linked(graph))
    following[graph.parents[linked]] = linked  # a blind key was replaced by its successor, if it has one
    needed = np.ones(k, dtype=np.bool_)
    needed[linked] = following[graph.parents[linked]] == linked
    representative[~needed] = NONE
    surplus = int(needed.sum()) - most_keys
    slack, previous = graph.rigid_variances.copy(), graph.parents.copy()
    heap = [(cost[b] + slack[b] + slack[previous[b]], int(b)) for b in linked if needed[b] and not fresh[b]]
    heapq.heapify(heap)
    while surplus > 0 and heap:
        price, b = heapq.heappop(heap)
        a = int(previous[b])
        if representative[b] != b or price < cost[b] + slack[a] + slack[b]:
            if representative[b] == b:
                heapq.heappush(heap, (cost[b] + slack[a] + slack[b], b))
            continue
        representative[b] = a
        slack[a] += slack[b] + cost[b]
        after = int(following[b])
        following[a] = after
        if after >= 0:
            previous[after] = a
        surplus -= 1
    return representative, slack


def _joined(graph: SlamGraph, representative: IntArray) -> SlamGraph:
    """Move all that hangs on a key to the one it now stands rigidly to."""
    kept = representative == np.arange(len(representative))
    root = np.maximum(representative, 0)
    while (representative[root] != root).any():
        root = representative[root]
    offsets = between(graph.poses[root], graph.poses)
    offsets[kept] = 0.0
    number = np.cumsum(kept) - 1
    before = np.maximum(graph.parents, 0)
    turn = np.zeros((len(kept), 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = rotation(offsets[before, 2]), 1.0
    moved = _moved(graph, np.flatnonzero(~kept[graph.condensed_keys]), offsets)
    sightings = _combined(root[graph.condensed_keys], graph.condensed_landmarks, *moved, graph.counts)
    return replace(
        graph,
        robots=graph.robots[kept],
        poses=graph.poses[kept],
        parents=np.where(graph.parents >= 0, number[root[before]], NONE)[kept],
        odometry=compose(offsets[before], graph.odometry)[kept],
        odometry_covariances=(turn @ graph.odometry_covariances @ turn.transpose(0, 2, 1))[kept],
        bias_jacobians=graph.bias_jacobians[kept],
        transition_variances=graph.transition_variances[kept],
        rigid_variances=graph.rigid_variances[kept],
        frame_keys=number[root[graph.frame_keys]],
        condensed_keys=number[sightings[0]],
        condensed_landmarks=sightings[1],
        linearisation_points=sightings[2],
        information=sightings[3],
        gradients=sightings[4],
        counts=sightings[5],
        first_keys=number[graph.first_keys],
        last_keys=number[graph.last_keys],
    )


def _moved(graph: SlamGraph, rows: IntArray, offsets: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return centres, informations and slopes of the frozen sightings, `rows` of them moved by their keys' offsets."""
    centres, infos, slopes = graph.linearisation_points.copy(), graph.information.copy(), graph.gradients.copy()
    by = offsets[graph.condensed_keys[rows]]
    turn = np.zeros((len(by), 3, 3))
    turn[:, :2, :2], turn[:, 2, 2] = rotation(by[:, 2]), 1.0
    centres[rows] = np.einsum("nij,nj->ni", turn, centres[rows])
    centres[rows, :2] += by[:, :2]
    infos[rows] = (turn @ infos[rows][:, UNPACK_INDEX] @ turn.transpose(0, 2, 1))[:, *UPPER]
    slopes[rows] = np.einsum("nij,nj->ni", turn, slopes[rows])
    return centres, infos, slopes


def _combined(
    keys: IntArray, landmarks: IntArray, centres: FloatArray, infos: FloatArray, slopes: FloatArray, counts: IntArray
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray, IntArray]:
    """Add up the forms of each pair of key and landmark, about the centre of the first."""
    if not len(keys):
        return keys, landmarks, centres, infos, slopes, counts
    order = np.argsort(landmarks * (keys.max() + 1) + keys, kind="stable")  # which is nearly theirs already
    keys, landmarks = keys[order], landmarks[order]
    centres, infos, slopes, counts = centres[order], infos[order], slopes[order], counts[order]
    new = np.ones(len(keys), dtype=np.bool_)
    new[1:] = (keys[1:] != keys[:-1]) | (landmarks[1:] != landmarks[:-1])
    first, other = np.flatnonzero(new), np.flatnonzero(~new)
    shift = centres[first][np.cumsum(new)[other] - 1] - centres[other]
    slopes[other] -= np.einsum("nij,nj->ni", infos[other][:, UNPACK_INDEX], shift)
    return (
        keys[first], landmarks[first], centres[first], np.add.reduceat(infos, first), np.add.reduceat(slopes, first),
        np.add.reduceat(counts, first),
    )  # fmt: skip
