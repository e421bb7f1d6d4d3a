"""Reports of teams: merge events, changes of maps, step reports, and counts of attempts. All frozen."""

import math
from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

from slam_backend.core.read_only import as_constant
from slam_backend.core.short_repr import short_repr
from slam_backend.core.validation import IntArray
from slam_backend.fastslam.reports import Associations, RejuvenationReport
from slam_backend.maps.alignment_types import REASONS, Alignment
from slam_backend.state import (
    INT64,
    MAX_LANDMARKS,
    Array,
    Float,
    Int,
    Maybe,
    OneOf,
    Record,
    Row,
    State,
    Text,
    with_state,
)
from slam_backend.team.merge_scheduler import ROBOT, ROBOTS


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class MergeEvent:
    """Attempt to align two groups' maps, merge, or undo of a merge.

    Attributes:
        step: Number of the team's step (the first is 0).
        kind: Kind of the event.
        robots_a: Group whose map frame stays.
        robots_b: The other group.
        alignment: `map` of group a from `map` of group b; refused attempts carry the reason.
        unsmoothed_alignment: Alignment of the filters' own maps, if the attempt smoothed the maps and `alignment` is
            that of the smoothed ones; else None.
        uncertainty: Uncertainty of the motion between aligned maps over the particles of the merge, relative to the
            limit for a merge; beyond 1 the merge may be deferred. NaN if not computed.
    """

    STATE = State(
        step=Int(), kind=Text(("attempt", "merge", "undo")), robots_a=ROBOTS, robots_b=ROBOTS,
        alignment=Record(Alignment), unsmoothed_alignment=Maybe(Record(Alignment)),
        uncertainty=Float(0.0, math.inf, nan=True),
    )  # fmt: skip

    step: int
    kind: Literal["attempt", "merge", "undo"]
    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    alignment: Alignment
    unsmoothed_alignment: Alignment | None = None
    uncertainty: float = float("nan")


@short_repr
@dataclass(frozen=True, slots=True, eq=False)
class LandmarkIdMap:
    """Renaming of the landmark ids of two groups to ids of their joint map.

    Attributes:
        robots_a: Group a before the merge; its landmark ids stay.
        robots_b: Group b before the merge.
        ids_b: (k, 2) int64, read-only. Rows (id in b's map, id in the joint map); fused landmarks get the id of a.
        maps: Numbers of a's map, of b's and of the joint one. The first two are kept until their `MapReleased`: an undo
            restores them.
    """

    STATE = State(
        robots_a=ROBOTS, robots_b=ROBOTS, ids_b=Array(INT64, "n 2", high=MAX_LANDMARKS), maps=Row(Int(), Int(), Int())
    )

    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    ids_b: IntArray
    maps: tuple[int, int, int]

    def __post_init__(self) -> None:
        object.__setattr__(self, "ids_b", as_constant(self.ids_b))

    def __reduce__(self) -> tuple[Any, ...]:
        """Make copies and unpickled objects read-only, too."""
        return LandmarkIdMap, (self.robots_a, self.robots_b, self.ids_b, self.maps)


@dataclass(frozen=True, slots=True)
class MapForked:
    """Fork of a filter: map number `copy` starts as a copy of map number `source`."""

    STATE = State(source=Int(), copy=Int())

    source: int
    copy: int


@dataclass(frozen=True, slots=True)
class MapReleased:
    """End of map number `number`."""

    STATE = State(number=Int())

    number: int


@short_repr
@with_state(number=Int(), robot=ROBOT, step=Int(), ids=Array(INT64, "n", -1, MAX_LANDMARKS))
class LandmarksCreated(NamedTuple):
    """Landmarks that a robot's measurements of one step created in a map.

    Attributes:
        number: Number of the map.
        robot: Index of the robot.
        step: Step of the measurements; in a replay earlier than the step of the report.
        ids: (n,) int64, read-only. Id of the landmark that each measurement created, -1 = none.
    """

    number: int
    robot: int
    step: int
    ids: IntArray


@dataclass(frozen=True, slots=True)
class MergeUndone:
    """Undo of a merge: the two maps before it are restored, and the joint one ends.

    Attributes:
        maps: Numbers of a's map, of b's and of the joint one, as in its `LandmarkIdMap`.
    """

    STATE = State(maps=Row(Int(), Int(), Int()))

    maps: tuple[int, int, int]


