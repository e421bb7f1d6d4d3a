"""`extended`: a graph takes in what the robots did since; steps without measurements are chained away."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.errors import FloatArray, IntArray, bad_argument
from slam_backend.log_arrays import EXACT, LogArrays
from slam_backend.motion import OdometryModel
from slam_backend.smoothing import _kernels
from slam_backend.smoothing.graph import LEVER, OF_FRAMES, OF_KEYS, OF_LANDMARKS, OF_POINTS, PathGraph
from slam_backend.smoothing.guesses import Guesses

LEAST_NOISE = 1e-5  # [m, rad] of odometry in one step: where a part has none, as with no floors, nothing is singular
NO_COVARIANCES = np.empty((0, 6))
NO_COVARIANCES.setflags(write=False)  # as those of logs are
NO_GUESSES = Guesses.none()


class Places(NamedTuple):
    """Where a filter holds landmarks to be.

    Attributes:
        ids: (n,) int64, ascending.
        means: (n, 3) float64 [m], map frame.
    """

    ids: IntArray
    means: FloatArray


NO_PLACES = Places(np.empty(0, dtype=np.int64), np.empty((0, 3)))


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
    steps, most = sum(map(len, logs)), sum(len(log.ids) for log in logs)
    room = {OF_KEYS: steps, OF_FRAMES: steps, OF_POINTS: most, OF_LANDMARKS: most}
    columns = {name: _with_room(getattr(graph, name), more) for names, more in room.items() for name in names}
    keys, frames, points, tips, is_guided = _walked(graph, logs, motion, guesses, rigid_within, columns)
    new, held = slice(len(graph.points), points), NO_PLACES if places is None else places
    landmarks = _kernels.settle(
        graph.aliases, len(graph.landmarks), columns["point_landmarks"][new], columns["points"][new],
        columns["point_frames"][new], columns["poses"], columns["frame_keys"], columns["frame_offsets"], mount,
        is_guided and len(held.ids) > 0, graph.frozen_landmarks, graph.counts, graph.point_landmarks, held.ids,
        held.means, columns["landmark_ids"], columns["landmarks"],
    )  # fmt: skip
    latest = [int(log.steps[-1]) if len(log) else before for log, before in zip(logs, graph.latest, strict=True)]
    used = {OF_KEYS: keys, OF_FRAMES: frames, OF_POINTS: points, OF_LANDMARKS: landmarks}
    return graph.with_columns(
        **{name: columns[name][:num] for names, num in used.items() for name in names},
        tips=tips,
        latest=np.array(latest, dtype=np.int64),
    )


def _walked(
    graph: PathGraph, logs: Sequence[LogArrays], motion: OdometryModel, guesses: Sequence[Guesses] | None,
    rigid_within: float, columns: dict[str, NDArray[Any]],
) -> tuple[int, int, int, IntArray, bool]:  # fmt: skip
    """Walk through the robots' new steps: which of them become keys, and what was measured.

    Args:
        graph, logs, motion, guesses, rigid_within: As of `extended`.
        columns: Of the graph with room; those of keys, frames and measurements are written, with landmarks' names in
            place of their rows.

    Returns:
        How many keys, frames and measurements there are then, the newest key of each robot (K,), and whether each robot
        is supposed to be anywhere where it measured something.
    """
    tips, is_guided = graph.tips.copy(), guesses is not None
    written = [columns[name] for name in (*OF_KEYS, *OF_FRAMES, *OF_POINTS)]
    keys, frames, points = graph.num_keys, len(graph.frame_keys), len(graph.points)
    for robot, log in enumerate(logs):
        if EXACT in log.kinds.tolist():
            raise bad_argument("logs", "odometry", "a pose that was given as exact", "There is nothing to smooth.")
        variances = motion.variances(log.motions)
        if not motion.is_exact:
            variances = np.maximum(variances, LEAST_NOISE**2)
        guessed = NO_GUESSES if guesses is None else guesses[robot]
        covariances = NO_COVARIANCES if log.covariances is None else log.covariances
        keys, frames, points, is_own = _kernels.take_in(
            log.steps, log.kinds, log.motions, log.given, log.starts, log.points, log.ids, covariances, variances,
            *guessed, robot, rigid_within, LEVER, keys, frames, points, tips, *written,
        )  # fmt: skip
        is_guided = is_guided and is_own
    return keys, frames, points, tips, is_guided


def _with_room(column: NDArray[Any], extra: int) -> NDArray[Any]:
    """Return a copy of a column (n, ...) with so many more rows, yet to be written."""
    longer = np.empty((len(column) + extra, *column.shape[1:]), dtype=column.dtype)
    longer[: len(column)] = column
    return longer


def first_rows(log: LogArrays, count: int) -> LogArrays:
    """Return the first `count` steps of a log, all if it has no more; the arrays are views."""
    if count >= len(log):
        return log
    end = int(log.starts[count])
    return LogArrays(
        steps=log.steps[:count], kinds=log.kinds[:count], motions=log.motions[:count], given=log.given[:count],
        starts=log.starts[: count + 1], points=log.points[:end], ids=log.ids[:end],
        covariances=None if log.covariances is None else log.covariances[:end],
    )  # fmt: skip
