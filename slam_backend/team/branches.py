"""Filters with the robots that use them, forks for robots that lose contact, and replay on their return.

A group's *trunk* is its joint filter. Robots that lose contact with the trunk's robots continue with a copy, a *fork*,
which gets their own inputs only, while the trunk keeps their last poses. On return the trunk replays their inputs since
then, in order of time, and the fork is dropped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import Associations, StepReport
from slam_backend.fastslam.run_log import last_step
from slam_backend.fastslam.step_input import InputBuffer, RobotRows, StepInput, rows_of
from slam_backend.state import Child, Dict, Each, Int, Maybe, Record, Sizes, State, restored, take, with_state
from slam_backend.team.merge_monitor import MergeMonitor
from slam_backend.team.merge_scheduler import LANDMARK, ROBOT, ROBOTS

MAX_REPLAYED = 20  # buffered steps that a filter replays per tick
TURNS = 4  # each robot's filter may smooth in one of this many steps; a joint filter in the turns of all its robots


@dataclass(slots=True, eq=False)
class Branch:
    """Filter with the robots that use it.

    Attributes:
        robots: Robots of the filter, ascending, in the filter's order.
        active_robots: Robots that use it now, ascending.
        filter: Filter of all `robots`.
        last_steps: Last step processed for each robot of the filter, -1 = none.
        number: Number of its map, unique among all filters ever made.
        epoch: Number of merges and undos in the team when the filter was made; a higher one knows more.
        report: Report of its last step.
        split_from: Number of the map that it was split from; None before any split.
        monitors: Monitors of its merges that can still be undone, oldest first.
        split_counts: Number of measurements, when last received, of each landmark of that map whose descriptor its
            robots know, by id.
    """

    STATE = State(
        robots=Each(ROBOT, "n"), active_robots=ROBOTS, filter=Child(FastSlam, K="n"),
        last_steps=Dict(ROBOT, Int(-1, "STEPS")), number=Int(), epoch=Int(), report=Maybe(Record(StepReport)),
        monitors=Each(Child(MergeMonitor), kind=list), split_from=Maybe(Int()), split_counts=Dict(LANDMARK, Int()),
    )  # fmt: skip

    robots: tuple[int, ...]
    active_robots: tuple[int, ...]
    filter: FastSlam
    last_steps: dict[int, int]
    number: int
    epoch: int = 0
    report: StepReport | None = None
    monitors: list[MergeMonitor] = field(default_factory=list)
    split_from: int | None = None
    split_counts: dict[int, int] = field(default_factory=dict)

    @property
    def merge_numbers(self) -> list[int]:
        """Numbers of the merges that the filter monitors, oldest first."""
        return [monitor.number for monitor in self.monitors]

    def known_landmarks(self, main: "Branch", replayed: Sequence["ReplayedStep"]) -> dict[int, int]:
        """Return the landmarks of the filter they return to that the robots know, those just created included.

        Args:
            main: Branch that replayed the steps.
            replayed: Steps replayed, those of these robots among them.
        """
        if self.split_from != main.number:
            self.split_from, self.split_counts = main.number, {}
        for done in replayed:
            for robot in set(done.robots) & set(self.active_robots):
                row = done.report.rows[main.robots.index(robot)]
                for name in done.report.all_associations.created_ids(row):
                    self.split_counts.setdefault(name, 0)
        return self.split_counts

    def rebuild(self) -> None:
        """Let the filter smooth, as a new one."""
        self.filter.may_smooth = True

    @staticmethod
    def check_state(parts: Mapping[str, Any], sizes: Sizes) -> None:
        """Raise if robots, steps, report or monitors belong to another branch."""
        robots, active, known, report = (parts[name] for name in ("robots", "active_robots", "last_steps", "report"))
        if list(robots) != sorted(set(robots)) or list(active) != sorted(set(active) & set(robots)):
            raise ValueError("robots out of order, or active ones that are not in the filter")
        if set(known) != set(robots):
            raise ValueError("last steps of other robots")
        for robot, log in zip(robots, parts["filter"]["logs"], strict=True):
            if last_step(log) > known[robot]:
                raise ValueError("logs beyond the last steps")
        if report is not None and len(report.rows) != len(robots):
            raise ValueError("a report about other robots")
        numbers = [monitor["number"] for monitor in parts["monitors"]]
        if numbers != sorted(set(numbers)):
            raise ValueError("monitors out of order")


@with_state(step=Int(high="STEPS"), robots=ROBOTS, inputs=Record(StepInput), report=Record(StepReport))
class ReplayedStep(NamedTuple):
    """Step that a filter processed later.

    Attributes:
        step: Number of the step.
        robots: Robots whose inputs were processed.
        inputs: Inputs of all robots in the step.
        report: Report of the filter, one entry for each of its robots.
    """

    step: int
    robots: tuple[int, ...]
    inputs: StepInput
    report: StepReport


def landmark_counts(slam: FastSlam) -> dict[int, int]:
    """Return the number of measurements of each landmark of the most probable particle, by id."""
    held = slam.map()
    return dict(zip(held.ids.tolist(), held.counts.tolist(), strict=True))


class StepRouting(NamedTuple):
    """Routing of steps to a filter, valid until a robot joins or leaves.

    Attributes:
        robots: Robots whose inputs are processed.
        rows: Rows of the filter's robots; the others stand still and see nothing.
        batches: Steps modulo `TURNS` in which the filter may smooth.
    """

    robots: tuple[int, ...]
    rows: RobotRows
    batches: frozenset[int]

    @classmethod
    def of(cls, branch: Branch, robots: tuple[int, ...]) -> Self:
        """Return the routing of some robots' inputs to a filter."""
        rows = tuple(robot if robot in robots else -1 for robot in branch.robots)
        smoothing = branch.robots if branch.split_from is None else branch.active_robots
        return cls(robots, rows_of(rows), frozenset(robot % TURNS for robot in smoothing))


