"""`PathGraph`: key poses of all robots, the odometry between them, and what was measured there. It never changes."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np

from slam_backend.errors import BoolArray, FloatArray, IntArray, bad_argument
from slam_backend.geometry import between, compose, rotation, wrap_angle
from slam_backend.log_arrays import EXACT, ODOMETRY, REJECTED, LogArrays
from slam_backend.motion import OdometryModel

NONE = -1
VAGUE = (1e4, 1e4, 10.0)  # variances [m^2, m^2, rad^2] of a start of which nothing is known
LEVER = 3.0  # [m]; where an error of the heading between two keys is felt
RIGID = 1e-4  # [m, rad]; starts that scatter less against each other do not move


def _empty(*shape: int) -> FloatArray:
    return np.zeros(shape)


def _no_index() -> IntArray:
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False, kw_only=True)
class PathGraph:
    """What a smoother knows of a run.

    A *key* is a pose that is sought. A *frame* is where measurements were taken: it stands rigidly to its key. Raw
    measurements of the newest keys are kept; those of older keys are condensed into frozen sightings.

    Attributes:
        robots: (k,) int64. Whose pose each key is, `NONE` for the origin; keys of a robot are in the order of time.
        poses: (k, 3) float64 [m, m, rad], map frame. The last mode.
        previous: (k,) int64. The key before, `NONE` where the pose is given: the origin, or a robot's start. A start
            that is not known hangs on the origin, or on another robot's start.
        motions: (k, 3) float64 [m, m, rad]. Odometry from the previous key, in its frame.
        noises: (k, 3, 3) float64. Its covariance, likewise.
        spreads: (k,) float64 [m^2]. How far the motion from the previous key scattered when paths were last drawn, or
            as far as odometry says before that; see `LEVER`.
        slack: (k,) float64 [m^2]. How much those poses may move against each other that stand rigidly to the key.
        frame_keys, frame_offsets: (f,) int64, (f, 3) float64. Key of each frame, and the frame's pose seen from it.
        points, point_noises, given: (n, 3), (n, 6), (n,) raw measurements, robot axes from the camera centre; their
            covariances where the sensor gave them.
        point_frames, point_landmarks: (n,) int64. Frame of each, and its row of `landmark_ids`.
        frozen_keys, frozen_landmarks: (s,) int64. Of the frozen sightings.
        centres, infos, slopes: (s, 3), (s, 6), (s, 3) float64. Their quadratic forms, see `_kernels`.
        counts: (s,) int64. Measurements in each.
        landmark_ids: (l,) int64. Names of the landmarks.
        landmarks: (l, 3) float64 [m], map frame. The last mode.
        aliases: (a, 2) int64. Rows (name, name it goes by): landmarks found to be one.
        heads: (K,) int64. Key at the start of each robot.
        tips: (K,) int64. Newest key of each robot.
        latest: (K,) int64. Newest step of each robot's log that is taken in, -1 before the first.
    """

    robots: IntArray = field(default_factory=_no_index)
    poses: FloatArray = field(default_factory=lambda: _empty(0, 3))
    previous: IntArray = field(default_factory=_no_index)
    motions: FloatArray = field(default_factory=lambda: _empty(0, 3))
    noises: FloatArray = field(default_factory=lambda: _empty(0, 3, 3))
    spreads: FloatArray = field(default_factory=lambda: _empty(0))
    slack: FloatArray = field(default_factory=lambda: _empty(0))
    frame_keys: IntArray = field(default_factory=_no_index)
    frame_offsets: FloatArray = field(default_factory=lambda: _empty(0, 3))
    points: FloatArray = field(default_factory=lambda: _empty(0, 3))
    point_noises: FloatArray = field(default_factory=lambda: _empty(0, 6))
    given: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    point_frames: IntArray = field(default_factory=_no_index)
    point_landmarks: IntArray = field(default_factory=_no_index)
    frozen_keys: IntArray = field(default_factory=_no_index)
    frozen_landmarks: IntArray = field(default_factory=_no_index)
    centres: FloatArray = field(default_factory=lambda: _empty(0, 3))
    infos: FloatArray = field(default_factory=lambda: _empty(0, 6))
    slopes: FloatArray = field(default_factory=lambda: _empty(0, 3))
    counts: IntArray = field(default_factory=_no_index)
    landmark_ids: IntArray = field(default_factory=_no_index)
    landmarks: FloatArray = field(default_factory=lambda: _empty(0, 3))
    aliases: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    heads: IntArray
    tips: IntArray
    latest: IntArray

    def __post_init__(self) -> None:
        for name in self.__dataclass_fields__:
            getattr(self, name).setflags(write=False)

    @classmethod
    def at_starts(cls, starts: FloatArray) -> "PathGraph":
        """Return the graph of K robots that stand at `starts` (K, 3), map frame, and have seen nothing."""
        return cls.at_uncertain_starts(np.asarray(starts, dtype=np.float64)[:, :, None])

    @classmethod
    def at_uncertain_starts(cls, starts: FloatArray) -> "PathGraph":
        """Return the graph of K robots whose starts (K, 3, M) particles may hold to be different, as after a merge.

        A start on which all particles agree is given. Another is sought: nothing but measurements shall say where it
        is, for what particles think of it stems from these. Where two robots' starts do not change against each other,
        the second hangs on the first.
        """
        k = len(starts)
        loose = [i for i in range(k) if (starts[i] != starts[i, :, :1]).any()]
        poses, previous, motions, noises = list(starts[:, :, 0]), [NONE] * k, [np.zeros(3)] * k, [np.zeros((3, 3))] * k
        for place, i in enumerate(loose):
            poses[i] = mean_pose(starts[i])
            previous[i], motions[i], noises[i] = k, poses[i], np.diag(VAGUE)
            for other in loose[:place]:
                apart = between(starts[other].T, starts[i].T)
                if np.abs(_turned(apart - apart[0])).max() < RIGID:
                    previous[i], motions[i], noises[i] = other, apart[0], RIGID**2 * np.eye(3)
                    break
        extra = 1 if loose else 0
        robots = np.concatenate([np.arange(k), np.full(extra, NONE)])
        return cls(
            robots=robots,
            poses=np.array([*poses, *np.zeros((extra, 3))]),
            previous=np.array([*previous, *[NONE] * extra], dtype=np.int64),
            motions=np.array([*motions, *np.zeros((extra, 3))]),
            noises=np.array([*noises, *np.zeros((extra, 3, 3))]),
            spreads=np.zeros(k + extra),
            slack=np.zeros(k + extra),
            heads=np.arange(k),
            tips=np.arange(k),
            latest=np.full(k, -1),
        )

    def reordered(self, order: IntArray) -> "PathGraph":
        """Return the graph in which robot i is the one that was `order[i]`; (K,) a permutation."""
        robots = self.robots.copy()
        robots[self.robots >= 0] = np.argsort(order)[self.robots[self.robots >= 0]]
        return replace(self, robots=robots, heads=self.heads[order], tips=self.tips[order], latest=self.latest[order])

    def known_as(self, ids: IntArray) -> IntArray:
        """Return the names by which landmarks go."""
        result = ids.copy()
        for old, new in self.aliases:  # in the order in which they were found
            result[result == old] = new
        return result

    def to_mapping(self) -> dict[str, Any]:
        """Return all arrays by name; they cannot be written."""
        return {name: getattr(self, name) for name in self.__dataclass_fields__}

    @property
    def linked(self) -> BoolArray:
        """(k,) whether a key comes after another of the same robot."""
        return np.asarray((self.previous >= 0) & (self.robots[self.previous] == self.robots))

    @property
    def num_keys(self) -> int:
        """Key poses, the starts included."""
        return len(self.poses)

    @property
    def num_sightings(self) -> int:
        """Frozen sightings, and raw measurements that may become some: what the effort of a rejuvenation grows with."""
        return len(self.frozen_keys) + len(self.points)

    @property
    def nbytes(self) -> int:
        """Bytes of all arrays."""
        return sum(getattr(self, name).nbytes for name in self.__dataclass_fields__)


class _Part(NamedTuple):
    """One robot's new keys, frames and measurements; keys and frames are counted from 0, `NONE` is the old tip."""

    poses: FloatArray
    motions: FloatArray
    noises: FloatArray
    frame_keys: IntArray
    rows: IntArray  # of the log's measurements that are taken
    frames: IntArray  # of these


