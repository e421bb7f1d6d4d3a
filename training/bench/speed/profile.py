"""Profile of `env.step`: time of each phase, without the time of nested phases."""

import time
from collections import defaultdict
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, NamedTuple

import numpy as np

from slam_backend.fastslam.filter import FastSlam
from slam_backend.team.team import TeamSlam
from vslam_env import environment
from vslam_env.belief.shared_grids import SharedGrids
from vslam_env.belief.team_belief import TeamBelief
from vslam_env.navigation import TeamCandidates
from vslam_env.sensors import LandmarkSensor, RangeFinder
from vslam_env.simulation.episode import Episode
from vslam_env.world import Simulator

REST = "other"


class Phase(NamedTuple):
    """Part of a step: its name, and the owners and names of its functions."""

    name: str
    calls: tuple[tuple[Any, str], ...]


PHASES = (
    Phase("physics", ((Simulator, "step"),)),
    Phase("landmark sensor", ((LandmarkSensor, "measure"),)),
    Phase("scans", ((RangeFinder, "measure"),)),
    Phase("grid painting", ((SharedGrids, "step"),)),
    Phase("filters", ((FastSlam, "step_checked"),)),
    Phase("team, alignment", ((TeamSlam, "step"),)),
    Phase("errors", ((Episode, "team_metrics"),)),
    Phase("observations", ((environment, "observe_team"),)),
    Phase("candidates", ((TeamCandidates, "update"),)),
    Phase(
        "beliefs, dictionaries",
        ((TeamBelief, "step"), (environment, "build_observations"), (environment, "build_infos")),
    ),
)  # fmt: skip


def measure_budget(step: Callable[[Any], Any], arguments: list[Any]) -> dict[str, dict[str, Any]]:
    """Call `step` with each argument in order and return the time of each phase by its name.

    The clock takes about a microsecond per timed call. Rare events show only in the mean.
    """
    totals: list[dict[str, int]] = []
    with _timed(PHASES) as spent:
        for argument in arguments:
            spent.clear()
            begin = time.perf_counter_ns()
            step(argument)
            whole = time.perf_counter_ns() - begin
            totals.append({**spent, REST: whole - sum(spent.values())})
    found = {}
    for name in (*(phase.name for phase in PHASES), REST):
        micros = np.array([total.get(name, 0) for total in totals]) / 1e3
        found[name] = {"median_us": float(np.median(micros)), "mean_us": float(micros.mean())}
    return found


@contextmanager
def _timed(phases: tuple[Phase, ...]) -> Iterator[dict[str, int]]:
    """Time the calls of phases while the block runs; yield nanoseconds by phase, without nested phases."""
    spent: dict[str, int] = defaultdict(int)
    stack: list[list[int]] = []  # nanoseconds of inner calls, for each nested call

    def timed(function: Callable[..., Any], name: str) -> Callable[..., Any]:
        @wraps(function)
        def call(*args: Any, **kwargs: Any) -> Any:
            stack.append([0])
            begin = time.perf_counter_ns()
            try:
                return function(*args, **kwargs)
            finally:
                whole = time.perf_counter_ns() - begin
                spent[name] += whole - stack.pop()[0]
                if stack:
                    stack[-1][0] += whole

        return call

    originals = [(owner, name, owner.__dict__[name]) for phase in phases for owner, name in phase.calls]
    try:
        for phase in phases:
            for owner, name in phase.calls:
                setattr(owner, name, timed(owner.__dict__[name], phase.name))
        yield spent
    finally:
        for owner, name, original in originals:
            setattr(owner, name, original)
