"""Planar pose graphs with landmarks, as g2o and GTSAM optimise them."""

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import ArrayLike

from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import BoolArray, FloatArray, IntArray, argument_error, check_array
from slam_backend.trajectory import Trajectory

LETTERS = "ABCDEFGHIJKMNOPQRSTUVWXYZ"  # of robots; L is that of landmarks


@short_repr
class Factors(NamedTuple):
    """Gaussian measurements of one kind.

    Attributes:
        rows: (e, 2) int64, rows of the two nodes that each measurement links; of priors (e,), rows of their nodes.
        values: (e, d) float64. Measured motions or poses [m, m, rad], or points [m, m].
        covariances: (e, d, d) float64. Covariances of `values`, positive definite.
    """

    rows: IntArray
    values: FloatArray
    covariances: FloatArray

    @classmethod
    def none(cls, size: int, linked: bool = True) -> Self:
        """Return no measurements, with values of `size` numbers."""
        rows = np.zeros((0, 2) if linked else 0, dtype=np.int64)
        return cls(rows, np.zeros((0, size)), np.zeros((0, size, size)))


@dataclass(frozen=True, slots=True, eq=False, kw_only=True, repr=False)
class PoseGraph:
    """Poses of one or more robots, landmarks, and measurements between them, in one frame. Arrays are read-only copies.

    The covariance of a motion is in axes of the second pose as measured, that of a prior of a pose in its own axes: the
    error is measured^-1 x predicted, as in g2o and in `BetweenFactorPose2` and `PriorFactorPose2` of GTSAM.

    Attributes:
        poses: (n, 3) float64 [m, m, rad]. Estimated poses; those of a robot in order of time.
        robots: (n,) int64. Robot of each pose, from 0. Default: all 0.
        pose_ids: (n,) int64 >= 0. Number of each pose, once for each robot. Default: from 0 on.
        times: (n,) float64. Time stamp or step of each pose; None: unknown.
        landmarks: (l, 2) float64 [m]. Estimated positions.
        landmark_ids: (l,) int64 >= 0, each once. Default: from 0 on.
        motions: Measured motions (dx, dy, dtheta) from one pose to another, in the frame of the first.
        sightings: Measured points of landmarks in frames of poses; rows are (pose, landmark).
        pose_priors: Priors of poses.
        landmark_priors: Priors of landmarks.
        fixed: (n,) bool. Poses that are known exactly. Default: none.
        pose_covariances: (n, 3, 3) float64. Marginal covariances of `poses` in the frame of the graph; None: unknown.
        landmark_covariances: (l, 2, 2) float64 [m^2]. Marginal covariances of `landmarks`; None: unknown.

    Raises:
        ValueError: If a shape is wrong, a number is not finite, an id is repeated or negative, a row does not exist, or
            a covariance of a measurement is not positive definite.

    >>> graph = PoseGraph(poses=[[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], landmarks=[[2.0, 1.0]])
    >>> graph.robots.tolist(), graph.pose_ids.tolist(), graph.names()
    ([0, 0], [0, 1], (['A0', 'A1'], ['L0']))
    """

    poses: FloatArray
    robots: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    pose_ids: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    times: FloatArray | None = None
    landmarks: FloatArray = field(default_factory=lambda: np.zeros((0, 2)))
    landmark_ids: IntArray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    motions: Factors = field(default_factory=lambda: Factors.none(3))
    sightings: Factors = field(default_factory=lambda: Factors.none(2))
    pose_priors: Factors = field(default_factory=lambda: Factors.none(3, linked=False))
    landmark_priors: Factors = field(default_factory=lambda: Factors.none(2, linked=False))
    fixed: BoolArray = field(default_factory=lambda: np.zeros(0, dtype=np.bool_))
    pose_covariances: FloatArray | None = None
    landmark_covariances: FloatArray | None = None

    def __post_init__(self) -> None:
        poses: FloatArray = check_array("poses", self.poses, (None, 3), "Give rows (x, y, theta).")
        landmarks: FloatArray = check_array("landmarks", self.landmarks, (None, 2), "Give rows (x, y).")
        n, num, hint = len(poses), len(landmarks), "Give one entry for each pose."
        robots = _ids("robots", self.robots, np.zeros(n, dtype=np.int64), hint)
        pose_ids = _ids("pose_ids", self.pose_ids, np.arange(n), hint)
        landmark_ids = _ids("landmark_ids", self.landmark_ids, np.arange(num), "Give one id for each landmark.")
        fixed = np.array(self.fixed if len(self.fixed) else np.zeros(n), dtype=np.bool_)
        if fixed.shape != (n,):
            raise argument_error("fixed", f"an array of shape ({n},)", f"shape {fixed.shape}", hint)
        for name, keys in (("pose_ids", np.column_stack([robots, pose_ids])), ("landmark_ids", landmark_ids[:, None])):
            if len(np.unique(keys, axis=0)) < len(keys):
                raise argument_error(name, "distinct ids", "a repeated one", "Give each pose and landmark its own.")
        parts: dict[str, Any] = {
            "poses": poses, "robots": robots, "pose_ids": pose_ids, "landmarks": landmarks,
            "landmark_ids": landmark_ids, "fixed": fixed,
        }  # fmt: skip
        for name, shape in (
            ("times", (n,)), ("pose_covariances", (n, 3, 3)), ("landmark_covariances", (num, 2, 2)),
        ):  # fmt: skip
            if getattr(self, name) is not None:
                parts[name] = check_array(name, getattr(self, name), shape, "Give one entry for each, or None.")
        for name, array in parts.items():
            array.setflags(write=False)
            object.__setattr__(self, name, array)
        for name, size, counts in (
            ("motions", 3, (n, n)), ("sightings", 2, (n, num)), ("pose_priors", 3, (n,)),
            ("landmark_priors", 2, (num,)),
        ):  # fmt: skip
            object.__setattr__(self, name, _checked(name, getattr(self, name), size, counts))

    def __repr__(self) -> str:
        counts = (
            f"{len(self.poses)} poses of {self.num_robots} robots", f"{len(self.landmarks)} landmarks",
            f"{len(self.motions.rows)} motions", f"{len(self.sightings.rows)} sightings",
        )  # fmt: skip
        return f"PoseGraph({', '.join(counts)})"

    @property
    def num_robots(self) -> int:
        """Number of robots."""
        return int(self.robots.max(initial=-1)) + 1

    def names(self) -> tuple[list[str], list[str]]:
        """Return the names of the poses and of the landmarks, with a letter for each robot: `A0`, `B0`, `L0`.

        Raises:
            ValueError: If there are more than 25 robots.
        """
        if self.num_robots > len(LETTERS):
            hint = "More have no letters: use g2o, which has none."
            raise argument_error("graph", f"at most {len(LETTERS)} robots", self.num_robots, hint)
        poses = [f"{LETTERS[r]}{i}" for r, i in zip(self.robots.tolist(), self.pose_ids.tolist(), strict=True)]
        return poses, [f"L{i}" for i in self.landmark_ids.tolist()]

    def trajectory(self, robot: int = 0, step_times: ArrayLike | None = None) -> Trajectory:
        """Return the poses of a robot over time.

        Args:
            robot: Index of the robot.
            step_times: (T,) [s]. Time of each step of the run, where `times` are steps, as in `FastSlam.graph()`; a
                pose before the first step is left out. None: `times` themselves, or `pose_ids` without them.

        Raises:
            ValueError: If there is no such robot, a step has no time, or times do not increase.
        """
        rows = np.flatnonzero(self.robots == robot)
        if not len(rows):
            expected = f"an index from 0 to {self.num_robots - 1}"
            raise argument_error("robot", expected, robot, "Count robots from 0.")
        times = self.pose_ids[rows].astype(np.float64) if self.times is None else self.times[rows]
        if step_times is None:
            return Trajectory(times, self.poses[rows])
        given = check_array("step_times", step_times, (None,), "Give the time of each step in seconds.")
        steps = times.astype(np.int64)
        rows, steps = rows[steps >= 0], steps[steps >= 0]
        if len(steps) and steps.max() >= len(given):
            raise argument_error(
                "step_times", f"at least {steps.max() + 1} times", len(given), "Give one for each step."
            )
        return Trajectory(given[steps], self.poses[rows])


