"""Benchmark `vslam bench train`: time of a training by part, and speedup by workers."""

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
from training.experiments.statistics import format_ci
from training.experiments.tables import console_table, number
from training.experiments.timing import describe_machine, print_caveats, run_named_trials

TRIALS = 4
WORKER_HEADINGS = ("workers", "median", "fastest", "mean", "speedup", "balance", "work", "overhead us")
LEGEND = (
    "In processor time: balance is the mean over the slowest worker, work is the total relative to one worker. "
    "An undisturbed step gains workers x balance / work. Overhead us: time of a decision outside the environments."
)


def run_bench(
    config: TrainBenchConfig,
    on_trial: Callable[[str], None] = lambda name: None,
    should_stop: Callable[[], bool] = lambda: False,
) -> dict[str, Any]:
    """Time the parts of a training, then the environments by number of workers.

    Returns:
        `parts` of a training in one process, `workers` in the given order, `machine`, and `complete`.
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
    result["complete"] = run_named_trials(trials, on_trial, should_stop)
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
    headings = ("part", "median us", "min us", "share")
    console.print(console_table("Time of one robot's decision, in one process", headings, rows))
    if result["workers"]:
        cells = []
        for row in result["workers"]:
            rates = (f"{row[name]:,.0f}" for name in ("per_second", "best_per_second", "mean_per_second"))
            shares = format_ci(row, "gain", 2), f"{row['balance']:.2f}", number(row["work"])
            cells.append((str(row["workers"]), *rates, *shares, f"{row['beside_us']:.0f}"))
        console.print(console_table("Environments only, decisions per second", WORKER_HEADINGS, cells))
        console.print(LEGEND)
    print_caveats(console, result)
