"""The command `vslam bench train`: where the time of a training goes, and what worker processes gain."""

from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from training.commands._options import Config, Json, Out, numbers
from training.commands._progress import trials_shown
from training.commands._run_folder import begin, choose, finish

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench.train.bench import TrainBenchResult
    from training.bench.train.workers import WorkerRow

COMMAND = "bench train"
WORKER_HEADINGS = ("workers", "median", "fastest", "mean", "times one", "balance", "work", "beside us")
TOLD = (
    "By the processors' own time: balance is the mean worker's over the slowest one's, work that of all beside one "
    "worker. A step that nobody interrupts gains workers x balance / work. Beside us: what else a decision takes."
)


def bench_train(
    world: Annotated[str | None, typer.Option(help="A family or a path.", show_default="office")] = None,
    robots: Annotated[int | None, typer.Option(help="How many, 1 to 8.", show_default="3")] = None,
    envs: Annotated[int | None, typer.Option(help="Environments side by side.", show_default="16")] = None,
    workers: Annotated[
        str | None, typer.Option(help="Numbers of processes, 0: this one.", show_default="0,1,2")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Timed per number of workers.", show_default="40")] = None,
    seed: Annotated[int | None, typer.Option(help="Of the episodes.", show_default="100")] = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Time environment, adapter, network and update per decision of a robot, and the environments over workers."""
    from training.rl.require_extra import need_learner

    need_learner()
    from training.bench.train.bench import TrainBenchConfig, count_trials, run_bench
    from training.experiments.run_folder import plain

    given = {
        "world": world,
        "robots": robots,
        "envs": envs,
        "workers": numbers("workers", workers),
        "steps": steps,
        "seed": seed,
    }
    chosen = choose(TrainBenchConfig, COMMAND, given, config=config, json=json, out=out)
    console, folder = begin(COMMAND, chosen, out)
    with trials_shown(console, count_trials(chosen)) as (on_trial, interrupted):
        result = run_bench(chosen, on_trial, interrupted)
    _print(console, result)
    metrics = folder.write_metrics(plain(result.to_mapping()))
    finish(console, folder, metrics, json)


def _print(console: Console, result: "TrainBenchResult") -> None:
    """Print both tables."""
    from training.bench.train.timing import ADAPTER_ALONE
    from training.experiments.tables import console_table
    from training.experiments.timed_bench import print_caveats

    total = sum(part.median_us for part in result.parts if part.name != ADAPTER_ALONE)
    rows = [
        (
            part.name,
            f"{part.median_us:.1f}",
            f"{part.min_us:.1f}",
            "" if part.name == ADAPTER_ALONE else f"{100.0 * part.median_us / total:.1f} %",
        )
        for part in result.parts
    ]
    headings = ("part", "median us", "least us", "share")
    console.print(console_table("A decision of a robot, in one process", headings, rows))
    if result.workers:
        told = [_told(row) for row in result.workers]
        console.print(console_table("Environments alone, decisions per second", WORKER_HEADINGS, told))
        console.print(TOLD, highlight=False)
    print_caveats(console, result.machine, result.complete)


def _told(row: "WorkerRow") -> tuple[str, ...]:
    """Return the cells of a number of workers."""
    from dataclasses import asdict

    from training.experiments.statistics import shown
    from training.experiments.tables import number

    return (
        str(row.workers),
        *(f"{rate:,.0f}" for rate in (row.per_second, row.best_per_second, row.mean_per_second)),
        shown(asdict(row), "gain", 2),
        f"{row.balance:.2f}",
        number(row.work),
        f"{row.beside_us:.0f}",
    )
