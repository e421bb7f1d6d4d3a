"""Construction of the pose-landmark graph: new keyframes from logs, and joint graphs of merged groups."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error
from slam_backend.geometry import between, compose, cosine_sine, rotation
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother import _kernels
from slam_backend.smoother._kernels import BIAS, Condensed, Frames, Keys, Landmarks, Log, Points
from slam_backend.smoother.graph import NONE, RIGID, UNINFORMATIVE, Part, SlamGraph, mapped
from slam_backend.smoother.log_arrays import EXACT, LogArrays
from slam_backend.state import FLOAT64, INT64, MAX_DISTANCE, Array, with_state


@with_state(steps=Array(INT64, "n", ascending=True), poses=Array(FLOAT64, "n 3", -MAX_DISTANCE, MAX_DISTANCE))
class InitialPoses(NamedTuple):
    """Poses of a robot after some steps.

    Attributes:
        steps: (n,) int64, ascending.
        poses: (n, 3) float64 [m, m, rad], map frame.
    """

    steps: IntArray
    poses: FloatArray

    @classmethod
    def empty(cls) -> "InitialPoses":
        """Return no poses."""
        return cls(np.empty(0, dtype=np.int64), np.empty((0, 3)))

    def with_later(self, steps: IntArray, poses: FloatArray) -> "InitialPoses":
        """Return these poses and those of later steps (m,), (m, 3)."""
        return InitialPoses(np.concatenate([self.steps, steps]), np.concatenate([self.poses, poses]))

    def after(self, step: int) -> "InitialPoses":
        """Return the poses after the steps later than `step`, as views."""
        first = self.steps.searchsorted(step, side="right")
        return InitialPoses(self.steps[first:], self.poses[first:])

    def at(self, steps: IntArray) -> FloatArray:
        """Return the poses (m, 3) after steps (m,), ascending; NaN where unknown."""
        poses = np.full((len(steps), 3), np.nan)
        _, rows, known = np.intersect1d(steps, self.steps, assume_unique=True, return_indices=True)
        poses[rows] = self.poses[known]
        return poses


MIN_NOISE = 1e-5  # [m, rad] of odometry in one step; keeps covariances regular if one component has no noise
NO_COVARIANCES = np.empty((0, 6))
NO_COVARIANCES.setflags(write=False)  # same type as the covariances of logs
NO_JACOBIANS, NO_BIAS = np.empty((0, 3, 3)), np.zeros(3)
NO_INITIAL_POSES = InitialPoses.empty()


class LandmarkPositions(NamedTuple):
    """Landmark positions estimated by a filter.

    Attributes:
        ids: (n,) int64, ascending.
        means: (n, 3) float64 [m], map frame.
    """

    ids: IntArray
    means: FloatArray


NO_LANDMARK_POSITIONS = LandmarkPositions(np.empty(0, dtype=np.int64), np.empty((0, 3)))


def extend_graph(
    graph: SlamGraph,
    logs: Sequence[LogArrays],
    motion: OdometryModel,
    mount: FloatArray,
    initial_poses: Sequence[InitialPoses] | None = None,
    rigid_within: float = 0.0,
    places: LandmarkPositions | None = None,
) -> SlamGraph:
    """Return the graph extended by the robots' new steps.

    Each step with measurements, and each robot's last step, becomes a key, unless it can be attached rigidly to the
    previous key. Odometry over steps without measurements is chained, with its noise to first order: those poses are
    eliminated, not approximated.

    Args:
        graph: Graph before these steps.
        logs: One log per robot, with the steps after `graph.latest`.
        motion: Noise of the odometry.
        mount: (3,) [m]. Position of the camera on the robot.
        initial_poses: Initial poses of each robot after some of these steps; all others come from odometry.
        rigid_within: Limit [m], see `SmoothingOptions`.
        places: Landmark positions from the filter, the initial estimates of landmarks with mostly new sightings: if a
            first sighting is an outlier, a robust kernel would reject the later ones instead. None, or with initial
            poses from odometry: the last estimates, or the first sightings.

    Raises:
        ValueError: If a log holds an exact pose.
    """
    steps, most = sum(map(len, logs)), sum(len(log.ids) for log in logs)
    keys, frames = _with_room(graph.part(Keys), steps), _with_room(graph.part(Frames), steps)
    raw = _with_room(graph.part(Points), most)
    tips, ends = graph.last_keys.copy(), np.array([graph.num_keys, len(graph.frame_keys), len(graph.points)])
    is_guided = initial_poses is not None
    for robot, log in enumerate(logs):
        if EXACT in log.kinds.tolist():
            raise argument_error("logs", "odometry", "a pose that was given as exact", "There is nothing to smooth.")
        variances = motion.variances(log.motions)
        if not motion.is_noiseless:
            variances = np.maximum(variances, MIN_NOISE**2)
        covariances = NO_COVARIANCES if log.covariances is None else log.covariances
        bias = int(graph.bias_keys[robot])
        jacobians = motion.bias_jacobians(log.motions) if bias >= 0 else NO_JACOBIANS
        arrays = Log(
            log.steps, log.kinds, log.motions, log.given, log.starts, log.points, log.ids, covariances, variances,
            jacobians, graph.poses[bias].copy() if bias >= 0 else NO_BIAS,
        )  # fmt: skip
        initial = NO_INITIAL_POSES if initial_poses is None else initial_poses[robot]
        is_guided &= _kernels.add_keyframes(arrays, initial, robot, rigid_within, tips, ends, keys, frames, raw)
    num_keys, num_frames, num_points = ends.tolist()
    held = places if is_guided and places is not None else NO_LANDMARK_POSITIONS
    landmarks = number_landmarks(
        graph.merged_ids, mapped(raw, lambda column: column[len(graph.points) : num_points]), graph.point_landmarks,
        graph.part(Condensed), graph.part(Landmarks), held, frames, keys.poses, mount,
    )  # fmt: skip
    latest = [int(log.steps[-1]) if len(log) else before for log, before in zip(logs, graph.latest, strict=True)]
    parts = ((keys, num_keys), (frames, num_frames), (raw, num_points), (landmarks, None))
    columns = {name: column[:num] for part, num in parts for name, column in part._asdict().items()}
    return graph.with_columns(**columns, last_keys=tips, latest=np.array(latest, dtype=np.int64))


def number_landmarks(
    aliases: IntArray, new: Points, old_landmarks: IntArray, frozen: Condensed, known: Landmarks,
    held: LandmarkPositions, frames: Frames, poses: FloatArray, mount: FloatArray,
) -> Landmarks:  # fmt: skip
    """Number the landmarks of new measurements, and return all landmarks.

    A new landmark is placed where it was first measured. A landmark that has more new measurements than old ones is
    placed where the filter holds it to be.

    Args:
        aliases: (a, 2) rows (name, name it goes by), applied in order.
        new: New measurements; `point_landmarks` holds the names of their landmarks, and is overwritten by rows.
        old_landmarks: (n,) landmark of each old raw measurement.
        frozen: Frozen sightings.
        known: Landmarks so far.
        held: Landmark positions of the filter.
        frames: Frames of the measurements.
        poses: (k, 3) of the keys, map frame.
        mount: (3,) [m] of the camera on the robot.
    """
    names, ids, landmarks = new.point_landmarks, known.landmark_ids, known.landmarks
    for name, other in aliases:
        names[names == name] = other
    row_of = {name: row for row, name in enumerate(ids.tolist())}
    first = []
    for n, name in enumerate(names.tolist()):
        if name not in row_of:
            row_of[name] = len(row_of)
            first.append(n)
    if first:
        frame, points = new.point_frames[first], new.points[first] + mount
        at = compose(poses[frames.frame_keys[frame]], frames.frame_offsets[frame])
        cos, sin = cosine_sine(at[:, 2])
        x, y = at[:, 0] + cos * points[:, 0] - sin * points[:, 1], at[:, 1] + sin * points[:, 0] + cos * points[:, 1]
        ids = np.concatenate([ids, names[first]])
        landmarks = np.concatenate([landmarks, np.column_stack([x, y, points[:, 2]])])
    names[:] = [row_of[name] for name in names.tolist()]
    if len(held.ids):
        old = np.bincount(frozen.condensed_landmarks, frozen.counts, len(ids))
        old += np.bincount(old_landmarks, minlength=len(ids))
        place = np.minimum(np.searchsorted(held.ids, ids), len(held.ids) - 1)
        moved = (np.bincount(names, minlength=len(ids)) > old) & (held.ids[place] == ids)
        landmarks = np.where(moved[:, None], held.means[place], landmarks)
    return Landmarks(ids, landmarks)


def _with_room(part: Part, extra: int) -> Part:
    """Return copies of columns (n, ...) with `extra` uninitialised rows."""

    def longer(column: NDArray[Any]) -> NDArray[Any]:
        result = np.empty((len(column) + extra, *column.shape[1:]), column.dtype)
        result[: len(column)] = column
        return result

    return mapped(part, longer)


def log_head(log: LogArrays, count: int) -> LogArrays:
    """Return the first `count` steps of a log, or all if it is shorter; the arrays are views."""
    if count >= len(log):
        return log
    end = int(log.starts[count])
    return LogArrays(
        steps=log.steps[:count], kinds=log.kinds[:count], motions=log.motions[:count], given=log.given[:count],
        starts=log.starts[: count + 1], points=log.points[:end], ids=log.ids[:end],
        covariances=None if log.covariances is None else log.covariances[:end],
    )  # fmt: skip


FIXES = 3  # common landmarks above which measurements alone determine the relative pose of two groups


def merge_graphs(
    a: SlamGraph, b: SlamGraph, motion: FloatArray, renamed: IntArray, uncertainty: FloatArray | None = None
) -> SlamGraph:
    """Return the joint graph of two groups in a's frame, with a's robots first.

    Measurements and odometry are relative to keys and do not change. Keys and landmarks of b are moved. Fixed starts of
    b become unknowns: the first has a vague prior about its moved pose, the others are linked rigidly to it. Common
    landmarks thus determine the relative pose of the groups. With fewer than `FIXES` of them the motion does, with its
    uncertainty.

    Args:
        a: Graph whose frame, robots and landmark ids stay.
        b: Graph of the other group.
        motion: (3,) [m, m, rad]. Motion from b's frame to a's, the initial estimate of the next descent.
        renamed: (n, 2) int64 rows (id in b, id in the joint map), each id in b once. Other landmarks of b are dropped.
        uncertainty: (3, 3) covariance of the start of b's first robot [m, m, rad], a's frame. None: unknown.
    """
    names = dict(zip(renamed[:, 0].tolist(), a.resolve_ids(renamed[:, 1]).tolist(), strict=True))
    b = _named(_moved(b, motion), names)
    fixed = uncertainty is None or len(np.intersect1d(a.landmark_ids, b.landmark_ids)) >= FIXES
    loose, b = _unpinned(b, np.diag(UNINFORMATIVE) if fixed else np.asarray(uncertainty))
    origin = np.flatnonzero(a.robots == NONE)
    if not len(origin):
        a, origin = _with_origin(a), np.array([a.num_keys])
    keys, frames = a.num_keys, len(a.frame_keys)
    previous = np.where(b.parents >= 0, b.parents + keys, NONE)
    previous[loose] = previous[b.robots == BIAS] = origin[0]
    ids, rows = np.unique(np.concatenate([a.landmark_ids, b.landmark_ids]), return_inverse=True)
    landmarks = np.empty((len(ids), 3))
    of_b = rows[len(a.landmark_ids) :]
    landmarks[of_b], landmarks[rows[: len(a.landmark_ids)]] = b.landmarks, a.landmarks
    shifted = {
        "robots": np.where(b.robots >= 0, b.robots + len(a.last_keys), b.robots),
        "bias_keys": np.where(b.bias_keys >= 0, b.bias_keys + keys, NONE),
        "parents": previous,
        "frame_keys": b.frame_keys + keys,
        "point_frames": b.point_frames + frames,
        "point_landmarks": of_b[b.point_landmarks],
        "condensed_keys": b.condensed_keys + keys,
        "condensed_landmarks": of_b[b.condensed_landmarks],
        "first_keys": b.first_keys + keys,
        "last_keys": b.last_keys + keys,
    }
    both = {
        name: np.concatenate([getattr(a, name), shifted.get(name, getattr(b, name))])
        for name in a.__dataclass_fields__
        if name not in ("landmark_ids", "landmarks")
    }
    for name in ("point_landmarks", "condensed_landmarks"):
        size_a = len(getattr(a, name))
        both[name][:size_a] = rows[: len(a.landmark_ids)][both[name][:size_a]]
    return SlamGraph(**both, landmark_ids=ids, landmarks=landmarks)


def _moved(graph: SlamGraph, motion: FloatArray) -> SlamGraph:
    """Return the graph with poses and landmarks moved to another frame; links from the origin are unchanged."""
    landmarks = graph.landmarks.copy()
    landmarks[:, :2] = landmarks[:, :2] @ rotation(motion[2]).T + motion[:2]
    poses = compose(motion, graph.poses)
    poses[graph.robots == BIAS] = graph.poses[graph.robots == BIAS]
    return graph.with_columns(poses=poses, landmarks=landmarks)


def _named(graph: SlamGraph, names: Mapping[int, int]) -> SlamGraph:
    """Return the graph with new landmark ids; landmarks without one are dropped with their measurements."""
    new = np.array([names.get(name, NONE) for name in graph.landmark_ids.tolist()], dtype=np.int64)
    kept = new >= 0
    row = np.cumsum(kept) - 1
    aliases = [(names[old], names[by]) for old, by in graph.merged_ids.tolist() if old in names and by in names]
    return graph.with_columns(
        **_rows(graph.part(Points), kept[graph.point_landmarks], row),
        **_rows(graph.part(Condensed), kept[graph.condensed_landmarks], row),
        landmark_ids=new[kept],
        landmarks=graph.landmarks[kept],
        merged_ids=np.array(aliases, dtype=np.int64).reshape(-1, 2),
    )


def _rows(part: Points | Condensed, kept: BoolArray, row: IntArray) -> dict[str, Any]:
    """Return some rows of columns by name; landmarks are renumbered by `row`."""
    columns = {name: column[kept] for name, column in part._asdict().items()}
    return columns | {name: row[column] for name, column in columns.items() if name.endswith("_landmarks")}


def _unpinned(graph: SlamGraph, prior: FloatArray) -> tuple[IntArray, SlamGraph]:
    """Return the starts (n,) without a parent in the group, and the graph without an origin and without fixed poses.

    These starts get the prior covariance (3, 3) about their poses.
    """
    origin = np.flatnonzero(graph.robots == NONE)
    given = np.flatnonzero((graph.parents == NONE) & (graph.robots >= 0))
    loose = np.flatnonzero(np.isin(graph.parents, origin) & (graph.robots >= 0))
    previous, motions, noises = graph.parents.copy(), graph.odometry.copy(), graph.odometry_covariances.copy()
    free = np.concatenate([given[:1], loose]).astype(np.int64)
    previous[given], motions[given], noises[given] = given[:1], 0.0, RIGID**2 * np.eye(3)
    if len(given):
        motions[given] = between(graph.poses[given[0]], graph.poses[given])
    previous[free], motions[free], noises[free] = NONE, graph.poses[free], prior
    graph = graph.with_columns(parents=previous, odometry=motions, odometry_covariances=noises)
    if not len(origin):
        return free, graph
    kept = graph.robots != NONE
    previous[graph.robots == BIAS] = NONE
    number = np.cumsum(kept) - 1
    return number[free], graph.with_columns(
        **{name: getattr(graph, name)[kept] for name in Keys._fields if name != "parents"},
        bias_keys=np.where(graph.bias_keys >= 0, number[graph.bias_keys], NONE),
        parents=np.where(previous >= 0, number[previous], NONE)[kept],
        **{name: number[getattr(graph, name)] for name in ("frame_keys", "condensed_keys", "first_keys", "last_keys")},
    )


def _with_origin(graph: SlamGraph) -> SlamGraph:
    """Return the graph with a key at the origin of its frame."""
    return graph.with_columns(
        robots=np.append(graph.robots, NONE),
        poses=np.concatenate([graph.poses, np.zeros((1, 3))]),
        parents=np.append(graph.parents, NONE),
        odometry=np.concatenate([graph.odometry, np.zeros((1, 3))]),
        odometry_covariances=np.concatenate([graph.odometry_covariances, np.zeros((1, 3, 3))]),
        bias_jacobians=np.concatenate([graph.bias_jacobians, np.zeros((1, 3, 3))]),
        transition_variances=np.append(graph.transition_variances, 0.0),
        rigid_variances=np.append(graph.rigid_variances, 0.0),
    )
