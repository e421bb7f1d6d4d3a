"""The commands `vslam bench ...`: how good, and how fast, the filter is."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench_accuracy import AccuracyConfig
    from training.run_folder import RunFolder

bench = typer.Typer(help="Measure the backend.", no_args_is_help=True)


@bench.command("accuracy")
def bench_accuracy(
    seeds: Annotated[int | None, typer.Option(help="How many.", show_default="16")] = None,
    first_seed: Annotated[int | None, typer.Option(help="The first of them.", show_default="0")] = None,
    preset: Annotated[str | None, typer.Option(help="good, coarse or paper noise.", show_default="good")] = None,
    association: Annotated[str | None, typer.Option(help="known or unknown.", show_default="known")] = None,
    robots: Annotated[str | None, typer.Option(help="How many share a map.", show_default="1")] = None,
    length: Annotated[str | None, typer.Option(help="Metres that each robot drives.", show_default="100")] = None,
    methods: Annotated[
        str | None,
        typer.Option(
            help="dead_reckoning, batch_ml, ideal_online, fastslam1, fastslam2, fastslam2+existence, "
            "fastslam2+rejuvenation.",
            show_default="all but the last two",
        ),
    ] = None,
    particles: Annotated[str | None, typer.Option(help="Per filter.", show_default="10,30,100,300,1000")] = None,
    processes: Annotated[int, typer.Option(help="At a time.")] = 1,
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder: a new one, or that of a bench to go on with.", show_default="the next in runs"),
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write all figures to this file too.", show_default=False)] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="config.toml of an earlier bench to repeat; other options override it.", show_default=False),
    ] = None,
) -> None:
    """How far filters are from the truth on simulated stereo runs, beside dead reckoning and what could be reached.

    Options in the singular take several values with commas between; all combinations are tried. Ctrl-C finishes the
    trial under way and sums up what there is; the same command with --out FOLDER goes on from there.
    """
    from slam_backend.errors import check_int
    from training.accuracy_summary import check_goals, summarise
    from training.accuracy_tables import markdown, print_tables
    from training.bench_accuracy import COMMAND, AccuracyConfig, open_folder
    from training.figures_accuracy import draw_accuracy
    from training.run_folder import check_writable, plain, read_config, to_json, write_whole

    if json is not None and json.parent != out:  # the run's own folder may not exist yet
        check_writable(json, "json")
    check_int("processes", processes, 1, "Use one process or more.")
    values: dict[str, Any] = {}
    if config is not None:
        values, values["seed"] = read_config(config, COMMAND)
    given = {
        "presets": _words(preset),
        "associations": _words(association),
        "robots": _numbers("robots", robots),
        "lengths": _numbers("length", length, float),
        "methods": _words(methods),
        "particles": _numbers("particles", particles),
        "seeds": seeds,
        "seed": first_seed,
    }
    chosen = AccuracyConfig.from_mapping(values | {name: value for name, value in given.items() if value is not None})
    folder = open_folder(out, chosen)
    prepare()
    console = Console()
    rows = _run_live(console, folder, chosen, processes)
    lines, goals = plain(summarise(rows)), plain(check_goals(rows))
    print_tables(console, lines, goals)
    metrics = folder.write_metrics({"summary": lines, "goals": goals, "trials": rows})
    folder.write_text("tables.md", markdown(lines, goals))
    if lines:
        draw_accuracy(folder.path / "accuracy.png", lines)
    if json is not None:
        write_whole(json, to_json(metrics), "json")
    console.print(f"Run folder: {folder.path}", soft_wrap=True, highlight=False)


def _run_live(
    console: Console, folder: "RunFolder", config: "AccuracyConfig", processes: int
) -> list[dict[str, Any]]:
    """Run what is not yet finished under a progress bar; return the rows of all finished trials, in order."""
    from training.accuracy_trials import Trial
    from training.bench_accuracy import finished_trials, run_trials
    from training.interrupt import interrupt_flag

    trials = config.trials()
    finished = finished_trials(folder)
    columns = (
        TextColumn("[progress.description]{task.description}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with interrupt_flag() as interrupted, Progress(*columns, console=console) as progress:
        task = progress.add_task("trials", total=len(trials), completed=len(finished))

        def on_trial(row: dict[str, Any]) -> None:
            finished[Trial(**{name: row[name] for name in Trial.__dataclass_fields__})] = row
            seen = f"seed {row['seed']}, {row['method']}" + (f" {row['particles']}" if row["particles"] else "")
            progress.update(task, advance=1, description=seen)

        run_trials(folder, [trial for trial in trials if trial not in finished], processes, interrupted, on_trial)
    if len(finished) < len(trials):
        again = f"go on with --out {folder.path}"
        console.print(f"Stopped after {len(finished)} of {len(trials)} trials; {again}.", highlight=False)
    return [finished[trial] for trial in trials if trial in finished]


def _words(text: str | None) -> tuple[str, ...] | None:
    """Return the words of a text with commas between."""
    return None if text is None else tuple(word.strip() for word in text.split(","))


def _numbers(name: str, text: str | None, kind: type = int) -> tuple[Any, ...] | None:
    """Return the numbers of a text with commas between.

    Raises:
        ValueError: If one is none; the message names the option.
    """
    from slam_backend.errors import bad_argument

    if text is None:
        return None
    try:
        return tuple(kind(word) for word in text.split(","))
    except ValueError as error:
        raise bad_argument(name, "numbers with commas between", repr(text), "Write them like 10,100.") from error
