"""Fewer key poses: what is known best of a path becomes rigid, so that a long run needs no more room than a short one.

Where the newest keys end, measurements are condensed once for all; where a robot waits, sooner. If there are still more
keys than allowed, those neighbours become one whose relative pose is known best: the second then stands rigidly to the
first, what was measured from it is moved there, and the odometry between them is spent.
"""

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray
from slam_backend.smoothing import _kernels
from slam_backend.smoothing.graph import PathGraph
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.smoothing.sightings import Sightings
from slam_backend.smoothing.solving import Mode

MOST_FRAMES = 100  # of a fresh key whose measurements stay raw: a robot that waits takes frames without end
CONTRADICTION = 2.0  # times the kernel's squared distance: measurements farther off are dropped for good
OF_POINTS = ("points", "point_noises", "given", "point_frames", "point_landmarks")


def coarsened(graph: PathGraph, camera: FloatArray, options: SmoothingOptions) -> PathGraph:
    """Return the graph with old keys condensed and at most `most_keys` of them, if the fresh ones allow.

    A fresh key's measurements stay raw unless more than `MOST_FRAMES` frames stand to it. Odometry is chained over old
    keys from which nothing was measured; they go if they have a successor. Landmarks and frames that nothing is left of
    go as well.

    Args:
        graph: At its mode, with what is known there of its spreads; see `at_mode`.
        camera: As in `find_mode`.
        options: How many keys, and how many of them fresh, of all robots together.
    """
    fresh = _fresh(graph, options)
    raw = fresh & (np.bincount(graph.frame_keys, minlength=graph.num_keys) <= MOST_FRAMES)
    graph, seen = _consistent(graph, raw, camera, options)
    rows = np.flatnonzero(seen.frozen | ~raw[seen.keys])  # what is frozen from now on
    k, sighted = graph.num_keys, np.zeros(graph.num_keys, dtype=np.bool_)
    sighted[seen.keys[rows]] = True
    previous, motions, noises = graph.previous.copy(), graph.motions.copy(), graph.noises.copy()
    slack, roots, numbers = graph.slack.copy(), np.empty(k, dtype=np.int64), np.empty(k, dtype=np.int64)
    offsets = np.empty((k, 3))
    _kernels.join_keys(
        graph.robots, graph.poses, graph.linked, previous, motions, noises, graph.spreads, slack, fresh, sighted,
        options.most_keys(len(graph.tips)), roots, numbers, offsets,
    )  # fmt: skip
    kept, n = np.flatnonzero(numbers >= 0), len(rows)
    frozen_keys, frozen_landmarks, counts = (np.empty(n, dtype=np.int64) for _ in range(3))
    centres, infos, slopes = np.empty((n, 3)), np.empty((n, 6)), np.empty((n, 3))
    num = _kernels.add_sightings(
        rows, seen.keys, seen.landmarks, seen.centres, seen.infos, seen.slopes, seen.counts, roots, offsets,
        frozen_keys, frozen_landmarks, centres, infos, slopes, counts,
    )  # fmt: skip
    fewer = graph.with_columns(
        robots=graph.robots[kept],
        poses=graph.poses[kept],
        previous=previous[kept],
        motions=motions[kept],
        noises=noises[kept],
        spreads=graph.spreads[kept],
        slack=slack[kept],
        frame_keys=numbers[graph.frame_keys],
        **_of_points(graph, raw[graph.frame_keys[graph.point_frames]]),
        frozen_keys=numbers[frozen_keys[:num]],
        frozen_landmarks=frozen_landmarks[:num],
        centres=centres[:num],
        infos=infos[:num],
        slopes=slopes[:num],
        counts=counts[:num],
        heads=numbers[graph.heads],
        tips=numbers[graph.tips],
    )
    return compacted(fewer)


def at_mode(graph: PathGraph, mode: Mode, spreads: FloatArray | None = None) -> PathGraph:
    """Return the graph with the poses and landmarks of the mode, and the spreads (k,) [m^2] of motions there."""
    spreads = graph.spreads if spreads is None else spreads
    return graph.with_columns(poses=mode.poses, landmarks=mode.landmarks, spreads=spreads)


def compacted(graph: PathGraph) -> PathGraph:
    """Return the graph without the frames from which, and the landmarks of which, nothing was measured."""
    frames, of_frames = _used(len(graph.frame_keys), graph.point_frames)
    landmarks, of_landmarks = _used(len(graph.landmark_ids), graph.point_landmarks, graph.frozen_landmarks)
    return graph.with_columns(
        frame_keys=graph.frame_keys[frames],
        frame_offsets=graph.frame_offsets[frames],
        point_frames=of_frames[graph.point_frames],
        point_landmarks=of_landmarks[graph.point_landmarks],
        frozen_landmarks=of_landmarks[graph.frozen_landmarks],
        landmark_ids=graph.landmark_ids[landmarks],
        landmarks=graph.landmarks[landmarks],
    )


def _fresh(graph: PathGraph, options: SmoothingOptions) -> BoolArray:
    """Return (k,) which keys are each robot's newest."""
    share = max(1, options.fresh_keys // len(graph.tips))
    fresh = np.zeros(graph.num_keys, dtype=np.bool_)
    for robot in range(len(graph.tips)):
        fresh[np.flatnonzero(graph.robots == robot)[-share:]] = True
    return fresh


def _consistent(
    graph: PathGraph, raw: BoolArray, camera: FloatArray, options: SmoothingOptions
) -> tuple[PathGraph, Sightings]:
    """Return the graph without old measurements that the smoothed path contradicts, and its sightings, linearised."""
    seen = _linearised(graph, camera, options)
    if options.kernel:
        lost = seen.squares > CONTRADICTION * options.kernel
        if lost.any() and (lost := lost & ~raw[graph.frame_keys[graph.point_frames]]).any():
            graph = graph.with_columns(**_of_points(graph, ~lost))
            seen = _linearised(graph, camera, options)
    return graph, seen


def _linearised(graph: PathGraph, camera: FloatArray, options: SmoothingOptions) -> Sightings:
    """Return all that was measured as forms, linearised where the graph's poses and landmarks are."""
    seen = Sightings.of(graph)
    seen.linearise(graph, graph.poses, graph.landmarks, camera, options.noise_scale, options.kernel)
    return seen


def _of_points(graph: PathGraph, chosen: BoolArray) -> dict[str, np.ndarray]:
    """Return some of the raw measurements, by the names of their columns."""
    rows = np.flatnonzero(chosen)
    return {name: getattr(graph, name)[rows] for name in OF_POINTS}


def _used(num: int, *rows: IntArray) -> tuple[IntArray, IntArray]:
    """Return which of `num` rows any of these name, and what each of those is called among them."""
    used = np.zeros(num, dtype=np.bool_)
    for column in rows:
        used[column] = True
    return np.flatnonzero(used), np.cumsum(used) - 1
