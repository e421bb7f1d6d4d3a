"""Reports of filters and teams: associations, pose estimates, step reports, merge events. All frozen."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, Self

import numpy as np

from slam_backend.core.read_only import Act, as_constant, as_read_only, map_arrays
from slam_backend.core.validation import BoolArray, FloatArray, IntArray
from slam_backend.fastslam._kernels import REJECTED, STATIONARY
from slam_backend.fastslam.step_input import NO_INPUT, RobotInput, StepInput


class Associations(NamedTuple):
    """What became of N robots' measurements in one step; read-only.

    Attributes:
        ids: (2, n) int64. Of all measurements used, one robot's after the other's: the landmark that each was taken
            for, and that which it created, as in `StepReport`.
        inputs: Of each robot, as in `StepInput`.
        masks: By robot which of its measurements were used, as there.
    """

    ids: IntArray
    inputs: Sequence[RobotInput]
    masks: Mapping[int, BoolArray]

    @classmethod
    def allocate(cls, inputs: StepInput) -> tuple[Self, IntArray]:
        """Return what becomes of some readings, and the room (2, n) int64 where the step is to write it.

        Until it is written all measurements are rejected.
        """
        room = np.empty((2, len(inputs.measurements)), np.int64)
        room.fill(REJECTED)
        return cls(as_read_only(room), inputs.inputs, inputs.masks), room

    @classmethod
    def from_arrays(cls, associations: Sequence[IntArray], created: Sequence[IntArray]) -> Self:
        """Return those of robots of each of which both are known, (n_i,) ids."""
        told = as_read_only(np.stack([np.concatenate(associations), np.concatenate(created)]))
        turns, begin = [], 0
        for own in associations:
            turns.append((STATIONARY, begin, begin + len(own), False, False, len(own)))
            begin += len(own)
        return cls(told, turns, {})

    def with_arrays(self, act: Act) -> Self:
        """Return the same with `act` done to each array; itself if that changes nothing."""
        before = self.ids, self.masks
        after = map_arrays(before, act)
        return self if after is before else type(self)(after[0], self.inputs, after[1])

    def num_measurements(self, row: int) -> int:
        """Return how many measurements a robot was given, used or not."""
        _, _, _, _, _, count = self.inputs[row]
        return max(count, 0)

    def associated(self, row: int) -> IntArray:
        """Return what the measurements (n_i,) of a robot were taken for; there are none of robot -1. A copy."""
        associated, _ = self.ids
        return self._per_measurement(row, associated)

    def created(self, row: int) -> IntArray:
        """Return likewise which landmarks they created."""
        _, created = self.ids
        return self._per_measurement(row, created)

    def associated_ids(self, row: int) -> list[int]:
        """Return the landmarks that measurements of a robot were taken for, in their order."""
        associated, _ = self.ids
        return self._valid_ids(row, associated)

    def created_ids(self, row: int) -> list[int]:
        """Return likewise the landmarks that they created."""
        _, created = self.ids
        return self._valid_ids(row, created)

    def _valid_ids(self, row: int, became: IntArray) -> list[int]:
        """Return the names among what became of the measurements of a robot."""
        _, begin, end, _, _, _ = self.inputs[row] if row >= 0 else NO_INPUT
        found: list[int] = became[begin:end].tolist()
        return [name for name in found if name != REJECTED]

    def _per_measurement(self, row: int, became: IntArray) -> IntArray:
        """Return what became of the measurements of a robot, -1 for those that were not used."""
        _, begin, end, _, _, _ = self.inputs[row] if row >= 0 else NO_INPUT
        used: IntArray = became[begin:end].copy()
        if row not in self.masks:
            return used
        every: IntArray = np.full(len(self.masks[row]), REJECTED)
        every[self.masks[row]] = used
        return every


if TYPE_CHECKING:
    from slam_backend.maps.alignment import Alignment


class PoseEstimate(NamedTuple):
    """A Gaussian summary of a robot's pose.

    Attributes:
        mean: (3,) float64 [m, m, rad].
        covariance: (3, 3) float64 [m, m, rad].
    """

    mean: FloatArray
    covariance: FloatArray


class PoseEstimates(NamedTuple):
    """Gaussian summaries of the poses of several robots, all in one frame or each in its own.

    Attributes:
        means: (K, 3) float64 [m, m, rad].
        covariances: (K, 3, 3) float64 [m, m, rad].
    """

    means: FloatArray
    covariances: FloatArray

    def copy(self) -> "PoseEstimates":
        """Return the same in arrays of their own."""
        return PoseEstimates(self.means.copy(), self.covariances.copy())

    def of(self, robot: int) -> PoseEstimate:
        """Return that of one robot. A copy."""
        return PoseEstimate(self.means[robot].copy(), self.covariances[robot].copy())


class StepReport(NamedTuple):
    """What one step of `FastSlam` did.

    Attributes:
        all_associations: What became of the measurements; `associations` and `created` are cut out of it.
        rows: Of each robot there, -1: none.
        num_created: Measurements that created a landmark in at least one particle.
        num_new: Landmarks created by the most probable particle.
        num_matched: Measurements that the most probable particle matched to landmarks it held.
        num_rejected: Measurements of which it made nothing: held back, in the dead zone, or named -1 by the caller.
        ess: Effective sample size after this step's weights, before resampling, in [1, M].
        nis: Mean of the squared Mahalanobis innovations (3 degrees of freedom, ideal 3) over the measurements that
            the most probable particle matched, without those it had predicted behind the camera; NaN if there is none.
        resampled: Whether the particles were resampled.
        rejuvenation: What came of drawing particles anew from smoothed paths; None: it was not tried in this step.
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
        """Per robot (n_i,) int64. Id of the landmark to which the most probable particle gave each measurement.

        That is the id of a new one if it made one; -1 = rejected. Copies.
        """
        return tuple([self.all_associations.associated(row) for row in self.rows])

    @property
    def created(self) -> tuple[IntArray, ...]:
        """Per robot (n_i,) int64. Id of the landmark that the measurement created in at least one particle.

        -1 if none did. A landmark stems from exactly one measurement. Copies.
        """
        return tuple([self.all_associations.created(row) for row in self.rows])


