"""The commands `vslam paper ...`: figures of the paper, computed anew."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from training.command_options import Config, Json, Out, Seed, finish, gather
from training.compiling import prepare

if TYPE_CHECKING:  # what computes is imported when the command runs, so that --help answers at once
    from training.paper_fig6 import Fig6Config
    from training.run_folder import RunFolder

paper = typer.Typer(help="Compute figures of the paper anew.", no_args_is_help=True)


class _Part(NamedTuple):
    """Trials of one kind: what they are called, where they are kept, how they run."""

    name: str
    file: str
    kind: Any
    play: Any
    trials: Any
    processes: int


@paper.command("fig6")
def fig6(
    seeds: Annotated[int | None, typer.Option(help="How many.", show_default="20")] = None,
    first_seed: Annotated[int | None, typer.Option(help="The first of them.", show_default="0")] = None,
    particles: Annotated[
        str | None, typer.Option(help="Numbers M with commas between.", show_default="the paper's eleven, 1 to 2000")
    ] = None,
    robots: Annotated[str | None, typer.Option(help="Numbers K.", show_default="1,2,3")] = None,
    regimes: Annotated[str | None, typer.Option(help="paper, look_alikes, good.", show_default="all")] = None,
    measurements: Annotated[
        int | None, typer.Option(help="Number B in a step, of all robots together.", show_default="15")
    ] = None,
    length: Annotated[float | None, typer.Option(help="Metres that each robot drives.", show_default="100")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="3 seeds, M = 1, 10, 100, and 25 m.")] = False,
    jobs: Annotated[int, typer.Option(help="Processes for the map errors; times are measured in one.")] = 1,
    check: Annotated[bool, typer.Option("--check", help="Exit with status 1 unless all claims hold.")] = False,
    out: Annotated[
        Path | None,
        typer.Option(help="Run folder: a new one, or that of a run to go on with.", show_default="the next in runs"),
    ] = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 6: time of a step, and map error, of one to three robots that share B measurements.

    The filter is the paper's (`fastslam1`, unknown association, resampling at random at every step), the noise large
    against the odometry; beside it look-alikes with false points, and good stereo with both proposals, for
    M = 10, 100, 1000. The paper's claims are asked of the data. Ctrl-C finishes the trial under way and sums up what
    there is; the same command with --out FOLDER goes on from there.
    """
    from slam_backend.errors import check_int
    from training.bench_filter_command import parse_counts
    from training.figures_fig6 import draw_fig6
    from training.kept_trials import open_folder
    from training.paper_claims import check_claims, robots_ratios
    from training.paper_fig6 import COMMAND, QUICK, Fig6Config
    from training.paper_summary import summarise, to_csv
    from training.paper_tables import print_result
    from training.run_folder import plain

    check_int("jobs", jobs, 1, "Use one process or more.")
    given = {
        "particles": None if particles is None else parse_counts("particles", particles),
        "robots": None if robots is None else parse_counts("robots", robots),
        "regimes": None if regimes is None else tuple(word.strip() for word in regimes.split(",")),
        "measurements": measurements,
        "length": length,
        "seeds": seeds,
        "seed": first_seed,
    }
    told = (QUICK if quick else {}) | {name: value for name, value in given.items() if value is not None}
    chosen = Fig6Config.from_mapping(gather(COMMAND, told, config, json, out))
    folder = open_folder(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    errors, times = _run_live(console, folder, chosen, jobs)
    lines, ratios, claims = plain(summarise(errors, times)), plain(robots_ratios(errors)), check_claims(errors, times)
    print_result(console, lines, ratios, claims)
    held = [claim.to_mapping() for claim in claims]
    metrics = folder.write_metrics({"summary": lines, "robots_ratios": ratios, "claims": held})
    folder.write_text("fig6.csv", to_csv(lines))
    if lines:
        draw_fig6(folder.path / "fig6.png", lines)
    finish(console, folder, metrics, json)
    if check and not (claims and all(claim.holds for claim in claims)):
        raise typer.Exit(1)


def _run_live(
    console: Console, folder: "RunFolder", config: "Fig6Config", jobs: int
) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Run what is not yet finished under a progress bar; return all finished rows, errors and times, in order."""
    from threadpoolctl import threadpool_limits

    from training.interrupt import interrupt_flag
    from training.kept_trials import finished_trials, run_trials, trial_of
    from training.paper_fig6 import ERRORS_FILE, TIMES_FILE, cost
    from training.paper_trials import ErrorTrial, TimeTrial, play_error, play_time

    parts = (
        _Part("map errors", ERRORS_FILE, ErrorTrial, play_error, config.error_trials(), jobs),
        _Part("times", TIMES_FILE, TimeTrial, play_time, config.time_trials(), 1),
    )
    rows: list[list[dict[str, Any]]] = []
    missing = 0
    columns = (
        TextColumn("{task.description}"), BarColumn(20), TaskProgressColumn(), TimeElapsedColumn(),
        TimeRemainingColumn(),
    )  # fmt: skip
    with (
        threadpool_limits(1),
        interrupt_flag() as interrupted,
        # Drawn between the trials only, so that no other thread of this process works while steps are timed.
        Progress(*columns, console=console, auto_refresh=False) as progress,
    ):
        kept = [finished_trials(folder, part.file, part.kind) for part in parts]
        total = sum(cost(trial) for part in parts for trial in part.trials)
        task = progress.add_task("", total=total, completed=sum(cost(trial) for found in kept for trial in found))
        for part, found in zip(parts, kept, strict=True):

            def on_trial(row: dict[str, Any], part: _Part = part, found: dict[Any, Any] = found) -> None:
                trial = trial_of(row, part.kind)
                found[trial] = row
                shown = f"{part.name}: seed {trial.seed}, M={trial.particles}"
                progress.update(task, advance=cost(trial), description=shown, refresh=True)

            left = [trial for trial in part.trials if trial not in found]
            run_trials(folder, part.file, part.play, left, part.processes, interrupted, on_trial)
            rows.append([found[trial] for trial in part.trials if trial in found])
            missing += len(part.trials) - len(rows[-1])
    if missing:
        console.print(f"Stopped, {missing} trials missing; go on with --out {folder.path}.", highlight=False)
    return rows[0], rows[1]


@paper.command("fig1")
def fig1(
    seed: Seed = None,
    robots: Annotated[int | None, typer.Option(help="How many.", show_default="3")] = None,
    particles: Annotated[int | None, typer.Option(help="Of each cloud.", show_default="400")] = None,
    length: Annotated[float | None, typer.Option(help="Metres that each robot drives.", show_default="30")] = None,
    every: Annotated[float | None, typer.Option(help="Metres between two clouds.", show_default="5")] = None,
    out: Out = None,
    json: Json = None,
    config: Config = None,
) -> None:
    """Fig. 1: clouds of particles along the paths of three robots, by odometry alone and with what they see."""
    from training.figures_fig1 import draw_fig1
    from training.paper_fig1 import COMMAND, Fig1Config, draw_clouds, figures_of, simulate_fig1
    from training.run_folder import RunFolder

    given = {"seed": seed, "robots": robots, "particles": particles, "length": length, "every": every}
    chosen = Fig1Config.from_mapping(gather(COMMAND, given, config, json, out))
    folder = RunFolder.create(out, COMMAND, chosen.to_mapping(), chosen.seed)
    prepare()
    console = Console()
    run = simulate_fig1(chosen)
    moved, measured = (draw_clouds(run, chosen, with_measurements) for with_measurements in (False, True))
    panels = [("motion model alone (Eq. 4)", "odometry", moved), ("with measurements", "estimate", measured)]
    draw_fig1(folder.path / "fig1.png", run, panels)
    found = {"odometry": figures_of(run, moved), "measurements": figures_of(run, measured)}
    for name, rows in found.items():
        for robot, row in enumerate(rows, 1):
            text = f"robot {robot}, {name}: path RMS {row['path_rms_m']:.2f} m, at the end off by"
            console.print(f"{text} {row['end_error_m']:.2f} m, spread {row['end_spread_m']:.2f} m", highlight=False)
    metrics = folder.write_metrics(found)
    finish(console, folder, metrics, json)
