"""Reports of filters: associations, pose estimates, step reports. All frozen."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Self, get_args

import numpy as np

from slam_backend.core.read_only import Act, as_read_only, map_arrays
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam._kernels import REJECTED, STATIONARY
from slam_backend.fastslam.step_input import MASKS, NO_INPUT, RobotInput, StepInput, check_rows
from slam_backend.smoother.relocalisation import Outcome
from slam_backend.state import (
    INT64,
    MAX_LANDMARKS,
    Array,
    Each,
    Flag,
    Float,
    Int,
    Maybe,
    Record,
    Sizes,
    State,
    Text,
    with_state,
)


@short_repr
@with_state(ids=Array(INT64, "2 n", REJECTED, MAX_LANDMARKS), inputs=Each(Record(RobotInput), "K"), masks=MASKS)
class Associations(NamedTuple):
    """Data association of N robots' measurements in one step; read-only.

    Attributes:
        ids: (2, n) int64. Landmarks that all used measurements were associated with, robot by robot, and landmarks that
            they created, as in `StepReport`.
        inputs: Input of each robot, as in `StepInput`.
        masks: Used measurements by robot, as in `StepInput`.
    """

    ids: IntArray
    inputs: Sequence[RobotInput]
    masks: Mapping[int, BoolArray]

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Refuse inputs or masks of other measurements."""
        check_rows(parts["inputs"], parts["masks"], sizes["n"])

    @classmethod
    def allocate(cls, inputs: StepInput) -> tuple[Self, IntArray]:
        """Return the data association of some inputs, and its array (2, n) int64 for the step to write.

        Initially all measurements are rejected.
        """
        buffer = np.empty((2, len(inputs.measurements)), np.int64)
        buffer.fill(REJECTED)
        return cls(as_read_only(buffer), inputs.inputs, inputs.masks), buffer

    @classmethod
    def from_arrays(cls, associations: Sequence[IntArray], created: Sequence[IntArray]) -> Self:
        """Return the data association of robots from their ids (n_i,)."""
        ids = as_read_only(np.stack([np.concatenate(associations), np.concatenate(created)]))
        inputs, begin = [], 0
        for of_robot in associations:
            inputs.append(RobotInput(STATIONARY, begin, begin + len(of_robot), 0, 0, len(of_robot)))
            begin += len(of_robot)
        return cls(ids, inputs, {})

    def with_arrays(self, act: Act) -> Self:
        """Return the associations with `act` applied to each array; themselves if that changes nothing."""
        before = self.ids, self.masks
        after = map_arrays(before, act)
        return self if after is before else type(self)(after[0], self.inputs, after[1])

    def num_measurements(self, row: int) -> int:
        """Return how many measurements a robot was given, used or not."""
        return max(self.inputs[row].num_given, 0)

    def associated(self, row: int) -> IntArray:
        """Return a copy of the landmark (n_i,) of each measurement of a robot, REJECTED: none; empty for robot -1."""
        associated, _ = self.ids
        return self._per_measurement(row, associated)

    def created(self, row: int) -> IntArray:
        """Return the landmark (n_i,) that each measurement of a robot created."""
        _, created = self.ids
        return self._per_measurement(row, created)

    def associated_ids(self, row: int) -> list[int]:
        """Return the landmarks that measurements of a robot were associated with, in their order."""
        associated, _ = self.ids
        return self._valid_ids(row, associated)

    def created_ids(self, row: int) -> list[int]:
        """Return the landmarks that measurements of a robot created, in their order."""
        _, created = self.ids
        return self._valid_ids(row, created)

    def _valid_ids(self, row: int, became: IntArray) -> list[int]:
        """Return the names among what became of the measurements of a robot."""
        one = self.inputs[row] if row >= 0 else NO_INPUT
        found: list[int] = became[one.begin : one.end].tolist()
        return [name for name in found if name != REJECTED]

    def _per_measurement(self, row: int, became: IntArray) -> IntArray:
        """Return what became of the measurements of a robot, -1 for those that were not used."""
        one = self.inputs[row] if row >= 0 else NO_INPUT
        used: IntArray = became[one.begin : one.end].copy()
        if row not in self.masks:
            return used
        every: IntArray = np.full(len(self.masks[row]), REJECTED)
        every[self.masks[row]] = used
        return every


@short_repr
class PoseEstimate(NamedTuple):
    """Gaussian summary of a robot's pose.

    Attributes:
        mean: (3,) float64 [m, m, rad].
        covariance: (3, 3) float64 [m, m, rad].
    """

    mean: FloatArray
    covariance: FloatArray


@short_repr
class BiasEstimate(NamedTuple):
    """Gaussian summary of a robot's odometry bias, see `OdometryModel`.

    Attributes:
        mean: (3,) float64 [m/m, rad/m, rad/rad]. Scale, turn per metre and turn per radian.
        covariance: (3, 3) float64.
    """

    mean: FloatArray
    covariance: FloatArray


