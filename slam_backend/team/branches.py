"""`Branch`: a filter and the robots that go by it; how a filter forks when robots lose contact, and is told later.

A group's *trunk* is its joint filter. Robots that lose contact with those who keep it go on with a copy, a *fork*, that
takes in only what they read themselves, while the trunk holds their poses as they were. On return the trunk takes in
what they have read meanwhile, in order of time, and the fork is dropped.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Self

import numpy as np

from slam_backend.core.read_only import with_constants
from slam_backend.core.validation import IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import Associations, StepReport
from slam_backend.fastslam.step_input import InputBuffer, RobotRows, StepInput, rows_of
from slam_backend.team.merge_monitor import MergeMonitor

MAX_REPLAYED = 20  # buffered steps that a filter takes in per tick
TURNS = 4  # filters smooth in turn: that of a robot only in every fourth step


@dataclass(slots=True, eq=False)
class Branch:
    """A filter and the robots that go by it.

    Attributes:
        robots: Of the filter, ascending, in the filter's order.
        active_robots: Those of them that go by it now, ascending.
        filter: Of all `robots`.
        last_steps: Per robot of the filter the last step whose readings it has taken in, -1 = none.
        number: Of its map; each filter that ever was has one of its own.
        epoch: How many merges and undos the team had seen when the filter was made: the higher the more it knows.
        report: Of its last step.
        split_from: Number of the map with which it had all in common at the split; None before any.
        monitors: Of its merges that can still be undone, oldest first.
        split_counts: The landmarks of that map whose descriptors its robots know, by id, and how often each had been
            measured when they were last told.
    """

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

    def known_landmarks(self, main: "Branch", replayed: Sequence["ReplayedStep"]) -> dict[int, int]:
        """Return which landmarks of the filter they return to the robots know, those included that they just created.

        Args:
            main: Which took in `replayed`.
            replayed: Among others what these robots read.
        """
        if self.split_from != main.number:
            self.split_from, self.split_counts = main.number, {}
        for done in replayed:
            for robot in set(done.robots) & set(self.active_robots):
                row = done.report.rows[main.robots.index(robot)]
                for name in done.report.all_associations.created_ids(row):
                    self.split_counts.setdefault(name, 0)
        return self.split_counts

    def get_state(self) -> dict[str, Any]:
        """Return all that decides how the branch goes on."""
        return {
            "robots": self.robots,
            "active_robots": self.active_robots,
            "filter": self.filter.get_state(),
            "last_steps": dict(self.last_steps),
            "number": self.number,
            "epoch": self.epoch,
            "report": self.report,
            "monitors": tuple(watch.copy() for watch in self.monitors),
            "split_from": self.split_from,
            "split_counts": dict(self.split_counts),
        }

    @classmethod
    def from_state(cls, state: Mapping[str, Any], at_hand: FastSlam | None = None) -> "Branch":
        """Build a branch from `get_state`; a filter at hand is filled in place of a new one."""
        slam = restored_filter(state["filter"], at_hand)
        rest = {name: state[name] for name in ("robots", "active_robots", "number", "epoch", "split_from")}
        return cls(
            filter=slam,
            last_steps=dict(state["last_steps"]),
            monitors=[watch.copy() for watch in state["monitors"]],
            split_counts=dict(state["split_counts"]),
            report=with_constants(state["report"]),
            **rest,
        )


class ReplayedStep(NamedTuple):
    """What a filter made of a step that it took in later.

    Attributes:
        step: Number of the step.
        robots: Whose readings it took in.
        inputs: Those readings, and the other robots'.
        report: Of the filter, one entry for each of its robots.
    """

    step: int
    robots: tuple[int, ...]
    inputs: StepInput
    report: StepReport


def restored_filter(state: Mapping[str, Any], at_hand: FastSlam | None = None) -> FastSlam:
    """Return a filter that goes on from `FastSlam.get_state`; one at hand is filled, which is faster than building."""
    slam = at_hand if at_hand is not None else FastSlam.from_options(len(state["poses"]), state["options"])
    slam.restore_checked(state)
    return slam


def landmark_counts(slam: FastSlam) -> dict[int, int]:
    """Return how often each landmark of the most probable particle was measured, by id."""
    held = slam.map()
    return dict(zip(held.ids.tolist(), held.counts.tolist(), strict=True))


class StepRouting(NamedTuple):
    """How a filter takes in steps, as long as nobody joins or leaves.

    Attributes:
        robots: Whose readings it takes in.
        rows: Of its robots; the others stand still, unseeing.
        batches: In which of `TURNS` steps it smooths.
    """

    robots: tuple[int, ...]
    rows: RobotRows
    batches: frozenset[int]

    @classmethod
    def of(cls, branch: Branch, robots: tuple[int, ...]) -> Self:
        """Return how a filter takes in what some of its robots read."""
        rows = tuple(robot if robot in robots else -1 for robot in branch.robots)
        smoothing = branch.robots if branch.split_from is None else branch.active_robots
        return cls(robots, rows_of(rows), frozenset(robot % TURNS for robot in smoothing))


def process_step(
    branch: Branch, step: int, intake: StepRouting, inputs: StepInput, findings: Associations, told: IntArray
) -> StepReport:
    """Let a filter take in what some of its robots read in one step.

    If there is nothing to take in the filter stays as it is, bit for bit, so that a later replay finds it unchanged.

    Args:
        branch: Whose filter steps; its `known`, `report` and watches move on.
        step: Number of the step; the filter's logs bear it, whenever it is taken in.
        intake: Of the branch and these robots.
        inputs: Of all robots of the team, checked by `validate_step`.
        findings: Of `inputs`.
        told: Their buffer, see `Associations.allocate`; what becomes of these robots' measurements is written there.
    """
    robots, seats, turns = intake
    for robot in robots:
        branch.last_steps[robot] = step
    for watch in branch.monitors:
        watch.steps += len(robots) == len(branch.robots) or watch.both_sides_connected(robots)
    if inputs.inactive and inputs.inactive.issuperset(robots):
        branch.report = report = _silent_report(branch, seats, findings)
        return report
    slam = branch.filter
    slam.may_smooth = step % TURNS in turns
    branch.report = report = slam.step_checked(inputs, seats, findings, told, step)
    if report.num_created:
        for watch in branch.monitors:
            watch.update(branch.robots, report)
    return report


def _silent_report(branch: Branch, seats: RobotRows, findings: Associations) -> StepReport:
    """Return the report of a step in which nothing happened."""
    ess = float(branch.filter.num_particles) if branch.report is None else branch.report.ess
    return StepReport(findings, seats.rows, 0, 0, 0, 0, ess, float("nan"), False)


def fork(branch: Branch, live: tuple[int, ...], number: int, rng: np.random.Generator) -> Branch:
    """Copy a branch for robots that lose contact with it; the copy draws from a stream of its own."""
    stream = np.random.default_rng(rng.integers(2**63, size=4)).bit_generator.state
    slam = restored_filter(branch.filter.get_state() | {"rng": stream})
    return Branch(
        robots=branch.robots,
        active_robots=live,
        filter=slam,
        last_steps=dict(branch.last_steps),
        number=number,
        epoch=branch.epoch,
        report=branch.report,
        monitors=[watch.copy() for watch in branch.monitors],
        split_from=branch.number if branch.split_from is None else branch.split_from,
        split_counts=landmark_counts(slam) if branch.split_from is None else dict(branch.split_counts),
    )


def split_by_component(live: Sequence[int], networks: IntArray) -> list[tuple[int, ...]]:
    """Divide robots by their networks: the largest part first, of equal ones that with the lowest robot."""
    by_network: dict[int, list[int]] = {}
    for robot in live:
        by_network.setdefault(int(networks[robot]), []).append(robot)
    return sorted((tuple(part) for part in by_network.values()), key=lambda part: (-len(part), part[0]))


def missing(branch: Branch, other: Branch) -> dict[int, int]:
    """Return per robot the last step that `other` knows of it, where `branch` has not taken in so much."""
    return {
        robot: last
        for robot, last in other.last_steps.items()
        if robot in branch.last_steps and robot not in branch.active_robots and branch.last_steps[robot] < last
    }


def replay(
    branch: Branch, log: InputBuffer, wanted: Mapping[int, int], most: int | None = MAX_REPLAYED
) -> list[ReplayedStep]:
    """Let a filter take in what it lacks, in order of time.

    Args:
        branch: Whose filter; its `known` moves on.
        log: Holds all that is wanted.
        wanted: Per robot the last step to take in.
        most: Steps to take in at most; None: all.

    Returns:
        One entry for each step taken in.
    """
    done: list[ReplayedStep] = []
    while wanted and (most is None or len(done) < most):
        due = {robot: branch.last_steps[robot] + 1 for robot, last in wanted.items() if branch.last_steps[robot] < last}
        if not due:
            break
        step = min(due.values())
        robots = tuple(sorted(robot for robot, first in due.items() if first == step))
        inputs = log.read(step)
        intake = StepRouting.of(branch, robots)
        report = process_step(branch, step, intake, inputs.with_copies(), *Associations.allocate(inputs))
        done.append(ReplayedStep(step, robots, inputs, report))
    return done