def _ids(name: str, given: ArrayLike, usual: IntArray, hint: str) -> IntArray:
    """Return ids that are not negative, the usual ones (count,) if none are given, or raise."""
    ids: IntArray = check_array(name, given if np.size(given) else usual, usual.shape, hint, dtype=np.int64)
    if len(ids) and ids.min() < 0:
        raise argument_error(name, "ints >= 0", int(ids.min()), hint)
    return ids


def _checked(name: str, given: Factors, size: int, counts: tuple[int, ...]) -> Factors:
    """Return measurements between nodes of so many rows, or raise."""
    hint = "Give rows of nodes, values and covariances of equal length."
    rows: IntArray = check_array(
        f"{name}.rows", given.rows, (None, 2) if len(counts) == 2 else (None,), hint, dtype=np.int64
    )
    values: FloatArray = check_array(f"{name}.values", given.values, (len(rows), size), hint)
    covariances: FloatArray = check_array(f"{name}.covariances", given.covariances, (len(rows), size, size), hint)
    if len(rows) and (rows.min() < 0 or (np.atleast_1d(rows.max(axis=0)) >= counts).any()):
        raise argument_error(f"{name}.rows", "rows of poses and landmarks", "a row that there is not", hint)
    if not positive_definite(covariances).all():
        got = f"a matrix that is not, at index {int(np.argmin(positive_definite(covariances)))}"
        raise argument_error(f"{name}.covariances", "symmetric positive definite matrices", got, "Check them.")
    for array in (rows, values, covariances):
        array.setflags(write=False)
    return Factors(rows, values, covariances)


def positive_definite(matrices: FloatArray) -> BoolArray:
    """Return which matrices (n, d, d) are symmetric and positive definite, with a margin for rounding.

    >>> positive_definite(np.array([[[2.0, 1.0], [1.0, 2.0]], [[1.0, 2.0], [2.0, 1.0]]])).tolist()
    [True, False]
    """
    if not len(matrices):
        return np.ones(0, dtype=np.bool_)
    variances = np.diagonal(matrices, axis1=1, axis2=2)
    above = (variances > 0.0).all(axis=1)
    scale = 1.0 / np.sqrt(np.where(variances > 0.0, variances, 1.0))
    scaled = matrices * scale[:, :, None] * scale[:, None, :]  # correlations: variances may differ in scale
    symmetric = (np.abs(scaled - scaled.transpose(0, 2, 1)) <= 1e-9).all(axis=(1, 2))
    return np.asarray(above & symmetric & (np.linalg.eigvalsh(scaled)[:, 0] > 1e-12))


def rotated(covariances: FloatArray, angles: FloatArray) -> FloatArray:
    """Return covariances (n, 3, 3) of poses [m, m, rad] turned by angles (n,) [rad]: R C R^T."""
    cos, sin = np.cos(angles), np.sin(angles)
    turn = np.zeros((len(angles), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = cos, -sin, sin, cos, 1.0
    result = turn @ covariances @ turn.transpose(0, 2, 1)
    return np.asarray(0.5 * (result + result.transpose(0, 2, 1)))
