"""`AlignmentBenchConfig`: what `vslam bench alignment` tries."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any, Self

from slam_backend.alignment import METHODS
from slam_backend.errors import bad_argument, check_choice, check_int
from training.alignment_trials import Trial, cases

COMMAND = "bench alignment"
TRIALS_FILE = "trials.jsonl"
# (overlap, outliers): with 200 landmarks of each map, 20 true pairs leave room for 180 wrong ones, 200 for none.
GRID = (
    (1.0, 0.0), (0.5, 0.0), (0.5, 0.5), (0.25, 0.0), (0.25, 0.5), (0.25, 0.75), (0.1, 0.0), (0.1, 0.5), (0.1, 0.8),
    (0.1, 0.9),
)  # fmt: skip
QUICK = {"seeds": 10, "hard": 45}


@dataclass(frozen=True, slots=True, kw_only=True)
class AlignmentBenchConfig:
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
        object.__setattr__(self, "methods", tuple(self.methods))
        if not self.methods or len(set(self.methods)) < len(self.methods):
            raise bad_argument("methods", "at least one, each once", list(self.methods), "Correct the list.")
        for method in self.methods:
            check_choice("methods", method, METHODS)

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> Self:
        """Build a config from plain values, as `to_mapping` gives them; unknown names are refused."""
        known = list(cls.__dataclass_fields__)
        for name in values:
            if name not in known:
                raise bad_argument("config", "one of " + ", ".join(known), name, "Correct the name in the file.")
        return cls(**values)

    def to_mapping(self) -> dict[str, Any]:
        """Return the plain values that repeat this bench, the first seed apart."""
        return {name: value for name, value in asdict(self).items() if name != "seed"}

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
