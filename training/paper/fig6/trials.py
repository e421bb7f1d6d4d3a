"""One trial of the paper's Fig. 6: how wrong a filter's map is in the end, or how long a step takes it."""

import time
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, bad_argument, check_choice, check_int
from slam_backend.fastslam.filter import FastSlam
from training.bench.accuracy.runs import FALSE_POINT, RunSpec, StereoRun, simulate_run
from training.bench.accuracy.trials import Answer, follow, optimal, score
from training.experiments.step_timing import no_garbage_collection
from training.paper.fig6.noise_regimes import BOUND, FILTER_OPTIONS, REGIMES, Proposal

BLOCK = 20  # steps that one filter takes before the next has its turn
FIGURES = (
    "map_rmse_m", "map_aligned_rmse_m", "map_all_rmse_m", "map_recall", "map_precision", "pose_rms_m",
    "pose_aligned_rms_m", "heading_rms_deg", "ess_share", "wrong_match_share",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class ErrorTrial:
    """What decides how wrong a map is.

    Attributes:
        regime: Key of `REGIMES`.
        proposal: Of the filter, or `BOUND`.
        robots: K.
        particles: M; 0 of the bound.
        measurements: B, of all robots together.
        length: Of each robot's path [m].
        seed: Of the run, and of the filter's draws.
    """

    regime: str
    proposal: Proposal
    robots: int
    particles: int
    measurements: int
    length: float
    seed: int

    def __post_init__(self) -> None:
        check_choice("regime", self.regime, tuple(REGIMES))
        check_choice("proposal", self.proposal, REGIMES[self.regime].proposals)
        least = 0 if self.proposal == BOUND else 1
        check_int("particles", self.particles, least, "Use at least one particle; 100 is a good start.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        _ = self.spec  # refuses the rest

    @property
    def spec(self) -> RunSpec:
        """The run that is simulated."""
        return REGIMES[self.regime].spec(self.robots, self.length, self.measurements)


@dataclass(frozen=True, slots=True, kw_only=True)
class TimeTrial:
    """What decides how long steps take; all numbers of robots are timed together.

    Attributes:
        robots: Numbers K.
        particles: M.
        measurements: B, of all robots together.
        length: Of each robot's path [m].
        seed: Of the runs, and of the filters' draws.
    """

    robots: tuple[int, ...]
    particles: int
    measurements: int
    length: float
    seed: int

    def __post_init__(self) -> None:
        object.__setattr__(self, "robots", tuple(self.robots))
        if not self.robots or len(set(self.robots)) < len(self.robots):
            raise bad_argument("robots", "at least one number, each once", list(self.robots), "Correct the list.")
        for robots in self.robots:
            ErrorTrial(
                regime="paper", proposal="fastslam1", robots=robots, particles=self.particles,
                measurements=self.measurements, length=self.length, seed=self.seed,
            )  # fmt: skip

    @property
    def specs(self) -> list[RunSpec]:
        """The runs that are simulated, one for each number of robots."""
        return [REGIMES["paper"].spec(robots, self.length, self.measurements) for robots in self.robots]


def play_error(trial: ErrorTrial) -> dict[str, Any]:
    """Run a trial.

    Returns:
        The trial's own fields, the figures that `accuracy_trials.play` explains, and `map_all_rmse_m`: that of all
        landmarks of the map which a true landmark caused, duplicates included, where `map_rmse_m` takes the nearest.
        What only filters have is NaN of the bound.
    """
    run = _run_of(trial.spec, trial.seed)
    if trial.proposal == BOUND:
        answer = optimal(run, BOUND)
    else:
        answer = follow(run, _build(run, trial.proposal, trial.particles, trial.seed))
    row = score(run, answer) | {"map_all_rmse_m": rms_of_all(run, answer)}
    return asdict(trial) | {name: row[name] for name in FIGURES}


def rms_of_all(run: StereoRun, answer: Answer) -> float:
    """Return the RMS distance [m] of all landmarks of a map from the true ones that caused them; NaN if none did."""
    if answer.means is None or answer.claims is None:
        return float("nan")
    caused = answer.claims != FALSE_POINT
    apart = answer.means[caused] - run.landmarks[answer.claims[caused]]
    return float(np.sqrt((apart**2).sum(axis=1).mean())) if caused.any() else float("nan")


def play_time(trial: TimeTrial) -> dict[str, Any]:
    """Time the filters of all numbers of robots in the paper's regime, in turns, so that what else is running hits all.

    Returns:
        The trial's own fields, and per number of robots: `median_ms`, of the steps with as many measurements as were
        asked for, `all_median_ms` and `all_mean_ms`, of all steps, and `measured`, the mean number in a step.
        Times are processor time of the one thread that a filter uses, which what else is running does not prolong
        but by the caches it takes.
    """
    runs = [_run_of(spec, trial.seed) for spec in trial.specs]
    filters = [_build(run, "fastslam1", trial.particles, trial.seed) for run in runs]
    times = time_in_turns(filters, runs)
    found: dict[str, list[float]] = {"median_ms": [], "all_median_ms": [], "all_mean_ms": [], "measured": []}
    for run, own in zip(runs, times, strict=True):
        full = full_steps(run)
        found["median_ms"].append(float(np.median(own[full])) if full.any() else float("nan"))
        found["all_median_ms"].append(float(np.median(own)))
        found["all_mean_ms"].append(float(own.mean()))
        found["measured"].append(float(_measured(run).mean()))
    return asdict(trial) | found


def time_in_turns(filters: list[FastSlam], runs: list[StereoRun]) -> list[FloatArray]:
    """Let each filter take its run, `BLOCK` steps at a time; return each one's times (T,) [ms]."""
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
    """Tell at which steps (T,) the robots measured all B landmarks that they may; fewer are in view now and then."""
    return np.asarray(_measured(run) == run.spec.measurements)


def _measured(run: StereoRun) -> FloatArray:
    """Return the measurements of all robots in each step (T,)."""
    return np.array([sum(map(len, frames)) for frames in run.frames], dtype=np.float64)


def _build(run: StereoRun, proposal: Proposal, particles: int, seed: int) -> FastSlam:
    """Return a filter of this figure."""
    options = FILTER_OPTIONS[proposal]
    return run.build_filter(particles, "fastslam1" if proposal == "fastslam1" else "fastslam2", seed=seed, **options)


@lru_cache(maxsize=3)
def _run_of(spec: RunSpec, seed: int) -> StereoRun:
    """Simulate a run once for the trials on it that follow each other."""
    return simulate_run(spec, seed)
