"""Pose-landmark graph of all robots: keyframes, odometry between them, and measurements."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from slam_backend.core.read_only import as_read_only
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.geometry import between, wrap_angle
from slam_backend.models.odometry import OdometryModel
from slam_backend.smoother._kernels import BIAS, Condensed, Frames, Keys, Landmarks, Points
from slam_backend.smoother._kernels import LEVER as LEVER
from slam_backend.smoother._kernels import NONE as NONE
from slam_backend.state import (
    BOOL,
    FLOAT64,
    INT64,
    LARGEST,
    MAX_DISTANCE,
    MAX_LANDMARKS,
    Array,
    Sizes,
    State,
)

UNINFORMATIVE = (1e4, 1e4, 10.0)  # variances [m^2, m^2, rad^2] of an unknown start
MIN_BIAS = 1e-6  # standard deviation [m/m, rad/m, rad/rad] of a part of the bias that is said to be none
RIGID = 1e-4  # [m, rad]; starts with a smaller relative scatter are rigidly connected

NO_BIASES: IntArray = np.zeros(0, dtype=np.int64)

Part = TypeVar("Part", Keys, Frames, Points, Condensed, Landmarks)  # columns of a graph that go together, row by row


def mapped(part: Part, act: Callable[[Any], Any]) -> Part:
    """Return a part with `act` applied to each column."""
    return type(part)(*map(act, part))


def _empty(*shape: int) -> FloatArray:
    """Return a new array of zeros."""
    return np.zeros(shape)


def _no_index() -> IntArray:
    """Return a new empty index."""
    return np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, eq=False, kw_only=True)
class SlamGraph:
    """Immutable pose-landmark graph.

    A *key* (keyframe) is a pose that is an unknown of the graph. A *frame* is a pose with measurements, attached
    rigidly to its key. Raw measurements of the newest keys are kept; those of older keys are condensed into frozen
    sightings. The odometry bias of a robot is an unknown with three components as well: it takes the place of the pose
    in a key of its own, whose "odometry" from the origin is the mean of its prior.

    Attributes:
        robots: (k,) int64. Robot of each key, `NONE` for the origin, `BIAS` for a bias; keys of a robot are in temporal
            order.
        poses: (k, 3) float64 [m, m, rad], map frame. Poses of the last MAP estimate.
        parents: (k,) int64. Previous key; `NONE` for a fixed pose: the origin, or a robot's start. The parent of an
            unknown start is the origin or another robot's start.
        odometry: (k, 3) float64 [m, m, rad]. Odometry u from the previous key, in its frame; under a bias b it measures
            the motion u - J b.
        odometry_covariances: (k, 3, 3) float64. Covariance of `odometry`, in the same frame.
        bias_jacobians: (k, 3, 3) float64. Derivative J of `odometry` by the bias of the robot; zeros without a bias.
        transition_variances: (k,) float64 [m^2]. Variance of the motion from the previous key when last computed, that
            of the odometry before; headings at `LEVER`.
        rigid_variances: (k,) float64 [m^2]. Accumulated variance of the poses that are attached rigidly to the key.
        frame_keys, frame_offsets: (f,) int64, (f, 3) float64. Key of each frame, and the frame's pose relative to it.
        points, point_noises, has_covariance: (n, 3), (n, 6), (n,) raw measurements, robot axes from the camera centre;
            covariances where the sensor gave them.
        point_frames, point_landmarks: (n,) int64. Frame of each measurement, and its row of `landmark_ids`.
        condensed_keys, condensed_landmarks: (s,) int64. Key and landmark of each frozen sighting.
        linearisation_points, information, gradients: (s, 3), (s, 6), (s, 3) float64. Quadratic forms of the frozen
            sightings, see `_kernels`.
        counts: (s,) int64. Measurements in each frozen sighting.
        landmark_ids: (l,) int64. Ids of the landmarks.
        landmarks: (l, 3) float64 [m], map frame. Landmarks of the last MAP estimate.
        merged_ids: (a, 2) int64. Rows (old id, current id) of duplicate landmarks.
        first_keys: (K,) int64. Key at the start of each robot.
        bias_keys: (K,) int64. Key of the odometry bias of each robot, `NONE` if it has none.
        last_keys: (K,) int64. Newest key of each robot.
        latest: (K,) int64. Newest step of each robot's log in the graph, -1 before the first.
    """

    STATE = State(
        robots=Array(INT64, "k", BIAS, "K"),
        poses=Array(FLOAT64, "k 3", -MAX_DISTANCE, MAX_DISTANCE),
        parents=Array(INT64, "k", NONE, "k"),
        odometry=Array(FLOAT64, "k 3", -MAX_DISTANCE, MAX_DISTANCE),
        odometry_covariances=Array(FLOAT64, "k 3 3"),
        bias_jacobians=Array(FLOAT64, "k 3 3"),
        transition_variances=Array(FLOAT64, "k", 0.0),
        rigid_variances=Array(FLOAT64, "k", 0.0),
        frame_keys=Array(INT64, "f", 0, "k"),
        frame_offsets=Array(FLOAT64, "f 3", -MAX_DISTANCE, MAX_DISTANCE),
        landmark_ids=Array(INT64, "l", 0, MAX_LANDMARKS),
        landmarks=Array(FLOAT64, "l 3", -MAX_DISTANCE, MAX_DISTANCE),
        points=Array(FLOAT64, "n 3", -MAX_DISTANCE, MAX_DISTANCE),
        point_noises=Array(FLOAT64, "n 6", -math.inf, math.inf, nan=True),
        has_covariance=Array(BOOL, "n"),
        point_frames=Array(INT64, "n", 0, "f"),
        point_landmarks=Array(INT64, "n", 0, "l"),
        condensed_keys=Array(INT64, "s", 0, "k"),
        condensed_landmarks=Array(INT64, "s", 0, "l"),
        linearisation_points=Array(FLOAT64, "s 3"),
        information=Array(FLOAT64, "s 6"),
        gradients=Array(FLOAT64, "s 3"),
        counts=Array(INT64, "s", 0, MAX_LANDMARKS),
        merged_ids=Array(INT64, "merged 2", 0, MAX_LANDMARKS),
        first_keys=Array(INT64, "K", 0, "k"),
        bias_keys=Array(INT64, "K", NONE, "k"),
        last_keys=Array(INT64, "K", 0, "k"),
        latest=Array(INT64, "K", -1),
    )
    robots: IntArray = field(default_factory=_no_index)
    poses: FloatArray = field(default_factory=lambda: _empty(0, 3))
    parents: IntArray = field(default_factory=_no_index)
    odometry: FloatArray = field(default_factory=lambda: _empty(0, 3))
    odometry_covariances: FloatArray = field(default_factory=lambda: _empty(0, 3, 3))
    bias_jacobians: FloatArray = field(default_factory=lambda: _empty(0, 3, 3))
    transition_variances: FloatArray = field(default_factory=lambda: _empty(0))
    rigid_variances: FloatArray = field(default_factory=lambda: _empty(0))
    frame_keys: IntArray = field(default_factory=_no_index)
    frame_offsets: FloatArray = field(default_factory=lambda: _empty(0, 3))
    points: FloatArray = field(default_factory=lambda: _empty(0, 3))
    point_noises: FloatArray = field(default_factory=lambda: _empty(0, 6))
    has_covariance: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    point_frames: IntArray = field(default_factory=_no_index)
    point_landmarks: IntArray = field(default_factory=_no_index)
    condensed_keys: IntArray = field(default_factory=_no_index)
    condensed_landmarks: IntArray = field(default_factory=_no_index)
    linearisation_points: FloatArray = field(default_factory=lambda: _empty(0, 3))
    information: FloatArray = field(default_factory=lambda: _empty(0, 6))
    gradients: FloatArray = field(default_factory=lambda: _empty(0, 3))
    counts: IntArray = field(default_factory=_no_index)
    landmark_ids: IntArray = field(default_factory=_no_index)
    landmarks: FloatArray = field(default_factory=lambda: _empty(0, 3))
    merged_ids: IntArray = field(default_factory=lambda: np.zeros((0, 2), dtype=np.int64))
    first_keys: IntArray
    bias_keys: IntArray
    last_keys: IntArray
    latest: IntArray

    def __post_init__(self) -> None:
        vars(self).update({name: as_read_only(column) for name, column in vars(self).items()})

    @classmethod
    def at_starts(cls, starts: FloatArray, motion: OdometryModel | None = None) -> "SlamGraph":
        """Return the graph of K robots at known `starts` (K, 3) [m, m, rad], map frame, without measurements.

        `motion` has the prior of the robots' odometry biases; None: there are none.
        """
        return cls.at_uncertain_starts(np.asarray(starts, dtype=np.float64)[:, :, None], motion=motion)

    @classmethod
    def at_uncertain_starts(
        cls, starts: FloatArray, held: BoolArray | None = None, motion: OdometryModel | None = None
    ) -> "SlamGraph":
        """Return the graph of K robots whose starts may differ between particles, as after a merge.

        A start that is equal in all particles is fixed, unless it is in `held`. Any other start is an unknown with a
        vague prior, so that measurements alone determine it: the particles' starts derive from the same measurements.
        If the relative pose of two starts is the same in all particles, the first is the parent of the second.

        Args:
            starts: (K, 3, M) float64 [m, m, rad], map frame.
            held: (K,) bool. Unknown starts that are equal in all particles, see `fix_start`. None: no such start.
            motion: Model with the prior of the robots' odometry biases. None: no biases.
        """
        k = len(starts)
        held = np.zeros(k, dtype=np.bool_) if held is None else held
        loose = [i for i in range(k) if held[i] or (starts[i] != starts[i, :, :1]).any()]
        poses, previous, motions, noises = list(starts[:, :, 0]), [NONE] * k, [np.zeros(3)] * k, [np.zeros((3, 3))] * k
        for place, i in enumerate(loose):
            poses[i] = mean_pose(starts[i])
            previous[i], motions[i], noises[i] = k, poses[i], np.diag(UNINFORMATIVE)
            for other in loose[:place]:
                if held[i] or held[other]:
                    continue
                apart = between(starts[other].T, starts[i].T)
                if np.abs(_turned(apart - apart[0])).max() < RIGID:
                    previous[i], motions[i], noises[i] = other, apart[0], RIGID**2 * np.eye(3)
                    break
        biased = k if motion is not None and motion.is_biased else 0
        extra = 1 if loose or biased else 0
        robots = np.concatenate([np.arange(k), np.full(extra, NONE), np.full(biased, BIAS)])
        if motion is not None and biased:
            prior = np.maximum(motion.bias_covariance, MIN_BIAS**2 * np.eye(3))
            poses, motions = [*poses, np.zeros(3), *np.zeros((k, 3))], [*motions, np.zeros(3), *np.zeros((k, 3))]
            previous, noises = [*previous, NONE, *[k] * k], [*noises, np.zeros((3, 3)), *[prior] * k]
        elif extra:
            poses, motions = [*poses, np.zeros(3)], [*motions, np.zeros(3)]
            previous, noises = [*previous, NONE], [*noises, np.zeros((3, 3))]
        return cls(
            robots=robots,
            poses=np.array(poses),
            parents=np.array(previous, dtype=np.int64),
            odometry=np.array(motions),
            odometry_covariances=np.array(noises),
            bias_jacobians=np.zeros((len(robots), 3, 3)),
            transition_variances=np.zeros(len(robots)),
            rigid_variances=np.zeros(len(robots)),
            first_keys=np.arange(k),
            bias_keys=k + 1 + np.arange(k) if biased else np.full(k, NONE),
            last_keys=np.arange(k),
            latest=np.full(k, -1),
        )

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse a graph with keys that do not lead back to a start, or that belong to another robot."""
        robots, parents, biases = parts["robots"], parts["parents"], parts["bias_keys"]
        every = np.arange(sizes["K"])
        if len(np.unique(parts["landmark_ids"])) < sizes["l"]:
            raise ValueError("a repeated landmark")
        if not (np.abs(parts["point_noises"][parts["has_covariance"]]) <= LARGEST).all():
            raise ValueError("a covariance out of range")
        if (robots[parts["first_keys"]] != every).any() or (robots[parts["last_keys"]] != every).any():
            raise ValueError("a key of another robot")
        held = biases[biases >= 0]
        if len(held) not in (0, len(every)) or sorted(held) != np.flatnonzero(robots == BIAS).tolist():
            raise ValueError("keys of biases that do not belong to the robots")
        if (parents[held] < 0).any() or (robots[parents[held]] != NONE).any():
            raise ValueError("a bias without the origin before it")
        if not _are_linked(parents, robots):
            raise ValueError("keys that do not lead back to a start")

    def reordered(self, order: IntArray) -> "SlamGraph":
        """Return the graph with robot `order[i]` as robot i; (K,) a permutation."""
        robots = self.robots.copy()
        robots[self.robots >= 0] = np.argsort(order)[self.robots[self.robots >= 0]]
        return self.with_columns(
            robots=robots,
            **{name: getattr(self, name)[order] for name in ("first_keys", "bias_keys", "last_keys", "latest")},
        )

    def with_columns(self, **columns: NDArray[Any]) -> "SlamGraph":
        """Return the graph with some columns replaced by read-only views of these arrays.

        Unlike `dataclasses.replace`, it does not check the other columns again. The caller must not write to the arrays
        afterwards.
        """
        assert columns.keys() <= vars(self).keys()
        other = object.__new__(SlamGraph)
        vars(other).update(vars(self), **{name: as_read_only(column) for name, column in columns.items()})
        return other

    def resolve_ids(self, ids: IntArray) -> IntArray:
        """Return the current ids of landmarks `ids` (n,) int64, with `merged_ids` applied."""
        result = ids.copy()
        for name, other in self.merged_ids.tolist():
            result[result == name] = other
        return result

    def part(self, kind: type[Part]) -> Part:
        """Return some of the columns."""
        return kind(*map(vars(self).__getitem__, kind._fields))

    @property
    def num_keys(self) -> int:
        """Number of keys, starts included."""
        return len(self.poses)

    @property
    def num_biases(self) -> int:
        """Number of keys that hold an odometry bias."""
        return int(np.count_nonzero(self.bias_keys >= 0))

    def biases_of_odometry(self) -> IntArray:
        """Return the key (k,) of the bias of each key's odometry, `NONE` if it has none; (0,) without biases."""
        if not self.num_biases:
            return NO_BIASES
        robots, before = self.robots, self.robots[self.parents]
        linked = (self.parents >= 0) & (robots >= 0) & (before == robots)
        return np.where(linked, self.bias_keys[np.maximum(robots, 0)], NONE)

    @property
    def num_sightings(self) -> int:
        """Number of frozen sightings and raw measurements, to which the effort of a rejuvenation is proportional."""
        return len(self.condensed_keys) + len(self.points)

    @property
    def nbytes(self) -> int:
        """Size of all arrays in bytes."""
        return sum(column.nbytes for column in vars(self).values())


