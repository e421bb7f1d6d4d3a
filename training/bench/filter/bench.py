"""`BenchConfig`: what `vslam bench filter` times; `run_bench`: its trials, one after the other."""

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

from slam_backend.core.validation import check_choice, check_int
from slam_backend.fastslam.options import PROPOSALS
from training.bench.filter.compile_time import time_compilation
from training.bench.filter.trials import Row, time_row, time_state
from training.bench.filter.workload import FilterLoad, Proposal
from training.experiments.config import PlainConfig, check_each_once
from training.experiments.step_timing import Timing
from training.experiments.timed_bench import describe_machine

STATE_LOAD = FilterLoad(particles=100, landmarks=300, measurements=15)
LARGE_LOADS = [FilterLoad(particles=10_000, landmarks=n, measurements=15) for n in (300, 1000)]
LARGE_STEPS = 60


@dataclass(frozen=True, slots=True, kw_only=True)
class BenchConfig(PlainConfig):
    """All that decides the benchmark; rows are all combinations of the numbers given.

    Attributes:
        particles: M.
        landmarks: N.
        measurements: B, of all robots together.
        robots: K.
        proposals: Of the filter.
        lookalikes: So many landmarks share one descriptor.
        steps: Timed steps per row.
        large: Also 10,000 particles with 300 and 1,000 landmarks each.
        compile: Also the compilation of the kernels.
        seed: Of all random draws.
    """

    particles: tuple[int, ...] = (100, 1000)
    landmarks: tuple[int, ...] = (100, 300, 1000)
    measurements: tuple[int, ...] = (5, 15)
    robots: tuple[int, ...] = (1, 2, 3)
    proposals: tuple[Proposal, ...] = ("fastslam1", "fastslam2")
    lookalikes: int = 1
    steps: int = 300
    large: bool = False
    compile: bool = False
    seed: int = 0

    def __post_init__(self) -> None:
        check_int("steps", self.steps, 1, "Time at least one step.")
        for name in ("particles", "landmarks", "measurements", "robots", "proposals"):
            check_each_once(name, getattr(self, name))
        for proposal in self.proposals:
            check_choice("proposals", proposal, PROPOSALS)
        self.loads()

    def loads(self) -> list[FilterLoad]:
        """Return what is timed, row by row."""
        numbers = product(self.proposals, self.particles, self.landmarks, self.measurements, self.robots)
        common = {"lookalikes": self.lookalikes, "seed": self.seed}
        rows = [
            FilterLoad(proposal=p, particles=m, landmarks=n, measurements=b, robots=k, **common)
            for p, m, n, b, k in numbers
        ]
        large = [replace(load, proposal=p, **common) for p in self.proposals for load in LARGE_LOADS]
        return rows + large if self.large else rows


@dataclass(frozen=True, slots=True, eq=False)
class BenchResult:
    """What was measured.

    Attributes:
        machine: As `describe_machine` tells.
        rows: In the order of the loads; fewer where the user stopped.
        state: Of `get_state` and `set_state`; none where the user stopped.
        compilation: As `time_compilation` tells, or None.
        complete: Whether nothing is missing.
    """

    machine: dict[str, Any]
    rows: tuple[Row, ...]
    state: dict[str, Timing]
    compilation: dict[str, Any] | None
    complete: bool

    def find(self, **numbers: Any) -> Row | None:
        """Return the first row whose load has these numbers."""
        found = (row for row in self.rows if all(getattr(row.load, k) == v for k, v in numbers.items()))
        return next(found, None)

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "machine": self.machine,
            "rows": [row.to_mapping() for row in self.rows],
            "state": {name: asdict(timing) for name, timing in self.state.items()},
            "compilation": self.compilation,
            "complete": self.complete,
        }


def run_bench(
    config: BenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> BenchResult:
    """Run all trials, or those until `should_stop`.

    Args:
        config: What to time.
        on_trial: Called with each trial's name before it begins; there are `count_trials(config)`.
        should_stop: Asked before each trial.
    """
    left_out: list[str] = []

    def goes_on(trial: str) -> bool:
        if should_stop():
            left_out.append(trial)
            return False
        on_trial(trial)
        return True

    machine = describe_machine()
    rows = [time_row(load, _steps(config, load)) for load in config.loads() if goes_on(_name(load))]
    state = time_state(STATE_LOAD) if goes_on("get_state, set_state") else {}
    compilation = time_compilation() if config.compile and goes_on("compilation") else None
    return BenchResult(machine, tuple(rows), state, compilation, not left_out)


def count_trials(config: BenchConfig) -> int:
    """Return how often `run_bench` calls `on_trial`."""
    return 1 + len(config.loads()) + config.compile


def _steps(config: BenchConfig, load: FilterLoad) -> int:
    """Return how many steps are timed."""
    return min(config.steps, LARGE_STEPS) if load.particles >= LARGE_LOADS[0].particles else config.steps


def _name(load: FilterLoad) -> str:
    """Name a load for the progress bar."""
    return f"{load.proposal} M={load.particles} N={load.landmarks} B={load.measurements} K={load.robots}"
