"""The command `vslam bench filter`: how fast the filter is, on this machine, beside the plain reference and bounds."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench_filter import BenchConfig, BenchResult

COMMAND = "bench filter"
QUICK: dict[str, Any] = {"measurements": (15,), "robots": (1,), "steps": 100, "plain": False}


def bench_filter(
    particles: Annotated[
        str | None, typer.Option(help="Numbers M with commas between.", show_default="100,1000")
    ] = None,
    landmarks: Annotated[
        str | None, typer.Option(help="Numbers N, all held by all particles.", show_default="100,300,1000")
    ] = None,
    measurements: Annotated[
        str | None, typer.Option(help="Numbers B, of all robots together.", show_default="5,15")
    ] = None,
    robots: Annotated[str | None, typer.Option(help="Numbers K.", show_default="1,2,3")] = None,
    lookalikes: Annotated[
        int | None, typer.Option(help="So many landmarks share one descriptor.", show_default="1")
    ] = None,
    steps: Annotated[int | None, typer.Option(help="Timed steps per row.", show_default="300")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="B=15, K=1, 100 steps, no plain reference.")] = False,
    large: Annotated[
        bool | None, typer.Option(help="Also 10,000 particles with 300 and 1,000 landmarks.", show_default="no-large")
    ] = None,
    plain: Annotated[bool | None, typer.Option(help="Also the plain reference.", show_default="plain")] = None,
    compilation: Annotated[
        bool | None,
        typer.Option("--compile/--no-compile", help="Also compiling into an empty cache.", show_default="no-compile"),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of all random draws.", show_default="0")] = None,
    out: Annotated[
        Path | None, typer.Option(help="New run folder.", show_default="the next runs/bench-filter-*")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures to this file too.", show_default=False)] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="config.toml of an earlier run to repeat; other options override it.", show_default=False),
    ] = None,
) -> None:
    """Time steps of the filter over particles, landmarks, measurements and robots, on one thread."""
    from training.bench_filter import BenchConfig
    from training.figures_filter import draw_speed
    from training.filter_goals import goals_of
    from training.filter_tables import print_result
    from training.run_folder import RunFolder, check_writable, read_config, to_json, write_whole
    from training.run_folder import plain as to_plain

    if json is not None and json.parent != out:  # the run's own folder does not exist yet
        check_writable(json, "json")
    values: dict[str, Any] = {}
    if config is not None:
        values, values["seed"] = read_config(config, COMMAND)
    lists = {"particles": particles, "landmarks": landmarks, "measurements": measurements, "robots": robots}
    given = {name: None if text is None else parse_counts(name, text) for name, text in lists.items()} | {
        "lookalikes": lookalikes,
        "steps": steps,
        "large": large,
        "plain": plain,
        "compile": compilation,
        "seed": seed,
    }
    values |= QUICK if quick else {}
    chosen = BenchConfig.from_mapping(values | {name: value for name, value in given.items() if value is not None})
    folder = RunFolder.create(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    result = _run_live(console, chosen)
    goals = goals_of(result)
    print_result(console, result, goals)
    metrics = folder.write_metrics(to_plain(result.to_mapping() | {"goals": [goal.to_mapping() for goal in goals]}))
    draw_speed(folder.path / "speed.png", result)
    if json is not None:
        write_whole(json, to_json(metrics), "json")
    console.print(f"Run folder: {folder.path}", soft_wrap=True, highlight=False)


def parse_counts(name: str, text: str) -> tuple[int, ...]:
    """Return the numbers of a text such as `100,1000`.

    Raises:
        ValueError: If it is none; the message names the argument `name`.
    """
    from slam_backend.errors import bad_argument

    words = text.split(",")
    if not all(word.strip().isdecimal() for word in words):
        raise bad_argument(name, "numbers with commas between", repr(text), "Write them like 100,1000.")
    return tuple(int(word) for word in words)


def _run_live(console: Console, config: "BenchConfig") -> "BenchResult":
    """Run the trials under a progress bar, all libraries on one thread; Ctrl-C ends them after the running one."""
    from threadpoolctl import threadpool_limits

    from training.bench_filter import count_trials, run_bench
    from training.interrupt import interrupt_flag

    columns = (
        TextColumn("{task.description}"), BarColumn(20), TimeElapsedColumn(), TimeRemainingColumn(),
    )  # fmt: skip
    with (
        threadpool_limits(1),
        interrupt_flag() as interrupted,
        # Drawn between the trials only, so that no other thread of this process works while steps are timed.
        Progress(*columns, console=console, transient=True, auto_refresh=False) as progress,
    ):
        task = progress.add_task("", total=count_trials(config))

        def on_trial(name: str) -> None:
            progress.update(task, description=name, advance=1, refresh=True)

        return run_bench(config, on_trial, interrupted)
