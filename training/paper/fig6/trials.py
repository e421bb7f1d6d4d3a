"""Trials of the paper's Fig. 6 under three noise regimes: the error of a filter's map, and the time of a step."""

import time
from dataclasses import asdict, dataclass
from functools import lru_cache
from typing import Any, Literal

import numpy as np

from slam_backend.core.validation import BoolArray, FloatArray, check_choice, check_int
from slam_backend.fastslam.filter import FastSlam
from training.bench.accuracy.runs import FALSE_POINT, Preset, RunSpec, StereoRun, simulate_run
from training.bench.accuracy.trials import REJUVENATE_EVERY, Answer, follow, optimal, score
from training.experiments.timing import no_garbage_collection

Proposal = Literal["fastslam1", "fastslam2", "fastslam2+rejuvenation", "batch_ml"]

BOUND: Proposal = "batch_ml"  # no filter: maximum likelihood over the whole run, told all names; it has no particles

FEW = (10, 100, 1000)  # particles, beside the paper's eleven numbers
# Algorithm 1, l. 10: drawn at random in proportion to the weights, at every step. fastslam2 keeps the defaults, and
# "+rejuvenation" draws all particles anew from smoothed paths every so many steps.
FILTER_OPTIONS: dict[Proposal, dict[str, Any]] = {
    "fastslam1": {"resample_threshold": 1.0, "resampling": "multinomial"}, "fastslam2": {},
    "fastslam2+rejuvenation": {"rejuvenate_every": REJUVENATE_EVERY},
}  # fmt: skip

# Sec. 5 speaks neither of look-alikes nor of false points.
DISTINCT = {"look_alikes": 1, "outliers": 0.0, "wrong_descriptors": 0.0}
ERRORS_FILE, TIMES_FILE = "errors.jsonl", "times.jsonl"
FIXED_COST = 200  # a step costs about as much as that of so many particles, however few there are
BOUND_COST = 4000  # in the same unit, of batch maximum likelihood
BLOCK = 20  # steps that one filter takes before the next has its turn
FIGURES = (
    "map_rmse_m", "map_aligned_rmse_m", "map_all_rmse_m", "map_recall", "map_precision", "pose_rms_m",
    "pose_aligned_rms_m", "heading_rms_deg", "ess_share", "wrong_match_share",
)  # fmt: skip


@dataclass(frozen=True, slots=True, kw_only=True)
class Regime:
    """Noise, looks of the landmarks, and the filters that are tried. Association is always unknown."""

    title: str  # For tables and figures
    preset: Preset  # Of the noise
    looks: dict[str, Any]  # Fields of `RunSpec` that say how landmarks are confused
    proposals: tuple[Proposal, ...]  # Of the filters; with `BOUND`, what nothing can beat stands beside them
    few: bool  # Whether the numbers of particles in `FEW` are enough

    def spec(self, robots: int, length: float, measurements: int = 15) -> RunSpec:
        """Return the run of K robots, each driving `length` [m]; all together measure at most B landmarks in a step."""
        return RunSpec(
            preset=self.preset, association="unknown", robots=robots, length=length, measurements=measurements,
            **self.looks,
        )  # fmt: skip


REGIMES = {
    "paper": Regime(
        title="as in the paper", preset="paper", looks=DISTINCT, proposals=("fastslam1",), few=False
    ),
    "look_alikes": Regime(
        title="with look-alikes and false points", preset="paper", looks={}, proposals=("fastslam1",),
        few=True,
    ),
    "good": Regime(
        title="good stereo", preset="good", looks=DISTINCT,
        proposals=("fastslam1", "fastslam2", "fastslam2+rejuvenation", BOUND), few=True,
    ),
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ErrorTrial:
    """What decides how wrong a map is."""

    regime: str  # Key of `REGIMES`
    proposal: Proposal  # Of the filter, or `BOUND`
    robots: int  # K
    particles: int  # M; 0 of the bound
    measurements: int  # B, of all robots together
    length: float  # Of each robot's path [m]
    seed: int  # Of the run, and of the filter's draws

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


@dataclass(frozen=True, slots=True)
class TimeTrial:
    """What decides how long steps take; all numbers of robots are timed together."""

    robots: tuple[int, ...]  # Numbers K
    particles: int  # M
    measurements: int  # B, of all robots together
    length: float  # Of each robot's path [m]
    seed: int  # Of the runs, and of the filters' draws

    def __post_init__(self) -> None:
        object.__setattr__(self, "robots", tuple(self.robots))
        for robots in self.robots:
            ErrorTrial("paper", "fastslam1", robots, self.particles, self.measurements, self.length, self.seed)

    @property
    def specs(self) -> list[RunSpec]:
        """The runs that are simulated, one for each number of robots."""
        return [REGIMES["paper"].spec(robots, self.length, self.measurements) for robots in self.robots]


def cost(trial: ErrorTrial | TimeTrial) -> int:
    """Return about how long a trial takes, in an arbitrary unit: what a progress bar counts."""
    if isinstance(trial, TimeTrial):
        return (trial.particles + FIXED_COST) * len(trial.robots)
    return BOUND_COST if trial.proposal == BOUND else trial.particles + FIXED_COST


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