def extended(
    graph: PathGraph,
    logs: Sequence[LogArrays],
    motion: OdometryModel,
    mount: FloatArray,
    guesses: Sequence[Mapping[int, FloatArray]] | None = None,
) -> PathGraph:
    """Return the graph with what the robots did since.

    Each step that measured something, and each robot's last, becomes a key. Odometry over steps without measurements is
    chained, and its noise to first order: those poses are eliminated, not approximated.

    Args:
        graph: As it stood.
        logs: Per robot, of the steps after `graph.latest`.
        motion: Noise of the odometry.
        mount: (3,) [m] of the camera on the robot.
        guesses: Per robot where it may be after some of these steps (3,), map frame; else odometry says.

    Raises:
        ValueError: If a log holds a pose that was given as exact: there is nothing to smooth.
    """
    parts = [_part(graph, i, log, motion, {} if guesses is None else guesses[i]) for i, log in enumerate(logs)]
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
    at = poses[frame_keys_now[new_frames]]  # a new frame is a key itself
    first_seen = np.column_stack([points[:, :2] + mount[:2], points[:, 2] + mount[2]])
    first_seen[:, :2] = at[:, :2] + np.einsum("nij,nj->ni", rotation(at[:, 2]), first_seen[:, :2])
    landmark_ids, landmarks, rows = _with_new(graph, ids, first_seen)
    return replace(
        graph,
        robots=np.concatenate([graph.robots, *(np.full(len(part.poses), i) for i, part in enumerate(parts))]),
        poses=poses,
        previous=np.concatenate(previous),
        motions=np.concatenate([graph.motions, *(part.motions for part in parts)]),
        noises=np.concatenate([graph.noises, *(part.noises for part in parts)]),
        spreads=np.concatenate([graph.spreads, *(scatter(part.noises) for part in parts)]),
        slack=np.concatenate([graph.slack, *(np.zeros(len(part.poses)) for part in parts)]),
        frame_keys=frame_keys_now,
        frame_offsets=np.concatenate([graph.frame_offsets, np.zeros((len(frame_keys_now) - len(graph.frame_keys), 3))]),
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


def scatter(noises: FloatArray) -> FloatArray:
    """Return the mean squares (n,) [m^2] by which motions of covariances (n, 3, 3) scatter, headings at `LEVER`."""
    return np.asarray(noises[:, 0, 0] + noises[:, 1, 1] + LEVER**2 * noises[:, 2, 2])


def _given(log: LogArrays, part: _Part) -> BoolArray:
    return np.repeat(log.given, np.diff(log.starts))[part.rows]


def _noises(log: LogArrays, part: _Part) -> FloatArray:
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
    graph: PathGraph, robot: int, log: LogArrays, motion: OdometryModel, guesses: Mapping[int, FloatArray]
) -> _Part:
    """Walk through a robot's new steps."""
    tip = graph.tips[robot]
    pose = graph.poses[tip]
    poses, motions, noises = [], [], []
    frame_keys: list[int] = []
    rows: list[IntArray] = []
    frames: list[IntArray] = []
    chain, noise, moved = np.zeros(3), np.zeros((3, 3)), False
    for t in range(len(log)):
        if log.kinds[t] == EXACT:
            raise bad_argument("logs", "odometry", "a pose that was given as exact", "There is nothing to smooth.")
        if log.kinds[t] == ODOMETRY:
            step, step_noise = log.motions[t], np.diag(motion.sigmas(log.motions[t]) ** 2)
            chain, noise = chained(chain, noise, step, step_noise) if moved else (step, step_noise)
            pose = compose(pose, step)
            moved = True
        pose = guesses.get(int(log.steps[t]), pose)
        taken = log.starts[t] + np.flatnonzero(log.ids[log.starts[t] : log.starts[t + 1]] != REJECTED)
        if moved and (len(taken) or t == len(log) - 1):
            poses.append(pose)
            motions.append(chain)
            noises.append(noise)
            chain, noise, moved = np.zeros(3), np.zeros((3, 3)), False
        if len(taken):
            rows.append(taken)
            frames.append(np.full(len(taken), len(frame_keys)))
            frame_keys.append(len(poses) - 1)  # NONE: it has not moved from the old tip
    return _Part(
        np.array(poses).reshape(-1, 3), np.array(motions).reshape(-1, 3), np.array(noises).reshape(-1, 3, 3),
        np.array(frame_keys, dtype=np.int64),
        np.concatenate(rows) if rows else _no_index(), np.concatenate(frames) if frames else _no_index(),
    )  # fmt: skip


