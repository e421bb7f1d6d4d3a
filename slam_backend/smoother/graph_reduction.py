"""Fewer key poses: what is known best of a path becomes rigid, so that a long run needs no more room than a short one.

Where the newest keys end, measurements are condensed once for all; where a robot waits, sooner. If there are still more
keys than allowed, those neighbours become one whose relative pose is known best: the second then stands rigidly to the
first, what was measured from it is moved there, and the odometry between them is spent.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, FloatArray
from slam_backend.smoother import _kernels
from slam_backend.smoother.graph import OF_FRAMES, OF_KEYS, OF_LANDMARKS, OF_POINTS, SlamGraph
from slam_backend.smoother.optimizer import LandmarkFactors, MapEstimate
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
        sightings: Of the graph, wherever they were linearised before they are here; None: they are gathered.
    """
    robots = len(graph.last_keys)
    share = max(1, options.recent_keys // robots)
    seen = LandmarkFactors.of(graph) if sightings is None else sightings
    graph, seen = _consistent(graph, seen, share, camera, options)
    k, n = graph.num_keys, len(seen.keys)
    raw, numbers = np.empty(k, dtype=np.bool_), np.empty(k, dtype=np.int64)
    keys = {name: getattr(graph, name).copy() for name in OF_KEYS}
    condensed_keys, condensed_landmarks, counts = (np.empty(n, dtype=np.int64) for _ in range(3))
    centres, infos, slopes = np.empty((n, 3)), np.empty((n, 6)), np.empty((n, 3))
    left, num = _kernels.reduce_keyframes(
        share, MAX_FRAMES, options.most_keys(robots), graph.frame_keys, seen.keys, seen.landmarks, seen.frozen,
        seen.centres, seen.infos, seen.slopes, seen.counts, raw, numbers, condensed_keys, condensed_landmarks, centres,
        infos,
        slopes, counts, *keys.values(),
    )  # fmt: skip
    fewer = {
        **{name: column[:left] for name, column in keys.items()},
        "frame_keys": numbers[graph.frame_keys],
        "condensed_keys": condensed_keys[:num],
        "condensed_landmarks": condensed_landmarks[:num],
        "linearisation_points": centres[:num],
        "information": infos[:num],
        "gradients": slopes[:num],
        "counts": counts[:num],
        "first_keys": numbers[graph.first_keys],
        "last_keys": numbers[graph.last_keys],
    }
    return _without_unused(graph, fewer, raw[graph.frame_keys[graph.point_frames]])


def relinearise(graph: SlamGraph, mode: MapEstimate, spreads: FloatArray | None = None) -> SlamGraph:
    """Return the graph with the poses and landmarks of the mode, and the spreads (k,) [m^2] of motions there."""
    spreads = graph.transition_variances if spreads is None else spreads
    return graph.with_columns(poses=mode.poses, landmarks=mode.landmarks, transition_variances=spreads)


def without_unused_frames(graph: SlamGraph) -> SlamGraph:
    """Return the graph without the frames from which, and the landmarks of which, nothing was measured."""
    return _without_unused(graph, {}, np.ones(len(graph.points), dtype=np.bool_))


def _without_unused(graph: SlamGraph, changed: dict[str, NDArray[Any]], kept: BoolArray) -> SlamGraph:
    """Return the graph with some columns replaced, without frames and landmarks that have no measurements left.

    Args:
        graph: As it was.
        changed: Columns by their names.
        kept: (n,) which of its raw measurements are left.
    """
    all_columns = graph.to_mapping() | changed
    frozen = all_columns["condensed_landmarks"].copy()
    columns = {name: all_columns[name].copy() for name in (*OF_POINTS, *OF_FRAMES, *OF_LANDMARKS)}
    points, frames, landmarks = _kernels.drop_unused(kept, frozen, *columns.values())
    used = {OF_POINTS: points, OF_FRAMES: frames, OF_LANDMARKS: landmarks}
    changed = changed | {name: columns[name][:num] for names, num in used.items() for name in names}
    return graph.with_columns(**changed | {"condensed_landmarks": frozen})


def _consistent(
    graph: SlamGraph, seen: LandmarkFactors, share: int, camera: FloatArray, options: SmoothingOptions
) -> tuple[SlamGraph, LandmarkFactors]:
    """Return the graph without old measurements that the smoothed path contradicts, and its sightings, linearised."""
    _linearise(seen, graph, camera, options)
    if options.kernel:
        lost = seen.squares > CONTRADICTION * options.kernel
        if lost.any() and (lost := lost & ~_is_raw(graph, share)).any():
            graph = graph.with_columns(**_of_points(graph, ~lost))
            seen = LandmarkFactors.of(graph)
            _linearise(seen, graph, camera, options)
    return graph, seen


def _is_raw(graph: SlamGraph, share: int) -> BoolArray:
    """Return which measurements (n,) stay raw where so many keys of a robot are fresh."""
    fresh, raw = np.empty(graph.num_keys, dtype=np.bool_), np.empty(graph.num_keys, dtype=np.bool_)
    _kernels.recent_key_mask(graph.robots, graph.frame_keys, share, MAX_FRAMES, fresh, raw)
    return raw[graph.frame_keys[graph.point_frames]]


def _linearise(seen: LandmarkFactors, graph: SlamGraph, camera: FloatArray, options: SmoothingOptions) -> None:
    """Linearise all that was measured where the graph's poses and landmarks are."""
    seen.linearise(graph, graph.poses, graph.landmarks, camera, options.noise_scale, options.kernel)


def _of_points(graph: SlamGraph, chosen: BoolArray) -> dict[str, np.ndarray]:
    """Return some of the raw measurements, by the names of their columns."""
    rows = np.flatnonzero(chosen)
    return {name: getattr(graph, name)[rows] for name in OF_POINTS}