MapChange = MapForked | MapReleased | LandmarksCreated | MergeUndone | LandmarkIdMap
MAP_CHANGE = OneOf(MapForked, MapReleased, LandmarksCreated, MergeUndone, LandmarkIdMap)


@short_repr
class TeamReport(NamedTuple):
    """Outcome of one step of `TeamSlam`.

    Attributes:
        step: Number of this step (the first is 0).
        all_associations: Data association of all measurements; `associations` and `created` are parts of it.
        groups: The groups after this step.
        events: This step's attempts, merges and undos, in order.
        id_maps: Landmark renaming of each merge of this step, in order; apply them after `created`.
        maps: Number of each robot's map after this step. Before the first step they are 0, 1, ...
        map_changes: All changes of maps in this step, in order, replays and `created` included: the complete record for
            keeping track of landmarks.
        oldest_step: First step that may still be replayed; 1 + `step` if none.
        rejuvenations: Pairs of robots and outcome, for each filter with a rejuvenation, or a failure of its smoother,
            in this step.
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
        """Per robot (n_i,) int64, as in `StepReport`; ids of the robot's map BEFORE this step's merges and undos."""
        return tuple([self.all_associations.associated(robot) for robot in range(len(self.maps))])

    @property
    def created(self) -> tuple[IntArray, ...]:
        """Per robot (n_i,) int64, as in `StepReport`; ids as in `associations`."""
        return tuple([self.all_associations.created(robot) for robot in range(len(self.maps))])


@dataclass(frozen=True, slots=True, kw_only=True)
class PairAttempts:
    """Attempts of one pair of groups to align their maps.

    Attributes:
        robots_a: Robots of the first group at that time.
        robots_b: Robots of the second group.
        attempts: Number of attempts.
        refusals: Number of refused attempts by reason, in the order of `REASONS`.
        last_reason: Reason of the last refusal; empty if there was none.
        last_step: Step of the last refusal; None if there was none.
        missed: Bound that the last refusal missed, see `Alignment.missed`.
        excess: Value of that bound over its limit, see `Alignment.excess`.
    """

    robots_a: tuple[int, ...]
    robots_b: tuple[int, ...]
    attempts: int
    refusals: Mapping[str, int]
    last_reason: str
    last_step: int | None
    missed: str
    excess: float


def count_attempts(events: Iterable[MergeEvent]) -> tuple[PairAttempts, ...]:
    """Return the attempts of each pair of groups, in order of their first attempts.

    Args:
        events: All events of a team, in order; merges and undos are ignored.
    """
    tried: dict[tuple[tuple[int, ...], tuple[int, ...]], list[MergeEvent]] = {}
    for event in events:
        if event.kind == "attempt":
            tried.setdefault((event.robots_a, event.robots_b), []).append(event)
    return tuple(_of_pair(attempts) for attempts in tried.values())


def refusals_of(events: Iterable[MergeEvent], robot: int) -> dict[str, float]:
    """Return the number of attempts of a robot's groups, and the number of refusals for each reason.

    Args:
        events: All events of a team.
        robot: Index of the robot.

    Returns:
        `attempts`, and for each of `REASONS` a key such as `refused_too_uncertain`.
    """
    attempts = [event for event in events if event.kind == "attempt" and robot in event.robots_a + event.robots_b]
    counts = Counter(event.alignment.reason for event in attempts)
    refusals = {f"refused_{reason.replace(' ', '_')}": float(counts[reason]) for reason in REASONS}
    return {"attempts": float(len(attempts))} | refusals


def _of_pair(events: list[MergeEvent]) -> PairAttempts:
    """Return the summary of one pair's attempts, at least one."""
    refused = [event for event in events if not event.alignment.success]
    counts = Counter(event.alignment.reason for event in refused)
    last = refused[-1] if refused else None
    return PairAttempts(
        robots_a=events[0].robots_a,
        robots_b=events[0].robots_b,
        attempts=len(events),
        refusals={reason: counts[reason] for reason in REASONS if counts[reason]},
        last_reason=last.alignment.reason if last else "",
        last_step=last.step if last else None,
        missed=last.alignment.missed if last else "",
        excess=last.alignment.excess if last else float("nan"),
    )
