"""`extended`: a graph takes in what the robots did since; steps without measurements are chained away."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument
from slam_backend.geometry import compose, rotation
from slam_backend.log_arrays import EXACT, LogArrays
from slam_backend.motion import OdometryModel
from slam_backend.smoothing._walking import choose, place, start_anew, walk
from slam_backend.smoothing.graph import LEVER, OF_FRAMES, OF_KEYS, PathGraph
from slam_backend.smoothing.guesses import Guesses

LEAST_NOISE = 1e-5  # [m, rad] of odometry in one step: where a part has none, as with no floors, nothing is singular


class Places(NamedTuple):
    """Where a filter holds landmarks to be.

    Attributes:
        ids: (n,) int64, ascending.
        means: (n, 3) float64 [m], map frame.
    """

    ids: IntArray
    means: FloatArray


class _Measured(NamedTuple):
    """New measurements: names of their landmarks (n,), points (n, 3), frames (n,); rows (m,) in each robot's log."""

    names: IntArray
    points: FloatArray
    frames: IntArray
    rows: list[IntArray]


def extended(
    graph: PathGraph,
    logs: Sequence[LogArrays],
    motion: OdometryModel,
    mount: FloatArray,
    guesses: Sequence[Guesses] | None = None,
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
        guesses: Per robot where it may be after some of these steps; else odometry says.
        rigid_within: [m]. See `SmoothingOptions`.
        places: Where the filter holds landmarks to be: those start there of which most sightings are new, for their
            first one may lie far off, and a robust kernel would then hold against the others that they contradict it.
            None, or where poses start from odometry: where they were, or were first seen.

    Raises:
        ValueError: If a log holds a pose that was given as exact: there is nothing to smooth.
    """
    columns, new = _walked(graph, logs, motion, _supposed(logs, guesses), rigid_within)
    landmark_ids, rows, first = _numbered(graph.landmark_ids, graph.known_as(new.names))
    first_seen = np.empty((len(first), 3))
    place(
        columns["poses"], columns["frame_keys"], columns["frame_offsets"], new.frames[first], new.points[first], mount,
        first_seen,
    )  # fmt: skip
    landmarks = np.concatenate([graph.landmarks, first_seen])
    if places is not None and len(places.ids) and guesses is not None and all(map(_guided, logs, guesses)):
        start_anew(
            graph.frozen_landmarks, graph.counts, graph.point_landmarks, rows, landmark_ids, places.ids, places.means,
            landmarks,
        )  # fmt: skip
    latest = [log.steps[-1] if len(log) else before for log, before in zip(logs, graph.latest, strict=True)]
    return graph.with_columns(
        **columns,
        points=np.concatenate([graph.points, new.points]),
        point_noises=np.concatenate([graph.point_noises, *map(_noises, logs, new.rows)]),
        given=np.concatenate([graph.given, *map(_given, logs, new.rows)]),
        point_frames=np.concatenate([graph.point_frames, new.frames]),
        point_landmarks=np.concatenate([graph.point_landmarks, rows]),
        landmark_ids=landmark_ids,
        landmarks=landmarks,
        latest=np.array(latest, dtype=np.int64),
    )


def _walked(
    graph: PathGraph, logs: Sequence[LogArrays], motion: OdometryModel, guesses: FloatArray, rigid_within: float
) -> tuple[dict[str, NDArray[Any]], _Measured]:
    """Walk through the robots' new steps: the graph's columns of keys and frames with the new ones, what was measured.

    Args:
        graph, logs, motion, rigid_within: As of `extended`.
        guesses: (T, 3) of `_supposed`.
    """
    steps, most = len(guesses), sum(len(log.ids) for log in logs)
    columns = {name: _with_room(getattr(graph, name), steps) for name in (*OF_KEYS, *OF_FRAMES)}
    tips, counts, points = graph.tips.copy(), np.empty(steps, dtype=np.int64), np.empty((most, 3))
    names, rows, frames = (np.empty(most, dtype=np.int64) for _ in range(3))
    variances = motion.variances(np.concatenate([log.motions for log in logs]))
    if not motion.is_exact:
        variances = np.maximum(variances, LEAST_NOISE**2)
    num_keys, num_frames, ends, first = graph.num_keys, len(graph.frame_keys), [0], 0
    for robot, log in enumerate(logs):
        if (log.kinds == EXACT).any():
            raise bad_argument("logs", "odometry", "a pose that was given as exact", "There is nothing to smooth.")
        own = slice(first, first := first + len(log))
        end = choose(log.ids, log.points, log.starts, ends[-1], num_frames, names, points, rows, frames, counts[own])
        num_keys, num_frames = walk(
            log.kinds, log.motions, variances[own], counts[own], guesses[own], robot, rigid_within, LEVER, num_keys,
            num_frames, tips, *columns.values(),
        )  # fmt: skip
        ends.append(end)
    used = {name: columns[name][:num_keys] for name in OF_KEYS}
    used |= {name: columns[name][:num_frames] for name in OF_FRAMES}
    of_robots = [rows[start:end] for start, end in pairwise(ends)]
    return used | {"tips": tips}, _Measured(names[: ends[-1]], points[: ends[-1]], frames[: ends[-1]], of_robots)


def _supposed(logs: Sequence[LogArrays], guesses: Sequence[Guesses] | None) -> FloatArray:
    """Return (T, 3) [m, m, rad] where robots are thought to be after the steps of all logs; NaN: nobody says."""
    if guesses is None:
        return np.full((sum(map(len, logs)), 3), np.nan)
    return np.concatenate([guessed.at(log.steps) for log, guessed in zip(logs, guesses, strict=True)])


def _with_room(column: NDArray[Any], extra: int) -> NDArray[Any]:
    """Return a copy of a column (n, ...) with so many more rows, yet to be written."""
    longer = np.empty((len(column) + extra, *column.shape[1:]), dtype=column.dtype)
    longer[: len(column)] = column
    return longer


def _guided(log: LogArrays, guesses: Guesses) -> bool:
    """Return whether there is a guess for the first step that measured something, and so for all."""
    t = int(log.starts.searchsorted(0, side="right")) - 1
    return t == len(log) or bool((guesses.steps == log.steps[t]).any())


def _given(log: LogArrays, rows: IntArray) -> BoolArray:
    """Return (n,) whether the sensor gave the covariances of these measurements."""
    if not log.given.any():
        return np.zeros(len(rows), dtype=np.bool_)
    return np.repeat(log.given, np.diff(log.starts))[rows]


def _noises(log: LogArrays, rows: IntArray) -> FloatArray:
    """Return these covariances (n, 6) [m^2], robot axes; zeros where none were given."""
    return np.zeros((len(rows), 6)) if log.covariances is None else log.covariances[rows]


def _numbered(known: IntArray, names: IntArray) -> tuple[IntArray, IntArray, list[int]]:
    """Return all names, known ones (l,) first, the row of each of `names` (n,), and which of these were new."""
    row_of = {name: row for row, name in enumerate(known.tolist())}
    new, rows = [], []
    for n, name in enumerate(names.tolist()):
        if name not in row_of:
            row_of[name] = len(row_of)
            new.append(n)
        rows.append(row_of[name])
    return np.concatenate([known, names[new]]), np.array(rows, dtype=np.int64), new


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
