"""`vslam bench train`: where the time of a training goes, and what workers gain."""

from collections.abc import Callable, Mapping
from typing import Any

from rich.console import Console

from training.bench.config import TrainBenchConfig
from training.bench.train.timing import (
    ADAPTER_ALONE,
    CLOCK,
    Part,
    Recording,
    WorkerTimes,
    record,
    summarise_workers,
    time_adapter,
    time_learner,
    time_workers,
)
from training.experiments.statistics import shown
from training.experiments.tables import console_table, number
from training.experiments.timing import describe_machine, print_caveats, run_in_turn

TRIALS = 4
WORKER_HEADINGS = ("workers", "median", "fastest", "mean", "times one", "balance", "work", "beside us")
LEGEND = (
    "By the processors' own time: balance is the mean worker's over the slowest one's, work that of all beside one "
    "worker. A step that nobody interrupts gains workers x balance / work. Beside us: what else a decision takes."
)


def run_bench(
    config: TrainBenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Time the parts of a training, then the environments alone over workers.

    Returns:
        `parts` of a training in one process, `workers` in the order asked for, `machine`, and `complete`.
    """
    result: dict[str, Any] = {"machine": describe_machine()}
    recordings: list[Recording] = []
    parts: list[Part] = []
    times: list[WorkerTimes] = []
    slots = config.envs * config.robots
    asked = (config.environment(), config.envs, config.workers, config.steps, config.seed)
    trials: list[tuple[str, Callable[[], None]]] = [
        ("recording", lambda: recordings.append(record(config.environment(), config.seed))),
        ("adapter", lambda: parts.extend(time_adapter(recordings[0], config.envs))),
        ("learner", lambda: parts.extend(time_learner(recordings[0], config.training()))),
        ("workers", lambda: times.extend(time_workers(*asked))),
    ]
    result["complete"] = run_in_turn(trials, on_trial, should_stop)
    for each in times:
        if each.workers == 0:
            environment = Part.of("environment", each.spent[:, 0, CLOCK], slots)
            parts[:0] = [environment, Part.of("adapter, between steps", each.beside, slots)]
    return result | {"parts": [part._asdict() for part in parts], "workers": summarise_workers(times, slots)}


def print_result(console: Console, result: Mapping[str, Any]) -> None:
    """Print both tables."""
    total = sum(part["median_us"] for part in result["parts"] if part["name"] != ADAPTER_ALONE)
    rows = []
    for part in result["parts"]:
        share = "" if part["name"] == ADAPTER_ALONE else f"{100.0 * part['median_us'] / total:.1f} %"
        rows.append((part["name"], f"{part['median_us']:.1f}", f"{part['min_us']:.1f}", share))
    headings = ("part", "median us", "least us", "share")
    console.print(console_table("A decision of a robot, in one process", headings, rows))
    if result["workers"]:
        cells = []
        for row in result["workers"]:
            rates = (f"{row[name]:,.0f}" for name in ("per_second", "best_per_second", "mean_per_second"))
            shares = shown(row, "gain", 2), f"{row['balance']:.2f}", number(row["work"])
            cells.append((str(row["workers"]), *rates, *shares, f"{row['beside_us']:.0f}"))
        console.print(console_table("Environments alone, decisions per second", WORKER_HEADINGS, cells))
        console.print(LEGEND)
    print_caveats(console, result)