def _are_linked(parents: IntArray, robots: IntArray) -> bool:
    """Return whether each key (k,) leads back to a start, with the keys of one robot in order of time."""
    keys = np.arange(len(parents))
    if ((parents >= keys) & (robots[parents] == robots)).any():
        return False
    before = np.where(parents < 0, keys, parents)
    for _ in range(len(keys).bit_length()):  # each time twice as far back
        before = before[before]
    return bool((parents[before] < 0).all())


def mean_pose(poses: FloatArray) -> FloatArray:
    """Return the mean (3,) of poses (3, n) [m, m, rad], with the circular mean of the headings."""
    x, y, headings = poses
    return np.array([x.mean(), y.mean(), np.arctan2(np.sin(headings).mean(), np.cos(headings).mean())])


def scattered(poses: FloatArray) -> FloatArray:
    """Return the covariance (3, 3) of poses (3, n) [m, m, rad] about their mean, plus a floor of `RIGID` squared."""
    off = poses - mean_pose(poses)[:, None]
    off[2] = wrap_angle(off[2])
    return np.asarray(off @ off.T / off.shape[1] + RIGID**2 * np.eye(3))


def _turned(poses: FloatArray) -> FloatArray:
    """Return differences of poses (n, 3) with headings wrapped to [-pi, pi)."""
    return np.column_stack([poses[:, :2], wrap_angle(poses[:, 2])])
