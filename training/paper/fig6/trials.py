"""Trials of the paper's Fig. 6 in three noise regimes: map error and step time of a filter."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, check_choice, check_int
from slam_backend.fastslam.filter import FastSlam
from training.experiments.machine.timing import no_garbage_collection
from training.experiments.study import Row
from training.paper.config import Fig6Config
from training.stereo_runs.runs import FALSE_POINT, Preset, RunSpec, StereoRun, simulate_run
from training.stereo_runs.scores import (
    REJUVENATE_EVERY,
    Answer,
    batch_of,
    follow,
    least_squares_answer,
    score,
)

Proposal = Literal["fastslam1", "fastslam2", "fastslam2+rejuvenation", "batch_ml"]

BOUND: Proposal = "batch_ml"  # no filter, no particles: maximum likelihood with true associations

FEW = (10, 100, 1000)  # numbers of particles, instead of the paper's eleven
# Algorithm 1, l. 10: random draws in proportion to the weights, at every step. fastslam2 has the defaults, and
# "+rejuvenation" samples all particles from smoothed paths at regular intervals.
FILTER_OPTIONS: dict[Proposal, dict[str, Any]] = {
    "fastslam1": {"resample_threshold": 1.0, "resampling": "multinomial"}, "fastslam2": {},
    "fastslam2+rejuvenation": {"rejuvenate_every": REJUVENATE_EVERY},
}  # fmt: skip

# Sec. 5 mentions neither similar landmarks nor false points.
DISTINCT = {"look_alikes": 1, "outliers": 0.0, "wrong_descriptors": 0.0}
BLOCK = 20  # steps of one filter before the next filter runs
FIGURES = (
    "map_rmse_m", "map_aligned_rmse_m", "map_all_rmse_m", "map_recall", "map_precision", "pose_rms_m",
    "pose_aligned_rms_m", "heading_rms_deg", "ess_share", "wrong_match_share",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Regime:
    """Noise, descriptors and filters of a set of trials. Association is always unknown."""

    title: str  # Title in tables and figures
    preset: Preset  # Noise preset
    looks: dict[str, Any]  # Fields of `RunSpec` for similar landmarks and outliers
    proposals: tuple[Proposal, ...]  # Proposals of the filters; `BOUND` adds the lower bound
    few: bool  # Whether only the numbers of particles in `FEW` are run

    def spec(self, robots: int, length: float, measurements: int = 15) -> RunSpec:
        """Return the run of K robots that drive `length` [m] each and measure at most B landmarks per step in total."""
        return RunSpec(
            preset=self.preset, association="unknown", robots=robots, length=length, measurements=measurements,
            **self.looks,
        )  # fmt: skip


REGIMES = {
    "paper": Regime(
        title="as in the paper", preset="paper", looks=DISTINCT, proposals=("fastslam1",), few=False
    ),
    "look_alikes": Regime(
        title="with similar landmarks and false points", preset="paper", looks={}, proposals=("fastslam1",),
        few=True,
    ),
    "good": Regime(
        title="good stereo", preset="good", looks=DISTINCT,
        proposals=("fastslam1", "fastslam2", "fastslam2+rejuvenation", BOUND), few=True,
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A filter whose map error is measured, or several whose steps are timed together."""

    regime: str = "paper"  # Key of `REGIMES`
    proposal: Proposal = "fastslam1"  # Proposal of the filter, or `BOUND`
    robots: tuple[int, ...]  # Number K, or all numbers that are timed together
    particles: int  # M; 0 for the bound
    measurements: int  # B, for all robots together
    length: float  # Path length of each robot [m]
    seed: int  # Seed of the runs and of the filters
    is_timed: bool = False  # Whether steps are timed

    def __post_init__(self) -> None:
        object.__setattr__(self, "robots", tuple(self.robots))
        check_choice("regime", self.regime, tuple(REGIMES))
        check_choice("proposal", self.proposal, REGIMES[self.regime].proposals)
        least = 0 if self.proposal == BOUND else 1
        check_int("particles", self.particles, least, "Use at least one particle; 100 is a good start.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        _ = self.specs  # validates the other fields

    @property
    def specs(self) -> list[RunSpec]:
        """Simulated runs, one for each number of robots."""
        return [REGIMES[self.regime].spec(robots, self.length, self.measurements) for robots in self.robots]


def play(config: Fig6Config, trial: Trial) -> dict[str, Any]:
    """Run a trial; lists have a value for each number of robots.

    Returns:
        The times of `play_times`, or `FIGURES`: the metrics of `score`, and `map_all_rmse_m`, the RMSE over all
        landmarks of the map that have a true landmark, duplicates included, while `map_rmse_m` uses the nearest one.
        Metrics that only filters have are NaN for the bound.
    """
    runs = [_run_of(spec, trial.seed) for spec in trial.specs]
    if trial.is_timed:
        return play_times(runs, trial)
    (run,) = runs
    if trial.proposal == BOUND:
        problem, batch = batch_of(run)
        answer = least_squares_answer(problem, batch.paths, batch.path_covariances, batch.landmarks)
    else:
        answer = follow(run, _build(run, trial.proposal, trial.particles, trial.seed))
    row = score(run, answer) | {"map_all_rmse_m": rms_of_all(run, answer)}
    return {name: row[name] for name in FIGURES}


def unfold(rows: Sequence[Row]) -> list[Row]:
    """Return a row for each number of robots of a trial, with the title of its `filter`."""
    return [
        {"filter": f"{REGIMES[row['regime']].title}, {row['proposal']}"}
        | {name: value[i] if isinstance(value, list | tuple) else value for name, value in row.items()}
        for row in rows
        for i in range(len(row["robots"]))
    ]


def rms_of_all(run: StereoRun, answer: Answer) -> float:
    """Return the RMS distance [m] of all landmarks of a map from their true landmarks; NaN if there are none."""
    if answer.means is None or answer.claims is None:
        return float("nan")
    caused = answer.claims != FALSE_POINT
    apart = answer.means[caused] - run.landmarks[answer.claims[caused]]
    return float(np.sqrt((apart**2).sum(axis=1).mean())) if caused.any() else float("nan")


def play_times(runs: list[StereoRun], trial: Trial) -> dict[str, list[float]]:
    """Time the filters of all numbers of robots, interleaved so that other load affects all.

    Returns:
        Lists with a value for each number of robots: `median_ms` over the steps with the full number of measurements,
        `all_median_ms` and `all_mean_ms` over all steps, and `measured`, the mean number per step. Times are processor
        times of the single thread of a filter; other processes affect them only through shared caches.
    """
    filters = [_build(run, trial.proposal, trial.particles, trial.seed) for run in runs]
    columns: dict[str, list[float]] = {"median_ms": [], "all_median_ms": [], "all_mean_ms": [], "measured": []}
    for run, own in zip(runs, time_in_turns(filters, runs), strict=True):
        full = full_steps(run)
        columns["median_ms"].append(float(np.median(own[full])) if full.any() else float("nan"))
        columns["all_median_ms"].append(float(np.median(own)))
        columns["all_mean_ms"].append(float(own.mean()))
        columns["measured"].append(float(_measured(run).mean()))
    return columns


def time_in_turns(filters: list[FastSlam], runs: list[StereoRun]) -> list[FloatArray]:
    """Run each filter on its run, `BLOCK` steps at a time; return the times (T,) [ms] of each."""
    times = [np.zeros(run.num_steps) for run in runs]
    readings = [list(run.readings()) for run in runs]
    with no_garbage_collection():
        for begin in range(0, max(run.num_steps for run in runs), BLOCK):
            for slam, own, taken in zip(filters, readings, times, strict=True):
                for step, reading in enumerate(own[begin : begin + BLOCK], begin):
                    before = time.thread_time_ns()
                    slam.step(**reading)
                    taken[step] = 1e-6 * (time.thread_time_ns() - before)
    return times


def full_steps(run: StereoRun) -> BoolArray:
    """Return at which steps (T,) the robots measured B landmarks; sometimes fewer are in view."""
    return np.asarray(_measured(run) == run.spec.measurements)


def _measured(run: StereoRun) -> FloatArray:
    """Return the number of measurements of all robots in each step (T,)."""
    return np.array([sum(map(len, frames)) for frames in run.frames], dtype=np.float64)


def _build(run: StereoRun, proposal: Proposal, particles: int, seed: int) -> FastSlam:
    """Return a filter for this figure."""
    options = FILTER_OPTIONS[proposal]
    return run.build_filter(particles, "fastslam1" if proposal == "fastslam1" else "fastslam2", seed=seed, **options)


@lru_cache(maxsize=3)
def _run_of(spec: RunSpec, seed: int) -> StereoRun:
    """Simulate a run once for consecutive trials."""
    return simulate_run(spec, seed)
