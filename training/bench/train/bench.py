"""`TrainBenchConfig`: what `vslam bench train` times; where the time of a training goes, and what workers gain."""

from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

from slam_backend.core.validation import bad_argument, check_int
from training.bench.train.timing import Part, Recording, record, time_adapter, time_learner
from training.bench.train.workers import CLOCK, WorkerRow, WorkerTimes, summarise_workers, time_workers
from training.experiments.config import PlainConfig
from training.experiments.timed_bench import describe_machine, run_in_turn
from training.rl.config import SPLIT_TRAIN, TrainConfig
from vslam_env.config import EnvConfig


@dataclass(frozen=True, slots=True, kw_only=True)
class TrainBenchConfig(PlainConfig):
    """All that decides the benchmark; the environments are those of `vslam train`'s preset `quick`.

    Attributes:
        world: A family or a path.
        robots: K.
        envs: Environments side by side.
        workers: Numbers of processes to time; 0: this one alone.
        steps: Of the environments, timed per number of workers.
        seed: Of the episodes.
    """

    world: str = "office"
    robots: int = 3
    envs: int = 16
    workers: tuple[int, ...] = (0, 1, 2)
    steps: int = 40
    seed: int = 100

    def __post_init__(self) -> None:
        check_int("envs", self.envs, 1, "Use at least one environment.")
        check_int("steps", self.steps, 2, "Time a few steps.")
        check_int("seed", self.seed, 0, "Use 0 or a positive number.")
        for workers in self.workers:
            if not 0 <= check_int("workers", workers, 0, "Use 0 for none.") <= self.envs:
                raise bad_argument("workers", f"at most one per environment, {self.envs}", workers, "Use fewer.")
        self.environment()

    def training(self) -> TrainConfig:
        """Return the training that is timed."""
        return TrainConfig(world=self.world, robots=self.robots, envs=self.envs)

    def environment(self) -> EnvConfig:
        """Return the environments' configuration."""
        return self.training().make_env_config(SPLIT_TRAIN)


@dataclass(frozen=True, slots=True, eq=False)
class TrainBenchResult:
    """What was measured.

    Attributes:
        machine: As `describe_machine` tells.
        parts: Of a training in one process.
        workers: In the order asked for.
        complete: Whether nothing is missing.
    """

    machine: dict[str, Any]
    parts: tuple[Part, ...]
    workers: tuple[WorkerRow, ...]
    complete: bool

    def to_mapping(self) -> dict[str, Any]:
        """Return it as plain values."""
        return {
            "machine": self.machine,
            "parts": [asdict(part) for part in self.parts],
            "workers": [asdict(row) for row in self.workers],
            "complete": self.complete,
        }


def run_bench(
    config: TrainBenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> TrainBenchResult:
    """Time the parts of a training, then the environments alone over workers.

    Args:
        config: What is timed.
        on_trial: Called with the name of each trial before it begins.
        should_stop: Asked between trials.
    """
    machine = describe_machine()
    recordings: list[Recording] = []
    parts: list[Part] = []
    times: list[WorkerTimes] = []
    slots = config.envs * config.robots
    trials: list[tuple[str, Callable[[], None]]] = [
        ("recording", lambda: recordings.append(record(config.environment(), config.seed))),
        ("adapter", lambda: parts.extend(time_adapter(recordings[0], config.envs))),
        ("learner", lambda: parts.extend(time_learner(recordings[0], config.training()))),
    ]
    if config.workers:
        asked = (config.environment(), config.envs, config.workers, config.steps, config.seed)
        trials.append(("workers", lambda: times.extend(time_workers(*asked))))
    complete = run_in_turn(trials, on_trial, should_stop)
    for each in times:
        if each.workers == 0:
            environment = Part.of("environment", each.spent[:, 0, CLOCK], slots)
            parts[:0] = [environment, Part.of("adapter, between steps", each.beside, slots)]
    return TrainBenchResult(machine, tuple(parts), summarise_workers(times, slots), complete)


def count_trials(config: TrainBenchConfig) -> int:
    """Return how often `run_bench` calls `on_trial`."""
    return 3 + bool(config.workers)
