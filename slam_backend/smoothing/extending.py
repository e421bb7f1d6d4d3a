"""`extended`: a graph takes in what the robots did since; steps without measurements are chained away."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument
from slam_backend.geometry import compose, rotation
from slam_backend.log_arrays import EXACT, LogArrays
from slam_backend.motion import OdometryModel
from slam_backend.smoothing._walking import choose, mostly_new, place, walk
from slam_backend.smoothing.graph import LEVER, PathGraph

LEAST_NOISE = 1e-5  # [m, rad] of odometry in one step: where a part has none, as with no floors, nothing is singular


class Places(NamedTuple):
    """Where a filter holds landmarks to be.

    Attributes:
        ids: (n,) int64, ascending.
        means: (n, 3) float64 [m], map frame.
    """

    ids: IntArray
    means: FloatArray


class _Part(NamedTuple):
    """One robot's new keys, frames and measurements; keys and frames are counted from 0, `NONE` is the old tip."""

    poses: FloatArray
    motions: FloatArray
    noises: FloatArray
    slack: FloatArray  # first of the old tip, then of the new keys
    frame_keys: IntArray
    offsets: FloatArray
    rows: IntArray  # of the log's measurements that are taken
    frames: IntArray  # of these


def extended(
    graph: PathGraph,
    logs: Sequence[LogArrays],
    motion: OdometryModel,
    mount: FloatArray,
    guesses: Sequence[Mapping[int, FloatArray]] | None = None,
    rigid_within: float = 0.0,
    places: Places | None = None,
) -> PathGraph:
    """Return the graph with what the robots did since.

    Each step that measured something, and each robot's last, becomes a key, unless it is near enough to the key before
    to stand rigidly to it. Odometry over steps without measurements is chained, and its noise to first order: those
    poses are eliminated, not approximated.

    Args:
        graph: As it stood.
        logs: Per robot, of the steps after `graph.latest`.
        motion: Noise of the odometry.
        mount: (3,) [m] of the camera on the robot.
        guesses: Per robot where it may be after some of these steps (3,), map frame; else odometry says.
        rigid_within: [m]. See `SmoothingOptions`.
        places: Where the filter holds landmarks to be: those start there of which most sightings are new, for their
            first one may lie far off, and a robust kernel would then hold against the others that they contradict it.
            None, or where poses start from odometry: where they were, or were first seen.

    Raises:
        ValueError: If a log holds a pose that was given as exact: there is nothing to smooth.
    """
    parts = [
        _part(graph, i, log, motion, rigid_within, {} if guesses is None else guesses[i]) for i, log in enumerate(logs)
    ]
    keys = np.cumsum([graph.num_keys, *(len(part.poses) for part in parts)])
    frames = np.cumsum([len(graph.frame_keys), *(len(part.frame_keys) for part in parts)])
    previous, frame_keys, tips = [graph.previous], [graph.frame_keys], graph.tips.copy()
    for i, part in enumerate(parts):
        n = len(part.poses)
        previous.append(np.where(np.arange(n) > 0, keys[i] + np.arange(n) - 1, graph.tips[i]))
        frame_keys.append(np.where(part.frame_keys < 0, graph.tips[i], part.frame_keys + keys[i]))
        tips[i] = keys[i] + n - 1 if n else graph.tips[i]
    poses = np.concatenate([graph.poses, *(part.poses for part in parts)])
    new_frames = np.concatenate([part.frames + frames[i] for i, part in enumerate(parts)])
    frame_keys_now = np.concatenate(frame_keys)
    points = np.concatenate([log.points[part.rows] for log, part in zip(logs, parts, strict=True)])
    ids = graph.known_as(np.concatenate([log.ids[part.rows] for log, part in zip(logs, parts, strict=True)]))
    offsets = np.concatenate([graph.frame_offsets, *(part.offsets for part in parts)])
    first_seen = np.empty((len(points), 3))
    place(poses, frame_keys_now, offsets, new_frames, points, mount, first_seen)
    slack = np.concatenate([graph.slack, *(part.slack[1:] for part in parts)])
    slack[graph.tips] = np.maximum(slack[graph.tips], [part.slack[0] for part in parts])
    landmark_ids, landmarks, rows = _with_new(graph, ids, first_seen)
    if places is not None and len(places.ids) and guesses is not None and all(map(_guided, logs, guesses)):
        landmarks = _started(graph, landmark_ids, landmarks, rows, places)
    return graph.with_columns(
        robots=np.concatenate([graph.robots, *(np.full(len(part.poses), i) for i, part in enumerate(parts))]),
        poses=poses,
        previous=np.concatenate(previous),
        motions=np.concatenate([graph.motions, *(part.motions for part in parts)]),
        noises=np.concatenate([graph.noises, *(part.noises for part in parts)]),
        spreads=np.concatenate([graph.spreads, *(scatter(part.noises) for part in parts)]),
        slack=slack,
        frame_keys=frame_keys_now,
        frame_offsets=offsets,
        points=np.concatenate([graph.points, points]),
        point_noises=np.concatenate([graph.point_noises, *map(_noises, logs, parts)]),
        given=np.concatenate([graph.given, *map(_given, logs, parts)]),
        point_frames=np.concatenate([graph.point_frames, new_frames]),
        point_landmarks=np.concatenate([graph.point_landmarks, rows]),
        landmark_ids=landmark_ids,
        landmarks=landmarks,
        tips=tips,
        latest=np.array([log.steps[-1] if len(log) else graph.latest[i] for i, log in enumerate(logs)], dtype=np.int64),
    )  # fmt: skip


def _guided(log: LogArrays, guesses: Mapping[int, FloatArray]) -> bool:
    """Return whether there is a guess for the first step that measured something, and so for all."""
    measured = np.flatnonzero(np.diff(log.starts))
    return not len(measured) or int(log.steps[measured[0]]) in guesses