def chained(
    chain: FloatArray, noise: FloatArray, move: FloatArray, move_noise: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return a motion followed by another, and its covariance, to first order."""
    by_first, by_second = np.eye(3), np.eye(3)
    by_second[:2, :2] = rotation(chain[2])
    by_first[:2, 2] = by_second[:2, :2] @ [-move[1], move[0]]
    joint = by_first @ noise @ by_first.T + by_second @ move_noise @ by_second.T
    return compose(chain, move), joint


def mean_pose(poses: FloatArray) -> FloatArray:
    """Return the mean (3,) of poses (3, n) [m, m, rad], headings by their mean direction."""
    x, y, headings = poses
    return np.array([x.mean(), y.mean(), np.arctan2(np.sin(headings).mean(), np.cos(headings).mean())])


def _turned(poses: FloatArray) -> FloatArray:
    """Return differences of poses (n, 3) with headings in [-pi, pi)."""
    return np.column_stack([poses[:, :2], wrap_angle(poses[:, 2])])


def first_rows(log: LogArrays, count: int) -> LogArrays:
    """Return the first steps of a log; the arrays are views."""
    end = int(log.starts[min(count, len(log))])
    return LogArrays(
        steps=log.steps[:count], kinds=log.kinds[:count], motions=log.motions[:count], given=log.given[:count],
        starts=log.starts[: count + 1], points=log.points[:end], ids=log.ids[:end],
        covariances=None if log.covariances is None else log.covariances[:end],
        descriptor_rows=None if log.descriptor_rows is None else log.descriptor_rows[:end],
    )  # fmt: skip
