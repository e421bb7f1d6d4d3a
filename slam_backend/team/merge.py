"""Merges of groups as processes with phases, and their owner in a team."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.maps.alignment import Alignment, align_maps
from slam_backend.state import (
    Child,
    ChildOf,
    Dict,
    Each,
    Flag,
    Generator,
    Int,
    Maybe,
    Options,
    Record,
    Row,
    Sizes,
    Snapshot,
    State,
    restored,
)
from slam_backend.team.branches import MAX_REPLAYED, Branch, ReplayedStep, replay
from slam_backend.team.filter_merging.pairing import Pairing
from slam_backend.team.group_merging import (
    JoinedGroups,
    MergePlan,
    is_refuted,
    join_groups,
    relative_uncertainty,
    separate_groups,
    transform_uncertainty,
)
from slam_backend.team.groups import Group, TeamTopology
from slam_backend.team.merge_attempt import (
    GroupPair,
    MapPair,
    align_smoothed,
    are_connected,
    choose_pair,
    key_of,
    map_numbers,
    mixture_maps,
    pairs_of,
    representatives,
)
from slam_backend.team.merge_monitor import are_both_connected
from slam_backend.team.merge_scheduler import PAIR, ROBOTS, MergeScheduler, PairKey
from slam_backend.team.options import MergeOptions
from slam_backend.team.reports import LandmarkIdMap, MergeEvent, MergeUndone
from slam_backend.team.shared_records import SharedRecords

MAX_SMOOTHING_STEPS = 40  # longest wait for smoothed maps and contact; then the maps are used as they are
MIN_REPLAYED = 2  # least input steps replayed per side and step of the team, which itself adds one


@dataclass(slots=True, eq=False)
class MergeProcess:
    """One merge of two groups, from the first alignment of their maps to its end.

    | phase | what happens in it | what ends it | next phase |
    |---|---|---|---|
    | attempt | The maps of the pair with the most new candidates are aligned. | an alignment | smoothing; trial without smoothers |
    | | | a refusal | refused |
    | smoothing | Both filters smooth, some work in each step. | both are smooth or 40 steps have passed, in contact | trial, in the next step |
    | | | a filter is replaced, or no contact after 40 steps | abandoned |
    | trial | Smoothed maps are aligned again; the joint graph, or particles, tell how uncertain the motion is. | motion known well enough, or waiting does not help | watched; final if merges are not monitored |
    | | | a refusal | refused |
    | watched | The filters are one; two tests run each 20 steps in contact. | a test fails in contact | undoing |
    | | | 200 steps in contact, and the end of earlier merges of the group | final |
    | undoing | The joint filter goes on, while those from before the merge replay the inputs since, 20 steps at a time. | they have caught up, and all sides are in contact | undone |
    | | | the group merges again, or a fork without the monitor replaces its filter | watched |
    | undone | The separate filters go on. Forks of the joint one still know its map. | the last of these forks returns | final |
    | refused | The pair waits for 25 steps or more. | | |
    | abandoned | The pair may try again at once. | | |
    | final | The merge cannot be undone any more. | | |

    Attempt and trial take no time. An undo of a merge undoes those on top of it, too.

    Attributes:
        pair: Robots of both groups; the map frame of the first one stays.
        phase: Present phase, with what it needs.
    """  # noqa: E501

    STATE = State(pair=PAIR, phase=ChildOf(lambda: Smoothing, lambda: Watched, lambda: Undoing, lambda: Undone))
    pair: PairKey
    phase: "Phase"

    def advance(self, team: "TeamMerges") -> None:
        """Do a step's part of the phase, and enter the next one if it ends."""
        before = self.phase
        self.phase = before.advance(team)
        if isinstance(self.phase, (Trial, Undoing)) and self.phase is not before:
            self.phase = self.phase.advance(team)  # these begin in the step in which they are entered

    @property
    def joined(self) -> JoinedGroups | None:
        """What it takes to undo the merge; None in phases without."""
        return self.phase.joined if isinstance(self.phase, (Watched, Undoing, Undone)) else None

    @property
    def oldest_step(self) -> int | None:
        """First step that an undo would replay; None if there will be none."""
        return None if self.joined is None else self.joined.oldest_step


# ---------------------------------------------------------------------- before the merge