def _started(graph: PathGraph, ids: IntArray, landmarks: FloatArray, rows: IntArray, places: Places) -> FloatArray:
    """Return the landmarks (l, 3), of which those start where the filter has them that are mostly seen anew.

    Args:
        graph: As it stood.
        ids: (l,) int64. Names of all landmarks, the graph's first.
        landmarks: (l, 3) float64 [m], map frame.
        rows: (n,) int64. Of the new measurements among `ids`.
        places: Of the filter; at least one.
    """
    at = np.minimum(places.ids.searchsorted(ids), len(places.ids) - 1)
    anew = mostly_new(graph.frozen_landmarks, graph.counts, graph.point_landmarks, rows, len(ids))
    return np.where((anew & (places.ids[at] == ids))[:, None], places.means[at], landmarks)


def scatter(noises: FloatArray) -> FloatArray:
    """Return the mean squares (n,) [m^2] by which motions of covariances (n, 3, 3) scatter, headings at `LEVER`."""
    return np.asarray(noises[:, 0, 0] + noises[:, 1, 1] + LEVER**2 * noises[:, 2, 2])


def _given(log: LogArrays, part: _Part) -> BoolArray:
    """Return (n,) whether the sensor gave the covariances of the measurements taken."""
    if not log.given.any():
        return np.zeros(len(part.rows), dtype=np.bool_)
    return np.repeat(log.given, np.diff(log.starts))[part.rows]


def _noises(log: LogArrays, part: _Part) -> FloatArray:
    """Return these covariances (n, 6) [m^2], robot axes; zeros where none were given."""
    return np.zeros((len(part.rows), 6)) if log.covariances is None else log.covariances[part.rows]


def _with_new(graph: PathGraph, ids: IntArray, seen: FloatArray) -> tuple[IntArray, FloatArray, IntArray]:
    """Return landmark ids and means with the new ones appended, each where it was first seen, and rows of `ids`."""
    old = len(graph.landmark_ids)
    values, first, inverse = np.unique(
        np.concatenate([graph.landmark_ids, ids]), return_index=True, return_inverse=True
    )
    order = np.argsort(first)  # old landmarks keep their rows
    row = np.empty(len(order), dtype=np.int64)
    row[order] = np.arange(len(order))
    new = np.sort(first)[old:] - old
    return values[order], np.concatenate([graph.landmarks, seen[new]]), row[inverse[old:]]


def _part(
    graph: PathGraph,
    robot: int,
    log: LogArrays,
    motion: OdometryModel,
    rigid_within: float,
    guesses: Mapping[int, FloatArray],
) -> _Part:
    """Walk through a robot's new steps."""
    if (log.kinds == EXACT).any():
        raise bad_argument("logs", "odometry", "a pose that was given as exact", "There is nothing to smooth.")
    n = len(log)
    where = [guesses.get(step) for step in log.steps.tolist()] if guesses else [None] * n
    guessed = np.array([pose is not None for pose in where], dtype=np.bool_)
    variances = motion.variances(log.motions)
    if not motion.is_exact:
        variances = np.maximum(variances, LEAST_NOISE**2)
    supposed = np.zeros((n, 3))
    if guessed.any():
        supposed[guessed] = [pose for pose in where if pose is not None]
    counts, rows, of_rows = np.empty(n, dtype=np.int64), np.empty_like(log.ids), np.empty_like(log.ids)
    taken = choose(log.ids, log.starts, counts, rows, of_rows)
    poses, motions, offsets = np.empty((n, 3)), np.empty((n, 3)), np.empty((n, 3))
    noises, slack, frame_keys = np.empty((n, 3, 3)), np.empty(n + 1), np.empty(n, dtype=np.int64)
    keys, frames = walk(
        log.kinds, log.motions, variances, counts, guessed, supposed,
        graph.poses[graph.tips[robot]], rigid_within, LEVER, poses, motions, noises, slack, frame_keys, offsets,
    )  # fmt: skip
    return _Part(
        poses=poses[:keys],
        motions=motions[:keys],
        noises=noises[:keys],
        slack=slack[: keys + 1],
        frame_keys=frame_keys[:frames],
        offsets=offsets[:frames],
        rows=rows[:taken],
        frames=of_rows[:taken],
    )


def chained(
    chain: FloatArray, noise: FloatArray, move: FloatArray, move_noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a motion followed by another, and its covariance, to first order.

    Args:
        chain: (3,) the first motion [m, m, rad].
        noise: (3, 3) its covariance, in the frame in which it begins.
        move: (3,) the second motion, in the frame to which the first one led.
        move_noise: (3, 3) its covariance, likewise.

    Returns:
        (3,) and (3, 3), in the frame in which the first begins.
    """
    by_first, by_second = np.eye(3), np.eye(3)
    by_second[:2, :2] = rotation(chain[2])
    by_first[:2, 2] = by_second[:2, :2] @ [-move[1], move[0]]
    joint = by_first @ noise @ by_first.T + by_second @ move_noise @ by_second.T
    return compose(chain, move), joint


def first_rows(log: LogArrays, count: int) -> LogArrays:
    """Return the first `count` steps of a log, all if it has no more; the arrays are views."""
    end = int(log.starts[min(count, len(log))])
    return LogArrays(
        steps=log.steps[:count], kinds=log.kinds[:count], motions=log.motions[:count], given=log.given[:count],
        starts=log.starts[: count + 1], points=log.points[:end], ids=log.ids[:end],
        covariances=None if log.covariances is None else log.covariances[:end],
        descriptor_rows=None if log.descriptor_rows is None else log.descriptor_rows[:end],
    )  # fmt: skip
