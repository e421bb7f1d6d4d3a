"""The configurations of the paper's figures."""

from itertools import product
from typing import TYPE_CHECKING, Literal

from training.experiments.config import ONE_PARTICLE, ExperimentConfig, Positive, first_seed, option

if TYPE_CHECKING:  # what computes is imported when a command runs, so that --help answers at once
    from training.paper.fig2 import Fig2Trial
    from training.paper.fig6.trials import ErrorTrial, TimeTrial

STEP = 0.25  # distance between frames along the path [m]
SEEN = "An office without landmarks shows nothing."


class Fig1Config(ExperimentConfig):
    """Fig. 1: clouds of particles along the paths of a few robots."""

    robots: int = option(3, "Number of robots.", ge=1)
    particles: int = option(400, "Particles of each cloud.", ge=1, hint="Use at least one particle; 400 make a cloud.")
    length: float = option(30.0, "Length of each robot's path [m].")
    every: float = option(5.0, "Metres between two clouds.", ge=STEP, hint="A cloud can be drawn after each step.")

    def check(self) -> None:
        """Refuse runs that cannot be simulated."""
        from training.bench.accuracy.world import check_crossings
        from training.paper.fig6.trials import REGIMES

        REGIMES["paper"].spec(self.robots, self.length)
        check_crossings(self.robots)


class Fig2Config(ExperimentConfig):
    """Fig. 2: errors of alignment methods against the size of two robots' maps."""

    seeds: int = option(20, "Number of runs.", ge=1, hint="Run at least one seed.")
    seed: int = first_seed()
    length: float = option(80.0, "Length of each robot's path [m].")
    every: float = option(5.0, "Metres between two alignments.", ge=STEP, hint="Maps can be aligned after each step.")
    landmarks: int = option(300, "Landmarks of the office.", ge=1, hint=SEEN)
    particles: int = option(100, "Particles of each robot's filter.", ge=1, hint="Use at least one particle.")

    def check(self) -> None:
        """Refuse a path without a stage."""
        from slam_backend.core.validation import check_float

        check_float("length", self.length, "Give metres, at least one stage of them.", at_least=self.every)

    def trials(self) -> list["Fig2Trial"]:
        """Return one trial for each seed."""
        from training.paper.fig2 import Fig2Trial

        return [
            Fig2Trial(self.length, self.every, self.landmarks, self.particles, seed)
            for seed in range(self.seed, self.seed + self.seeds)
        ]


class PairConfig(ExperimentConfig):
    """Figs. 3 and 4: two robots' maps, aligned and fused."""

    length: float = option(30.0, "Length of each robot's path [m].", ge=STEP, hint="Give metres.")
    landmarks: int = option(300, "Landmarks of the office.", ge=1, hint=SEEN)
    particles: int = option(100, "Particles of each robot's filter.", ge=1, hint="Use at least one particle.")


class Fig5Config(ExperimentConfig):
    """Fig. 5: robots in a room, what they see, and what walls hide from them."""

    robots: int = option(3, "Number of robots.", ge=1, le=8, hint="Use 1 to 8 robots.")
    decisions: int = option(
        30, "Seconds of exploration before the figure.", ge=1, hint="Let them move for a second or more."
    )
    measurements: int = option(
        5, "Number of measurements B of each robot in a tick, at most.", ge=1,
        hint="Let each measure a landmark or more.",
    )  # fmt: skip


class Fig6Config(ExperimentConfig):
    """Fig. 6: time of a step and map error against particles and robots."""

    seeds: int = option(20, "Number of runs of each kind.", ge=1, hint="Run at least one seed.")
    seed: int = first_seed()
    particles: tuple[Positive, ...] = option(
        (1, 10, 50, 100, 200, 300, 400, 500, 1000, 1500, 2000), "Numbers of particles M with commas between.",
        shown="the paper's eleven, 1 to 2000", hint=ONE_PARTICLE,
    )  # fmt: skip
    robots: tuple[Positive, ...] = option((1, 2, 3), "Numbers of robots K.", hint="Use at least one robot.")
    regimes: tuple[Literal["paper", "look_alikes", "good"], ...] = option(
        ("paper", "look_alikes", "good"), "paper, look_alikes, good.", shown="all"
    )
    measurements: int = option(15, "Number of measurements B in a step, of all robots together.")
    length: float = option(100.0, "Length of each robot's path [m].")

    def check(self) -> None:
        """Refuse what no trial can be."""
        from training.bench.accuracy.world import check_crossings

        self.error_trials()
        self.time_trials()
        check_crossings(max(self.robots))

    def error_trials(self) -> list["ErrorTrial"]:
        """Return the trials of the map error, those on the same run in a row, seed by seed."""
        from training.paper.fig6.trials import BOUND, FEW, REGIMES, ErrorTrial

        return [
            ErrorTrial(name, proposal, robots, particles, self.measurements, self.length, seed)
            for seed, name, robots in product(range(self.seed, self.seed + self.seeds), self.regimes, self.robots)
            for proposal in REGIMES[name].proposals
            for particles in ((0,) if proposal == BOUND else self.particles)
            if particles in FEW or proposal == BOUND or not REGIMES[name].few
        ]

    def time_trials(self) -> list["TimeTrial"]:
        """Return the trials of the time per step, seed by seed; none without the paper's regime."""
        from training.paper.fig6.trials import TimeTrial

        seeds = range(self.seed, self.seed + self.seeds) if "paper" in self.regimes else ()
        return [
            TimeTrial(self.robots, particles, self.measurements, self.length, seed)
            for seed, particles in product(seeds, self.particles)
        ]
