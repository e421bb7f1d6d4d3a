"""`AlignmentBenchConfig`: what `vslam bench alignment` tries."""

from dataclasses import dataclass

from slam_backend.core.validation import check_choice, check_int
from slam_backend.maps.alignment import METHODS
from training.bench.alignment.trials import Trial, cases
from training.experiments.config import PlainConfig, check_each_once

COMMAND = "bench alignment"
TRIALS_FILE = "trials.jsonl"
# (overlap, outliers): with 200 landmarks of each map, 20 true pairs leave room for 180 wrong ones, 200 for none.
GRID = (
    (1.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.25, 0.0), (0.25, 0.5), (0.25, 0.75), (0.1, 0.0), (0.1, 0.5), (0.1, 0.8),
    (0.1, 0.9),
)  # fmt: skip
QUICK = {"seeds": 10, "hard": 45}


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentBenchConfig(PlainConfig):
    """All that decides the benchmark.

    Attributes:
        methods: Of `align_maps`.
        seeds: Trials of each cell of the grid and method.
        hard: Trials of each of the sets U and I and method, spread evenly over their cases.
        seed: The first one.
    """

    methods: tuple[str, ...] = METHODS
    seeds: int = 500
    hard: int = 1000
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("seeds", self.seeds, 1, "Try each cell at least once.")
        check_int("hard", self.hard, 0, "Use 0 to leave the hard sets out.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        check_each_once("methods", self.methods)
        for method in self.methods:
            check_choice("methods", method, METHODS)

    def trials(self) -> list[Trial]:
        """Return all trials, those on the same maps in a row."""
        grid = [
            Trial(kind="grid", case="", overlap=overlap, outliers=outliers, method=method, seed=seed)
            for overlap, outliers in GRID
            for seed in range(self.seed, self.seed + self.seeds)
            for method in self.methods
        ]
        hard = [
            Trial(
                kind=kind, case=cases(kind)[i % len(cases(kind))], overlap=0.0, outliers=0.0, method=method,
                seed=self.seed + i,
            )
            for kind in ("U", "I")
            for i in range(self.hard)
            for method in self.methods
        ]  # fmt: skip
        return grid + hard
