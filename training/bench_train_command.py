"""The command `vslam bench train`: where the time of a training goes, and what worker processes gain."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer
from rich.console import Console

from training.bench_filter_command import parse_counts
from training.command_options import Config, Json, finish, gather
from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench_train import TrainBenchConfig, TrainBenchResult

COMMAND = "bench train"


def bench_train(
    world: Annotated[str | None, typer.Option(help="A family or a path.", show_default="office")] = None,
    robots: Annotated[int | None, typer.Option(help="How many, 1 to 8.", show_default="3")] = None,
    envs: Annotated[int | None, typer.Option(help="Environments side by side.", show_default="4")] = None,
    workers: Annotated[
        str | None, typer.Option(help="Numbers of processes, 0: this one.", show_default="0,1,2")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Timed per number of workers.", show_default="40")] = None,
    seed: Annotated[int | None, typer.Option(help="Of the episodes.", show_default="100")] = None,
    out: Annotated[
        Path | None, typer.Option(help="New run folder.", show_default="the next runs/bench-train-*")
    ] = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Time environment, adapter, network and update per decision of a robot, and the environments over workers."""
    from training.learn_extra import need_learner

    need_learner()
    from training.bench_train import TrainBenchConfig
    from training.run_folder import RunFolder, plain

    given = {
        "world": world,
        "robots": robots,
        "envs": envs,
        "workers": None if workers is None else parse_counts("workers", workers),
        "steps": steps,
        "seed": seed,
    }
    chosen = TrainBenchConfig.from_mapping(gather(COMMAND, given, config, json, out))
    folder = RunFolder.create(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    result = _run_live(console, chosen)
    _print(console, result)
    finish(console, folder, folder.write_metrics(plain(result.to_mapping())), json)


def _run_live(console: Console, config: "TrainBenchConfig") -> "TrainBenchResult":
    """Run the trials under a progress bar, all libraries on one thread; Ctrl-C ends them after the running one."""
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn
    from threadpoolctl import threadpool_limits

    from training.bench_train import count_trials, run_bench
    from training.interrupt import interrupt_flag

    columns = (TextColumn("{task.description}"), BarColumn(20), TimeElapsedColumn())
    with (
        threadpool_limits(1),
        interrupt_flag() as interrupted,
        # Drawn between the trials only, so that no other thread of this process works while something is timed.
        Progress(*columns, console=console, transient=True, auto_refresh=False) as progress,
    ):
        task = progress.add_task("", total=count_trials(config))

        def on_trial(name: str) -> None:
            progress.update(task, description=name, advance=1)
            progress.refresh()

        return run_bench(config, on_trial, interrupted)


def _print(console: Console, result: "TrainBenchResult") -> None:
    """Print both tables and the goals."""
    from rich.table import Table

    from training.filter_tables import BUSY

    table = Table("part", title="A decision of a robot, in one process", title_justify="left")
    for column in ("median us", "least us", "share"):
        table.add_column(column, justify="right")
    total = sum(part.median_us for part in result.parts)
    for part in result.parts:
        table.add_row(
            part.name, f"{part.median_us:.1f}", f"{part.min_us:.1f}", f"{100.0 * part.median_us / total:.1f} %"
        )
    console.print(table)
    table = Table("workers", title="Environments alone", title_justify="left")
    for column in ("decisions/s", "of the fastest step"):
        table.add_column(column, justify="right")
    for row in result.workers:
        table.add_row(str(row.workers), f"{row.per_second:,.0f}", f"{row.best_per_second:,.0f}")
    console.print(table)
    for goal in result.goals():
        sign = ">=" if goal["at_least"] else "<="
        verdict = f"goal {sign} {goal['goal']:g}: {'met' if goal['met'] else 'missed'}"
        console.print(f"{goal['name']}: {goal['measured']:.3g}, {verdict}", highlight=False)
    load = result.machine["load_before"]
    if load is not None and load > BUSY:
        console.print(f"The machine was busy (load {load:.1f}): times may be too long.", highlight=False)
    if not result.complete:
        console.print("Stopped early: the tables hold what was timed until then.", highlight=False)
