"""The accuracy bench: trials over conditions, methods, particles and seeds, each kept as soon as it is finished."""

from dataclasses import dataclass

from slam_backend.core.validation import check_int
from training.bench.accuracy.trials import FILTERS, PEERS, Trial
from training.experiments.config import PlainConfig, check_each_once

COMMAND = "bench accuracy"
TRIALS_FILE = "trials.jsonl"


@dataclass(frozen=True, slots=True, kw_only=True)
class AccuracyConfig(PlainConfig):
    """All that decides a bench: each combination of the lists is tried on each seed.

    Attributes:
        presets: Of the noise, keys of `stereo_runs.PRESETS`.
        associations: "known", "unknown" or both.
        robots: Numbers of robots.
        lengths: Of each robot's path [m].
        methods: Of `accuracy_trials.METHODS`.
        particles: Numbers of particles of the filters.
        seeds: How many.
        seed: The first of them.
        noise_factor: What filters multiply the true variance of the measurements by.
        landmark_noise: Of filters [m], see `FilterOptions`.
    """

    presets: tuple[str, ...] = ("good",)
    associations: tuple[str, ...] = ("known",)
    robots: tuple[int, ...] = (1,)
    lengths: tuple[float, ...] = (100.0,)
    methods: tuple[str, ...] = (*PEERS, "fastslam1", "fastslam2")
    particles: tuple[int, ...] = (10, 30, 100, 300, 1000)
    seeds: int = 16
    seed: int = 0
    noise_factor: float = 1.0
    landmark_noise: float | None = None

    def __post_init__(self) -> None:
        check_int("seeds", self.seeds, 1, "Run at least one seed.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        for name in ("presets", "associations", "robots", "lengths", "methods", "particles"):
            check_each_once(name, getattr(self, name))
        self.trials()  # refuses what no trial can be

    def trials(self) -> list[Trial]:
        """Return all trials, those on the same run in a row."""
        return [
            Trial(
                preset=preset, association=association, robots=robots, length=float(length), method=method,  # type: ignore[arg-type]
                particles=particles, seed=seed, noise_factor=float(self.noise_factor),
                landmark_noise=self.landmark_noise,
            )
            for seed in range(self.seed, self.seed + self.seeds)
            for preset in self.presets
            for association in self.associations
            for robots in self.robots
            for length in self.lengths
            for method in self.methods
            for particles in (self.particles if method in FILTERS else (0,))
        ]  # fmt: skip