@dataclass(frozen=True, slots=True, eq=False)
class RejuvenationReport:
    """What came of an attempt to rejuvenate a filter.

    Attributes:
        reason: Why the old particles stay; "" if there are new ones.
        ess: Effective sample size of the importance weights of whole paths, in [1, M]; NaN if it did not come to that.
        iterations: Of the smoother.
        num_keys: Key poses that it keeps.
    """

    reason: str
    ess: float
    iterations: int
    num_keys: int


@dataclass(frozen=True, slots=True, eq=False)
class MergeEvent:
    """An attempt to align two groups' maps, a merge, or the undoing of one.

    Attributes:
        step: Number of the team's step (the first is 0).
        kind: What happened.
        robots_a: The group whose map frame stays.
        robots_b: The other group.
        alignment: `map` of group a from `map` of group b, as found; refused attempts carry the reason.
        unsmoothed_alignment: Of an attempt: the alignment of the maps as the filters had bent them, where these were
            straightened then and `alignment` is that of the straight ones; else None.
        uncertainty: For an attempt whose maps align, the uncertainty of the motion between them over the particles of
            the merge, relative to what a merge has to be sure of; beyond 1 it may wait. NaN if that was not asked.
    """

    step: int
    kind: Literal["attempt", "merge", "undo"]
    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    alignment: "Alignment"
    unsmoothed_alignment: "Alignment | None" = None
    uncertainty: float = float("nan")


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkIdMap:
    """How landmark ids of two groups became ids of their joint map.

    Attributes:
        robots_a: Group a before the merge; its landmark ids stay.
        robots_b: Group b before the merge.
        ids_b: (k, 2) int64, read-only. Rows (id in b's map, id in the joint map); fused landmarks carry the id of a.
        maps: Numbers of a's map, of b's and of the joint one. The first two are kept until their `MapReleased`: an undo
            takes them up again as they were.
    """

    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    ids_b: IntArray
    maps: tuple[int, int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids_b", as_constant(self.ids_b))

    def __reduce__(self) -> tuple[Any, ...]:
        """Let copies and what was pickled be read-only, too."""
        return LandmarkIdMap, (self.robots_a, self.robots_b, self.ids_b, self.maps)


@dataclass(frozen=True, slots=True)
class MapForked:
    """A filter forked: map number `copy` begins as what map number `source` is now."""

    source: int
    copy: int


@dataclass(frozen=True, slots=True)
class MapReleased:
    """Map number `number` is gone for good."""

    number: int


class LandmarksCreated(NamedTuple):
    """What a robot read in a step created landmarks in a map.

    Attributes:
        number: Of the map.
        robot: Who read it.
        step: When it was read; with a replay that is earlier than the step of the report.
        ids: (n,) int64, read-only. Id of the landmark that each of its measurements created, -1 = none.
    """

    number: int
    robot: int
    step: int
    ids: IntArray


@dataclass(frozen=True, slots=True)
class MergeUndone:
    """A merge was taken back: two maps are taken up again as they were before it, and the joint one ends.

    Attributes:
        maps: Numbers of a's map, of b's and of the joint one, as in its `LandmarkIdMap`.
    """

    maps: tuple[int, int, int]


MapChange = MapForked | MapReleased | LandmarksCreated | MergeUndone | LandmarkIdMap


class TeamReport(NamedTuple):
    """What one step of `TeamSlam` did.

    Attributes:
        step: Number of this step (the first is 0).
        all_associations: What became of the measurements; `associations` and `created` are cut out of it.
        groups: The groups after this step.
        events: This step's attempts, merges and undos, in order.
        id_maps: One for each merge of this step, in order; apply them after `created`.
        maps: Per robot the number of the map that it goes by after this step. Before the first step they are 0, 1, ...
        map_changes: All that happened to maps in this step, in order, replays and `created` included: whoever keeps
            books on landmarks goes by these.
        oldest_step: Steps from this one on may still be taken in again; 1 + `step` if none.
        rejuvenations: For each filter of which something is to be told the robots that go by it, and what came of
            drawing its particles anew in this step, or what its smoother could not make sense of.
    """

    step: int
    all_associations: Associations
    groups: tuple[tuple[int, ...], ...]
    events: tuple[MergeEvent, ...]
    id_maps: tuple[LandmarkIdMap, ...]
    maps: tuple[int, ...]
    map_changes: tuple[MapChange, ...]
    oldest_step: int
    rejuvenations: tuple[tuple[tuple[int, ...], RejuvenationReport], ...] = ()

    @property
    def associations(self) -> tuple[IntArray, ...]:
        """Per robot (n_i,) int64, as in `StepReport`, ids in the robot's map BEFORE this step's merges and undos."""
        return tuple([self.all_associations.associated(robot) for robot in range(len(self.maps))])

    @property
    def created(self) -> tuple[IntArray, ...]:
        """Per robot (n_i,) int64, as in `StepReport`, ids likewise."""
        return tuple([self.all_associations.created(robot) for robot in range(len(self.maps))])
