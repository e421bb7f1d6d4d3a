"""Fewer key poses: what is known best of a path becomes rigid, so that a long run needs no more room than a short one.

Where the newest keys end, measurements are condensed once for all; where a robot waits, sooner. If there are still more
keys than allowed, those neighbours become one whose relative pose is known best: the second then stands rigidly to the
first, what was measured from it is moved there, and the odometry between them is spent.
"""

import numpy as np

from slam_backend.errors import BoolArray, FloatArray
from slam_backend.smoothing import _kernels
from slam_backend.smoothing.graph import OF_FRAMES, OF_KEYS, OF_LANDMARKS, OF_POINTS, PathGraph
from slam_backend.smoothing.options import SmoothingOptions
from slam_backend.smoothing.sightings import Sightings
from slam_backend.smoothing.solving import Mode

MOST_FRAMES = 100  # of a fresh key whose measurements stay raw: a robot that waits takes frames without end
CONTRADICTION = 2.0  # times the kernel's squared distance: measurements farther off are dropped for good


def coarsened(
    graph: PathGraph, camera: FloatArray, options: SmoothingOptions, sightings: Sightings | None = None
) -> PathGraph:
    """Return the graph with old keys condensed and at most `most_keys` of them, if the fresh ones allow.

    A fresh key's measurements stay raw unless more than `MOST_FRAMES` frames stand to it. Odometry is chained over old
    keys from which nothing was measured; they go if they have a successor. Landmarks and frames that nothing is left of
    go as well.

    Args:
        graph: At its mode, with what is known there of its spreads; see `at_mode`.
        camera: As in `find_mode`.
        options: How many keys, and how many of them fresh, of all robots together.
        sightings: Of the graph, wherever they were linearised before they are here; None: they are gathered.
    """
    k, robots = graph.num_keys, len(graph.tips)
    fresh, raw, sighted = (np.empty(k, dtype=np.bool_) for _ in range(3))
    share = max(1, options.fresh_keys // robots)
    _kernels.look_at_keys(graph.robots, graph.frame_keys, share, MOST_FRAMES, fresh, raw)
    seen = Sightings.of(graph) if sightings is None else sightings
    graph, seen = _consistent(graph, seen, raw, camera, options)
    rows = np.empty(len(seen.keys), dtype=np.int64)
    rows = rows[: _kernels.to_freeze(seen.frozen, seen.keys, raw, rows, sighted)]
    keys = {name: getattr(graph, name).copy() for name in OF_KEYS}
    roots, numbers, offsets = np.empty(k, dtype=np.int64), np.empty(k, dtype=np.int64), np.empty((k, 3))
    left = _kernels.join_keys(fresh, sighted, options.most_keys(robots), roots, numbers, offsets, *keys.values())
    n = len(rows)
    frozen_keys, frozen_landmarks, counts = (np.empty(n, dtype=np.int64) for _ in range(3))
    centres, infos, slopes = np.empty((n, 3)), np.empty((n, 6)), np.empty((n, 3))
    num = _kernels.add_sightings(
        rows, seen.keys, seen.landmarks, seen.centres, seen.infos, seen.slopes, seen.counts, roots, numbers, offsets,
        frozen_keys, frozen_landmarks, centres, infos, slopes, counts,
    )  # fmt: skip
    fewer = graph.with_columns(
        **{name: column[:left] for name, column in keys.items()},
        frame_keys=numbers[graph.frame_keys],
        frozen_keys=frozen_keys[:num],
        frozen_landmarks=frozen_landmarks[:num],
        centres=centres[:num],
        infos=infos[:num],
        slopes=slopes[:num],
        counts=counts[:num],
        heads=numbers[graph.heads],
        tips=numbers[graph.tips],
    )
    return _without_unused(fewer, raw[graph.frame_keys[graph.point_frames]])


def at_mode(graph: PathGraph, mode: Mode, spreads: FloatArray | None = None) -> PathGraph:
    """Return the graph with the poses and landmarks of the mode, and the spreads (k,) [m^2] of motions there."""
    spreads = graph.spreads if spreads is None else spreads
    return graph.with_columns(poses=mode.poses, landmarks=mode.landmarks, spreads=spreads)


def compacted(graph: PathGraph) -> PathGraph:
    """Return the graph without the frames from which, and the landmarks of which, nothing was measured."""
    return _without_unused(graph, np.ones(len(graph.points), dtype=np.bool_))


def _without_unused(graph: PathGraph, kept: BoolArray) -> PathGraph:
    """Return the graph with some of its raw measurements (n,), and with what anything is left of; see `compacted`."""
    frozen = graph.frozen_landmarks.copy()
    columns = {name: getattr(graph, name).copy() for name in (*OF_POINTS, *OF_FRAMES, *OF_LANDMARKS)}
    points, frames, landmarks = _kernels.drop_unused(kept, frozen, *columns.values())
    return graph.with_columns(
        frozen_landmarks=frozen,
        **{name: columns[name][:points] for name in OF_POINTS},
        **{name: columns[name][:frames] for name in OF_FRAMES},
        **{name: columns[name][:landmarks] for name in OF_LANDMARKS},
    )


def _consistent(
    graph: PathGraph, seen: Sightings, raw: BoolArray, camera: FloatArray, options: SmoothingOptions
) -> tuple[PathGraph, Sightings]:
    """Return the graph without old measurements that the smoothed path contradicts, and its sightings, linearised."""
    _linearise(seen, graph, camera, options)
    if options.kernel:
        lost = seen.squares > CONTRADICTION * options.kernel
        if lost.any() and (lost := lost & ~raw[graph.frame_keys[graph.point_frames]]).any():
            graph = graph.with_columns(**_of_points(graph, ~lost))
            seen = Sightings.of(graph)
            _linearise(seen, graph, camera, options)
    return graph, seen


def _linearise(seen: Sightings, graph: PathGraph, camera: FloatArray, options: SmoothingOptions) -> None:
    """Linearise all that was measured where the graph's poses and landmarks are."""
    seen.linearise(graph, graph.poses, graph.landmarks, camera, options.noise_scale, options.kernel)


def _of_points(graph: PathGraph, chosen: BoolArray) -> dict[str, np.ndarray]:
    """Return some of the raw measurements, by the names of their columns."""
    rows = np.flatnonzero(chosen)
    return {name: getattr(graph, name)[rows] for name in OF_POINTS}