@dataclass(frozen=True, slots=True, eq=False)
class Attempt:
    """Alignment of two groups' maps as they are."""

    name: ClassVar[str] = "attempt"
    groups: GroupPair
    maps: MapPair

    def advance(self, team: "TeamMerges") -> "Phase":
        """Align the maps."""
        alignment = align_maps(*self.maps, rng=team.rng, options=team.schedule.alignment)
        team.records.exchange.record_maps(*representatives(self.groups), *self.maps)
        can_smooth = all(group.trunk.filter.can_rejuvenate for group in self.groups)
        if not (alignment.success and team.merging.smooth_first and can_smooth):
            return Trial(MergePlan(self.groups, self.maps, alignment), None)
        for group in self.groups:
            group.trunk.filter.request_rejuvenation()
        return Smoothing(map_numbers(self.groups), alignment, team.step)


@dataclass(slots=True, eq=False)
class Smoothing:
    """Smoothing of both maps, which are then aligned again.

    Attributes:
        numbers: Numbers of both joint filters' maps.
        unsmoothed: Alignment of the maps as they were.
        since: Step in which it began.
        ready: Whether both maps are smoothed; the trial comes one step later, which limits the work per step.
    """

    name: ClassVar[str] = "smoothing"
    STATE = State(numbers=Row(Int(), Int()), unsmoothed=Record(Alignment), since=Int(high="STEPS"), ready=Flag())
    numbers: tuple[int, int]
    unsmoothed: Alignment
    since: int
    ready: bool = False

    def advance(self, team: "TeamMerges") -> "Phase":
        """Wait for the smoothers, which work in the filters' steps."""
        groups = next((pair for pair in pairs_of(team.free_groups) if map_numbers(pair) == self.numbers), None)
        is_late = team.step - self.since >= MAX_SMOOTHING_STEPS
        if groups is None or (is_late and not are_connected(groups, team.networks)):
            return ABANDONED
        if not (self.ready and are_connected(groups, team.networks)):
            is_smooth = not any(group.trunk.filter.rejuvenation_requested for group in groups)
            self.ready |= is_late or is_smooth
            return self
        maps = mixture_maps(groups)
        alignment = align_smoothed(maps, self.unsmoothed, team.schedule.alignment, team.rng)
        team.records.exchange.record_smoothed(*representatives(groups), *maps)
        return Trial(MergePlan(groups, maps, alignment), self.unsmoothed)


@dataclass(frozen=True, slots=True, eq=False)
class Trial:
    """Decision about the merge, by the uncertainty of the motion between the maps.

    Attributes:
        plan: Groups, maps and alignment, which may be a refusal.
        unsmoothed: Alignment of the unsmoothed maps, if these were smoothed.
    """

    name: ClassVar[str] = "trial"
    plan: MergePlan
    unsmoothed: Alignment | None

    def advance(self, team: "TeamMerges") -> "Phase":
        """Merge the groups if the motion is known well enough."""
        merging, plan, pairing = team.merging, self.plan, None
        uncertainty, before = float("nan"), team.rng.bit_generator.state
        alignment, key = plan.alignment, key_of(plan.groups)
        if alignment.success and merging.min_sigmas:
            start = plan.relative_start()
            if start is None:
                pairing = plan.pair_particles(merging, team.rng)
                relative = transform_uncertainty(plan, pairing)
            else:
                relative = relative_uncertainty(start.covariance)
            uncertainty = merging.min_sigmas * relative
            if start is not None and uncertainty <= 1.0:
                plan = plan.with_motion(start)
            alignment = plan.alignment
            if team.schedule.should_defer(key, uncertainty):
                alignment = Alignment.refused("too uncertain", alignment.ratio, "paths", uncertainty)
        team.schedule.record(key, team.step, alignment.success, self.unsmoothed is not None)
        team.events.append(MergeEvent(team.step, "attempt", *key, alignment, self.unsmoothed, uncertainty))
        if not alignment.success:
            team.rng.bit_generator.state = before  # the draws for the merge are dropped
            return REFUSED
        if pairing is None:
            pairing = plan.pair_particles(merging, team.rng)
        return team.join(plan, pairing)[1]


# ---------------------------------------------------------------------- after the merge


