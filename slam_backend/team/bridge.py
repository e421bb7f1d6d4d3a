"""Parts of states of teams that have no declarations yet."""  # bridge

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from slam_backend.core import state_checks as check
from slam_backend.core.read_only import with_constants, with_read_only
from slam_backend.core.state import MAX_LANDMARKS, Part, Sizes, Snapshot
from slam_backend.core.state_checks import refuse_malformed
from slam_backend.fastslam import reports
from slam_backend.fastslam._kernels import EXACT_POSE
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.state_checks import check_descriptors, check_filter, check_landmarks
from slam_backend.fastslam.step_input import InputBuffer, StepInput
from slam_backend.maps.alignment_types import Alignment
from slam_backend.smoother.log_arrays import REJECTED


@dataclass(frozen=True)
class Opaque(Part):
    """A constant value with a check of its own."""

    check: Callable[[str, Any, Sizes], object]

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        self.check(name, value, sizes)
        return with_constants(value)


@dataclass(frozen=True)
class LegacyFilter(Part):
    """A `FastSlam`."""

    is_constant: ClassVar[bool] = False

    def _take(self, value: FastSlam) -> Any:
        return with_read_only(value.get_state())

    def _put(self, value: Any, kept: Mapping[str, Any]) -> FastSlam:
        return put_filter(kept, value)

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        with refuse_malformed(name):
            check_filter(name, value)
        if len(value["poses"]) != sizes["n"]:
            check.refuse(name, f"a filter of {sizes['n']} robots", len(value["poses"]))
        return with_constants(value)


def put_filter(kept: Mapping[str, Any], value: FastSlam | None = None) -> FastSlam:
    """Return a filter in a state."""
    slam = value if type(value) is FastSlam else FastSlam.from_options(len(kept["poses"]), kept["options"])
    slam.restore_checked(kept)
    return slam


@dataclass(frozen=True)
class LegacyInputs(Part):
    """An `InputBuffer`."""

    is_constant: ClassVar[bool] = False

    def _take(self, value: InputBuffer) -> Any:
        return Snapshot(value.get_state())

    def _put(self, value: InputBuffer, kept: Mapping[str, Any]) -> InputBuffer:
        value.set_state(kept)
        return value

    def _check(self, name: str, value: Any, sizes: Sizes) -> Any:
        check.keys(name, value, ("steps",))
        check.instance(name, value["steps"], dict)
        for step, inputs in value["steps"].items():
            check.integer(name, step)
            check_inputs(f"{name}['steps'][{step}]", inputs, sizes)
        return Snapshot(with_constants({"steps": value["steps"]}))


def check_inputs(name: str, inputs: Any, sizes: Sizes) -> None:
    """Refuse a value that is not the input of K robots in one step."""
    count = sizes["K"]
    check.instance(name, inputs, StepInput)
    n, table = check.positions(f"{name}.measurements", inputs.measurements, (None, 9), 3), inputs.inputs_table
    check.indices(f"{name}.inputs_table", table, (count, 6), -1)
    check_turns(f"{name}.inputs", inputs.inputs, n, count)
    if [list(turn) for turn in inputs.inputs] != table.tolist():
        check.refuse(f"{name}.inputs_table", "the numbers of `inputs`", "a table that differs")
    check.positions(f"{name}.moves", inputs.moves, (count, 3))
    check_descriptors(f"{name}.descriptors", inputs.descriptors, n)
    named = check.indices(f"{name}.names", inputs.names, (None,), -1)
    if named != n and (named or any(has_ids for *_, has_ids, _ in inputs.inputs)):
        check.refuse(f"{name}.names", "one name per measurement, or none", named)
    for _, begin, end, given, _, _ in inputs.inputs:
        if given:
            check.floats(f"{name}.measurements", inputs.measurements[begin:end], (None, 9))
    check_masks(f"{name}.masks", inputs.masks, inputs.inputs)
    check.integers(f"{name}.inactive", inputs.inactive, 0, count - 1, frozenset)


def check_report(name: str, report: Any, sizes: Sizes) -> None:
    """Refuse a value that is not the step report of a filter."""
    check.instance(name, report, reports.StepReport)
    found = report.all_associations
    check.instance(f"{name}.all_associations", found, reports.Associations)
    check.indices(f"{name}.all_associations.ids", found.ids, (2, None), REJECTED, check.MAX_LANDMARKS)
    check_turns(f"{name}.all_associations.inputs", found.inputs, found.ids.shape[1], None)
    check_masks(f"{name}.all_associations.masks", found.masks, found.inputs)
    check.integers(f"{name}.rows", report.rows, -1, min(len(found.inputs), sizes["K"]) - 1)
    for part in ("num_created", "num_new", "num_matched", "num_rejected"):
        check.integer(f"{name}.{part}", getattr(report, part))
    check.number(f"{name}.ess", report.ess, 0.0)
    if not (isinstance(report.nis, float) and (report.nis >= 0.0 or report.nis != report.nis)):
        check.refuse(f"{name}.nis", "a float at least 0, or NaN", report.nis)
    if report.rejuvenation is not None:
        check.instance(f"{name}.rejuvenation", report.rejuvenation, reports.RejuvenationReport)


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


def _is_alignment(name: str, value: Any, sizes: Sizes) -> None:
    check.instance(name, value, Alignment)


def _is_map(name: str, value: Any, sizes: Sizes) -> None:
    check_landmarks(name, value)


ALIGNMENT = Opaque(_is_alignment)  # then Record(Alignment)
LANDMARKS = Opaque(_is_map)  # then Record(LandmarkMap)
INPUTS = Opaque(check_inputs)  # then Record(StepInput)
REPORT = Opaque(check_report)  # then Record(StepReport)
FILTER = LegacyFilter()  # then Child(FastSlam, K="n")
BUFFER = LegacyInputs()  # then Child(InputBuffer)
assert MAX_LANDMARKS == check.MAX_LANDMARKS