def process_step(
    branch: Branch, step: int, routing: StepRouting, inputs: StepInput, associations: Associations, buffer: IntArray
) -> StepReport:
    """Process the inputs of some robots of a filter in one step.

    Without any input the filter does not change, bit for bit, so that a later replay gives the same result.

    Args:
        branch: Branch of the filter; its `last_steps`, `report` and monitors are updated.
        step: Number of the step in the filter's logs, in a replay too.
        routing: Routing of these robots' inputs to the branch.
        inputs: Inputs of all robots of the team, from `validate_step`.
        associations: Data association of `inputs`.
        buffer: Writable array of `associations`, see `Associations.allocate`; the association of these robots'
            measurements is written there.
    """
    robots, rows, batches = routing
    for robot in robots:
        branch.last_steps[robot] = step
    for monitor in branch.monitors:
        monitor.steps += len(robots) == len(branch.robots) or monitor.both_sides_connected(robots)
    if inputs.inactive and inputs.inactive.issuperset(robots):
        branch.report = report = _silent_report(branch, rows, associations)
        return report
    slam = branch.filter
    slam.may_smooth = step % TURNS in batches
    branch.report = report = slam.step_checked(inputs, rows, associations, buffer, step)
    if report.num_created:
        for monitor in branch.monitors:
            monitor.update(branch.robots, report)
    return report


def _silent_report(branch: Branch, rows: RobotRows, associations: Associations) -> StepReport:
    """Return the report of a step without input."""
    ess = float(branch.filter.num_particles) if branch.report is None else branch.report.ess
    return StepReport(associations, rows.rows, 0, 0, 0, 0, ess, float("nan"), False)


def fork(
    branch: Branch, active_robots: tuple[int, ...], number: int, rng: np.random.Generator, at_hand: FastSlam | None
) -> Branch:
    """Copy a branch for robots that lose contact with it; the copy has its own random stream.

    Args:
        branch: The branch.
        active_robots: Robots of the copy.
        number: Number of its map.
        rng: Generator that seeds its random stream.
        at_hand: Filter that is no longer needed, whose memory the copy takes; or None.
    """
    slam = restored(take(branch.filter), at_hand)
    slam.may_smooth, slam.rng = True, np.random.default_rng(rng.integers(2**63, size=4))
    return Branch(
        robots=branch.robots,
        active_robots=active_robots,
        filter=slam,
        last_steps=dict(branch.last_steps),
        number=number,
        epoch=branch.epoch,
        report=branch.report,
        monitors=[monitor.copy() for monitor in branch.monitors],
        split_from=branch.number if branch.split_from is None else branch.split_from,
        split_counts=landmark_counts(slam) if branch.split_from is None else dict(branch.split_counts),
    )


def split_by_component(active_robots: Sequence[int], networks: IntArray) -> list[tuple[int, ...]]:
    """Divide robots by network: the largest part first, among equal ones that with the lowest robot."""
    by_network: dict[int, list[int]] = {}
    for robot in active_robots:
        by_network.setdefault(int(networks[robot]), []).append(robot)
    return sorted((tuple(part) for part in by_network.values()), key=lambda part: (-len(part), part[0]))


def missing(branch: Branch, other: Branch) -> dict[int, int]:
    """Return the last step that `other` has processed for each robot whose steps `branch` lacks."""
    return {
        robot: last
        for robot, last in other.last_steps.items()
        if robot in branch.last_steps and robot not in branch.active_robots and branch.last_steps[robot] < last
    }


def replay(
    branch: Branch, log: InputBuffer, wanted: Mapping[int, int], most: int | None = MAX_REPLAYED
) -> list[ReplayedStep]:
    """Process the steps that a filter lacks, in order of time.

    Args:
        branch: Branch of the filter; its `last_steps` are updated.
        log: Buffer with all these steps.
        wanted: Last step to process for each robot.
        most: Limit of the number of steps; None: no limit.

    Returns:
        One entry for each step processed.
    """
    done: list[ReplayedStep] = []
    while wanted and (most is None or len(done) < most):
        due = {robot: branch.last_steps[robot] + 1 for robot, last in wanted.items() if branch.last_steps[robot] < last}
        if not due:
            break
        step = min(due.values())
        robots = tuple(sorted(robot for robot, first in due.items() if first == step))
        inputs = log.read(step)
        routing = StepRouting.of(branch, robots)
        report = process_step(branch, step, routing, inputs.with_copies(), *Associations.allocate(inputs))
        done.append(ReplayedStep(step, robots, inputs, report))
    return done