@dataclass(slots=True, eq=False)
class Watched:
    """Monitoring of a merge that can be undone."""

    name: ClassVar[str] = "watched"
    STATE = State(joined=Record(JoinedGroups))
    joined: JoinedGroups

    def advance(self, team: "TeamMerges") -> "Phase":
        """Test the merge, if a test is due."""
        is_due = team.step % team.merging.watch_every == 0
        group = next(group for group in team.groups if self.joined.number in group.merge_numbers)
        if not (is_due and is_refuted(self.joined.number, group.trunk, team.merging, team.schedule.alignment)):
            return self
        return team.rollback(self.joined, group)


@dataclass(slots=True, eq=False)
class Undoing:
    """Rollback of a merge and of those on top of it, over several steps, which bounds the replayed input per step.

    Attributes:
        joined: Groups that the merge joined.
        robots: Robots of the group.
        trunks: Trunks from before the merges, on their way to the present. Their robots still use the joint filter.
        replayed: Steps replayed by each of them so far.
    """

    name: ClassVar[str] = "undoing"
    STATE = State(
        joined=Record(JoinedGroups), robots=ROBOTS, trunks=Each(Child(Branch), "sides", list),
        replayed=Each(Each(Record(ReplayedStep), kind=list), "sides", list),
    )  # fmt: skip
    joined: JoinedGroups
    robots: tuple[int, ...]
    trunks: list[Branch]
    replayed: list[list[ReplayedStep]]

    def advance(self, team: "TeamMerges") -> "Phase":
        """Replay some steps, and separate the groups when all sides have caught up and are in contact."""
        group = next(group for group in team.groups if group.robots == self.robots)
        if self.joined.number not in group.merge_numbers:
            team.is_stale = True
            return Watched(self.joined)
        merges = list(team.merges_down_to(self.joined.number, group.merge_numbers))
        has_caught_up = self._catch_up(group.trunk, team.records)
        active_robots = group.trunk.active_robots
        if not has_caught_up or not all(are_both_connected(each.pair, active_robots) for each in merges):
            return self
        team.records.entries += [MergeUndone((*each.map_numbers, each.number)) for each in merges]
        for trunk, replayed in zip(self.trunks, self.replayed, strict=True):
            team.records.note_replay(trunk.number, replayed)
        team.epoch += 1
        team.replace([group], separate_groups(group, self.trunks, team.epoch, team.records))
        for each in merges:
            team.events.append(MergeEvent(team.step, "undo", *each.pair, each.alignment))
            team.joined[each.number].phase = Undone(each)
        team.schedule.block(self.joined.pair, team.step + team.merging.blocked_steps)
        return Undone(self.joined)

    def _catch_up(self, joint: Branch, records: SharedRecords) -> bool:
        """Replay some steps that the joint filter has processed, and return whether all sides are up to date."""
        share = max(MIN_REPLAYED, MAX_REPLAYED // len(self.trunks))
        for trunk, replayed in zip(self.trunks, self.replayed, strict=True):
            wanted = {robot: joint.last_steps[robot] for robot in trunk.robots}
            replayed += replay(trunk, records.log, wanted, share)
        return all(last >= joint.last_steps[robot] for trunk in self.trunks for robot, last in trunk.last_steps.items())


@dataclass(slots=True, eq=False)
class Undone:
    """Time after an undo in which forks of the joint filter remain."""

    name: ClassVar[str] = "undone"
    STATE = State(joined=Record(JoinedGroups))
    joined: JoinedGroups

    def advance(self, team: "TeamMerges") -> "Phase":
        """Wait for the robots of these forks."""
        return self


@dataclass(frozen=True, slots=True)
class Ended:
    """End of a process, of which nothing is left."""

    name: str

    def advance(self, team: "TeamMerges") -> "Phase":
        """Stay."""
        return self


REFUSED, ABANDONED, FINAL = Ended("refused"), Ended("abandoned"), Ended("final")
Phase = Attempt | Smoothing | Trial | Watched | Undoing | Undone | Ended


# ---------------------------------------------------------------------- all merges of a team


@dataclass(slots=True, eq=False)
class TeamMerges:
    """Owner of the groups of a team and of their merges.

    Attributes:
        groups: Groups by ascending robots.
        records: Records of the team.
        schedule: Scheduler of attempts.
        merging: Options of merges and of their undo.
        rng: Generator of alignments and merges.
        epoch: Number of merges and undos so far.
        events: Attempts, merges and undos so far.
        attempt: Process that smooths maps, or None: one pair tries at a time.
        joined: Processes of merges that a filter still monitors, by the number of the joint map.
        step: Present step.
        networks: (K,) robots with the same number are in contact.
        is_stale: Whether groups, branches or monitors have changed since the last `topology`.
    """

    STATE = State(
        groups=Each(Child(Group), kind=list), schedule=Child(MergeScheduler), merging=Options(MergeOptions),
        rng=Generator(), epoch=Int(), events=Each(Record(MergeEvent), kind=list),
        attempt=Maybe(Child(MergeProcess)), joined=Dict(Int(), Child(MergeProcess)),
    )  # fmt: skip

    groups: list[Group]
    records: SharedRecords
    schedule: MergeScheduler
    merging: MergeOptions
    rng: np.random.Generator
    epoch: int = 0
    events: list[MergeEvent] = field(default_factory=list)
    attempt: MergeProcess | None = None
    joined: dict[int, MergeProcess] = field(default_factory=dict)
    step: int = 0
    networks: IntArray = field(default_factory=lambda: np.empty(0, np.int64))
    is_stale: bool = False

    def advance(self, step: int, networks: IntArray) -> None:
        """Advance the merges of each group, then the attempt in progress, or a new one."""
        self.step, self.networks = step, networks
        if self.joined:
            for group in list(self.groups):
                self._advance_group(group)
        if self.attempt is None and self.schedule.is_due(step):
            self.attempt = self._new_attempt()
        if self.attempt is not None:
            process, self.attempt = self.attempt, None
            process.advance(self)
            self._keep(process)

    def _advance_group(self, group: Group) -> None:
        """Advance the undo in a group, or its merges, oldest first, until an undo begins."""
        processes = [each for each in self.joined.values() if _robots_undoing(each) == group.robots]
        is_undoing = bool(processes)
        for process in processes or [self.joined[number] for number in group.merge_numbers]:
            process.advance(self)
            if is_undoing or not isinstance(process.phase, Watched):
                return
        self.is_stale |= group.drop_monitors(self.merging.watch_steps)

    def _new_attempt(self) -> MergeProcess | None:
        """Return the process of the pair that may try; None if no pair may."""
        chosen = choose_pair(self.free_groups, self.networks, self.step, self.schedule)
        return None if chosen is None else MergeProcess(key_of(chosen[0]), Attempt(*chosen))

    def _keep(self, process: MergeProcess) -> None:
        """Keep a process that goes on."""
        if isinstance(process.phase, Smoothing):
            self.attempt = process
        elif process.joined is not None:
            self.joined[process.joined.number] = process

    @property
    def free_groups(self) -> list[Group]:
        """Groups without an undo in progress."""
        busy = {_robots_undoing(process) for process in self.joined.values()}
        return [group for group in self.groups if group.robots not in busy]

    @property
    def watched(self) -> list[JoinedGroups]:
        """Merges that joint filters monitor, oldest first."""
        numbers = sorted(number for group in self.groups for number in group.merge_numbers)
        return [self._monitored(number) for number in numbers]

    def merge(self, plan: MergePlan, step: int, known: bool = False) -> LandmarkIdMap:
        """Merge two groups by a given alignment before a step, without an attempt; see `merge_filters` for `known`."""
        self.step = step
        for process in self.joined.values():
            if isinstance(process.phase, Undoing) and process.phase.robots in key_of(plan.groups):
                process.phase = Watched(process.phase.joined)
        id_map, phase = self.join(plan, plan.pair_particles(self.merging, self.rng, known))
        self._keep(MergeProcess(key_of(plan.groups), phase))
        return id_map

    def join(self, plan: MergePlan, pairing: Pairing) -> tuple[LandmarkIdMap, Phase]:
        """Join two groups; return the renaming of landmarks, and the phase that follows."""
        group, id_map = join_groups(plan, pairing, self.merging, self.records, self.rng, self.epoch + 1)
        self.epoch += 1
        self.events.append(MergeEvent(self.step, "merge", id_map.robots_a, id_map.robots_b, plan.alignment))
        self.replace(plan.groups, [group])
        is_final = self.merging.watch_steps == 0
        return id_map, FINAL if is_final else Watched(JoinedGroups.of(plan, group.trunk.number))

    def replace(self, old: Sequence[Group], new: Sequence[Group]) -> None:
        """Replace some groups by others."""
        self.groups[:] = [group for group in self.groups if all(group is not each for each in old)] + list(new)
        self.groups.sort(key=lambda group: group.robots)
        self.is_stale = True

    def rollback(self, joined: JoinedGroups, group: Group) -> Undoing:
        """Return the start of an undo of a group's merge."""
        trunks = [restored(side) for side in self._sides_down_to(joined.number, group.merge_numbers)]
        return Undoing(joined, group.robots, trunks, [[] for _ in trunks])

    def merges_down_to(self, number: int, monitored: Sequence[int]) -> Iterator[JoinedGroups]:
        """Yield the merges to undo, the last of those monitored first, to undo the one that made map `number`."""
        joined = self._monitored(monitored[-1])
        yield joined
        for earlier in joined.earlier:
            if number in earlier:
                yield from self.merges_down_to(number, earlier)

    def _sides_down_to(self, number: int, monitored: Sequence[int]) -> Iterator[Snapshot]:
        """Yield the states of the trunks that remain when these merges are undone."""
        joined = self._monitored(monitored[-1])
        for side, earlier in zip(joined.sides, joined.earlier, strict=True):
            if number in earlier:
                yield from self._sides_down_to(number, earlier)
            else:
                yield side

    def _monitored(self, number: int) -> JoinedGroups:
        """Return what it takes to undo a monitored merge."""
        joined = self.joined[number].joined
        assert joined is not None
        return joined

    def topology(self) -> TeamTopology:
        """Return the assignment of robots to filters, and end the processes of merges that no filter monitors."""
        waiting = [number for group in self.groups for branch in group.branches for number in branch.merge_numbers]
        monitored: set[int] = set()
        while waiting:
            number = waiting.pop()
            if number not in monitored:
                monitored.add(number)
                for earlier in self._monitored(number).earlier:
                    waiting += earlier
        for number, process in list(self.joined.items()):
            if number not in monitored and not isinstance(process.phase, Undoing):
                self.joined.pop(number).phase = FINAL
        self.is_stale = False
        merges = [self._monitored(number) for number in monitored]
        return TeamTopology.of(self.groups, [(joined.oldest_step, set(joined.map_numbers)) for joined in merges])

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise unless groups share out all robots, and each monitor and each undo fits a merge."""
        trunks = [group["branches"][0]["robots"] for group in parts["groups"]]
        if trunks != sorted(trunks) or sorted(sum(trunks, ())) != list(range(sizes["K"])):
            raise ValueError("groups that do not share out all robots, ordered by their first ones")
        if parts["attempt"] is not None and parts["attempt"]["phase"].of is not Smoothing:
            raise ValueError("an attempt in another phase than smoothing")
        pairs: dict[int, PairKey] = {}
        for number, process in parts["joined"].items():
            joined = process["phase"].get("joined")
            if joined is None or joined.number != number or process["pair"] != joined.pair:
                raise ValueError("a merge of other groups")
            if any(other >= number for earlier in joined.earlier for other in earlier):
                raise ValueError("a merge that undoes a later one")
            pairs[number] = joined.pair
            if process["phase"].of is Undoing:
                robots, parted = process["phase"]["robots"], [trunk["robots"] for trunk in process["phase"]["trunks"]]
                if robots not in trunks or tuple(sorted(sum(parted, ()))) != robots:
                    raise ValueError("an undo in no group")
        for branch in branches_in(parts):
            for monitor in branch["monitors"]:
                pair = pairs.get(monitor["number"])
                if pair is None or monitor["pair"] != pair or not {*pair[0], *pair[1]} <= set(branch["robots"]):
                    raise ValueError("a monitor of no merge")


def branches_in(merges: Mapping[str, Any]) -> Iterator[Snapshot]:
    """Yield the states of all branches in a state of `TeamMerges`: in use, from before a merge, and replaying."""
    for group in merges["groups"]:
        yield from group["branches"]
    for process in merges["joined"].values():
        yield from process["phase"]["joined"].sides
        yield from process["phase"].get("trunks", ())


def _robots_undoing(process: MergeProcess) -> tuple[int, ...] | None:
    """Return the robots of the group that undoes a merge; None in other phases."""
    return process.phase.robots if isinstance(process.phase, Undoing) else None
