"""Fewer key poses: what is known best of a path becomes rigid, so that a long run needs no more room than a short one.

Where the newest keys end, measurements are condensed once for all; where a robot waits, sooner. If there are still more
keys than allowed, those neighbours become one whose relative pose is known best: the second then stands rigidly to the
first, what was measured from it is moved there, and the odometry between them is spent.
"""

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import Keys, LandmarkFactors, Points
from slam_backend.smoother.graph import SlamGraph, mapped
from slam_backend.smoother.optimizer import MapEstimate, gathered, linearise
from slam_backend.smoother.options import SmoothingOptions

MAX_FRAMES = 100  # of a fresh key whose measurements stay raw: a robot that waits takes frames without end
CONTRADICTION = 2.0  # times the kernel's squared distance: measurements farther off are dropped for good


def reduce_keyframes(
    graph: SlamGraph, camera: FloatArray, options: SmoothingOptions, sightings: LandmarkFactors | None = None
) -> SlamGraph:
    """Return the graph with old keys condensed and at most `most_keys` of them, if the fresh ones allow.

    A fresh key's measurements stay raw unless more than `MAX_FRAMES` frames stand to it. Odometry is chained over old
    keys from which nothing was measured; they go if they have a successor. Landmarks and frames that nothing is left of
    go as well.

    Args:
        graph: At its mode, with what is known there of its spreads; see `relinearise`.
        camera: As in `optimize`.
        options: How many keys, and how many of them fresh, of all robots together.
        sightings: Sightings of the graph, which are linearised again; None: they are gathered.
    """
    seen = gathered(graph) if sightings is None else sightings
    share = max(1, options.recent_keys // len(graph.last_keys))
    fresh = np.zeros(graph.num_keys, dtype=np.bool_)
    for robot in range(len(graph.last_keys)):
        fresh[np.flatnonzero(graph.robots == robot)[-share:]] = True
    raw = fresh & (np.bincount(graph.frame_keys, minlength=graph.num_keys) <= MAX_FRAMES)
    graph, seen = _consistent(graph, seen, raw, camera, options)
    rows, sighted = np.flatnonzero(seen.condensed | ~raw[seen.keys]), np.zeros(graph.num_keys, dtype=np.bool_)
    sighted[seen.keys[rows]] = True
    keys = mapped(graph.part(Keys), np.copy)
    left, roots, numbers, offsets = _kernels.merge_keys(fresh, sighted, options.most_keys(len(graph.last_keys)), keys)
    frozen = _kernels.add_sightings(rows, seen, roots, numbers, offsets)
    fewer = graph.with_columns(
        **{name: column[:left] for name, column in keys._asdict().items()},
        **frozen._asdict(),
        **{name: numbers[getattr(graph, name)] for name in ("frame_keys", "first_keys", "last_keys")},
    )
    return _without_unused(fewer, raw[graph.frame_keys[graph.point_frames]])


def relinearise(graph: SlamGraph, mode: MapEstimate, spreads: FloatArray | None = None) -> SlamGraph:
    """Return the graph with the poses and landmarks of the mode, and the spreads (k,) [m^2] of motions there."""
    spreads = graph.transition_variances if spreads is None else spreads
    return graph.with_columns(poses=mode.poses, landmarks=mode.landmarks, transition_variances=spreads)


def without_unused_frames(graph: SlamGraph) -> SlamGraph:
    """Return the graph without the frames from which, and the landmarks of which, nothing was measured."""
    return _without_unused(graph, np.ones(len(graph.points), dtype=np.bool_))


def _without_unused(graph: SlamGraph, kept: BoolArray) -> SlamGraph:
    """Return the graph with the raw measurements that are `kept` (n,), and with what anything is left of."""
    raw = mapped(graph.part(Points), lambda column: column[kept])
    frames, frame_rows = _used(len(graph.frame_keys), raw.point_frames)
    landmarks, landmark_rows = _used(len(graph.landmark_ids), raw.point_landmarks, graph.condensed_landmarks)
    raw = raw._replace(point_frames=frame_rows[raw.point_frames], point_landmarks=landmark_rows[raw.point_landmarks])
    return graph.with_columns(
        **raw._asdict(),
        frame_keys=graph.frame_keys[frames],
        frame_offsets=graph.frame_offsets[frames],
        condensed_landmarks=landmark_rows[graph.condensed_landmarks],
        landmark_ids=graph.landmark_ids[landmarks],
        landmarks=graph.landmarks[landmarks],
    )


def _used(num: int, *rows: IntArray) -> tuple[BoolArray, IntArray]:
    """Return which of `num` rows (num,) any of these name, and the number of each among them (num,)."""
    used = np.zeros(num, dtype=np.bool_)
    for named in rows:
        used[named] = True
    return used, np.cumsum(used) - 1


def _consistent(
    graph: SlamGraph, seen: LandmarkFactors, raw: BoolArray, camera: FloatArray, options: SmoothingOptions
) -> tuple[SlamGraph, LandmarkFactors]:
    """Return the graph without old measurements that the smoothed path contradicts, and its sightings, linearised.

    Args:
        graph, seen: The graph, and its sightings.
        raw: (k,) whether measurements from a key stay raw.
        camera, options: See `reduce_keyframes`.
    """
    poses, landmarks = graph.poses.copy(), graph.landmarks.copy()  # arrays that can be written, as in a descent
    linearise(seen, graph, poses, landmarks, camera, options)
    if options.kernel:
        lost = seen.squares > CONTRADICTION * options.kernel
        if lost.any() and (lost := lost & ~raw[graph.frame_keys[graph.point_frames]]).any():
            kept = np.flatnonzero(~lost)
            graph = graph.with_columns(**mapped(graph.part(Points), lambda column: column[kept])._asdict())
            seen = gathered(graph)
            linearise(seen, graph, poses, landmarks, camera, options)
    return graph, seen
