"""Graph reduction: joining of keyframes with well-known relative poses, to bound the size of the graph.

Measurements of keys that are no longer recent are condensed into frozen sightings, and earlier where a robot waits. If
too many keys remain, neighbours with the smallest variance of their relative pose are joined: the second is attached
rigidly to the first, its measurements move there, and of the odometry between them only what it says about the bias is
kept, in the prior of the bias.
"""

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import NONE, Keys, LandmarkFactors, Points
from slam_backend.smoother.graph import SlamGraph, mapped
from slam_backend.smoother.optimizer import MapEstimate, gathered, linearise
from slam_backend.smoother.options import SmoothingOptions, keyframe_limit

MAX_FRAMES = 100  # frames of a recent key with raw measurements: a robot that waits adds frames to the same key
CONTRADICTION = 2.0  # factor on the kernel's squared distance: measurements beyond it are dropped


def reduce_keyframes(
    graph: SlamGraph, camera: FloatArray, options: SmoothingOptions, sightings: LandmarkFactors | None = None,
    most_keys: int | None = None,
) -> SlamGraph:  # fmt: skip
    """Return the graph with old keys condensed and at most `most_keys` keys, if the recent ones allow.

    The measurements of a recent key stay raw unless it has more than `MAX_FRAMES` frames. Old keys without measurements
    are dropped if they have a successor; the odometry is chained over them. Landmarks and frames without measurements
    are dropped as well.

    Args:
        graph: Graph at its MAP estimate, with the transition variances there; see `relinearise`.
        camera: (7,) focal length, baseline, sigma_px, sigma_disparity, mount.
        options: Limits on all keys and on recent keys of all robots together.
        sightings: Sightings of the graph, which are linearised again; None: gathered here.
        most_keys: Limit on all keys; None: that of the options.
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
    if most_keys is None:
        most_keys = keyframe_limit(options, len(graph.landmark_ids), graph.latest)
    left, roots, numbers, offsets = _kernels.merge_keys(
        fresh, sighted, most_keys + graph.num_biases, keys, graph.biases_of_odometry()
    )
    frozen = _kernels.add_sightings(rows, seen, roots, numbers, offsets)
    fewer = graph.with_columns(
        **{name: column[:left] for name, column in keys._asdict().items()},
        **frozen._asdict(),
        bias_keys=np.where(graph.bias_keys >= 0, numbers[graph.bias_keys], NONE),
        **{name: numbers[getattr(graph, name)] for name in ("frame_keys", "first_keys", "last_keys")},
    )
    return _without_unused(fewer, raw[graph.frame_keys[graph.point_frames]])


def relinearise(graph: SlamGraph, mode: MapEstimate, variances: FloatArray | None = None) -> SlamGraph:
    """Return the graph with the poses and landmarks of the mode, and the transition variances (k,) [m^2] there."""
    variances = graph.transition_variances if variances is None else variances
    return graph.with_columns(poses=mode.poses, landmarks=mode.landmarks, transition_variances=variances)


def without_unused_frames(graph: SlamGraph) -> SlamGraph:
    """Return the graph without frames and landmarks that have no measurements."""
    return _without_unused(graph, np.ones(len(graph.points), dtype=np.bool_))


def _without_unused(graph: SlamGraph, kept: BoolArray) -> SlamGraph:
    """Return the graph with the raw measurements of the mask `kept` (n,), without unused frames and landmarks."""
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
    """Return the mask (num,) of rows in any of these indices, and the new index (num,) of each used row."""
    used = np.zeros(num, dtype=np.bool_)
    for indices in rows:
        used[indices] = True
    return used, np.cumsum(used) - 1


def _consistent(
    graph: SlamGraph, seen: LandmarkFactors, raw: BoolArray, camera: FloatArray, options: SmoothingOptions
) -> tuple[SlamGraph, LandmarkFactors]:
    """Return the graph without old measurements that the smoothed path contradicts, and its sightings, linearised.

    Args:
        graph, seen: Graph and its sightings.
        raw: (k,) bool. Mask of the keys whose measurements stay raw.
        camera, options: See `reduce_keyframes`.
    """
    poses, landmarks = graph.poses.copy(), graph.landmarks.copy()  # writable arrays, as in a descent
    linearise(seen, graph, poses, landmarks, camera, options)
    if options.kernel:
        lost = seen.squares > CONTRADICTION * options.kernel
        if lost.any() and (lost := lost & ~raw[graph.frame_keys[graph.point_frames]]).any():
            kept = np.flatnonzero(~lost)
            graph = graph.with_columns(**mapped(graph.part(Points), lambda column: column[kept])._asdict())
            seen = gathered(graph)
            linearise(seen, graph, poses, landmarks, camera, options)
    return graph, seen
