"""The command `vslam bench alignment`: options, live progress, tables, and the run folder."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from training.command_options import Config, Json, finish, gather
from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench_alignment import AlignmentBenchConfig
    from training.run_folder import RunFolder


def bench_alignment(
    methods: Annotated[
        str | None, typer.Option(help="Of ransac, svd, icp, impicp, gnc, clique.", show_default="all")
    ] = None,
    seeds: Annotated[int | None, typer.Option(help="Trials of each cell of the grid.", show_default="500")] = None,
    hard: Annotated[int | None, typer.Option(help="Trials of each hard set.", show_default="1000")] = None,
    first_seed: Annotated[int | None, typer.Option(help="The first seed.", show_default="0")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="10 trials of each cell, 45 of each hard set.")] = False,
    check: Annotated[bool, typer.Option("--check", help="Exit with status 1 unless ransac meets all goals.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder: a new one, or that of a bench to go on with.", show_default="the next in runs"),
    ] = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Success, error over the Cramer-Rao bound and time of all alignment methods, on pairs of simulated maps.

    A grid over the share of common landmarks and of wrong look-alikes; U: maps that must not be aligned; I: maps that
    just can be. One process, one thread, so that times count. Ctrl-C ends the bench after the trial under way and sums
    up what there is; the same command with --out FOLDER goes on from there.
    """
    from training.alignment_summary import check_goals, summarise
    from training.alignment_tables import markdown, print_tables
    from training.bench_alignment import COMMAND, QUICK, AlignmentBenchConfig
    from training.figures_alignment import draw_alignment
    from training.kept_trials import open_folder
    from training.run_folder import plain

    given = {
        "methods": None if methods is None else tuple(word.strip() for word in methods.split(",")),
        "seeds": seeds,
        "hard": hard,
        "seed": first_seed,
    }
    told = (QUICK if quick else {}) | {name: value for name, value in given.items() if value is not None}
    chosen = AlignmentBenchConfig.from_mapping(gather(COMMAND, told, config, json, out))
    folder = open_folder(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    rows = _run_live(console, folder, chosen)
    lines = plain(summarise(rows))
    goals = plain(check_goals(lines, chosen.methods[0]))
    print_tables(console, lines, goals)
    metrics = folder.write_metrics({"summary": lines, "goals": goals, "goals_of": chosen.methods[0]})
    folder.write_text("tables.md", markdown(lines, goals))
    draw_alignment(folder.path / "alignment.png", lines)
    finish(console, folder, metrics, json)
    if check and not (goals and all(goal["met"] for goal in goals)):
        raise typer.Exit(1)


def _run_live(console: Console, folder: "RunFolder", config: "AlignmentBenchConfig") -> list[dict[str, Any]]:
    """Run what is not yet finished under a progress bar; return the rows of all finished trials, in order."""
    from threadpoolctl import threadpool_limits

    from training.alignment_trials import Trial, play
    from training.bench_alignment import TRIALS_FILE
    from training.interrupt import interrupt_flag
    from training.kept_trials import finished_trials, run_trials, trial_of

    trials = config.trials()
    finished = finished_trials(folder, TRIALS_FILE, Trial)
    columns = (
        TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with (
        threadpool_limits(1),
        interrupt_flag() as interrupted,
        Progress(*columns, console=console, refresh_per_second=1) as progress,
    ):
        task = progress.add_task("", total=len(trials), completed=len(finished))

        def on_trial(row: dict[str, Any]) -> None:
            finished[trial_of(row, Trial)] = row
            progress.update(task, advance=1, description=f"{row['kind']} {row['case']}".strip())

        left = [trial for trial in trials if trial not in finished]
        run_trials(folder, TRIALS_FILE, play, left, 1, interrupted, on_trial)
    if len(finished) < len(trials):
        again = f"go on with --out {folder.path}"
        console.print(f"Stopped after {len(finished)} of {len(trials)} trials; {again}.", highlight=False)
    return [finished[trial] for trial in trials if trial in finished]
