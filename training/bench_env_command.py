"""The command `vslam bench env`: how fast an environment steps, where the time goes, and a peer beside it."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from training.bench_filter_command import parse_counts
from training.command_options import finish, gather
from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.bench_env import EnvBenchConfig, EnvBenchResult

COMMAND = "bench env"
QUICK: dict[str, Any] = {"robots": (3,), "particles": (100,), "worlds": ("office",), "modes": ("dict",), "steps": 300}


def bench_env(
    robots: Annotated[
        str | None, typer.Option(help="Numbers K with commas between, the base first.", show_default="3,1,2,4,6,8")
    ] = None,
    particles: Annotated[str | None, typer.Option(help="Numbers M.", show_default="100,30,300,1000")] = None,
    worlds: Annotated[
        str | None, typer.Option(help="Families or paths.", show_default="office,fig5,maze,hall,loops")
    ] = None,
    modes: Annotated[str | None, typer.Option(help="Of dict, flat, goal.", show_default="all")] = None,
    steps: Annotated[int | None, typer.Option(help="Timed steps per row.", show_default="600")] = None,
    peer: Annotated[bool | None, typer.Option(help="Also simple_spread of MPE2.", show_default="peer")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="The base alone, 300 steps.")] = False,
    seed: Annotated[int | None, typer.Option(help="Of the episodes.", show_default="100")] = None,
    out: Annotated[
        Path | None, typer.Option(help="New run folder.", show_default="the next runs/bench-env-*")
    ] = None,
    json: Annotated[Path | None, typer.Option(help="Write the figures to this file too.", show_default=False)] = None,
    config: Annotated[
        Path | None,
        typer.Option(help="config.toml of an earlier run to repeat; other options override it.", show_default=False),
    ] = None,
) -> None:
    """Time steps of environments with the filter in the loop, on one thread, and tell where the time goes."""
    from training.bench_env import EnvBenchConfig
    from training.env_tables import print_env_result
    from training.run_folder import RunFolder
    from training.run_folder import plain as to_plain
    from vslam_env import vslam_v0

    given = {
        "robots": None if robots is None else parse_counts("robots", robots),
        "particles": None if particles is None else parse_counts("particles", particles),
        "worlds": None if worlds is None else tuple(word.strip() for word in worlds.split(",")),
        "modes": None if modes is None else tuple(word.strip() for word in modes.split(",")),
        "steps": steps,
        "peer": peer,
        "seed": seed,
    }
    told = (QUICK if quick else {}) | {name: value for name, value in given.items() if value is not None}
    chosen = EnvBenchConfig.from_mapping(gather(COMMAND, told, config, json, out))
    for load in chosen.loads():  # what cannot be built shows before there is a folder
        vslam_v0.parallel_env(config=load.config())
    folder = RunFolder.create(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    result = _run_live(console, chosen)
    print_env_result(console, result, chosen.peer)
    finish(console, folder, folder.write_metrics(to_plain(result.to_mapping())), json)


def _run_live(console: Console, config: "EnvBenchConfig") -> "EnvBenchResult":
    """Run the trials under a progress bar, all libraries on one thread; Ctrl-C ends them after the running one."""
    from threadpoolctl import threadpool_limits

    from training.bench_env import count_trials, run_bench
    from training.interrupt import interrupt_flag

    columns = (TextColumn("{task.description}"), BarColumn(20), TimeElapsedColumn())
    with (
        threadpool_limits(1),
        interrupt_flag() as interrupted,
        # Drawn between the trials only, so that no other thread of this process works while steps are timed.
        Progress(*columns, console=console, transient=True, auto_refresh=False) as progress,
    ):
        task = progress.add_task("", total=count_trials(config))

        def on_trial(name: str) -> None:
            progress.update(task, description=name, advance=1)
            progress.refresh()

        return run_bench(config, on_trial, interrupted)
