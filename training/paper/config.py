"""Configurations of the paper's figures."""

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING, Any, Literal

from training.experiments.config import ONE_PARTICLE, ExperimentConfig, Positive, first_seed, option

if TYPE_CHECKING:  # numerical modules are imported when a command runs, so that --help is fast
    from training.paper.fig6.trials import Trial

STEP = 0.25  # distance between frames along the path [m]
SEEN = "Use at least one landmark."


class Fig1Config(ExperimentConfig):
    """Fig. 1: particles along the paths of several robots."""

    robots: int = option(3, "Number of robots.", ge=1)
    particles: int = option(400, "Number of particles per robot.", ge=1, hint="Use at least one particle, e.g. 400.")
    length: float = option(30.0, "Length of each robot's path [m].")
    every: float = option(
        5.0, "Distance between two plotted sets of particles [m].", ge=STEP, hint="Use at least the length of a step."
    )

    def check(self) -> None:
        """Refuse runs that cannot be simulated."""
        from training.paper.fig6.trials import REGIMES
        from training.stereo_runs.office import check_crossings

        REGIMES["paper"].spec(self.robots, self.length)
        check_crossings(self.robots)


@dataclass(frozen=True, slots=True)
class Fig2Trial:
    """One run of two robots; fields as in `Fig2Config`."""

    length: float
    every: float
    landmarks: int
    particles: int
    seed: int


class Fig2Config(ExperimentConfig):
    """Fig. 2: errors of alignment methods over the size of two robots' maps."""

    seeds: int = option(20, "Number of runs.", ge=1, hint="Use at least one seed.")
    seed: int = first_seed()
    length: float = option(80.0, "Length of each robot's path [m].")
    every: float = option(
        5.0, "Distance between two alignments [m].", ge=STEP, hint="Use at least the length of a step."
    )
    landmarks: int = option(300, "Number of landmarks in the office.", ge=1, hint=SEEN)
    particles: int = option(100, "Number of particles per filter.", ge=1, hint="Use at least one particle.")

    def check(self) -> None:
        """Refuse a path shorter than one stage."""
        from slam_backend.core.validation import check_float

        check_float("length", self.length, "Give metres, at least one stage.", at_least=self.every)

    def trials(self) -> list[Fig2Trial]:
        """Return one trial for each seed."""
        return [
            Fig2Trial(self.length, self.every, self.landmarks, self.particles, seed)
            for seed in range(self.seed, self.seed + self.seeds)
        ]


class PairConfig(ExperimentConfig):
    """Figs. 3 and 4: aligned and fused maps of two robots."""

    length: float = option(30.0, "Length of each robot's path [m].", ge=STEP, hint="Give metres.")
    landmarks: int = option(300, "Number of landmarks in the office.", ge=1, hint=SEEN)
    particles: int = option(100, "Number of particles per filter.", ge=1, hint="Use at least one particle.")


class Fig5Config(ExperimentConfig):
    """Fig. 5: robots in a room, with visible and hidden landmarks."""

    robots: int = option(3, "Number of robots.", ge=1, le=8, hint="Use 1 to 8 robots.")
    decisions: int = option(
        30, "Simulated time of the exploration before the figure [s].", name="max_seconds", ge=1,
        hint="Give at least one second.",
    )  # fmt: skip
    measurements: int = option(
        5, "Maximum number of measurements B per robot and tick.", ge=1,
        hint="Use at least one measurement.",
    )  # fmt: skip


class Fig6Config(ExperimentConfig):
    """Fig. 6: time of a step and map error over numbers of particles and robots."""

    seeds: int = option(20, "Number of runs of each kind.", ge=1, hint="Use at least one seed.")
    seed: int = first_seed()
    particles: tuple[Positive, ...] = option(
        (1, 10, 50, 100, 200, 300, 400, 500, 1000, 1500, 2000), "Numbers of particles M, comma-separated.",
        shown="11 values of the paper, 1 to 2000", hint=ONE_PARTICLE,
    )  # fmt: skip
    robots: tuple[Positive, ...] = option(
        (1, 2, 3), "Numbers of robots K, comma-separated.", hint="Use at least one robot."
    )
    regimes: tuple[Literal["paper", "look_alikes", "good"], ...] = option(
        ("paper", "look_alikes", "good"), "Noise regimes: paper, look_alikes, good.", shown="all"
    )
    measurements: int = option(15, "Number of measurements B per step, of all robots together.")
    length: float = option(100.0, "Length of each robot's path [m].")

    def check(self) -> None:
        """Refuse combinations without a valid trial."""
        from training.stereo_runs.office import check_crossings

        self.trials()
        check_crossings(max(self.robots))

    def trials(self) -> list["Trial"]:
        """Return the trials: errors by seed, those of one run in succession, then times in the paper's regime."""
        from training.paper.fig6.trials import BOUND, FEW, REGIMES, Trial

        shared: dict[str, Any] = {"measurements": self.measurements, "length": self.length}
        seeds = range(self.seed, self.seed + self.seeds)
        errors = [
            Trial(regime=name, proposal=proposal, robots=(robots,), particles=particles, seed=seed, **shared)
            for seed, name, robots in product(seeds, self.regimes, self.robots)
            for proposal in REGIMES[name].proposals
            for particles in ((0,) if proposal == BOUND else self.particles)
            if particles in FEW or proposal == BOUND or not REGIMES[name].few
        ]
        return errors + [
            Trial(robots=self.robots, particles=particles, seed=seed, is_timed=True, **shared)
            for seed, particles in product(seeds if "paper" in self.regimes else (), self.particles)
        ]
