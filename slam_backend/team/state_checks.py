"""Validation of a `TeamSlam` state before a team continues from it."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from slam_backend.core import state_checks as check
from slam_backend.core.state import MAX_DESCRIPTOR, Record, accepted
from slam_backend.core.validation import argument_error
from slam_backend.fastslam import reports
from slam_backend.fastslam._kernels import EXACT_POSE
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.options import FilterOptions
from slam_backend.fastslam.run_log import last_step
from slam_backend.fastslam.step_input import StepInput
from slam_backend.maps.alignment_types import Alignment, AlignmentOptions
from slam_backend.maps.landmark_map import LandmarkMap
from slam_backend.smoother.log_arrays import REJECTED
from slam_backend.team import reports as team_reports
from slam_backend.team.branches import ReplayedStep
from slam_backend.team.merge import STORED
from slam_backend.team.merge_monitor import MergeMonitor
from slam_backend.team.merge_scheduler import AttemptOptions, AttemptRecord, PairKey
from slam_backend.team.options import MergeOptions

BY_ROBOTS = ("uncertainties", "motions")  # parts of the schedule with an entry for each pair of robots
KEYS = ("step", "groups", "numbers", "records", "epoch", "rng", "events", "merging", "schedule", "processes")
BRANCH = (
    "robots",
    "active_robots",
    "filter",
    "last_steps",
    "number",
    "epoch",
    "report",
    "monitors",
    "split_from",
    "split_counts",
)
KINDS = ("attempt", "merge", "undo")


class TeamCheck:
    """Checks of the parts of one state.

    Args:
        num_robots: K.
        kept: Inputs by step that the team already holds and need no check.
        known: Options of its filters known to be valid.

    Attributes:
        descriptor_sizes: Lengths of the descriptors in the state.
        options: Options of all its filters.
    """

    def __init__(self, num_robots: int, kept: Mapping[int, StepInput], known: Sequence[FilterOptions] = ()) -> None:
        self._count, self._kept, self._known = num_robots, kept, known
        self._step = self._next_number = 0
        self._inputs: Mapping[int, StepInput] = {}
        self.descriptor_sizes: set[int] = set()
        self.options: list[FilterOptions] = []
        self._merges: dict[int, PairKey] = {}  # robots of the merges checked so far, by the number of the joint map

    def check(self, name: str, state: Any) -> None:
        """Refuse a value that is not a valid state of a team of K robots.

        Raises:
            ValueError: If a part is wrong; the text names it.
        """
        check.keys(name, state, KEYS)
        for of_group, group in check.named_items(f"{name}['groups']", state["groups"]):
            check.keys(of_group, group, ("branches",))
            for where, branch in check.named_items(f"{of_group}['branches']", group["branches"]):
                check.keys(where, branch, BRANCH)
                check.instance(f"{where}['robots']", branch["robots"], tuple)
        found = sum(len(group["branches"][0]["robots"]) for group in state["groups"] if group["branches"])
        if found != self._count:
            raise argument_error(name, f"one of {self._count} robots", found, "Build a team of the same size.")
        check.integer(f"{name}['step']", state["step"])
        check.integer(f"{name}['epoch']", state["epoch"])
        check.generator(f"{name}['rng']", state["rng"])
        check.options(f"{name}['merging']", state["merging"], MergeOptions)
        self._step = state["step"]
        self._check_records(f"{name}['records']", state["records"])
        for where, event in check.named_items(f"{name}['events']", state["events"]):
            self._check_event(where, event)
        check.integers(f"{name}['numbers']", state["numbers"], 0, self._next_number - 1, list)
        self._check_schedule(f"{name}['schedule']", state["schedule"])
        self._check_processes(f"{name}['processes']", state["processes"])
        for where, group in check.named_items(f"{name}['groups']", state["groups"]):
            self._check_group(where, group)
        self._check_undoing(f"{name}['processes']", state)
        trunks = [group["branches"][0]["robots"] for group in state["groups"]]
        if sorted(sum(trunks, ())) != list(range(self._count)) or trunks != sorted(trunks):
            check.refuse(f"{name}['groups']", "groups of all robots, ordered by their first robots", trunks)
        if len(self.descriptor_sizes) > 1:
            check.refuse(name, "descriptors of one length", sorted(self.descriptor_sizes))

    # ------------------------------------------------------------------ groups

    def _check_group(self, name: str, group: Mapping[str, Any]) -> None:
        active_robots: list[int] = []
        for where, branch in check.named_items(f"{name}['branches']", group["branches"]):
            self._check_branch(where, branch)
            if not branch["active_robots"]:
                check.refuse(f"{where}['active_robots']", "at least one robot", "no robot")
            active_robots += branch["active_robots"]
            self._check_oldest(where, branch)
        trunk = group["branches"][0]
        if sorted(active_robots) != list(trunk["robots"]):
            check.refuse(f"{name}['branches']", f"branches with each of {trunk['robots']} active in one", active_robots)

    # ------------------------------------------------------------------ merges

    def _check_processes(self, name: str, processes: Any) -> None:
        """Refuse values that are not the processes of merges, in order of time so that sides need only earlier ones."""
        for where, process in check.named_items(name, processes):
            check.keys(where, process, ("pair", "phase"))
            self._check_pair(f"{where}['pair']", process["pair"])
            if process["phase"] not in STORED:
                check.refuse(f"{where}['phase']", f"one of {', '.join(STORED)}", process["phase"])
            if process["phase"] == "smoothing":
                check.keys(where, process, ("numbers", "unsmoothed", "since", "ready"))
                check.integers(f"{where}['numbers']", process["numbers"])
                check.sequence(f"{where}['numbers']", process["numbers"], 2)
                check.instance(f"{where}['unsmoothed']", process["unsmoothed"], Alignment)
                check.integer(f"{where}['since']", process["since"], 0, self._step)
                check.boolean(f"{where}['ready']", process["ready"])
                continue
            check.keys(where, process, ("number", "alignment", "sides"))
            check.integer(f"{where}['number']", process["number"], 0, self._next_number - 1)
            check.instance(f"{where}['alignment']", process["alignment"], Alignment)
            if any(process["number"] <= earlier for earlier in self._merges):
                check.refuse(f"{where}['number']", "merges from the oldest to the newest", process["number"])
            sides = check.named_items(f"{where}['sides']", process["sides"], 2)
            for of_side, side in sides:
                self._check_branch(of_side, side)
                for last in side["last_steps"].values():
                    self._need_from(of_side, last + 1)
            parts = tuple(side["robots"] for _, side in sides)
            if set(parts[0]) & set(parts[1]) or process["pair"] != parts:
                check.refuse(f"{where}['sides']", f"those of {process['pair']}", parts)
            self._merges[process["number"]] = parts

    def _check_undoing(self, name: str, state: Mapping[str, Any]) -> None:
        """Refuse rollbacks of merges that do not fit their groups."""
        trunks = {group["branches"][0]["robots"]: group["branches"][0] for group in state["groups"]}
        for where, process in check.named_items(name, state["processes"]):
            if process["phase"] != "undoing":
                continue
            check.keys(where, process, ("robots", "trunks", "replayed"))
            if process["robots"] not in trunks:
                check.refuse(f"{where}['robots']", "robots of a group", process["robots"])
            joint = trunks.pop(process["robots"])
            sides = check.named_items(f"{where}['trunks']", process["trunks"])
            for of_side, side in sides:
                self._check_branch(of_side, side)
                for robot, last in side["last_steps"].items():
                    self._need_from(of_side, last + 1)
                    if last > joint["last_steps"].get(robot, -1):
                        check.refuse(of_side, "sides that know no more steps than the joint filter", last)
            parts = [side["robots"] for _, side in sides]
            if sorted(sum(parts, ())) != list(joint["robots"]):
                check.refuse(f"{where}['trunks']", f"parts of {joint['robots']}", parts)
            replayed = check.named_items(f"{where}['replayed']", process["replayed"], len(parts))
            for (of_side, steps), robots in zip(replayed, parts, strict=True):
                for of_step, done in check.named_items(of_side, steps):
                    self._check_replayed(of_step, done, len(robots))

    def _check_branch(self, name: str, branch: Any) -> None:
        """Refuse a value that is not a branch with a valid filter and monitors."""
        check.keys(name, branch, BRANCH)
        robots, active_robots, known = branch["robots"], branch["active_robots"], branch["last_steps"]
        check.robots(f"{name}['robots']", robots, self._count)
        check.integers(f"{name}['active_robots']", active_robots, 0, self._count - 1)
        if list(active_robots) != sorted(set(active_robots)) or not set(active_robots) <= set(robots):
            check.refuse(f"{name}['active_robots']", f"some of {robots}, in ascending order", active_robots)
        check.int_dict(f"{name}['last_steps']", known, (0, self._count), (-1, self._step - 1))
        if set(known) != set(robots):
            check.refuse(f"{name}['last_steps']", f"the last step of each of {robots}", known)
        check.integer(f"{name}['number']", branch["number"], 0, self._next_number - 1)
        check.integer(f"{name}['epoch']", branch["epoch"])
        state = accepted(FastSlam, f"{name}['filter']", branch["filter"])
        if len(state["poses"]) != len(robots):
            check.refuse(f"{name}['filter']", f"one of {len(robots)} robots", len(state["poses"]))
        for robot, log in zip(robots, state["logs"], strict=True):
            if last_step(log) > known[robot]:
                check.refuse(f"{name}['last_steps']", f"at least {last_step(log)}, the last step logged", known[robot])
        self.options.append(state["options"])
        descriptors = state["maps"].descriptors
        if len(descriptors):
            self.descriptor_sizes.add(descriptors.shape[1])
        if branch["report"] is not None:
            self._check_report(f"{name}['report']", branch["report"], len(robots))
        if branch["split_from"] is not None:
            check.integer(f"{name}['split_from']", branch["split_from"], 0, self._next_number - 1)
        check.int_dict(f"{name}['split_counts']", branch["split_counts"], check.LANDMARK)
        for where, monitor in check.named_items(f"{name}['monitors']", branch["monitors"]):
            self._check_watch(where, monitor, robots)
        numbers = [monitor.number for monitor in branch["monitors"]]
        if numbers != sorted(set(numbers)):
            check.refuse(f"{name}['monitors']", "merges from the oldest to the newest", numbers)

    def _check_oldest(self, name: str, branch: Mapping[str, Any]) -> None:
        """Refuse a branch that may have to replay steps that are not buffered."""
        for robot, last in branch["last_steps"].items():
            if robot not in branch["active_robots"]:
                self._need_from(name, last + 1)
            elif last != self._step - 1 and self._step:
                check.refuse(f"{name}['last_steps']", f"{self._step - 1} for an active robot", last)

    def _need_from(self, name: str, first: int) -> None:
        """Refuse a state in which a step from `first` on is not buffered."""
        if first < self._step and (first not in self._inputs or len(self._inputs) < self._step - first):
            check.refuse(name, "only buffered steps to replay", f"a filter without the steps from {first} on")

    def _check_watch(self, name: str, monitor: Any, robots: Sequence[int]) -> None:
        """Refuse a value that is not the monitor of a merge of some of these robots."""
        check.instance(name, monitor, MergeMonitor)
        check.integer(f"{name}.number", monitor.number, 0, self._next_number - 1)
        check.integer(f"{name}.steps", monitor.steps)
        for where, landmarks in check.named_items(f"{name}.pre_merge_maps", monitor.pre_merge_maps, 2):
            check_landmarks(where, landmarks)
        for where, exclusive in check.named_items(f"{name}.exclusive_landmarks", monitor.exclusive_landmarks, 2):
            check.integers(where, exclusive, *check.LANDMARK, set)
        pair = self._merges.get(monitor.number)
        if pair is None or monitor.pair != pair or not {*pair[0], *pair[1]} <= set(robots):
            check.refuse(f"{name}.pair", f"the robots of a merge among {robots}", monitor.pair)

    # ------------------------------------------------------------------ inputs and reports

    def _check_inputs(self, name: str, inputs: Any) -> None:
        """Refuse a value that is not the input of K robots in one step."""
        check.instance(name, inputs, StepInput)
        n, table = check.positions(f"{name}.measurements", inputs.measurements, (None, 9), 3), inputs.inputs_table
        check.indices(f"{name}.inputs_table", table, (self._count, 6), -1)
        check_turns(f"{name}.inputs", inputs.inputs, n, self._count)
        if [list(turn) for turn in inputs.inputs] != table.tolist():
            check.refuse(f"{name}.inputs_table", "the numbers of `inputs`", "a table that differs")
        check.positions(f"{name}.moves", inputs.moves, (self._count, 3))
        size = check_descriptors(f"{name}.descriptors", inputs.descriptors, n)
        if n:
            self.descriptor_sizes.add(size)
        named = check.indices(f"{name}.names", inputs.names, (None,), -1)
        if named != n and (named or any(has_ids for *_, has_ids, _ in inputs.inputs)):
            check.refuse(f"{name}.names", "one name per measurement, or none", named)
        for _, begin, end, given, _, _ in inputs.inputs:
            if given:
                check.floats(f"{name}.measurements", inputs.measurements[begin:end], (None, 9))
        check_masks(f"{name}.masks", inputs.masks, inputs.inputs)
        check.integers(f"{name}.inactive", inputs.inactive, 0, self._count - 1, frozenset)

    def _check_replayed(self, name: str, done: Any, robots: int) -> None:
        """Refuse a value that is not a replayed step of a filter of so many robots."""
        check.instance(name, done, ReplayedStep)
        check.integer(f"{name}.step", done.step, 0, self._step)
        check.robots(f"{name}.robots", done.robots, self._count)
        if self._inputs.get(done.step) is not done.inputs:
            self._check_inputs(f"{name}.inputs", done.inputs)
        self._check_report(f"{name}.report", done.report, robots)

    def _check_report(self, name: str, report: Any, robots: int) -> None:
        """Refuse a value that is not the step report of a filter of so many robots."""
        check.instance(name, report, reports.StepReport)
        found = report.all_associations
        check.instance(f"{name}.all_associations", found, reports.Associations)
        check.indices(f"{name}.all_associations.ids", found.ids, (2, None), REJECTED, check.MAX_LANDMARKS)
        check_turns(f"{name}.all_associations.inputs", found.inputs, found.ids.shape[1], None)
        check_masks(f"{name}.all_associations.masks", found.masks, found.inputs)
        check.integers(f"{name}.rows", report.rows, -1, min(len(found.inputs), self._count) - 1)
        if len(report.rows) != robots:
            check.refuse(f"{name}.rows", f"a row for each of {robots} robots", report.rows)
        for part in ("num_created", "num_new", "num_matched", "num_rejected"):
            check.integer(f"{name}.{part}", getattr(report, part))
        check.number(f"{name}.ess", report.ess, 0.0)
        if not (isinstance(report.nis, float) and (report.nis >= 0.0 or report.nis != report.nis)):
            check.refuse(f"{name}.nis", "a float at least 0, or NaN", report.nis)
        if report.rejuvenation is not None:
            check.instance(f"{name}.rejuvenation", report.rejuvenation, reports.RejuvenationReport)

    # ------------------------------------------------------------------ records

    def _check_records(self, name: str, records: Any) -> None:
        check.keys(name, records, ("log", "exchange", "rng", "entries", "next_number"))
        check.integer(f"{name}['next_number']", records["next_number"], self._count, check.MAX_LANDMARKS)
        self._next_number = records["next_number"]
        check.keys(f"{name}['log']", records["log"], ("steps",))
        steps = records["log"]["steps"]
        check.keys(f"{name}['log']['steps']", steps, ())
        check.integers(f"{name}['log']['steps']", tuple(steps), 0, self._step - 1)
        if list(steps) != list(range(self._step - len(steps), self._step)):
            check.refuse(f"{name}['log']['steps']", "the last steps, in order", "a step missing or out of order")
        for step, inputs in steps.items():
            if self._kept.get(step) is not inputs:
                self._check_inputs(f"{name}['log']['steps'][{step}]", inputs)
        self._inputs = steps
        exchange = records["exchange"]
        check.keys(f"{name}['exchange']", exchange, ("bytes_sent", "known"))
        for where, number in check.named_items(
            f"{name}['exchange']['bytes_sent']", exchange["bytes_sent"], self._count
        ):
            check.integer(where, number)
        check.instance(f"{name}['exchange']['known']", exchange["known"], dict)
        for pair, counts in exchange["known"].items():
            check.integers(f"{name}['exchange']['known']", pair, 0, self._count - 1)
            check.int_dict(f"{name}['exchange']['known']", counts, check.LANDMARK)
        check.generator(f"{name}['rng']", records["rng"])
        for where, entry in check.named_items(f"{name}['entries']", records["entries"]):
            self._check_entry(where, entry)

    def _check_entry(self, name: str, entry: Any) -> None:
        """Refuse a value that is not a change of maps."""
        kind = type(entry)
        if kind is team_reports.LandmarksCreated:
            numbers: tuple[Any, ...] = (entry.number,)
            check.integer(f"{name}.robot", entry.robot, 0, self._count - 1)
            check.integer(f"{name}.step", entry.step, 0, self._step)
            check.indices(f"{name}.ids", entry.ids, (None,), REJECTED, check.MAX_LANDMARKS)
        elif kind is team_reports.LandmarkIdMap:
            numbers = entry.maps
            check.indices(f"{name}.ids_b", entry.ids_b, (None, 2), *check.LANDMARK)
            check.robots(f"{name}.robots_a", entry.robots_a, self._count)
            check.robots(f"{name}.robots_b", entry.robots_b, self._count)
        elif kind is team_reports.MapForked:
            numbers = entry.source, entry.copy
        elif kind is team_reports.MergeUndone:
            numbers = entry.maps
        else:
            check.instance(name, entry, team_reports.MapReleased)
            numbers = (entry.number,)
        check.integers(name, numbers, 0, self._next_number - 1)

    def _check_event(self, name: str, event: Any) -> None:
        check.instance(name, event, team_reports.MergeEvent)
        check.integer(f"{name}.step", event.step, 0, self._step)
        if event.kind not in KINDS:
            check.refuse(f"{name}.kind", f"one of {KINDS}", event.kind)
        check.robots(f"{name}.robots_a", event.robots_a, self._count)
        check.robots(f"{name}.robots_b", event.robots_b, self._count)
        check.instance(f"{name}.alignment", event.alignment, Alignment)
        if event.unsmoothed_alignment is not None:
            check.instance(f"{name}.unsmoothed_alignment", event.unsmoothed_alignment, Alignment)

    def _check_schedule(self, name: str, schedule: Any) -> None:
        check.keys(name, schedule, ("options", "alignment", "records", "blocks", *BY_ROBOTS))
        check.options(f"{name}['options']", schedule["options"], AttemptOptions)
        check.options(f"{name}['alignment']", schedule["alignment"], AlignmentOptions)
        check.instance(f"{name}['records']", schedule["records"], dict)
        for pair, record in schedule["records"].items():
            self._check_pair(f"{name}['records']", pair)
            check.instance(f"{name}['records']", record, AttemptRecord)
            for part in ("wait", "last_step", "next_step"):
                check.integer(f"{name}['records'].{part}", getattr(record, part))
            check.instance(f"{name}['records'].tried", record.tried, set)
            for match in record.tried:
                check.integers(f"{name}['records'].tried", match, *check.LANDMARK)
        for where, block in check.named_items(f"{name}['blocks']", schedule["blocks"]):
            check.sequence(where, block, 2)
            self._check_pair(where, block[0])
            check.integer(where, block[1])
        for part in BY_ROBOTS:
            where = f"{name}[{part!r}]"
            check.instance(where, schedule[part], dict)
            for robots in schedule[part]:
                check.integers(where, robots, 0, self._count - 1)
                check.sequence(where, robots, 2)
        for uncertainty in schedule["uncertainties"].values():
            if not (isinstance(uncertainty, float) and uncertainty >= 0.0):
                check.refuse(f"{name}['uncertainties']", "a float at least 0", uncertainty)
        for motion in schedule["motions"].values():
            check.floats(f"{name}['motions']", motion, (3,))

    def _check_pair(self, name: str, pair: Any) -> None:
        """Refuse a value that is not two groups of robots."""
        check.instance(name, pair, tuple)
        check.sequence(name, pair, 2)
        for robots in pair:
            check.robots(name, robots, self._count)


def check_descriptors(name: str, value: Any, n: int) -> int:
    """Return the length d of n descriptors, or refuse a wrong array or length."""
    check.floats(name, value, (n, None), -MAX_DESCRIPTOR, MAX_DESCRIPTOR, dtype=check.FLOAT32)
    return int(value.shape[1])


def check_landmarks(name: str, landmarks: Any) -> None:
    """Refuse a value that is not a landmark map."""
    check.instance(name, landmarks, LandmarkMap)
    Record(LandmarkMap)._check(name, landmarks, {})


def check_turns(name: str, turns: Any, n: int, robots: int | None) -> None:
    """Refuse a value that is not the inputs of robots whose measurements lie among n, robot by robot."""
    check.sequence(name, turns, robots)
    last = 0
    for turn in turns:
        check.sequence(name, turn, 6)
        for number in turn:
            if type(number) is not int and type(number) is not bool:
                check.refuse(name, "ints", turn)
        kind, begin, end, has_covariances, has_ids, count = turn
        is_in_order = (0 <= kind <= EXACT_POSE and last <= begin <= end <= n) or begin == end == 0
        if not is_in_order or {has_covariances, has_ids} - {0, 1} or not -1 <= count <= check.MAX_LANDMARKS:
            check.refuse(name, f"rows of {n} measurements in order", turn)
        last = max(last, end)


def check_masks(name: str, masks: Any, turns: Sequence[Sequence[int]]) -> None:
    """Refuse a value that is not the masks of used measurements of some robots."""
    if not isinstance(masks, Mapping):
        check.refuse(name, "a dict", f"a {type(masks).__name__}")
    for robot, mask in masks.items():
        check.integer(name, robot, 0, len(turns) - 1)
        _, begin, end, _, _, count = turns[robot]
        check.array(name, mask, check.BOOL, (max(count, 0),))
        if np.count_nonzero(mask) != end - begin:
            check.refuse(name, "as many True values as used measurements", int(np.count_nonzero(mask)))