@short_repr
class PoseEstimates(NamedTuple):
    """Gaussian summaries of the poses of several robots, all in one frame or each in its own.

    Attributes:
        means: (K, 3) float64 [m, m, rad].
        covariances: (K, 3, 3) float64 [m, m, rad].
    """

    means: FloatArray
    covariances: FloatArray

    def copy(self) -> "PoseEstimates":
        """Return a copy of the arrays."""
        return PoseEstimates(self.means.copy(), self.covariances.copy())

    def of(self, robot: int) -> PoseEstimate:
        """Return the estimate of one robot. A copy."""
        return PoseEstimate(self.means[robot].copy(), self.covariances[robot].copy())


@short_repr
@with_state(
    all_associations=Record(Associations), rows=Each(Int(-1, "K")), num_created=Int(), num_new=Int(),
    num_matched=Int(), num_rejected=Int(), ess=Float(0.0), nis=Float(0.0, math.inf, nan=True), resampled=Flag(),
    rejuvenation=Maybe(Record(lambda: RejuvenationReport)),
)  # fmt: skip
class StepReport(NamedTuple):
    """Outcome of one step of `FastSlam`.

    Attributes:
        all_associations: Data association of all inputs; `associations` and `created` are parts of it.
        rows: Row of each robot in `all_associations`, -1: none.
        num_created: Measurements that created a landmark in at least one particle.
        num_new: Landmarks created by the most probable particle.
        num_matched: Measurements that the most probable particle matched to landmarks it held.
        num_rejected: Measurements that it rejected: ambiguous, in the dead zone, or named -1 by the caller.
        ess: Effective sample size after this step's weights, before resampling, in [1, M].
        nis: Mean of the squared Mahalanobis innovations (3 degrees of freedom, ideal 3) over the measurements that
            the most probable particle matched, without those predicted behind the camera; NaN without matches.
        resampled: Whether the particles were resampled.
        rejuvenation: Outcome of a rejuvenation; None: no attempt in this step.
    """

    all_associations: Associations
    rows: tuple[int, ...]
    num_created: int
    num_new: int
    num_matched: int
    num_rejected: int
    ess: float
    nis: float
    resampled: bool
    rejuvenation: "RejuvenationReport | None" = None

    @property
    def associations(self) -> tuple[IntArray, ...]:
        """Per robot (n_i,) int64. Id of the landmark that the most probable particle associated each measurement with.

        The landmark may be new; -1 = rejected. Copies.
        """
        return tuple([self.all_associations.associated(row) for row in self.rows])

    @property
    def created(self) -> tuple[IntArray, ...]:
        """Per robot (n_i,) int64. Id of the landmark that the measurement created in at least one particle.

        -1 = none. Each landmark is created by exactly one measurement. Copies.
        """
        return tuple([self.all_associations.created(row) for row in self.rows])


@dataclass(frozen=True, slots=True)
class Relocalisation:
    """A robot that sees older landmarks of its map again where it has built that part a second time.

    Attributes:
        robot: Index of the robot.
        shift: Difference [m, m, rad] of its pose by these landmarks to the one that was believed, map frame.
        num_landmarks: Number of landmarks that were held twice.
        outcome: "loop closed": the covariance that was claimed for its pose allows the shift. "found": it excludes the
            shift, but the odometry jumped while the view stayed the same; the robot was lost. After both pose and map
            are corrected. "suspected": the robot is lost, or another place looks alike; nothing is changed.
    """

    STATE = State(robot=Int(), shift=Each(Float(), "3"), num_landmarks=Int(1), outcome=Text(get_args(Outcome)))

    robot: int
    shift: tuple[float, float, float]
    num_landmarks: int
    outcome: Outcome

    @property
    def distance(self) -> float:
        """Distance between the two [m]."""
        return math.hypot(*self.shift[:2])


@dataclass(frozen=True, slots=True, eq=False)
class RejuvenationReport:
    """Outcome of an attempt to rejuvenate a filter.

    Attributes:
        reason: Reason why the old particles stay; "" after success.
        ess: Effective sample size of the importance weights of whole paths, in [1, M]; NaN if none were computed.
        iterations: Number of iterations of the smoother.
        num_keys: Number of keyframes in the graph.
        relocalisation: Robot that sees older landmarks of its map elsewhere; None: no robot.
    """

    STATE = State(
        reason=Text(), ess=Float(0.0, nan=True), iterations=Int(), num_keys=Int(),
        relocalisation=Maybe(Record(Relocalisation)),
    )  # fmt: skip

    reason: str
    ess: float
    iterations: int
    num_keys: int
    relocalisation: Relocalisation | None = None

    def renumbered(self, robots: Sequence[int]) -> Self:
        """Return the report with robot `robots[i]` for robot i."""
        found = self.relocalisation
        return self if found is None else replace(self, relocalisation=replace(found, robot=robots[found.robot]))
