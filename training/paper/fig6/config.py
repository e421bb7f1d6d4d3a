"""`Fig6Config`: all that decides the paper's Fig. 6; its trials in the order in which they run."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from slam_backend.core.validation import check_choice, check_int
from training.bench.accuracy.world import start_crossings
from training.experiments.config import PlainConfig, check_each_once
from training.paper.fig6.noise_regimes import BOUND, FEW, REGIMES, Regime
from training.paper.fig6.trials import ErrorTrial, TimeTrial

COMMAND = "paper fig6"
ERRORS_FILE, TIMES_FILE = "errors.jsonl", "times.jsonl"
PARTICLES = (1, 10, 50, 100, 200, 300, 400, 500, 1000, 1500, 2000)  # of the paper's figure
QUICK: dict[str, Any] = {"particles": (1, 10, 100), "seeds": 3, "length": 25.0}
FIXED_COST = 200  # a step costs about as much as that of so many particles, however few there are
BOUND_COST = 4000  # in the same unit, of batch maximum likelihood


@dataclass(frozen=True, slots=True, kw_only=True)
class Fig6Config(PlainConfig):
    """All that decides the figure.

    Attributes:
        particles: Numbers M.
        robots: Numbers K.
        regimes: Keys of `REGIMES`.
        measurements: B, of all robots together.
        length: Of each robot's path [m].
        seeds: How many runs of each kind.
        seed: The first of them.
    """

    particles: tuple[int, ...] = PARTICLES
    robots: tuple[int, ...] = (1, 2, 3)
    regimes: tuple[str, ...] = tuple(REGIMES)
    measurements: int = 15
    length: float = 100.0
    seeds: int = 20
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("seeds", self.seeds, 1, "Run at least one seed.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        for name in ("particles", "robots", "regimes"):
            check_each_once(name, getattr(self, name))
        for regime in self.regimes:
            check_choice("regimes", regime, tuple(REGIMES))
        self.error_trials()  # refuses what no trial can be
        self.time_trials()
        start_crossings(max(self.robots), np.random.default_rng(0))  # each robot starts at one of its own

    def error_trials(self) -> list[ErrorTrial]:
        """Return the trials of the map error, those on the same run in a row, seed by seed."""
        return [
            ErrorTrial(
                regime=name,
                proposal=proposal,
                robots=robots,
                particles=particles,
                measurements=self.measurements,
                length=float(self.length),
                seed=seed,
            )
            for seed in range(self.seed, self.seed + self.seeds)
            for name in self.regimes
            for robots in self.robots
            for proposal in REGIMES[name].proposals
            for particles in ((0,) if proposal == BOUND else self._particles_in(REGIMES[name]))
        ]

    def _particles_in(self, regime: Regime) -> tuple[int, ...]:
        """Return the numbers M that are run in a regime."""
        return tuple(m for m in self.particles if not regime.few or m in FEW)

    def time_trials(self) -> list[TimeTrial]:
        """Return the trials of the time per step, seed by seed; none without the paper's regime."""
        return [
            TimeTrial(
                robots=self.robots,
                particles=particles,
                measurements=self.measurements,
                length=float(self.length),
                seed=seed,
            )
            for seed in range(self.seed, self.seed + self.seeds)
            for particles in self.particles
            if "paper" in self.regimes
        ]


def cost(trial: ErrorTrial | TimeTrial) -> int:
    """Return about how long a trial takes, in an arbitrary unit: what a progress bar counts."""
    if isinstance(trial, TimeTrial):
        return (trial.particles + FIXED_COST) * len(trial.robots)
    return BOUND_COST if trial.proposal == BOUND else trial.particles + FIXED_COST
