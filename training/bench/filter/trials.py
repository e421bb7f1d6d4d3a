"""The trials of `vslam bench filter`: one filter, filled with a map, is timed step by step."""

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import IntArray
from slam_backend.fastslam.filter import FastSlam
from slam_backend.fastslam.reports import StepReport
from training.bench.filter.workload import FilterLoad, LoadStep, LoadWorld
from training.experiments.step_timing import Timing, time_calls

SWEEPS = 3  # how often each landmark was measured before
WARM_UP = 30  # steps that are not counted
STATE_CALLS = 200


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One load and how long its steps took.

    Attributes:
        load: What was timed.
        timing: Of `FastSlam.step`.
        right: Share of the measurements that the most probable particle gave to the landmark they are of.
        landmarks_held: By that particle at the end.
        ess: Mean effective sample size over M, before resampling.
        resampled: Share of the steps that resampled.
        nbytes: Memory that the particles hold.
    """

    load: FilterLoad
    timing: Timing
    right: float
    landmarks_held: int
    ess: float
    resampled: float
    nbytes: int

    @property
    def bytes_per_landmark(self) -> float:
        """Memory per particle and landmark."""
        return self.nbytes / (self.load.particles * self.load.landmarks)

    def to_mapping(self) -> dict[str, Any]:
        """Return the row as one flat table of plain values."""
        rest = {name: value for name, value in asdict(self).items() if name not in ("load", "timing")}
        return asdict(self.load) | asdict(self.timing) | rest | {"bytes_per_landmark": self.bytes_per_landmark}


def time_row(load: FilterLoad, steps: int) -> Row:
    """Fill a `FastSlam` and time `steps` steps of it."""
    world = LoadWorld(load)
    slam, ids = filled_filter(world)
    course = list(world.course(WARM_UP + steps))
    seconds, reports = time_calls(lambda step: slam.step(step.odometry, step.frames), course, WARM_UP)
    return Row(
        load=load,
        timing=Timing.of(seconds),
        right=_share_right(course[WARM_UP:], reports, ids),
        landmarks_held=slam.map_size,
        ess=float(np.mean([report.ess for report in reports])) / load.particles,
        resampled=float(np.mean([report.resampled for report in reports])),
        nbytes=slam.nbytes,
    )


def time_state(load: FilterLoad) -> dict[str, Timing]:
    """Time `get_state` and `set_state` of a filter that has run for a while."""
    world = LoadWorld(load)
    slam, _ = filled_filter(world)
    for step in world.course(WARM_UP):
        slam.step(step.odometry, step.frames)
    state = slam.get_state()
    taken, _ = time_calls(lambda _: len(slam.get_state()), range(STATE_CALLS), WARM_UP)  # each freed before the next
    given, _ = time_calls(slam.set_state, [state] * STATE_CALLS, WARM_UP)
    return {"get_state": Timing.of(taken), "set_state": Timing.of(given)}


def filled_filter(world: LoadWorld) -> tuple[FastSlam, IntArray]:
    """Return a filter whose particles all hold all landmarks, and the landmarks' ids in it (N,)."""
    load = world.load
    options = load.options
    slam = FastSlam(
        load.robots,
        load.particles,
        proposal=load.proposal,
        resample_threshold=options.resample_threshold,
        seed=load.seed,
        initial_poses=world.starts,
    )
    ids = np.full(load.landmarks, -1)
    for step in world.mapping(SWEEPS):
        created = slam.step(step.odometry, step.frames, step.names).created[0]
        ids[step.names[0][created >= 0]] = created[created >= 0]
    return slam, ids


def _share_right(course: list[LoadStep], reports: list[StepReport], ids: IntArray) -> float:
    """Return the share of all measurements that were given to the landmark they are of."""
    found = np.concatenate([np.concatenate(report.associations) for report in reports])
    true = np.concatenate([np.concatenate(step.names) for step in course])
    return float(np.mean(found == ids[true]))
