"""What a state of `TeamSlam` must be so that a team can go on from it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend.core.state_checks import (
    BOOL,
    FARTHEST,
    FLOAT32,
    MOST,
    check_each,
    check_flag,
    check_floats,
    check_generator,
    check_indices,
    check_kept,
    check_keys,
    check_kind,
    check_length,
    check_number,
    check_options,
    check_robots,
    check_whole,
    check_wholes,
    refuse,
)
from slam_backend.core.validation import bad_argument
from slam_backend.fastslam._kernels import PLACED
from slam_backend.fastslam._kernels.layout import ACT, BEGIN, COUNT, END, GIVEN, NAMED
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.reports import (
    Findings,
    LandmarksCreated,
    MapCopied,
    MapDropped,
    MergeEvent,
    MergeUndone,
    RejuvenationReport,
    Renaming,
    StepReport,
)
from slam_backend.fastslam.state_checks import MOST_LANDMARKS, check_filter, check_landmarks, last_step
from slam_backend.fastslam.step_input import StepInput
from slam_backend.maps.alignment_types import Alignment, AlignmentOptions
from slam_backend.models.measurements import LARGEST_DESCRIPTOR
from slam_backend.smoother.log_arrays import REJECTED
from slam_backend.team.branches import ReplayedStep
from slam_backend.team.merge_monitor import Side, Watch
from slam_backend.team.merge_scheduler import AttemptOptions, AttemptRecord, Straightening
from slam_backend.team.options import MergeOptions

BY_ROBOTS = ("doubts", "trials")  # parts of the schedule with an entry for each pair of robots
KEYS = ("step", "epoch", "rng", "events", "groups", "numbers", "alignment", "merging", "schedule", "records")
BRANCH = ("robots", "live", "filter", "known", "number", "epoch", "report", "watches", "split_from", "split_counts")
KINDS = ("attempt", "merge", "undo")


class TeamCheck:
    """Checks the parts of one state.

    Args:
        num_robots: K.
        kept: Readings by step that the team holds already: the same ones are not looked at again.
        known: Options of its filters that were checked before.

    Attributes:
        descriptor_sizes: Lengths of the descriptors in it.
        options: Options of all its filters.
    """

    def __init__(self, num_robots: int, kept: Mapping[int, StepInput], known: Sequence[FilterOptions] = ()) -> None:
        self._count, self._kept, self._known = num_robots, kept, known
        self._step = self._next_number = 0
        self._inputs: Mapping[int, StepInput] = {}
        self.descriptor_sizes: set[int] = set()
        self.options: list[FilterOptions] = []
        self._done: set[int] = set()  # by `id`: sides that were looked at, for merges share them

    def check(self, name: str, state: Any) -> None:
        """Refuse what is no state of a team of K robots.

        Raises:
            ValueError: By name of the part that is wrong.
        """
        check_keys(name, state, KEYS)
        check_length(f"{name}['groups']", state["groups"])
        for i, group in enumerate(state["groups"]):
            check_keys(f"{name}['groups'][{i}]", group, ("branches", "undoing"))
            check_length(f"{name}['groups'][{i}]['branches']", group["branches"])
            for branch in group["branches"]:
                check_keys(f"{name}['groups'][{i}]['branches']", branch, BRANCH)
                check_kind(f"{name}['groups'][{i}]['branches']['robots']", branch["robots"], tuple)
        found = sum(len(group["branches"][0]["robots"]) for group in state["groups"] if group["branches"])
        if found != self._count:
            raise bad_argument(name, f"one of {self._count} robots", found, "Build a team of the same size.")
        check_whole(f"{name}['step']", state["step"])
        check_whole(f"{name}['epoch']", state["epoch"])
        check_generator(f"{name}['rng']", state["rng"])
        check_options(f"{name}['alignment']", state["alignment"], AlignmentOptions)
        check_options(f"{name}['merging']", state["merging"], MergeOptions)
        self._step = state["step"]
        self._check_records(f"{name}['records']", state["records"])
        check_length(f"{name}['events']", state["events"])
        for event in state["events"]:
            self._check_event(f"{name}['events']", event)
        check_wholes(f"{name}['numbers']", state["numbers"], 0, self._next_number - 1)
        self._check_schedule(f"{name}['schedule']", state["schedule"])
        robots: list[int] = []
        for i, group in enumerate(state["groups"]):
            self._check_group(f"{name}['groups'][{i}]", group, robots)
        if sorted(robots) != list(range(self._count)):
            refuse(f"{name}['groups']", "groups of all robots, each in one", robots)
        firsts = [group["branches"][0]["robots"] for group in state["groups"]]
        if firsts != sorted(firsts):
            refuse(f"{name}['groups']", "groups in the order of their first robots", firsts)
        if len(self.descriptor_sizes) > 1:
            refuse(name, "descriptors of one length", sorted(self.descriptor_sizes))

    # ------------------------------------------------------------------ groups

    def _check_group(self, name: str, group: Mapping[str, Any], robots: list[int]) -> None:
        """Refuse what is no group; add its robots to those of others."""
        branches = group["branches"]
        live: list[int] = []
        for i, branch in enumerate(branches):
            self._check_branch(f"{name}['branches'][{i}]", branch)
            if not branch["live"]:
                refuse(f"{name}['branches'][{i}]['live']", "some robots", "none")
            live += branch["live"]
            self._check_oldest(f"{name}['branches'][{i}]", branch)
        trunk = branches[0]["robots"]
        if sorted(live) != list(trunk):
            refuse(f"{name}['branches']", f"branches by which {trunk} go, each by one", live)
        robots += trunk
        undoing = group["undoing"]
        if undoing is not None:
            check_keys(f"{name}['undoing']", undoing, ("number", "sides", "replayed"))
            check_whole(f"{name}['undoing']['number']", undoing["number"], 0, self._next_number - 1)
            sides = undoing["sides"]
            check_length(f"{name}['undoing']['sides']", sides)
            for side in sides:
                self._check_branch(f"{name}['undoing']['sides']", side)
            self._check_parts(f"{name}['undoing']['sides']", [side["robots"] for side in sides], trunk)
            for where, replayed in check_each(f"{name}['undoing']['replayed']", undoing["replayed"], len(sides)):
                check_length(where, replayed)
                for done in replayed:
                    self._check_replayed(where, done)
            if all(watch.number != undoing["number"] for watch in branches[0]["watches"]):
                return  # the joint filter is another one now
            for side in sides:
                for robot, last in side["known"].items():
                    self._need_from(f"{name}['undoing']['sides']", last + 1)
                    if last > branches[0]["known"].get(robot, -1):
                        refuse(f"{name}['undoing']['sides']", "sides that know no more than the joint filter", last)

    def _check_parts(self, name: str, parts: Sequence[Sequence[int]], whole: Sequence[int]) -> None:
        if sorted(robot for part in parts for robot in part) != list(whole):
            refuse(name, f"parts of {whole}", parts)

    def _check_branch(self, name: str, branch: Any) -> None:
        """Refuse what is no branch, whose filter and watches are checked with it."""
        check_keys(name, branch, BRANCH)
        robots, live, known = branch["robots"], branch["live"], branch["known"]
        check_robots(f"{name}['robots']", robots, self._count)
        check_kind(f"{name}['live']", live, tuple)
        if live:
            check_robots(f"{name}['live']", live, self._count)
        if not set(live) <= set(robots):
            refuse(f"{name}['live']", f"some of {robots}", live)
        check_kind(f"{name}['known']", known, dict)
        check_wholes(f"{name}['known']", tuple(known), 0, self._count)
        if set(known) != set(robots):
            refuse(f"{name}['known']", f"the last step of each of {robots}", known)
        check_wholes(f"{name}['known']", tuple(known.values()), -1, self._step - 1)
        check_whole(f"{name}['number']", branch["number"], 0, self._next_number - 1)
        check_whole(f"{name}['epoch']", branch["epoch"])
        check_filter(f"{name}['filter']", branch["filter"], self._known)
        if len(branch["filter"]["poses"]) != len(robots):
            refuse(f"{name}['filter']", f"one of {len(robots)} robots", len(branch["filter"]["poses"]))
        for robot, log in zip(robots, branch["filter"]["logs"], strict=True):
            if last_step(log) > known[robot]:
                refuse(f"{name}['known']", f"at least {last_step(log)}, the last step logged", known[robot])
        self.options.append(branch["filter"]["options"])
        looks = branch["filter"]["maps"]["descriptors"]
        if len(looks):
            self.descriptor_sizes.add(looks.shape[1])
        if branch["report"] is not None:
            self._check_report(f"{name}['report']", branch["report"], len(robots))
        if branch["split_from"] is not None:
            check_whole(f"{name}['split_from']", branch["split_from"], 0, self._next_number - 1)
        self._check_pairs(f"{name}['split_counts']", branch["split_counts"])
        check_length(f"{name}['watches']", branch["watches"])
        for i, watch in enumerate(branch["watches"]):
            self._check_watch(f"{name}['watches'][{i}]", watch, robots)
        if branch["watches"]:
            numbers = [watch.number for watch in branch["watches"]]
            if numbers != sorted(set(numbers)):
                refuse(f"{name}['watches']", "merges from the oldest to the newest", numbers)

    def _check_oldest(self, name: str, branch: Mapping[str, Any]) -> None:
        """Refuse a branch that may have to take in steps that are not kept."""
        for robot, last in branch["known"].items():
            if robot not in branch["live"]:
                self._need_from(name, last + 1)
            elif last != self._step - 1 and self._step:
                refuse(f"{name}['known']", f"{self._step - 1} of a robot that goes by it", last)
        for watch in branch["watches"]:
            for side in watch.sides:
                self._need_from(name, side.oldest)

    def _need_from(self, name: str, first: int) -> None:
        """Refuse a state in which a step from `first` on is not kept."""
        if first < self._step and (first not in self._inputs or len(self._inputs) < self._step - first):
            refuse(name, "steps whose readings are kept", f"one that knows nothing from step {first} on")

    def _check_watch(self, name: str, watch: Any, robots: Sequence[int]) -> None:
        """Refuse what is no watch of a merge of some of these robots."""
        check_kind(name, watch, Watch)
        check_whole(f"{name}.number", watch.number, 0, self._next_number - 1)
        check_whole(f"{name}.steps", watch.steps)
        check_kind(f"{name}.alignment", watch.alignment, Alignment)
        check_length(f"{name}.sides", watch.sides, 2)
        check_length(f"{name}.before", watch.before, 2)
        check_length(f"{name}.own", watch.own, 2)
        for landmarks in watch.before:
            check_landmarks(f"{name}.before", landmarks)
        for own in watch.own:
            check_kind(f"{name}.own", own, set)
            check_wholes(f"{name}.own", own, 0, MOST_LANDMARKS)
        for side in watch.sides:
            check_kind(f"{name}.sides", side, Side)
            if id(side) not in self._done:
                self._done.add(id(side))
                self._check_branch(f"{name}.sides", side.trunk)
            earliest = [1 + min(side.trunk["known"].values()), *(s.oldest for w in side.watches for s in w.sides)]
            check_whole(f"{name}.sides.oldest", side.oldest, 0, min(earliest))
        one, two = (side.robots for side in watch.sides)
        if set(one) & set(two) or not {*one, *two} <= set(robots):
            refuse(f"{name}.sides", f"two parts of {robots}", (one, two))

    # ------------------------------------------------------------------ readings and reports

    def _check_inputs(self, name: str, inputs: Any) -> None:
        """Refuse what are no readings of K robots in one step."""
        check_kind(name, inputs, StepInput)
        n = len(inputs.sightings) if isinstance(inputs.sightings, np.ndarray) else 0
        table = inputs.table
        check_floats(f"{name}.sightings", inputs.sightings, (n, 9), -FARTHEST, FARTHEST, 3)
        check_indices(f"{name}.table", table, (self._count, 6), -1, MOST)
        check_turns(f"{name}.turns", inputs.turns, n, self._count)
        if [list(turn) for turn in inputs.turns] != table.tolist():
            refuse(f"{name}.table", "the turns", "others")
        check_floats(f"{name}.moves", inputs.moves, (self._count, 3), -FARTHEST, FARTHEST)
        largest = float(LARGEST_DESCRIPTOR)
        check_floats(f"{name}.descriptors", inputs.descriptors, (n, None), -largest, largest, dtype=FLOAT32)
        if n:
            self.descriptor_sizes.add(inputs.descriptors.shape[1])
        is_named = bool(table[:, NAMED].any())
        check_indices(f"{name}.names", inputs.names, (n if is_named else len(inputs.names),), -1, MOST)
        if len(inputs.names) not in (0, n):
            refuse(f"{name}.names", "one for each measurement, or none", len(inputs.names))
        for _, begin, end, given, _, _ in inputs.turns:
            if given:
                own = inputs.sightings[begin:end]
                check_floats(f"{name}.sightings", own, (end - begin, 9))
        check_masks(f"{name}.masks", inputs.masks, inputs.turns)
        check_kind(f"{name}.silent", inputs.silent, frozenset)
        check_wholes(f"{name}.silent", inputs.silent, 0, self._count - 1)

    def _check_replayed(self, name: str, done: Any) -> None:
        """Refuse what is no step that was taken in late."""
        check_kind(name, done, ReplayedStep)
        check_whole(f"{name}.step", done.step, 0, self._step)
        check_robots(f"{name}.robots", done.robots, self._count)
        if self._inputs.get(done.step) is not done.inputs:
            self._check_inputs(f"{name}.inputs", done.inputs)
        self._check_report(f"{name}.report", done.report, None)

    def _check_report(self, name: str, report: Any, robots: int | None) -> None:
        """Refuse what is no report of a step of a filter of some robots; None: of any number."""
        check_kind(name, report, StepReport)
        found = report.findings
        check_kind(f"{name}.findings", found, Findings)
        check_indices(f"{name}.findings.told", found.told, (2, None), REJECTED, MOST_LANDMARKS)
        check_turns(f"{name}.findings.turns", found.turns, found.told.shape[1], None)
        check_masks(f"{name}.findings.masks", found.masks, found.turns)
        check_kind(f"{name}.rows", report.rows, tuple)
        check_wholes(f"{name}.rows", report.rows, -1, min(len(found.turns), self._count) - 1)
        if robots is not None and len(report.rows) != robots:
            refuse(f"{name}.rows", f"a row for each of {robots} robots", report.rows)
        for part in ("num_created", "num_new", "num_matched", "num_rejected"):
            check_whole(f"{name}.{part}", getattr(report, part))
        check_number(f"{name}.ess", report.ess, 0.0)
        if not (isinstance(report.nis, float) and (report.nis >= 0.0 or report.nis != report.nis)):
            refuse(f"{name}.nis", "a float at least 0, or NaN", report.nis)
        if report.rejuvenation is not None:
            check_kind(f"{name}.rejuvenation", report.rejuvenation, RejuvenationReport)

    # ------------------------------------------------------------------ what is written down

    def _check_records(self, name: str, records: Any) -> None:
        check_keys(name, records, ("log", "exchange", "rng", "entries", "next_number"))
        check_whole(f"{name}['next_number']", records["next_number"], self._count, MOST_LANDMARKS)
        self._next_number = records["next_number"]
        check_keys(f"{name}['log']", records["log"], ("steps",))
        steps = records["log"]["steps"]
        check_kind(f"{name}['log']['steps']", steps, dict)
        if steps:
            check_wholes(f"{name}['log']['steps']", tuple(steps), 0, self._step - 1)
            if list(steps) != list(range(self._step - len(steps), self._step)):
                refuse(f"{name}['log']['steps']", "the last steps, in order", "others")
        for step, inputs in steps.items():
            if self._kept.get(step) is not inputs:
                self._check_inputs(f"{name}['log']['steps'][{step}]", inputs)
        self._inputs = steps
        exchange = records["exchange"]
        check_keys(f"{name}['exchange']", exchange, ("bytes_sent", "known"))
        check_length(f"{name}['exchange']['bytes_sent']", exchange["bytes_sent"], self._count)
        check_wholes(f"{name}['exchange']['bytes_sent']", exchange["bytes_sent"])
        check_kind(f"{name}['exchange']['known']", exchange["known"], dict)
        for pair, counts in exchange["known"].items():
            check_kind(f"{name}['exchange']['known']", pair, tuple)
            check_wholes(f"{name}['exchange']['known']", pair, 0, self._count - 1)
            self._check_pairs(f"{name}['exchange']['known']", counts)
        check_generator(f"{name}['rng']", records["rng"])
        check_length(f"{name}['entries']", records["entries"])
        for entry in records["entries"]:
            self._check_entry(f"{name}['entries']", entry)

    def _check_entry(self, name: str, entry: Any) -> None:
        """Refuse what is no entry about maps."""
        kind = type(entry)
        if kind is LandmarksCreated:
            numbers: tuple[Any, ...] = (entry.number,)
            check_whole(f"{name}.robot", entry.robot, 0, self._count - 1)
            check_whole(f"{name}.step", entry.step, 0, self._step)
            check_indices(f"{name}.ids", entry.ids, (None,), REJECTED, MOST_LANDMARKS)
        elif kind is Renaming:
            numbers = entry.maps
            check_indices(f"{name}.ids_b", entry.ids_b, (None, 2), 0, MOST_LANDMARKS)
            check_robots(f"{name}.robots_a", entry.robots_a, self._count)
            check_robots(f"{name}.robots_b", entry.robots_b, self._count)
        elif kind is MapCopied:
            numbers = entry.source, entry.copy
        elif kind is MergeUndone:
            numbers = entry.maps
        else:
            check_kind(name, entry, MapDropped)
            numbers = (entry.number,)
        check_wholes(name, numbers, 0, self._next_number - 1)

    def _check_event(self, name: str, event: Any) -> None:
        check_kind(name, event, MergeEvent)
        check_whole(f"{name}.step", event.step, 0, self._step)
        if event.kind not in KINDS:
            refuse(f"{name}.kind", f"one of {KINDS}", event.kind)
        check_robots(f"{name}.robots_a", event.robots_a, self._count)
        check_robots(f"{name}.robots_b", event.robots_b, self._count)
        check_kind(f"{name}.alignment", event.alignment, Alignment)
        if event.bent is not None:
            check_kind(f"{name}.bent", event.bent, Alignment)

    def _check_schedule(self, name: str, schedule: Any) -> None:
        check_keys(name, schedule, ("options", "alignment", "straightening", "records", "bars", *BY_ROBOTS))
        check_options(f"{name}['options']", schedule["options"], AttemptOptions)
        check_options(f"{name}['alignment']", schedule["alignment"], AlignmentOptions)
        pending = schedule["straightening"]
        if pending is not None:
            check_kind(f"{name}['straightening']", pending, Straightening)
            self._check_pair(f"{name}['straightening'].pair", pending.pair)
            check_length(f"{name}['straightening'].numbers", pending.numbers, 2)
            check_wholes(f"{name}['straightening'].numbers", pending.numbers)
            check_kind(f"{name}['straightening'].bent", pending.bent, Alignment)
            check_whole(f"{name}['straightening'].since", pending.since, 0, self._step)
            check_flag(f"{name}['straightening'].ready", pending.ready)
        check_kind(f"{name}['records']", schedule["records"], dict)
        for pair, record in schedule["records"].items():
            self._check_pair(f"{name}['records']", pair)
            check_kind(f"{name}['records']", record, AttemptRecord)
            for part in ("wait", "last_step", "next_step"):
                check_whole(f"{name}['records'].{part}", getattr(record, part))
            check_kind(f"{name}['records'].tried", record.tried, set)
            for match in record.tried:
                check_kind(f"{name}['records'].tried", match, tuple)
                check_wholes(f"{name}['records'].tried", match, 0, MOST_LANDMARKS)
        check_length(f"{name}['bars']", schedule["bars"])
        for bar in schedule["bars"]:
            check_length(f"{name}['bars']", bar, 2)
            self._check_pair(f"{name}['bars']", bar[0])
            check_whole(f"{name}['bars']", bar[1])
        for part in BY_ROBOTS:
            where = f"{name}[{part!r}]"
            check_kind(where, schedule[part], dict)
            for robots in schedule[part]:
                check_kind(where, robots, tuple)
                check_length(where, robots, 2)
                check_wholes(where, robots, 0, self._count - 1)
        for doubt in schedule["doubts"].values():
            if not (isinstance(doubt, float) and doubt >= 0.0):
                refuse(f"{name}['doubts']", "a float at least 0", doubt)
        for motion in schedule["trials"].values():
            check_floats(f"{name}['trials']", motion, (3,))

    def _check_pair(self, name: str, pair: Any) -> None:
        """Refuse what are no two groups of robots."""
        check_kind(name, pair, tuple)
        check_length(name, pair, 2)
        for robots in pair:
            check_robots(name, robots, self._count)

    def _check_pairs(self, name: str, numbers: Any) -> None:
        """Refuse what is no dict of ints by landmark."""
        check_kind(name, numbers, dict)
        check_wholes(name, tuple(numbers), 0, MOST_LANDMARKS)
        check_wholes(name, tuple(numbers.values()))


def check_turns(name: str, turns: Any, n: int, robots: int | None) -> None:
    """Refuse what are no turns of robots whose measurements lie among n, one robot's after the other's."""
    check_length(name, turns, robots)
    last = 0
    for turn in turns:
        check_length(name, turn, 6)
        for number in turn:
            if type(number) is not int and type(number) is not bool:
                refuse(name, "ints", turn)
        fine = (0 <= turn[ACT] <= PLACED and last <= turn[BEGIN] <= turn[END] <= n) or turn[BEGIN] == turn[END] == 0
        if not fine or not (0 <= turn[GIVEN] <= 1 and 0 <= turn[NAMED] <= 1 and -1 <= turn[COUNT] <= MOST_LANDMARKS):
            refuse(name, f"measurements among {n}", turn)
        last = max(last, turn[END])


def check_masks(name: str, masks: Any, turns: Sequence[Sequence[int]]) -> None:
    """Refuse what does not say which measurements of some robots are used."""
    if not isinstance(masks, Mapping):
        refuse(name, "a dict", f"a {type(masks).__name__}")
    for robot, mask in masks.items():
        check_whole(name, robot, 0, len(turns) - 1)
        check_kept(name, mask, BOOL, (max(turns[robot][COUNT], 0),))
        if np.count_nonzero(mask) != turns[robot][END] - turns[robot][BEGIN]:
            refuse(name, "as many as are used", int(np.count_nonzero(mask)))
